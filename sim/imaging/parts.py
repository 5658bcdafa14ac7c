"""Obstructed light through a wide aperture, part by part: every part of it sees the scene past another obstruction.

The models of `sim.imaging.occlusion` know one PSF of the scene, of the open aperture. A lens that is out of focus, or a
plate of slow waves, sends the light of every part of the aperture elsewhere, and a shadow on one side moves the
picture. Here the aperture is cut into squares k, and the PSF into what each of them sends,

    p_k(u) = Re[F(u)* F_k(u)],    sum of F_k = F,

F_k being the field of the square alone and F that of all: together they are the PSF exactly, whatever plate it is, and
each holds the energy that passes its square. For an obstruction whose transmission changes little from square to
square the light of the shadowed pupil is the sum of t_k p_k, exact for an even shadow and to first order about it;
t_k(u) is the share of the square that scene point u sees freely, by rays. So

    I = sum over k of p_k ∗ (t_k · I_far) + d ∗ (M · I_obs),

with the obstruction's own light spread by the shadow disc d alone: at its distance a plate that acts by some waves is
nothing beside hundreds of waves of defocus. `sim.imaging.shadow` judges it (tests/sim/test_parts.py). Fringes at the
shadow's edge are left out.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.signal
from jaxtyping import Array, Complex, Float

from sim.aperture import open_cells
from sim.camera import Camera, SpectralLine
from sim.imaging.convolve import Otf, plan_otf, superpose
from sim.optic import CellOptic

_SAMPLES = 8  # of a pixel, at least; intensities need two per wavelength x distance / aperture


class ApertureParts(eqx.Module):
    """The far PSF of a camera by parts of its aperture.

    Attributes:
        psf: `[part, c, y, x]` what every part sends, energy per pixel per unit power on the whole aperture.
        centre_m: `[part, 2]` middle (y, x) of the open area of every part.
        side_m: `[part]` side of a square of that area.
        camera: lens, sensor and aperture; its window is that of the PSFs, an odd number of pixels.
        depth_m: distance of the scene, metres.
    """

    psf: Float[np.ndarray, "part c y x"]
    centre_m: Float[np.ndarray, "part 2"]
    side_m: Float[np.ndarray, " part"]
    camera: Camera = eqx.field(static=True)
    depth_m: float = eqx.field(static=True)

    @property
    def whole(self) -> Float[np.ndarray, "c y x"]:
        """PSF of the open aperture."""
        return self.psf.sum(axis=0)

    def shift_px(self, near_m: float) -> Float[np.ndarray, "part 2"]:
        """Pixels (y, x) of the view between a scene point and what its ray to every part's middle meets at `near_m`."""
        camera = self.camera
        bent = 1 / near_m - (0.0 if np.isinf(self.depth_m) else 1 / self.depth_m)
        return -self.centre_m * (bent * camera.sensor_distance_m / camera.pixel_m)

    def side_px(self, near_m: float) -> Float[np.ndarray, " part"]:
        """Side of every part in pixels of the view, as an obstruction at `near_m` has its shadow."""
        camera = self.camera
        bent = 1 / near_m - (0.0 if np.isinf(self.depth_m) else 1 / self.depth_m)
        return self.side_m * (bent * camera.sensor_distance_m / camera.pixel_m)

    def otfs(self, shape: tuple[int, int]) -> list[Otf]:
        """Transforms of the parts' PSFs for every colour, for scenes of `shape` pixels (y, x) with their own margin."""
        return [plan_otf(self.psf[:, colour], shape, "own") for colour in range(self.psf.shape[1])]


def aperture_parts(optic: CellOptic, depth_m: float, across: int) -> ApertureParts:
    """Cut the far PSF of a DOE, as drawn or as fabricated, into parts of the aperture.

    Args:
        optic: the DOE behind its lens; flat glass for the bare lens.
        depth_m: distance of the scene, metres; `inf` allowed.
        across: squares along each axis of the aperture; those without open area are left out.

    Raises:
        ValueError: an even window, or no square.
    """
    camera = optic.camera
    if camera.window % 2 == 0 or across < 1:
        raise ValueError(f"`across` must be at least 1 and the window odd, but got {across} and {camera.window}")
    cuts = [np.linspace(0, count, across + 1).round().astype(int).tolist() for count in camera.grid.shape]
    open_share = np.asarray(open_cells(camera.grid, camera.opening), np.float64)
    blocks = [
        (slice(y0, y1), slice(x0, x1))
        for y0, y1 in zip(cuts[0], cuts[0][1:], strict=False)
        for x0, x1 in zip(cuts[1], cuts[1][1:], strict=False)
        if open_share[y0:y1, x0:x1].any()
    ]
    images = np.zeros((len(blocks), len(camera.colours), camera.window, camera.window), np.float32)
    for line in camera.lines:
        field = np.asarray(optic.field(line, depth_m))
        images[:, line.colour] += line.factor * _line_parts(camera, line, field, blocks)
    centres, sides = [], []
    y, x = camera.grid.axis_m("y"), camera.grid.axis_m("x")
    for block in blocks:
        area = open_share[block]
        centres.append((area.sum(1) @ y[block[0]] / area.sum(), area.sum(0) @ x[block[1]] / area.sum()))
        sides.append(np.sqrt(area.sum()) * camera.grid.pitch_m)
    return ApertureParts(images, np.array(centres), np.array(sides), camera, float(depth_m))


def _line_parts(
    camera: Camera, line: SpectralLine, field: Complex[np.ndarray, "y x"], blocks: Sequence[tuple[slice, slice]]
) -> Float[np.ndarray, "part v u"]:
    """Light of every block of cells in one wavelength, `[part, y, x]`, the window's pixels integrated by sums."""
    scale = line.wavelength_m * camera.sensor_distance_m
    reach = max(camera.grid.extent_m)
    count = max(_SAMPLES, int(np.ceil(2 * reach * camera.pixel_m * camera.fill / scale)))
    inside = ((np.arange(count) + 0.5) / count - 0.5) * camera.pixel_m * camera.fill
    places = (camera.axis_m()[:, None] + inside).ravel()
    waves = [np.outer(places, camera.grid.axis_m(axis)) / scale for axis in ("y", "x")]
    # A cell's own diffraction, the same for all parts.
    cell = np.sinc(places * camera.grid.pitch_m / scale).astype(np.float32)
    to_y, to_x = (np.exp(-2j * np.pi * (wave - np.rint(wave))).astype(np.complex64) for wave in waves)
    parts = []
    for rows, columns in blocks:
        parts.append((to_y[:, rows] @ field[rows, columns]) @ to_x[:, columns].T)
    whole = np.conj(np.sum(parts, axis=0))
    envelope = cell[:, None] * cell
    power = float(np.sum(np.asarray(open_cells(camera.grid, camera.opening), np.float64)))
    # Sums over cells are integrals over areas of pitch²; Parseval: light over the sensor is that over the aperture.
    step = camera.pixel_m * camera.fill / count
    norm = camera.grid.pitch_m**2 * step**2 / (scale**2 * power)
    n = camera.window
    return np.stack(
        [
            (norm * (whole.real * part.real - whole.imag * part.imag) * envelope**2)
            .reshape(n, count, n, count)
            .sum(axis=(1, 3), dtype=np.float64)
            .astype(np.float32)
            for part in parts
        ]
    )


class CoarseMask(eqx.Module):
    """A mask of the view on pixels that are `pixel` of the camera's wide, its middle in the middle of the view.

    Shadows of a wide aperture are hundreds of pixels wide and soft, which a few pixels for each of their widths hold.

    Attributes:
        blocked: `[y, x]` blocked share of every pixel; its edges go on for ever.
        pixel: width of a pixel, in pixels of the camera.
    """

    blocked: Float[np.ndarray, "y x"]
    pixel: float = eqx.field(static=True)

    def mean_over(
        self, y_px: Float[np.ndarray, " y"], x_px: Float[np.ndarray, " x"], side_px: float
    ) -> Float[np.ndarray, "y x"]:
        """Blocked share `[y, x]` of squares about places of the view.

        Args:
            y_px: middles of the squares along y, in pixels of the camera from the middle of the view.
            x_px: along x.
            side_px: side of the squares in pixels of the camera.
        """
        rows = self._means(self.blocked, y_px, side_px)
        return self._means(rows.T, x_px, side_px).T

    def _means(
        self, values: Float[np.ndarray, "n m"], middle_px: Float[np.ndarray, " k"], side_px: float
    ) -> Float[np.ndarray, "k m"]:
        """Means along the first axis: differences of the running sum, which is linear within a pixel."""
        count = len(values)
        far = int(np.ceil((np.abs(middle_px).max(initial=0.0) + side_px) / self.pixel)) + 2
        more = max(0, far - count // 2)
        wide = np.pad(values, ((more, more), (0, 0)), mode="edge").astype(np.float64)
        total = np.concatenate([np.zeros((1, wide.shape[1])), np.cumsum(wide, axis=0)])
        ends = [middle_px / self.pixel + sign * side_px / (2 * self.pixel) + len(wide) / 2 for sign in (1, -1)]
        upper, lower = (_between(total, end) for end in ends)
        return (upper - lower) * (self.pixel / side_px)


def _between(total: Float[np.ndarray, "n m"], at: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k m"]:
    """Rows of a table at fractional numbers, linear between them."""
    low = np.clip(np.floor(at).astype(int), 0, len(total) - 2)
    share = (at - low)[:, None]
    return total[low] * (1 - share) + total[low + 1] * share


def passed_shares(
    parts: ApertureParts, mask: CoarseMask, near_m: float, shape: tuple[int, int], step: int = 1
) -> Float[np.ndarray, "part y x"]:
    """Share of every part of the aperture that every pixel of the view sees freely, `[part, y, x]`, 0 to 1.

    Args:
        parts: the aperture, and the distance of the scene.
        mask: the obstruction.
        near_m: its distance, metres.
        shape: pixels (y, x) of the view, about the middle of the mask.
        step: pixels between places where shares are computed; they are linear between them.
    """
    places, between = zip(*(_places(count, step) for count in shape), strict=True)
    found = [
        1 - mask.mean_over(places[0] + shift[0], places[1] + shift[1], side)
        for shift, side in zip(parts.shift_px(near_m), parts.side_px(near_m), strict=True)
    ]
    return between[0] @ np.clip(np.stack(found), 0, 1).astype(np.float32) @ between[1].T


def _places(count: int, step: int) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "n k"]]:
    """Places `step` pixels apart about the middle of `count` pixels, and the weights that are linear between them."""
    pixels = np.arange(count) - (count - 1) / 2
    knots = pixels[0] + step * np.arange(-(-(count - 1) // step) + 1)
    weights = np.maximum(1 - np.abs(pixels[:, None] - knots) / step, 0.0)
    return knots, weights.astype(np.float32)


def spread_by_disc(
    light: Float[np.ndarray, "*c y x"], width_px: float, pixel: float, shape: tuple[int, int]
) -> Float[np.ndarray, "*c v u"]:
    """An obstruction's own light on the sensor: its layer on coarse pixels, spread by the shadow disc.

    Args:
        light: `[..., y, x]` light of the layer on pixels as in `CoarseMask`, 0 where it is open.
        width_px: diameter of the disc in pixels of the camera.
        pixel: width of a coarse pixel in pixels of the camera.
        shape: pixels (y, x) of the result, about the middle of the layer.
    """
    radius = width_px / pixel / 2
    half = int(np.ceil(radius + 0.5))
    # Coverage of every pixel from 8 x 8 points.
    points = (np.arange(8 * (2 * half + 1)) + 0.5) / 8 - (2 * half + 1) / 2
    disc = (np.hypot(points[:, None], points) <= radius).reshape(2 * half + 1, 8, 2 * half + 1, 8).mean(axis=(1, 3))
    if not disc.any():  # narrower than the points are apart
        disc[half, half] = 1.0
    padded = np.pad(light, [(0, 0)] * (light.ndim - 2) + [(half, half)] * 2, mode="edge")
    kernel = np.broadcast_to(disc / disc.sum(), (*light.shape[:-2], *disc.shape))
    spread = scipy.signal.fftconvolve(padded, kernel, mode="valid", axes=(-2, -1))
    axes = [(np.arange(n) - (n - 1) / 2) / pixel + (m - 1) / 2 for n, m in zip(shape, light.shape[-2:], strict=True)]
    y, x = np.meshgrid(*axes, indexing="ij")
    flat = spread.reshape(-1, *spread.shape[-2:])
    found = [scipy.ndimage.map_coordinates(one, [y, x], order=1, mode="nearest") for one in flat]
    return np.stack(found).reshape(*light.shape[:-2], *shape).astype(np.float32)


def through_parts(
    background: Float[np.ndarray, "c y x"] | Float[Array, "c y x"],
    passed: Float[np.ndarray, "part y x"] | Float[Array, "part y x"],
    otfs: Sequence[Otf],
) -> Float[Array, "c v u"]:
    """Light of a scene on the sensor past an obstruction, without the obstruction's own.

    Args:
        background: `[c, y, x]` scene with its own margin, half a window of the PSFs on every side.
        passed: what every part of the aperture sees of it (`passed_shares`).
        otfs: `ApertureParts.otfs` for its shape.

    Returns:
        `[c, y, x]`, smaller by the window less one.
    """
    return _through(jnp.asarray(background), jnp.asarray(passed), list(otfs))


@eqx.filter_jit
def _through(background: Array, passed: Array, otfs: list[Otf]) -> Array:
    colours = [superpose(list(passed * light), otf) for light, otf in zip(background, otfs, strict=True)]
    return jnp.stack(colours)
