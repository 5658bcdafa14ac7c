"""The paper's PSF bench (§5, figs. 7 and 8): the light that reaches its camera.

A single-mode fibre at 520 nm lights a plate, from its tip near by or collimated by a lens. Two equal lenses, a relay,
image the plate onto the aperture of the camera's lens. The fibre's light is a Gaussian of its mode field in angle, so a
near tip lights the rim of the aperture less than its middle (A. W. Snyder and J. D. Love, *Optical Waveguide Theory*,
§20: divergence wavelength / (pi w0)); the description of a measurement tells the mode field. What it does not tell:

* The relay's lenses have rims of radius R at a distance f from the plate. A ray that leaves the plate at x in the
  direction of sine s meets the first lens at x + f s and, 2 f behind it, the second at f s - x. So the pixel that
  images s sees only that part of the aperture where |x + f s| < R and |x - f s| < R: all of it up to s = (R - a) / f
  for an aperture of radius a, nothing from s = R / f on. This is the stationary phase of two Fresnel propagations with
  the rim between them; it leaves out the diffraction at the rim, which softens it over sqrt(wavelength f), 0.2 mm of
  27 mm.
* The relay turns the picture by half a turn, which is told; the camera is turned and stretched a little (the focal
  lengths of the relay are as equal as they are stated), and the chief ray misses the middle of the frame.
* Depths are as exact as a stage, and frames have photon noise, reading noise, an offset, background and a bracket of
  exposures, of which the longer one is full in the middle.

Light that the relay does not stop is that of `sim.psf`.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.calibration.geometry import displacement_m, places
from doedesign.design.design import Design
from fab.errors import InputError
from sim.camera import Camera, Colour, SpectralLine
from sim.optic import CellOptic, HeightOptic
from sim.propagation.farfield import FarField, bent, plan_far_field
from sim.propagation.pupil import doe_field

if TYPE_CHECKING:
    pass

_ZONES = (6, 8)  # of directions between those that the relay lets pass and those that it stops: along sine, half a turn
_ROOM = 0.01  # share of the image by which pixels may lie farther than the bench says, for rounding


@dataclass(frozen=True)
class PsfBench:
    """A bench for PSFs; lengths in metres. The paper's by default.

    Attributes:
        probe_m: vacuum wavelength of the source.
        mode_field_m: diameter of the fibre's mode field, at 1/e² of its irradiance; 0 for a point that lights evenly.
        collimator_m: focal length of the lens that makes a plane wave of the fibre's light, for sources at infinity.
        relay_m: focal length of either lens of the relay.
        relay_clear_m: clear diameter of either; infinite for a relay that stops nothing. By default 75 mm f/2.8.
        throughput: share of the light on the clear aperture that arrives behind the DOE; None for what faces and relay
            leave. It makes the frames dimmer, and nothing else.
        pixel_m: pixel pitch of the camera; None for that of the design's.
        margin: pixels of a frame beyond the design's window, together on both sides.
        rotation_rad: by which the camera is turned from the plate's +x toward +y.
        scale_y: share by which a pixel sees more light than its pitch says, along y.
        scale_x: the same along x.
        off_px: pixels (y, x) by which the chief ray misses the middle of the frame.
        depth_sigma_m: standard deviation of the distance of a near source.
        source_e_per_s: electrons per second that all light of the fibre would give.
        background_e_per_s: electrons per second and pixel from elsewhere.
        gain: electrons per count.
        read_noise: electrons, standard deviation of a reading.
        black: counts without light.
        full: counts from which a pixel is full.
        bracket: exposures over the shortest, which is chosen for every image; longer ones that would fill more than
            a quarter of the frame are left out.
        within_relay: whether the description limits what is compared to the window that the relay passes whole. A
            relay that takes the corners from a window that is compared is taken for errors of the plate.
    """

    probe_m: float = 520e-9
    mode_field_m: float = 3.5e-6
    collimator_m: float = 100e-3
    relay_m: float = 75e-3
    relay_clear_m: float = 75e-3 / 2.8
    throughput: float | None = 0.86
    pixel_m: float | None = None
    margin: int = 24
    rotation_rad: float = math.radians(0.4)
    scale_y: float = 0.006
    scale_x: float = 0.004
    off_px: tuple[float, float] = (3.4, -5.2)
    depth_sigma_m: float = 0.1e-3
    source_e_per_s: float = 1e11
    background_e_per_s: float = 1e4
    gain: float = 2.0
    read_noise: float = 4.0
    black: int = 64
    full: int = 4095
    bracket: tuple[float, ...] = (1.0, 6.0, 60.0, 600.0)
    within_relay: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers that no bench has."""
        lengths = ("probe_m", "collimator_m", "relay_m", "relay_clear_m", "source_e_per_s", "gain")
        for name in lengths:
            if not getattr(self, name) > 0:
                raise InputError(name, "must be positive", getattr(self, name), "Correct it.")
        if self.throughput is not None and not 0 < self.throughput <= 1:
            raise InputError("throughput", "must be a share", self.throughput, "For example 0.86, or None.")
        if not self.bracket or min(self.bracket) < 1:
            cure = "For example (1.0, 6.0, 60.0, 600.0)."
            raise InputError("bracket", "must be exposures over the shortest, 1 or more", self.bracket, cure)

    @classmethod
    def exact(cls, **rest: Any) -> "PsfBench":
        """A bench whose light is that of `sim.psf`; `rest` as of the class."""
        still = {"rotation_rad": 0.0, "scale_y": 0.0, "scale_x": 0.0, "off_px": (0.0, 0.0), "depth_sigma_m": 0.0}
        wide = {"mode_field_m": 0.0, "relay_clear_m": math.inf, "throughput": None}
        return cls(**{**still, **wide, **rest})

    def scaled(self, share: float) -> "PsfBench":
        """The bench of a camera that is so many times as long: angles stay, so the fibre stays."""
        names = ("collimator_m", "relay_m", "relay_clear_m", "depth_sigma_m")
        return replace(self, **{name: getattr(self, name) * share for name in names})

    @property
    def divergence_rad(self) -> float:
        """Half angle of the fibre's light at 1/e² of its irradiance; infinite for a point."""
        return 2 * self.probe_m / (math.pi * self.mode_field_m) if self.mode_field_m else math.inf

    def beam_radius_m(self, depth_m: float) -> float:
        """Radius of the light on the plate at 1/e² of its irradiance, for a tip at a depth or collimated."""
        return self.divergence_rad * (self.collimator_m if math.isinf(depth_m) else depth_m)

    def passes(self, y_m: Any, x_m: Any, sine_y: Any, sine_x: Any) -> Any:
        """Whether a ray that leaves the plate at (y, x), metres, with these direction sines passes both lenses."""
        along_y, along_x, rim = self.relay_m * sine_y, self.relay_m * sine_x, self.relay_clear_m / 2
        first = np.hypot(y_m + along_y, x_m + along_x) < rim
        return first & (np.hypot(y_m - along_y, x_m - along_x) < rim)

    def passed_share(self, sine: Float[np.ndarray, "*s"], radius_m: float) -> Float[np.ndarray, "*s"]:
        """Share of a round aperture that passes light of a direction sine, by area; `radius_m` is the aperture's.

        The part inside both of two circles of the lenses' radius on either side of the middle, by Gauss's rule.
        """
        if math.isinf(self.relay_clear_m):
            return np.ones_like(sine)
        nodes, parts = np.polynomial.legendre.leggauss(64)
        across = radius_m * np.sin(np.pi / 2 * nodes)  # of strips along the direction of the light
        half = np.sqrt(radius_m**2 - across**2)
        rim = np.sqrt(np.maximum((self.relay_clear_m / 2) ** 2 - across**2, 0.0))
        open_ = np.clip(rim - self.relay_m * np.abs(sine)[..., None], 0.0, half)
        return (open_ / radius_m * np.cos(np.pi / 2 * nodes) * parts).sum(-1)


class BenchThroughput(NamedTuple):
    """Throughput of a plate on a bench, with the plate over without, for collimated light.

    Attributes:
        faces: what both uncoated faces of the substrate let pass.
        accepted: share of the light behind the plate that the relay passes.
        empty: the same without a plate.
        throughput: faces * accepted / empty, what a power meter behind the relay tells.
        stated: the bench's.
        needed: what `accepted` would have to be, over `empty`, for the stated throughput.
    """

    faces: float
    accepted: float
    empty: float
    throughput: float
    stated: float | None
    needed: float | None


def bench_camera(design: Design, bench: PsfBench) -> Camera:
    """The camera of a bench before a design: its one wavelength, its pixels, and a frame with a margin."""
    pixel_m = bench.pixel_m or design.camera.pixel_m
    window = round(design.camera.window * design.camera.pixel_m / pixel_m) + bench.margin
    probe = Colour("probe", (bench.probe_m,), (1.0,))
    return replace(design.camera, colours=(probe,), pixel_m=pixel_m, window=window, beam=None)


def clear_window(camera: Camera, bench: PsfBench) -> int:
    """Pixels per side of the largest window, without the frame's margin, that the relay passes whole.

    Args:
        camera: the bench's camera (`bench_camera`).
        bench: the bench.

    Raises:
        InputError: the relay leaves less than 16 pixels.
    """
    largest = camera.window - bench.margin
    if math.isinf(bench.relay_clear_m):
        return largest
    sine = max(bench.relay_clear_m / 2 - camera.opening.reach_m, 0.0) / bench.relay_m
    _, edge_m = camera.image_m(0.0, sine)
    found = min(largest, int(math.sqrt(2) * edge_m / camera.pixel_m))
    if found < 16:
        cure = "Take wider or shorter lenses."
        raise InputError("relay_clear_m", "the relay must leave 16 pixels", found, cure)
    return found


def bench_light(
    plate: CellOptic, bench: PsfBench, depth_m: float
) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]]:
    """Energy in every pixel, per unit power on the clear aperture, without the relay's stops and with them.

    Args:
        plate: the plate, with the bench's camera (`bench_camera`).
        bench: the bench.
        depth_m: of the source, metres; infinite for collimated light.
    """
    camera, (line,) = plate.camera, plate.lines
    y, x = camera.grid.axis_m("y")[:, None], camera.grid.axis_m("x")[None, :]
    beam = np.exp(-(y**2 + x**2) / bench.beam_radius_m(depth_m) ** 2)  # even for a point, whose radius is infinite
    beam /= np.sqrt(_mean_over_opening(beam**2, plate))
    seen = _sines_seen(camera, bench)
    image = partial(_image, plate, line, depth_m, bench)
    open_ = image(beam if bench.mode_field_m else None)
    radius, sine = camera.opening.reach_m, np.hypot(*seen)
    clear, dark = (bench.relay_clear_m / 2 - radius) / bench.relay_m, bench.relay_clear_m / 2 / bench.relay_m
    if sine.max() <= clear:
        return open_, open_
    passed = np.where(sine <= clear, open_, 0.0)
    # Between, every zone of directions sees its own part of the aperture; the opposite direction sees the same.
    low = max(clear, 0.0)
    ring = np.floor((sine - low) / (dark - low) * _ZONES[0]).astype(int)
    wedge = np.rint(np.arctan2(*seen) / np.pi * _ZONES[1]).astype(int) % _ZONES[1]
    zone = np.where((sine > clear) & (sine < dark), ring * _ZONES[1] + wedge, -1)
    for number in np.unique(zone[zone >= 0]):
        of = zone == number
        middle = low + (number // _ZONES[1] + 0.5) * (dark - low) / _ZONES[0]
        angle = (number % _ZONES[1]) * np.pi / _ZONES[1]
        window = bench.passes(y, x, middle * np.sin(angle), middle * np.cos(angle))
        passed[of] = image(beam * window)[of]
    return open_, passed


def _mean_over_opening(values: Float[np.ndarray, "y x"], plate: CellOptic) -> float:
    coverage = np.asarray(plate.coverage, np.float64)
    return float((values * coverage).sum() / coverage.sum())


def _sines_seen(camera: Camera, bench: PsfBench) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]]:
    """Direction sines (y, x) of the light that every pixel sees."""
    geometry = (bench.rotation_rad, bench.scale_y, bench.scale_x, 0.0)
    axis = camera.axis_m() / camera.pixel_m
    find = places(geometry, bench.off_px, camera.sensor_distance_m / camera.pixel_m)
    row, column = (np.asarray(part, np.float64) for part in find(*np.meshgrid(axis, axis, indexing="ij")))
    off_y, off_x = bench.off_px
    y, x = camera.sines_of((row - off_y) * camera.pixel_m, (column - off_x) * camera.pixel_m)
    return np.asarray(y), np.asarray(x)


def _image(
    plate: CellOptic,
    line: SpectralLine,
    depth_m: float,
    bench: PsfBench,
    amplitude: Float[np.ndarray, "cell_y cell_x"] | None,
) -> Float[np.ndarray, "y x"]:
    """Energy in every pixel of light with an amplitude on the plate, float64."""
    rows, columns = plate.rows(line, plate.source(line, depth_m))
    if amplitude is not None:
        rows = rows._replace(light=jnp.asarray(amplitude, jnp.complex64))
    plan, displaced, camera = plate.plan(line, depth_m), None, plate.camera
    turned = max(map(abs, (bench.rotation_rad, bench.scale_y, bench.scale_x)))
    if turned or any(bench.off_px):
        geometry = jnp.asarray([bench.rotation_rad, bench.scale_y, bench.scale_x, 0.0])
        off = jnp.asarray(bench.off_px)
        displaced = displacement_m(camera, geometry, off).at[:, 0].add(-off * camera.pixel_m)
        room = abs(bench.rotation_rad) + max(abs(bench.scale_y), abs(bench.scale_x))
        room += 2 * max(map(abs, bench.off_px)) / camera.window + _ROOM
        plan = plan_far_field(camera, line.wavelength_m, depth_m=depth_m, room=room)
    assert isinstance(plan, FarField)
    return line.factor * np.asarray(_energy(plan, camera, displaced, rows, columns), np.float64)


@eqx.filter_jit
def _energy(plan: FarField, camera: Camera, displaced: Array | None, rows: Any, columns: Any) -> Array:
    if displaced is not None:
        plan = bent(plan, camera, displaced)
    return plan.energy(doe_field, rows, columns)


def bench_throughput(plate: CellOptic, bench: PsfBench) -> BenchThroughput:
    """Throughput of a plate on a bench, for collimated light.

    The light of all directions behind the plate's cells, also that beyond half a wave per cell (its next two orders on
    either side), each with the share of the aperture that the relay passes.

    Args:
        plate: the plate, with the bench's camera.
        bench: the bench.
    """
    (line,) = plate.lines
    faces = plate.camera.transmission(bench.probe_m)
    accepted, empty = (
        _accepted(np.asarray(optic.field(line)), plate.camera, bench) for optic in (plate, HeightOptic.of(plate.camera))
    )
    found = faces * accepted / empty
    needed = None if bench.throughput is None else bench.throughput / faces
    return BenchThroughput(faces, accepted, empty, found, bench.throughput, needed)


def _accepted(field: np.ndarray, camera: Camera, bench: PsfBench) -> float:
    """Share of the power of a field of square cells in directions that pass the relay."""
    from scipy.fft import fft2, fftfreq

    if math.isinf(bench.relay_clear_m):
        return 1.0
    power = np.abs(np.asarray(fft2(field))) ** 2
    step = bench.probe_m / camera.grid.pitch_m
    reach, found = bench.relay_clear_m / 2 / bench.relay_m, 0.0
    nodes = np.linspace(0, reach, 512)
    of_nodes = bench.passed_share(nodes, camera.opening.reach_m)
    for order_y in range(-2, 3):
        for order_x in range(-2, 3):
            y, x = (fftfreq(n) + order for n, order in zip(field.shape, (order_y, order_x), strict=True))
            sine = step * np.hypot(y[:, None], x)
            if step * math.hypot(np.abs(y).min(), np.abs(x).min()) >= reach:
                continue
            shares = np.interp(sine, nodes, of_nodes, right=0.0)
            found += float((power * np.outer(np.sinc(y), np.sinc(x)) ** 2 * shares).sum())
    return found / float(power.sum())
