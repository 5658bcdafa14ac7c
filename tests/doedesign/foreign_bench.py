"""A bench that shares no code with the model: a plate on a raster, and a camera that stands askew before it.

What a calibration is judged by must not come from what it fits with. Here a plate as fabricated is a raster of many
samples per cell (`tests.physics.plate_raster`) behind a hard round rim; its light at the sensor is a sum over all
samples, in double precision; and a pixel is a square that the camera's rotation, its scales and its distortion carry
to a place in the light, integrated by Gauss's rule. Walls may add their lines of light, as `sim.rigorous.edge_widths`
has them, to the samples on either side, one image for each polarisation, and what walls near to each other share.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.special import wofz

from doedesign.design.design import Design
from fab.process import Process, variation_of
from sim.material import refractive_index
from sim.rigorous.edge_widths import edge_dipoles, edge_widths
from tests.physics.plate_raster import raster_height_m

SAMPLES = 25  # per cell and axis: 74 nm in a cell of 1.85 um, so moved edges move by multiples of that
_SPACING = 0.125  # of lambda f / D, at which the intensity, of half that frequency at most, is sampled
_ROOM = 6  # samples of the intensity beyond the outermost pixel
_NODES = 5  # of Gauss's rule per axis of a pixel
_WALL_M = 10e-9  # smaller steps of height are those of uneven depths
_NODE_M = 10e-9  # between heights for which the light of walls is solved
_SHARED = 14  # samples, a micrometre, over which walls share light: 1 % of it is left there


class Askew(NamedTuple):
    """How a camera stands: pixel p (y, x), from the chief ray in pixels, sees the light at R S p (1 - k |p|² / f²).

    R turns from +x toward +y by `rotation` (radians), S stretches by 1 + `scale`, and |p| / f is in the camera's
    nominal pixels and focal length; k is `distortion`.
    """

    rotation: float = 0.0
    scale_y: float = 0.0
    scale_x: float = 0.0
    distortion: float = 0.0


EXACT = Askew()


def foreign_light(
    design: Design,
    process: Process,
    hidden: Mapping[str, float],
    depths_m: Sequence[float],
    wavelength_m: float,
    *,
    askew: Askew = EXACT,
    shift_px: tuple[float, float] = (0.0, 0.0),
    margin: int = 24,
    edges: bool = False,
) -> list[Float[np.ndarray, "v u"]]:
    """Energy in every pixel, per unit power on the clear aperture, of frames `margin` pixels wider than the window.

    Args:
        design: the plate and its camera.
        process: where the plate lies on the wafer, and how large that is.
        hidden: errors of the plate by flat name.
        depths_m: of the point source, one for every frame.
        wavelength_m: of its light.
        askew: how the camera stands.
        shift_px: where the chief ray falls, (y, x) from the middle of the frame.
        margin: pixels.
        edges: add the light of walls, unpolarised.
    """
    camera, levels = design.camera, design.level_map.levels
    variation = variation_of(levels.bits, hidden)
    pitch, die, radius = camera.grid.pitch_m, process.die_m, process.wafer_radius_m
    height = raster_height_m(design.level_map.level, levels, pitch, SAMPLES, variation, die, radius)
    step = pitch / SAMPLES
    axis = (np.arange(len(height)) + 0.5 - len(height) / 2) * step
    square = axis[:, None] ** 2 + axis**2
    open_ = square <= camera.aperture_m**2 / 4
    index, waves = refractive_index(camera.material, wavelength_m), 2 * np.pi / wavelength_m
    thin = np.exp(1j * waves * (index - 1) * height)
    fields = _with_walls(thin, height, wavelength_m, index, step) if edges else [(thin, 0.0, 0.0)]
    scale, side = wavelength_m * camera.focal_length_m, camera.window + margin
    places, weights = _pixels(side, camera.fill, camera.pixel_m, camera.focal_length_m, askew, shift_px)
    reach = np.ceil(np.abs(places).max() / (_SPACING * scale / camera.aperture_m)) + _ROOM
    u = np.arange(-reach, reach + 1) * (_SPACING * scale / camera.aperture_m)
    wave = np.exp(-2j * np.pi / scale * np.outer(u, axis)) * np.sinc(u * step / scale)[:, None] * step
    frames = []
    for depth in depths_m:
        path = np.zeros_like(square) if np.isinf(depth) else square / (np.sqrt(square + depth**2) + depth)
        source = open_ * np.exp(2j * np.pi / wavelength_m * path)
        # The amplitude is that per unit of power on the clear aperture.
        oblique = 0.0 if np.isinf(depth) else 4j * np.pi * axis / (wavelength_m * depth)
        lit = [
            field + dipole_y * np.reshape(oblique, (-1, 1)) + dipole_x * oblique for field, dipole_y, dipole_x in fields
        ]
        power = [np.abs(wave @ (field * source) @ wave.T / scale) ** 2 for field in lit]
        intensity = np.mean(power, axis=0) / (np.pi * camera.aperture_m**2 / 4)
        spline = RectBivariateSpline(u, u, intensity, kx=5, ky=5)
        frames.append((spline.ev(places[0], places[1]) * weights).sum(axis=-1))
    return frames


def _pixels(
    side: int, fill: float, pixel_m: float, focal_m: float, askew: Askew, shift_px: tuple[float, float]
) -> tuple[Float[np.ndarray, "2 v u node"], Float[np.ndarray, "v u node"]]:
    """Places (y, x) in the light of the nodes of all pixels, metres, and what part of an area each stands for."""
    nodes, parts = np.polynomial.legendre.leggauss(_NODES)
    inner_y, inner_x = (n.ravel() * fill / 2 for n in np.meshgrid(nodes, nodes, indexing="ij"))
    share = np.outer(parts, parts).ravel() / 4 * (fill * pixel_m) ** 2
    centre = np.arange(side) - (side - 1) / 2
    y = centre[:, None, None] - shift_px[0] + inner_y + np.zeros((1, side, 1))
    x = centre[None, :, None] - shift_px[1] + inner_x + np.zeros((side, 1, 1))
    squared = -askew.distortion * (y**2 + x**2) * (pixel_m / focal_m) ** 2
    bent = 1 + squared
    wide_y, wide_x = (1 + askew.scale_y) * pixel_m, (1 + askew.scale_x) * pixel_m
    cos, sin = np.cos(askew.rotation), np.sin(askew.rotation)
    places = np.stack([(cos * wide_y * y + sin * wide_x * x) * bent, (cos * wide_x * x - sin * wide_y * y) * bent])
    # Determinant of the map: along the radius the cubic counts three times.
    area = (1 + askew.scale_y) * (1 + askew.scale_x) * bent * (1 + 3 * squared)
    return places, share * area


def _with_walls(
    thin: Complex[np.ndarray, "y x"], height: np.ndarray, wavelength_m: float, index: float, step: float
) -> list[tuple[Complex[np.ndarray, "y x"], ...]]:
    """Transmission with the lines and dipoles of all upright walls, for light polarised along y and along x.

    After it come the dipoles across y and across x as lines of light, which count where walls are lit from a side.
    """
    waves, across = 2 * np.pi / wavelength_m, [_walls(height, axis) for axis in (0, 1)]
    nodes = np.arange(0.0, np.ptp(height) + 2 * _NODE_M, _NODE_M)
    table = {
        way: [
            CubicSpline(nodes, of(tuple(nodes.tolist()), wavelength_m, index, way))
            for of in (edge_widths, edge_dipoles)
        ]
        for way in ("TE", "TM")
    }

    def light(before: np.ndarray, behind: np.ndarray, way: str) -> np.ndarray:
        """Line and dipole, `[2, wall]`, of walls between two heights."""
        low, size = np.minimum(before, behind), np.abs(behind - before)
        width, own = (one(size) for one in table[way])
        air = np.exp(1j * waves * (index * low - (low + size)))
        step_of_light = np.exp(1j * waves * (index - 1) * (low + size)) - np.exp(1j * waves * (index - 1) * low)
        stands = 1j / (2 * waves * index) * (low - height.mean()) * step_of_light
        return np.stack([width * air, np.sign(behind - before) * (stands + own * air)])

    fields = []
    for polarised in (0, 1):
        field, aside = thin.copy(), [np.zeros_like(thin) for _ in across]
        for axis, (places, before, behind) in enumerate(across):
            # Light polarised across a wall is TM.
            way = "TM" if polarised == axis else "TE"
            _add(field, aside[axis], light(before, behind, way), places, axis, 0, step)
            for apart, (first, second) in _pairs(height, axis).items():
                (a, b), (c, d) = (_ends(height, wall, axis) for wall in (first, second))
                shared = light(a, d, way) - light(a, c, way) - light(b, d, way) + light(b, c, way)
                kept = shared * _left(apart * step, (a, b, c, d), wavelength_m)
                _add(field, aside[axis], kept, first, axis, apart, step)
        fields.append((field, *aside))
    return fields


def _add(
    field: np.ndarray,
    aside: np.ndarray,
    light: np.ndarray,
    places: tuple[np.ndarray, ...],
    axis: int,
    half: int,
    step: float,
) -> None:
    """Add lines and dipoles that lie so many halves of a sample behind the upper border of the samples at `places`."""
    beside = (half // 2, half // 2 + 1) if half % 2 == 0 else (half // 2, half // 2 + 1, half // 2 + 2)
    shares = {2: ((0.5, 1.0), (0.5, -1.0)), 3: ((0.0, 0.5), (1.0, 0.0), (0.0, -0.5))}[len(beside)]
    line, dipole = light
    for more, (of_line, of_dipole) in zip(beside, shares, strict=True):
        at = tuple(place + more * (k == axis) for k, place in enumerate(places))
        np.add.at(field, at, of_line * line / step + of_dipole * dipole / step**2)
        np.add.at(aside, at, of_line * dipole / step)


def _pairs(height: np.ndarray, axis: int) -> dict[int, tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]]:
    """Samples before the first and before the second wall of all pairs, by their distance in samples."""
    wall, found = np.abs(np.diff(height, axis=axis)) > _WALL_M, {}
    for apart in range(1, _SHARED + 1):
        both = np.delete(wall, np.s_[wall.shape[axis] - apart :], axis) & np.delete(wall, np.s_[:apart], axis)
        first = np.nonzero(both)
        if first[0].size:
            found[apart] = first, tuple(place + apart * (k == axis) for k, place in enumerate(first))
    return found


def _ends(height: np.ndarray, places: tuple[np.ndarray, ...], axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights before and behind walls."""
    return height[places], height[tuple(place + (k == axis) for k, place in enumerate(places))]


def _left(apart_m: float, heights: tuple[np.ndarray, ...], wavelength_m: float) -> np.ndarray:
    """Light that crosses both of two walls, over that of walls in one place, by quadrature over the depth between."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    root = (nodes + 1) / 2
    depths = np.linspace(0, np.sqrt(max(np.ptp(np.stack(heights)), _NODE_M)), 80) ** 2
    between = depths[:, None] * root**2

    def twice(apart_m: float) -> CubicSpline:
        """Second integral over depth of the light that crosses, by the root of the depth."""
        spread = np.sqrt(1j * (between + 1e-15) * wavelength_m / (2 * np.pi))
        z = apart_m / spread / np.sqrt(2)
        density = np.exp(-(z**2)) * (spread / np.sqrt(2 * np.pi) - apart_m / 2 * wofz(1j * z))
        return CubicSpline(np.sqrt(depths), (density * (depths[:, None] - between) * root) @ weights * depths)

    a, b, c, d = heights
    ends = ((d - a, 1), (c - b, 1), (d - b, -1), (c - a, -1))
    apart, joint = (
        np.sum([sign * of(np.sqrt(np.abs(depth))) for depth, sign in ends], axis=0) for of in map(twice, (apart_m, 0.0))
    )
    return apart / joint


def _walls(height: np.ndarray, axis: int) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Samples before every wall, and the heights before and behind it."""
    places = np.nonzero(np.abs(np.diff(height, axis=axis)) > _WALL_M)
    return places, *_ends(height, places, axis)
