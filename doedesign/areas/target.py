"""An area to be lit, on a lattice of directions that is fine enough for all that light can draw."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.ndimage import map_coordinates

from doedesign.design.patterns import picture_light
from doedesign.spec.targets.areas import AreaSpec
from fab.errors import InputError
from fab.pictures import read_pixels
from fab.units import DEGREES, format_length
from sim.camera import Camera
from sim.illumination import GaussianBeam

# Samples per lambda d / D along each axis. Two would do for all detail of an endless picture; in a small one, light
# may be even on every sample and uneven between them.
_SAMPLES = 3.0
_MARGIN = 2.0  # edges, beyond the area on each side
OUTER, FLAT = 0.135, 0.9  # of the value inside: where an area begins, and where it is flat
# The logistic function falls from 90 to 13.5 % over so many times its scale.
_FALL = np.log(FLAT / (1 - FLAT)) + np.log((1 - OUTER) / OUTER)
_MOST = 4096  # samples per axis
_LEAST = 1.5  # edges: a rectangle so wide has 90 % of its value in the middle
_STRAIGHT, _PLACES = 0.3, 13  # share of a side, on either side of its middle, that should be straight; places on it
_TAPER = 3.0  # samples


def camera_for(table: AreaSpec, camera: Camera) -> Camera:
    """The camera whose first and only colour lights an area, with its sensor where the area lies."""
    return replace(in_plane(table, camera), colours=(camera.colours[colour_number(table, camera)],))


def colour_number(table: AreaSpec, camera: Camera) -> int:
    """Which of a camera's colours lights an area."""
    return 0 if table.colour is None else [colour.name for colour in camera.colours].index(table.colour)


def in_plane(table: AreaSpec, camera: Camera) -> Camera:
    """A camera with its sensor where an area lies."""
    if table.distance_m is None:
        return camera
    if camera.distance_m is not None:
        return replace(camera, distance_m=table.distance_m)
    return replace(camera, defocus_m=table.distance_m - camera.focal_length_m)


@dataclass(frozen=True, eq=False)
class AreaTarget:
    """An area on a lattice of direction sines.

    Attributes:
        sines_y: direction sines of the rows, ascending.
        sines_x: of the columns.
        value: `[y, x]` light wanted, from 1 in the middle of an area, over an edge, to 0.
        dark: `[y, x]` where light counts against evenness although none is wanted.
        centre_m: middle (y, x) of the area on the sensor.
        size_m: its size (y, x) at half its value; 0 across a line.
        edge_m: distance from 90 to 13.5 % of the value.
        shape: its kind.
        border: `[place, y]` and `[place, x]` weights of rows and columns for the light at places on the border, where
            it should be half of that inside.
        phase: `[y, x]` phase of the light wanted, radians, but for a common one; None where it is free.
    """

    sines_y: Float[np.ndarray, " v"]
    sines_x: Float[np.ndarray, " u"]
    value: Float[np.ndarray, "v u"]
    dark: Bool[np.ndarray, "v u"]
    centre_m: tuple[float, float]
    size_m: tuple[float, float]
    edge_m: float
    shape: str
    border: tuple[Float[np.ndarray, "n v"], Float[np.ndarray, "n u"]]
    phase: Float[np.ndarray, "v u"] | None = None

    @property
    def lit(self) -> Bool[np.ndarray, "v u"]:
        """Where light counts as that of the area."""
        return self.value >= OUTER

    @property
    def flat(self) -> Bool[np.ndarray, "v u"]:
        """Where light should be even, or as the picture has it."""
        return self.lit if self.shape == "picture" else self.value >= FLAT

    @property
    def wanted(self) -> Float[np.ndarray, "v u"]:
        """Light wanted where it should be flat: 1, but for pictures and across lines; elsewhere the value."""
        return self.value if self.shape in ("picture", "line") else np.where(self.flat, 1.0, self.value)

    @property
    def wave(self) -> Complex[np.ndarray, "v u"] | None:
        """Field wanted where light counts as that of the area, of unit power; None where its phase is free."""
        if self.phase is None:
            return None
        field = np.where(self.lit, np.sqrt(self.wanted), 0.0) * np.exp(1j * self.phase)
        return field / np.linalg.norm(field)

    @classmethod
    def of(
        cls,
        table: AreaSpec,
        camera: Camera,
        picture: Path | None = None,
        phase: Path | None = None,
        *,
        samples: float = _SAMPLES,
        key: str = "area",
    ) -> "AreaTarget":
        """The area of a spec for the first wavelength of a camera, so many samples per lambda d / D apart.

        `key` is what messages call it, "area[1]" for the second of several.

        Raises:
            InputError: a picture that cannot be read, is dark, or reaches beyond what cells can light, a phase that is
                not grey, or an area with too much detail or too small to have a flat part.
        """
        light = None if picture is None else _picture_light(picture)
        size_m = table.size_m if light is None else (table.size_m[1] * light.shape[0] / light.shape[1], table.size_m[1])
        wavelength = camera.lines[0].wavelength_m
        edge = table.edge_m or finest_detail_m(camera)
        step = wavelength / camera.opening.widest_m / samples
        middle, axes = (table.offset_m[1], table.offset_m[0]), []
        for centre, size in zip(middle, size_m, strict=True):
            half = size / 2 + max(_MARGIN * edge, table.dark_m + edge)
            ends = [camera.sines_of(*(centre + side * half, 0.0))[0] for side in (-1, 1)]
            # A multiple of the step from the axis, so that the 0th order is one of the samples.
            first, last = np.floor(ends[0] / step), np.ceil(ends[1] / step)
            if last - first > _MOST:
                rule = f"at most {_MOST} times the smallest detail, over {samples:g}, across"
                got, cure = f"{last - first:.0f}", "Choose a smaller area or aperture."
                raise InputError(key, rule, got, cure)
            axes.append(np.arange(first, last + 1) * step)
        moved = camera.moved_sines()
        _require_reach(camera, max(float(np.abs(axis - by).max()) for axis, by in zip(axes, moved, strict=True)), key)
        y, x = camera.image_m(axes[0][:, None], axes[1][None, :])
        at = y - middle[0], x - middle[1]
        value = _draw(table, at, edge) if light is None else _draw_picture(light, at, size_m)
        dark = np.zeros(value.shape, bool)
        if table.dark_m:
            wider = [size + 2 * table.dark_m for size in size_m]
            dark = (np.abs(at[0]) <= wider[0] / 2) & (np.abs(at[1]) <= wider[1] / 2) & (value < 1 - FLAT)
        sines = camera.sines_of(*(_border(table) + middle).T)
        rows, columns = (_between(axis, at) for axis, at in zip(axes, sines, strict=True))
        sines_y, sines_x = axes
        turned = None
        if table.phase is not None:
            turned = np.zeros(value.shape) if phase is None else _draw_phase(phase, at, size_m)
        target = cls(sines_y, sines_x, value, dark, middle, size_m, edge, table.shape, (rows, columns), turned)
        if not target.flat.any():
            band_m = None if table.inner_m is None else (min(size_m) - table.inner_m) / 2  # of a ring
            sizes = edge, _LEAST * edge, min(filter(None, (*size_m, band_m)))
            falls, least, got = (_size_text(camera, size) for size in sizes)
            rule = f"light falls over {falls} there, so that an area needs {least}"
            raise InputError(key, rule, got, "Choose a larger area, a larger aperture, or a nearer sensor.")
        return target


def _size_text(camera: Camera, size_m: float) -> str:
    """A size with three digits, of length or in degrees."""
    return f"{DEGREES.size(size_m):.3g} deg" if camera.in_angles else format_length(float(f"{size_m:.3g}"))


def finest_detail_m(camera: Camera) -> float:
    """Size of detail that light can draw, metres: the radius of a Gaussian beam's focus, 2 lambda d / D of plane light.

    The focus is that of the beam as wide as it is on the DOE, wherever its waist lies. D is the shorter side of an
    aperture that is not round.

    Args:
        camera: beam, aperture, sensor, and the first wavelength.
    """
    wavelength = camera.lines[0].wavelength_m
    scale = wavelength * camera.sensor_distance_m
    finest = scale / min(camera.opening.sizes_m)
    if not isinstance(camera.beam, GaussianBeam):
        return 2 * finest
    quality = np.sqrt(np.prod(camera.beam.m_squared))
    radius = np.sqrt(np.prod(camera.beam.diameters_m(wavelength))) / 2
    return float(max(quality * scale / np.pi / radius, finest))


def _require_reach(camera: Camera, farthest: float, key: str) -> None:
    """Raise an `InputError` where the farthest direction sine of an area is beyond those that the cells tell apart."""
    most = camera.lines[0].wavelength_m / (2 * camera.grid.pitch_m)
    if farthest > most:
        finer = format_length(float(f"{camera.grid.pitch_m * most / farthest:.3g}"))
        rule = f"cells of {format_length(camera.grid.pitch_m)} light directions up to a sine of {most:.3g}"
        raise InputError(key, rule, f"{farthest:.3g}", f"Choose a smaller area, or a pitch of at most {finer}.")


def _draw(
    table: AreaSpec, at_m: tuple[Float[np.ndarray, "v u"], Float[np.ndarray, "v u"]], edge_m: float
) -> Float[np.ndarray, "v u"]:
    """Light wanted at places (y, x) from the middle of an area."""
    (y, x), (height, width) = np.broadcast_arrays(*at_m), table.size_m

    def within(distance_m: np.ndarray) -> np.ndarray:
        """Fall across an edge that lies so far outward of a place."""
        return 1 / (1 + np.exp(np.clip(-distance_m * _FALL / edge_m, -50, 50)))

    if table.shape == "rectangle":
        return within(height / 2 - np.abs(y)) * within(width / 2 - np.abs(x))
    if table.shape == "line":
        along, across, size = (x, y, width) if width else (y, x, height)
        return within(size / 2 - np.abs(along)) * np.exp(-2 * (across / edge_m) ** 2)
    radius = np.hypot(2 * y / height, 2 * x / width)  # 1 on the rim
    # Distance to the rim along the ray from the middle: exact for a circle.
    outer = np.hypot(y, x) * (1 / np.maximum(radius, 1e-9) - 1)
    if table.shape == "ellipse":
        return within(outer)
    assert table.inner_m is not None
    return within(outer) * within(np.hypot(y, x) - table.inner_m / 2)


def _border(table: AreaSpec) -> Float[np.ndarray, "n 2"]:
    """Places (y, x) on the border, from the middle of an area; corners are left alone."""
    (height, width), along = table.size_m, np.linspace(-_STRAIGHT, _STRAIGHT, _PLACES)
    found = [np.zeros((0, 2))]
    if table.shape in ("rectangle", "line"):
        for side in (-0.5, 0.5):
            found += [np.stack([along * height, np.full(_PLACES, side * width)], 1)] if width else []
            found += [np.stack([np.full(_PLACES, side * height), along * width], 1)] if height else []
    if table.shape in ("ellipse", "ring"):
        rims = [(height, width)] + ([(table.inner_m, table.inner_m)] if table.inner_m else [])
        angle = np.linspace(0, 2 * np.pi, 4 * _PLACES, endpoint=False)
        found += [np.stack([high / 2 * np.sin(angle), wide / 2 * np.cos(angle)], 1) for high, wide in rims]
    return np.concatenate(found)


def _between(axis: Float[np.ndarray, " m"], at: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n m"]:
    """Weights on equally spaced samples for the values between them: a sinc under a Gaussian window."""
    away = (at[:, None] - axis) / (axis[1] - axis[0])
    weights = np.sinc(away) * np.exp(-((away / _TAPER) ** 2) / 2)
    return weights / weights.sum(1, keepdims=True)


def _picture_light(path: Path) -> Float[np.ndarray, "y x"]:
    """Light of a picture, its brightest part 1."""
    light = picture_light(path)
    if not light.max() > 0:
        raise InputError(str(path), "the picture must hold some light", "black", "Give another picture.")
    return light / light.max()


def _draw_picture(
    light: Float[np.ndarray, "y x"],
    at_m: tuple[Float[np.ndarray, "v u"], Float[np.ndarray, "v u"]],
    size_m: tuple[float, float],
) -> Float[np.ndarray, "v u"]:
    """Light of a picture of that size at places (y, x) from its middle; dark around it.

    Detail finer than the distance of the places is averaged first.
    """
    from skimage.transform import resize

    steps_m = [float(np.ptp(at)) / (n - 1) for at, n in zip(at_m, at_m[0].shape, strict=True)]
    shape = [min(n, int(np.ceil(size / step))) for n, size, step in zip(light.shape, size_m, steps_m, strict=True)]
    light = np.asarray(resize(light, shape, anti_aliasing=True))
    return map_coordinates(light, _in_pixels(light.shape, at_m, size_m), order=1, mode="constant")


def _in_pixels(
    shape: tuple[int, ...],
    at_m: tuple[Float[np.ndarray, "_v _u"], Float[np.ndarray, "_v _u"]],
    size_m: tuple[float, float],
) -> Float[np.ndarray, "2 v u"]:
    """Places (y, x) from the middle of a picture of some pixels and of that size, in these pixels."""
    places = [at / size * n + (n - 1) / 2 for at, size, n in zip(at_m, size_m, shape, strict=True)]
    return np.stack(np.broadcast_arrays(*places))


def _draw_phase(
    path: Path, at_m: tuple[Float[np.ndarray, "v u"], Float[np.ndarray, "v u"]], size_m: tuple[float, float]
) -> Float[np.ndarray, "v u"]:
    """Phase of a grey picture of that size, radians, at places (y, x) from its middle; that of its edge around it."""
    values = read_pixels(path)
    if values.ndim != 2 or values.dtype.kind not in "ui":
        rule, got = "a picture of a phase must be grey, with whole numbers", f"{values.dtype} {values.shape}"
        raise InputError(str(path), rule, got, "Save it as a grey PNG or TIFF of 8 or 16 bits.")
    wave = np.exp(2j * np.pi * values / (np.iinfo(values.dtype).max + 1.0))
    places = _in_pixels(values.shape, at_m, size_m)
    # Between pixels light turns the short way, past the end of a turn, too.
    real, imag = (map_coordinates(part, places, order=1, mode="nearest") for part in (np.real(wave), np.imag(wave)))
    return np.arctan2(imag, real)
