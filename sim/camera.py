"""Lens, sensor and DOE substrate of a camera, and the light that arrives at it.

The DOE sits on a thin lens in the aperture plane (paper §3.1). For a sensor at the focal distance the lens cancels the
quadratic term of Fresnel propagation and only the source's own path differences and the DOE remain (eq. 7); a sensor
out of focus, or one without a lens, leaves a quadratic remainder (`Camera.curvature_per_m`).
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Complex, Float

from fab.aperture import Aperture, aperture_from, diameter_of
from fab.errors import InputError
from fab.grid import Grid
from fab.units import DEGREES, PlaceUnit, format_length, is_whole, number_of
from sim.illumination import Beam, EvenBeam, GaussianBeam, MeasuredBeam, beam_amplitude, beam_irradiance
from sim.lens import IDEAL, Distortion, Mapping, check_lens, direction_sines, distorted_place, image_place, sines_at
from sim.material import fresnel_transmission, material, refractive_index, waves_per_metre

_PARAXIAL = 0.02  # wave
# Without a lens an image is that of the axis, moved, while an oblique chief ray adds less than so much of a wave of
# astigmatism and coma at the rim (a Strehl ratio above 0.98) and of the distances of places.
_ASLANT, _STRETCHED = 0.05, 0.01
_LONGEST_M = 1e-3  # wavelength; a longer one is in other units
Light = Literal["scalar", "edges"]
Polarised = Literal["unpolarised", "x", "y"]


@dataclass(frozen=True)
class Colour:
    """One colour channel.

    Attributes:
        name: name of the channel.
        wavelengths_m: vacuum wavelengths, metres; a list or an array is made a tuple.
        weights: their weights, none negative, which sum to 1.

    Raises:
        InputError: a wavelength that is not positive or longer than 1 mm, another number of weights than of
            wavelengths, negative weights, or weights that do not sum to 1.
    """

    name: str
    wavelengths_m: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        """Make tuples of both, so that a camera can be hashed, and refuse what is no spectrum."""
        for key in ("wavelengths_m", "weights"):
            object.__setattr__(self, key, _numbers(f"colour {self.name}: {key}", getattr(self, key)))
        if not all(0 < wavelength <= _LONGEST_M for wavelength in self.wavelengths_m):
            rule, cure = "must be metres, positive and at most 1 mm", "For example (550e-9,)."
            raise InputError(f"colour {self.name}: wavelengths_m", rule, f"{self.wavelengths_m}", cure)
        if not all(weight >= 0 for weight in self.weights):
            rule, cure = "must be numbers that are not negative", "Leave wavelengths without light out."
            raise InputError(f"colour {self.name}: weights", rule, f"{self.weights}", cure)
        if len(self.wavelengths_m) != len(self.weights) or abs(sum(self.weights) - 1) > 1e-6:
            rule, got = "must be one for each wavelength, together 1", f"{self.weights} for {len(self.wavelengths_m)}"
            raise InputError(f"colour {self.name}: weights", rule, got, "Divide them by their sum.")


def _numbers(where: str, given: Any) -> tuple[float, ...]:
    """Several numbers as a tuple of floats; an InputError for anything else."""
    try:
        # Text would be as many numbers as it has digits.
        return () if isinstance(given, str) else tuple(float(number) for number in given)
    except (TypeError, ValueError) as error:
        raise InputError(where, "must be a list of numbers", repr(given), "Give a single one as [1.0].") from error


def _require_length(name: str, value: Any, *, signed: bool = False, infinite: bool = False) -> None:
    """Raise an InputError unless a value is a number of metres: finite and above 0, unless other ones will do, too."""
    number = number_of(value)
    if (math.isfinite(number) or (infinite and number == math.inf)) and (signed or number > 0):
        return
    rule = f"must be metres, a{'' if signed else ' positive'} number{' or infinity' if infinite else ' that is finite'}"
    raise InputError(name, rule, repr(value), "For example 5e-3 for 5 mm.")


def require_colour(camera: "Camera", colour: int) -> None:
    """Raise an `InputError` for what is no number of one of a camera's colours."""
    if not is_whole(colour, 0, len(camera.colours) - 1):
        rule = f"must be the number of a colour, 0 to {len(camera.colours) - 1}"
        raise InputError("colour", rule, repr(colour), f"They are {', '.join(one.name for one in camera.colours)}.")


def require_same_grid(camera: "Camera", grid: Grid) -> None:
    """Raise an InputError unless the DOE of a camera lies on this grid, that of a plate."""
    if camera.grid != grid:
        shown, own = (
            f"{one.shape[0]} x {one.shape[1]} cells of {format_length(one.pitch_m)}" for one in (grid, camera.grid)
        )
        raise InputError("camera", f"must have the grid of the plate, {shown}", own, "Make it with the plate's grid.")


class SpectralLine(NamedTuple):
    """One wavelength of a colour channel.

    Attributes:
        colour: number of the channel.
        wavelength_m: vacuum wavelength, metres.
        factor: weight in the channel times the power that passes the substrate's two faces; of a beam of several modes
            times the share of the mode.
        mode: number of the mode of the beam (`sim.illumination`).
    """

    colour: int
    wavelength_m: float
    factor: float
    mode: int = 0


@dataclass(frozen=True)
class Camera:
    """Everything that is fixed while a DOE is designed. Hashable: it may be a static argument of `jit`.

    Attributes:
        grid: cells of the DOE.
        aperture: the clear aperture (`fab.aperture`); a number is the diameter of a round one, metres. Beyond the grid
            it is dark.
        material: substrate, a name that `sim.material.material` takes.
        colours: colour channels, in the order of the bank's first axis; a list is made a tuple.
        focal_length_m: focal length of the lens.
        pixel_m: centre-to-centre distance of sensor pixels, after binning.
        window: sensor pixels computed per axis, centred on the chief ray; for an even count the chief ray
            falls on the corner shared by the four middle pixels, for an odd one on the middle pixel's centre.
        fill: side of a pixel's light-sensitive square over `pixel_m`, 0-1.
        defocus_m: distance of the sensor beyond the focal plane.
        mapping: how the lens images directions: light at an angle to the axis lands at the height r = d sin(angle)
            ("sine") or d tan(angle) ("tangent", a lens without distortion) on a sensor at the distance d.
        distortion: (k1, k2), by which that height changes: to r (1 + k1 (r/d)² + k2 (r/d)⁴). Negative numbers make
            a barrel, positive ones a pincushion. An InputError if the image would fold over near the window.
        doe_distance_m: distance of the DOE before the lens. Depths count from the DOE. The lens must be wide enough for
            all light that passes the aperture: nothing is vignetted.
        light: "scalar" for a thin element, "edges" for one whose walls add their light (`sim.rigorous.edge_optic`).
        polarisation: "unpolarised", or "x" or "y", the axis along which the electric field lies; for light with edges.
        distance_m: distance of the sensor behind the DOE where there is no lens and `focal_length_m` is infinite. At
            infinity there is no sensor but directions: `pixel_m` and all places are direction sines.
        beam: the beam that lights the DOE, of whose power energies are shares; None for plane or spherical waves, whose
            power is that on the clear aperture.

    Raises:
        InputError: a value of another kind, a length that is not positive or not finite where it has to be, an
            aperture that is narrower than a cell, a sensor that would lie before the lens, an unknown substrate or
            word, or a lens that cannot image the window.
    """

    grid: Grid
    aperture: Aperture | float
    material: str
    colours: tuple[Colour, ...]
    focal_length_m: float
    pixel_m: float
    window: int
    fill: float = 1.0
    defocus_m: float = 0.0
    mapping: Mapping = "sine"
    distortion: Distortion = IDEAL
    doe_distance_m: float = 0.0
    light: str = "scalar"
    polarisation: str = "unpolarised"
    distance_m: float | None = None
    beam: Beam | None = None

    def __post_init__(self) -> None:
        """Refuse values that no camera has, a lens that cannot image the window, and words that mean nothing here."""
        object.__setattr__(self, "aperture", aperture_from(self.aperture))
        if isinstance(self.colours, list):
            object.__setattr__(self, "colours", tuple(self.colours))
        self._require_kinds()
        self._require_lengths()
        self._require_opening()
        if not 0 < number_of(self.fill) <= 1:
            cure = "Give the side of a pixel over its pitch."
            raise InputError("fill", "must lie above 0, up to 1", repr(self.fill), cure)
        if math.isinf(self.focal_length_m) != (self.distance_m is not None):
            got = f"a focal length of {self.focal_length_m:g} m and a distance of {self.distance_m} m"
            rule, cure = "a camera has a lens, or a sensor at a distance", "Give a distance without a lens only."
            raise InputError("distance_m", rule, got, cure)
        if self.distance_m is not None and (self.mapping != "sine" or any(self.distortion) or self.doe_distance_m):
            rule = "without a lens there is no mapping, distortion or distance before it"
            raise InputError("mapping", rule, self.lens_text, "Leave them out.")
        if self.in_angles and self.window * self.pixel_m > 2 * (1 + 1e-9):
            rule, got = "directions end at a sine of 1", f"{self.window * self.pixel_m / 2:.4g} at the window's edge"
            raise InputError("window", rule, got, f"Choose at most {int(2 / self.pixel_m)} pixels, or finer ones.")
        if not self.sensor_distance_m > 0:
            got = f"a defocus of {format_length(self.defocus_m)} for a focal length of {self.focal_length_m:g} m"
            rule, cure = "the sensor must lie behind the lens", "Choose a defocus above minus the focal length."
            raise InputError("defocus_m", rule, got, cure)
        if self.distance_m is None and self.pixel_m > 2 * self.sensor_distance_m:
            rule = f"must be at most twice the sensor's distance, {format_length(self.sensor_distance_m)}"
            raise InputError("pixel_m", rule, format_length(self.pixel_m), "Give metres, such as 3e-6 for 3 um.")
        check_lens(self.mapping, self.distortion, self.window * self.pixel_m / 2**0.5 / self.sensor_distance_m)
        for key, words in (("light", get_args(Light)), ("polarisation", get_args(Polarised))):
            if getattr(self, key) not in words:
                rule = f"must be one of {', '.join(words)}"
                raise InputError(key, rule, repr(getattr(self, key)), "Choose one of them.")

    def _require_kinds(self) -> None:
        """Raise an InputError for a value of another kind than it has to be."""
        if not isinstance(self.grid, Grid):
            cure = "Give a fab.Grid(shape, pitch_m)."
            raise InputError("grid", "must be the raster of the DOE", type(self.grid).__name__, cure)
        material(self.material)
        colours: Any = self.colours
        if not isinstance(colours, tuple) or not colours or not all(isinstance(one, Colour) for one in colours):
            cure = 'For example (sim.Colour("green", (550e-9,), (1.0,)),).'
            raise InputError("colours", "must be colour channels", repr(colours), cure)
        if not isinstance(self.beam, GaussianBeam | MeasuredBeam | EvenBeam | None):
            cure = "For example sim.GaussianBeam((1e-3, 1e-3)), or None for plane light."
            raise InputError("beam", "must be a beam of sim", repr(self.beam), cure)
        if not is_whole(self.window, 1):
            rule = "must be a whole number of pixels, at least 1, for both axes"
            raise InputError("window", rule, repr(self.window), "For example 128.")

    def _require_lengths(self) -> None:
        """Raise an InputError for a length that is no number, or one that no camera has."""
        _require_length("focal_length_m", self.focal_length_m, infinite=True)
        _require_length("pixel_m", self.pixel_m)
        _require_length("defocus_m", self.defocus_m, signed=True)
        _require_length("doe_distance_m", self.doe_distance_m, signed=True)
        if self.distance_m is not None:
            _require_length("distance_m", self.distance_m, infinite=True)

    def _require_opening(self) -> None:
        """Raise an InputError for a clear aperture that is narrower than a cell, or infinite."""
        cell_m = self.grid.pitch_m
        if not all((1 - 1e-9) * cell_m <= side < math.inf for side in self.opening.extent_m):
            rule = f"must be at least a cell wide, {format_length(cell_m)}, and finite"
            raise InputError("aperture", rule, str(self.opening), "Give its diameter, or width and height, in metres.")

    @property
    def in_angles(self) -> bool:
        """Whether light is looked at by its direction, and not on a sensor; pixels are equally wide in the sine."""
        return self.distance_m == math.inf

    def told_in(self, unit: PlaceUnit) -> PlaceUnit:
        """The unit in which to tell places: the one given, or degrees where there is no sensor."""
        return DEGREES if self.in_angles else unit

    @property
    def opening(self) -> Aperture:
        """The clear aperture."""
        return aperture_from(self.aperture)

    @property
    def aperture_m(self) -> float:
        """Diameter of a round clear aperture, metres; an InputError for another."""
        return diameter_of(self.opening)

    @property
    def is_sine(self) -> bool:
        """Whether places on the sensor are direction sines, times its distance."""
        return self.mapping == "sine" and not any(self.distortion)

    @property
    def sensor_distance_m(self) -> float:
        """Distance at which directions through the DOE's middle have their places: from the lens to the sensor.

        For a DOE at a distance s before the lens it is the element B of the ray matrix from DOE to sensor,
        d + s (1 - d/f) with d from lens to sensor, which Collins' integral has in place of d (S. A. Collins, J. Opt.
        Soc. Am. 60, 1168, 1970). In the focal plane B = f whatever s is, and nothing is left of the lens's curvature:
        there s changes phases on the sensor alone. Without a lens B = d, and 1 where places are direction sines.
        """
        if self.in_angles:
            return 1.0
        if self.distance_m is not None:
            return self.distance_m
        return self.focal_length_m + self.defocus_m - self.doe_distance_m * self.defocus_m / self.focal_length_m

    def curvature_per_m(self, source_per_m: float = 0.0) -> float:
        """Curvature of the wave behind the DOE as the sensor's distance has it, for a source's curvature at the DOE.

        Lens and propagation leave A/B of the ray matrix, 1/d - 1/f for a DOE on the lens, and 0 in the focal plane and
        at infinity.
        """
        if self.in_angles:
            return source_per_m
        if self.doe_distance_m:
            return source_per_m - self.defocus_m / self.focal_length_m / self.sensor_distance_m
        return source_per_m + 1 / self.sensor_distance_m - 1 / self.focal_length_m

    @property
    def lines(self) -> tuple[SpectralLine, ...]:
        """Every wavelength of every colour, colour by colour, and of each every mode of the beam."""
        return tuple(
            SpectralLine(number, wavelength, weight * self.transmission(wavelength) * share, mode)
            for number, colour in enumerate(self.colours)
            for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True)
            for mode, share in enumerate(self.shares)
        )

    @property
    def shares(self) -> tuple[float, ...]:
        """Power of every mode of the beam, together 1; `lines` has as many of every wavelength."""
        return (1.0,) if self.beam is None else self.beam.shares

    def chief_rad(self, field_rad: tuple[float, float]) -> tuple[float, float]:
        """Angles (y, x) that the window follows, at field angles about the axis of the beam or that of the lens."""
        return field_rad if self.beam is None else _sum(field_rad, self.beam.angle_rad)

    def light_rad(self, field_rad: tuple[float, float]) -> tuple[float, float]:
        """Angles (y, x) at which light arrives: `chief_rad`, and what the beam is tilted by beside the window."""
        chief_rad = self.chief_rad(field_rad)
        return chief_rad if self.beam is None else _sum(chief_rad, self.beam.tilt_rad)

    @property
    def is_tilted(self) -> bool:
        """Whether light arrives at an angle that the sensor's window does not follow."""
        return self.beam is not None and any(self.beam.tilt_rad)

    @property
    def images_alike(self) -> bool:
        """Whether pixels lie evenly among the sines about the chief ray, whatever its angle."""
        return self.is_sine and not self.is_tilted

    @property
    def sees_field(self) -> bool:
        """Whether the pixels of a window depend on its chief ray otherwise than by lying about it."""
        return self.in_angles or not self.images_alike

    def moved_sines(self, chief_rad: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
        """Direction sines (y, x) by which a tilted beam moves images, for the angles of the window's chief ray."""
        if self.beam is None or not self.is_tilted:
            return 0.0, 0.0
        y, x = direction_sines(_sum(chief_rad, self.beam.tilt_rad)) - direction_sines(chief_rad)
        return float(y), float(x)

    def beam_curvature_per_m(self, wavelength_m: float) -> float:
        """Curvature of the beam's wavefront at the DOE, beside that of a source; 0 without a beam."""
        return 0.0 if self.beam is None else self.beam.curvature_per_m(wavelength_m)

    def incident(self, line: SpectralLine) -> Complex[np.ndarray, "y x"] | None:
        """Amplitude of a mode of the beam on the cells, whose square is 1 for plane light; None without a beam."""
        if self.beam is None:
            return None
        return beam_amplitude(self.beam, self.grid, self.opening, line.wavelength_m, line.mode)

    def irradiance(self, wavelength_m: float) -> Float[np.ndarray, "y x"] | None:
        """Irradiance on the cells, 1 for plane light; None without a beam."""
        if self.beam is None:
            return None
        return beam_irradiance(self.beam, self.grid, self.opening, wavelength_m)

    @property
    def propagation(self) -> Literal["far_field", "angular_spectrum"]:
        """How light gets to the sensor unless one asks for another way.

        "far_field" behind a lens, and without one from `far_from_m` on; "angular_spectrum" where the sensor is nearer.
        """
        return "far_field" if self.distance_m is None or self.distance_m >= self.far_from_m else "angular_spectrum"

    @property
    def far_from_m(self) -> float:
        """Distance without a lens from which on the far field holds for this aperture and window.

        Its quadratic phase is right to `_PARAXIAL` of a wave of fourth order from the rim to a corner of the window,
        and cells can follow it: cells pitch² / wavelength is at most the distance.
        """
        shortest = min(w for colour in self.colours for w in colour.wavelengths_m)
        reach = self.opening.reach_m + self.window * self.pixel_m / math.sqrt(2)
        follows = max(self.grid.shape) * self.grid.pitch_m**2 / shortest
        return max(follows, (reach**4 / (8 * shortest * _PARAXIAL)) ** (1 / 3))

    def require_image(self, field_rad: tuple[float, float]) -> None:
        """Raise an `InputError` for a field angle at which a distorted image folds over within the window.

        Or for one beside a beam from a point, whose wavefront has the beam's own angle alone.
        """
        if isinstance(self.beam, EvenBeam) and math.isfinite(self.beam.distance_m) and any(field_rad):
            rule, cure = "a beam from a point has an angle of its own", "Give the beam that angle."
            raise InputError("field_rad", rule, f"{field_rad} besides", cure)
        chief_rad = self.chief_rad(field_rad)
        if self.distance_m is not None or self.is_sine or not any(chief_rad):
            return
        chief = distorted_place(self.mapping, self.distortion, float(np.hypot(*direction_sines(chief_rad))))
        corner = self.window * self.pixel_m / 2**0.5 / self.sensor_distance_m
        check_lens(self.mapping, self.distortion, chief + corner)

    def require_upright(self, field_rad: tuple[float, float]) -> None:
        """Raise an `InputError` for a chief ray so aslant that a sensor without a lens sees another image than on axis.

        A lens images all directions alike; without one the wave to a place aside has astigmatism and coma, r² / 2d and
        r³ / 2d² times functions of the angle, which are left out here.
        """
        chief_rad = self.chief_rad(field_rad)
        if self.distance_m is None or self.in_angles or not any(chief_rad):
            return
        sine, most = float(np.hypot(*direction_sines(chief_rad))), self._steepest_sine
        if sine > most:
            where = "field_rad" if any(field_rad) else "illumination.angle"
            rule = (
                f"without a lens, light must arrive within {math.degrees(math.asin(most)):.2g} degrees of the axis here"
            )
            cure = "Leave it out, or look through a lens; of beams give the tilt, which the sensor does not follow."
            raise InputError(where, rule, f"{math.degrees(math.asin(sine)):.3g} degrees", cure)

    @property
    def _steepest_sine(self) -> float:
        """Largest sine of a chief ray for `require_upright`, of a sensor without a lens."""
        assert self.distance_m is not None
        rim, shortest = self.opening.reach_m, min(w for colour in self.colours for w in colour.wavelengths_m)
        sines = np.linspace(0.0, 0.1, 1001)  # places are stretched by more from 0.082 on
        stretched = (1 - sines**2) ** -1.5 - 1
        astigmatism = rim**2 / (2 * self.distance_m) * (1 - (1 - sines**2) ** 1.5)
        coma = rim**3 / (2 * self.distance_m**2) * sines
        seen = (astigmatism + coma <= _ASLANT * shortest) & (stretched <= _STRETCHED)
        return float(sines[seen][-1])

    def axis_m(self) -> Float[np.ndarray, " window"]:
        """Pixel centres on the sensor relative to the chief ray, metres."""
        return Grid((self.window, self.window), self.pixel_m).axis_m("x")

    @property
    def lens_text(self) -> str:
        """The lens's mapping in words, or that there is none."""
        if self.in_angles:
            return "no lens, directions of light; pixels are equally wide in the sine of the angle"
        if self.distance_m is not None:
            return f"no lens, sensor {format_length(self.distance_m)} behind the DOE"
        names = {"sine": "places follow the sine of the angle", "tangent": "places follow the tangent of the angle"}
        k1, k2 = self.distortion
        bent = f", distortion k1 = {k1:g}, k2 = {k2:g}" if any(self.distortion) else ""
        before = f", DOE {format_length(self.doe_distance_m)} before the lens" if self.doe_distance_m else ""
        return names[self.mapping] + bent + before

    def image_m(self, sine_y: Any, sine_x: Any) -> tuple[Any, Any]:
        """Place (y, x) on the sensor, metres from the axis, of light with these direction sines."""
        y, x = image_place(self.mapping, self.distortion, sine_y, sine_x)
        return y * self.sensor_distance_m, x * self.sensor_distance_m

    def sines_of(self, y_m: Any, x_m: Any) -> tuple[Any, Any]:
        """Direction sines (y, x) of the light that lands at a place on the sensor; the inverse of `image_m`."""
        distance = self.sensor_distance_m
        return sines_at(self.mapping, self.distortion, y_m / distance, x_m / distance)

    def transmission(self, wavelength_m: float) -> float:
        """Power that passes both faces of the uncoated substrate."""
        return fresnel_transmission(refractive_index(self.material, wavelength_m))

    def waves_per_metre(self, wavelength_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> float:
        """Waves of delay per metre of DOE height (eq. 2), along the chief ray (`sim.material.waves_per_metre`)."""
        square = float(np.sum(np.square(direction_sines(self.light_rad(field_rad)))))
        return waves_per_metre(self.material, wavelength_m, square)

    def defocus_radius_m(self, depth_m: float) -> float:
        """Radius on the sensor of the geometric blur disc: R · |B/z + 1 - d/f|, or R f / z in the focal plane.

        R is how far the aperture reaches, B `sensor_distance_m` and d the distance from lens to sensor. Without a lens
        it is the aperture's shadow, and without a sensor the sine that the aperture fills as seen from the source.
        """
        inverse_depth = 0.0 if np.isinf(depth_m) else 1.0 / depth_m
        if self.in_angles:
            return self.opening.reach_m * inverse_depth
        if self.distance_m is not None:
            return self.opening.reach_m * (self.distance_m * inverse_depth + 1.0)
        distance = self.focal_length_m + self.defocus_m
        return self.opening.reach_m * abs(self.sensor_distance_m * inverse_depth + 1.0 - distance / self.focal_length_m)


def _sum(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    return one[0] + other[0], one[1] + other[1]
