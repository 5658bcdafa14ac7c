"""What a camera sees past an obstruction, by wave optics alone: the reference of `occlusion_table.py`.

Plain numpy in double precision; nothing here is shared with the package that it judges. A plane wave passes the
obstruction, spreads to the aperture by Fresnel's transfer function on a raster of the plate's own cells (J. W. Goodman,
Introduction to Fourier Optics, ch. 4), is cut and delayed there by the plate, and a lens makes its Fourier transform on
the sensor. A scene is far away and incoherent: every pixel of it is a point that lights the obstruction from another
direction, which moves the obstruction's wave across the aperture, and the pictures of all points are added.

Lengths have to fit each other, so that nothing is interpolated: see `Rig`.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from jaxtyping import Complex, Float

# Intensity samples per pixel and axis. Light of an aperture at most half as wide as the raster of the transform is
# known exactly between the samples of its intensity.
_SAMPLES = 4


@dataclass(frozen=True)
class Rig:
    """A camera whose lengths are whole multiples of each other, and an obstruction before it.

    Attributes:
        cells: cells of the plate per axis.
        pitch_m: width of a cell, metres.
        aperture_m: diameter of the clear aperture, metres.
        focal_m: focal length; the sensor is in focus for a far scene, metres.
        pixel_m: pixel pitch, metres.
        depth_m: distance of the obstruction from the plate; a pixel there is `moved` cells wide, metres.
        window: pixels per axis of a point's picture, an even number.
    """

    cells: int
    pitch_m: float
    aperture_m: float
    focal_m: float
    pixel_m: float
    depth_m: float
    window: int

    @property
    def wavelength_m(self) -> float:
        """The wavelength by which the Fourier transform of the aperture has a period of one window, metres."""
        return self.window * self.pixel_m * self.pitch_m / self.focal_m

    @property
    def moved(self) -> int:
        """Cells by which the obstruction's wave moves across the aperture from one scene pixel to the next."""
        cells = self.pixel_m * self.depth_m / (self.focal_m * self.pitch_m)
        if abs(cells - round(cells)) > 1e-9 or round(cells) % 2:
            raise ValueError(f"a pixel at `depth_m` must be an even number of cells wide, but got {cells}")
        return round(cells)

    @cached_property
    def aperture(self) -> Float[np.ndarray, "y x"]:
        """Open share of every cell, from 8 x 8 points of it."""
        points = (np.arange(8 * self.cells) - (8 * self.cells - 1) / 2) * self.pitch_m / 8
        inside = np.hypot(points[:, None], points) <= self.aperture_m / 2
        return inside.reshape(self.cells, 8, self.cells, 8).mean(axis=(1, 3))

    def psf(self, field: Complex[np.ndarray, "y x"]) -> Float[np.ndarray, "v u"]:
        """Picture `[y, x]` of a far point from the field in the aperture, energy per pixel.

        The power on the clear aperture counts as 1. The chief ray is in the middle of pixel `window // 2`. Light that
        leaves the window is counted on its other side.
        """
        count = _SAMPLES * self.window
        if 2 * self.cells > count:
            raise ValueError(f"`window` must be at least {2 * self.cells / _SAMPLES} pixels, but got {self.window}")
        columns = scipy.fft.fft(field * self.aperture, count, axis=1)
        light = np.abs(np.asarray(scipy.fft.fft(columns, count, axis=0))) ** 2 * self._envelope
        return self._pixels @ light @ self._pixels.T / (self.aperture.sum() * count**2)

    @cached_property
    def _envelope(self) -> Float[np.ndarray, "y x"]:
        """Light of one square cell: sinc² of the direction, 1 on the axis."""
        along = np.sinc(np.fft.fftfreq(_SAMPLES * self.window)) ** 2
        return along[:, None] * along

    @cached_property
    def _pixels(self) -> Float[np.ndarray, "pixel sample"]:
        """Integral over every pixel of light that is band-limited and known at all samples, in samples."""
        count = _SAMPLES * self.window
        waves = np.fft.fftfreq(count, 1 / count)
        # The spectrum of a pixel over its samples; cosines alone, for pixels are even.
        places = np.arange(self.window)[:, None] - self.window // 2 - np.arange(count) / _SAMPLES
        spectrum = np.sinc(waves / self.window) * (np.abs(waves) < count / 2)
        table = np.fft.fft(spectrum).real * _SAMPLES / count
        return table[np.rint(places * _SAMPLES).astype(int) % count]


@dataclass(frozen=True)
class Obstacle:
    """Something opaque and dark before the plate.

    Attributes:
        mask: `[y, x]` blocked pixels of the view, 0 or 1; an odd number of them, the axis in the middle one.
        upright: whether it is the same in every row and goes on for ever; so does what stands at the view's edges.
        period: pixels after which it repeats along both axes for ever; 0 for one that ends within the view.
    """

    mask: Float[np.ndarray, "v v"]
    upright: bool = False
    period: int = 0

    def wave(self, rig: Rig) -> Complex[np.ndarray, "y x"]:
        """Field that a far point on the axis sends past it, in the plane of the plate, over the field without it.

        Pixel (row, column) of the view, from the axis, lies on cells `moved` times (-row, -column) from the axis, for a
        lens turns its picture round. With h = len(mask) // 2 the raster begins with pixel (h, h); an upright one has
        a single row, a periodic one begins with the axis.
        """
        turned = 1.0 - np.asarray(self.mask, np.float64)[::-1, ::-1]
        if self.period:
            half = len(turned) // 2
            turned = turned[half : half + self.period, half : half + self.period]
        rows = turned[:1] if self.upright else np.repeat(turned, rig.moved, axis=0)
        plane = np.repeat(rows, rig.moved, axis=1)
        if self.period:
            return _spread(plane, rig)
        # Twice the view: what a periodic transform brings in from beyond starts that far away.
        guard = plane.shape[1] // 2
        wide = np.pad(plane, ((0, 0) if self.upright else (guard, guard), (guard, guard)), mode="edge")
        inner = slice(guard, guard + plane.shape[1])
        return _spread(wide, rig)[:, inner] if self.upright else _spread(wide, rig)[inner, inner]

    def before(self, wave: Complex[np.ndarray, "y x"], point: tuple[int, int], rig: Rig) -> Complex[np.ndarray, "y x"]:
        """Its wave on the cells of the plate, or on one row of them, for a scene point (row, column) from the axis."""
        first = 0 if self.period else len(self.mask) // 2 * rig.moved
        cells = np.arange(rig.cells) - (rig.cells - rig.moved) // 2 + first
        places = []
        for samples, at in zip(wave.shape, point, strict=True):
            index = cells - rig.moved * at
            places.append(index % samples if self.period else np.clip(index, 0, samples - 1))
        return wave[np.ix_(*places)]

    def seen(self, row: int, column: int, rig: Rig) -> tuple[int, int] | None:
        """Which scene points, counted from the axis, see it alike: those of one answer; None where it is not seen."""
        if self.upright:
            return 0, column
        if self.period:
            return row % self.period, column % self.period
        if not np.any(self.mask):
            return None
        blocked = np.argwhere(self.mask) - len(self.mask) // 2
        # Four pixels more than the shadow of the aperture, for fringes.
        near = rig.aperture_m / rig.pitch_m / rig.moved / 2 + 4
        hidden = np.min(np.hypot(*(blocked - (row, column)).T)) <= near
        return (row, column) if hidden else None


def _spread(plane: np.ndarray, rig: Rig) -> Complex[np.ndarray, "y x"]:
    """Fresnel propagation over the distance of the obstruction, periodic beyond the raster."""
    spectrum = scipy.fft.fft2(plane)
    frequency = sum(
        np.fft.fftfreq(count, rig.pitch_m).reshape(shape) ** 2
        for count, shape in zip(plane.shape, ((-1, 1), (1, -1)), strict=True)
    )
    return np.asarray(scipy.fft.ifft2(spectrum * np.exp(-1j * np.pi * rig.wavelength_m * rig.depth_m * frequency)))


def picture(
    rig: Rig,
    delay_waves: Float[np.ndarray, "y x"],
    obstacle: Obstacle,
    scenes: Float[np.ndarray, "scene v v"],
    judged_px: int,
) -> Float[np.ndarray, "scene j j"]:
    """Pictures of far scenes behind an obstruction.

    Args:
        rig: lengths.
        delay_waves: `[y, x]` delay of every cell of the plate, in waves.
        obstacle: what stands before it.
        scenes: `[scene, y, x]` light of every pixel of the view of the obstacle's mask.
        judged_px: pixels, an odd number, of the middle of the picture that is returned. The view must reach half a
            window beyond it, or a ValueError is raised: all light that lands there is counted.
    """
    view, half = scenes.shape[-1] // 2, judged_px // 2
    reach = half + rig.window // 2
    if view < reach or scenes.shape[1:] != obstacle.mask.shape:
        raise ValueError(f"`scenes` must be {2 * reach + 1} pixels wide and match the mask, but got {scenes.shape}")
    groups: dict[tuple[int, int] | None, list[tuple[int, int]]] = {}
    for row in range(-reach, reach + 1):
        for column in range(-reach, reach + 1):
            groups.setdefault(obstacle.seen(row, column, rig), []).append((row, column))
    wave, plate = obstacle.wave(rig), np.exp(2j * np.pi * delay_waves)

    def part(members: list[tuple[tuple[int, int] | None, list[tuple[int, int]]]]) -> np.ndarray:
        found = np.zeros((len(scenes), judged_px, judged_px))
        for key, points in members:
            image = rig.psf(plate if key is None else plate * obstacle.before(wave, key, rig))
            # Rows and columns beyond the window hold nothing, for points that are farther than that.
            padded = np.pad(image, judged_px)
            for row, column in points:
                y, x = (rig.window // 2 + judged_px - half - place for place in (row, column))
                light = scenes[:, view + row, view + column]
                found += light[:, None, None] * padded[y : y + judged_px, x : x + judged_px]
        return found

    members = list(groups.items())
    with ThreadPoolExecutor(2) as pool:
        return np.sum(list(pool.map(part, (members[0::2], members[1::2]))), axis=0)
