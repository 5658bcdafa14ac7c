"""Scene, light, sensor and obstruction: the tables [scene], [illumination], [sensor] and [obstruction].

What only `simulate` and `train` need may be left out; a spec without it stays what it was. The occlusion model has no
default, so that nobody uses one unawares: those two commands ask for it.
"""

from collections.abc import Mapping
from math import sin
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field

from doedesign.spec.values import (
    ANGLE,
    Count,
    FarDepth,
    NearDepth,
    NotNegative,
    OneOrList,
    Options,
    OptionsTable,
    Pitch,
    Positive,
    bounded,
    known,
    length,
    share,
)
from doedesign.spec.values.table import SpecTable, optional
from fab.units import MM, NM, UM

# The same names as in `sim`, which would bring jax along.
Occlusion = Literal["radiometric", "reciprocal", "paper", "paper_release"]
Noise = Literal["physical", "tseng", "release", "none"]
Bayer = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
OCCLUSION_MODELS, NOISE_MODELS, BAYER_PATTERNS = get_args(Occlusion), get_args(Noise), get_args(Bayer)
OBSTRUCTION_KINDS = ("fence", "raindrop", "dirt", "dirt_raindrop", "dirt_raindrop_fence")
OBSTRUCTION_KINDS += ("release_fence", "release_raindrop", "release_dirt", "folder")


def _as_list(value: Any) -> Any:
    # One number stands for every colour. A mapping is refused by the list's own rule.
    return value if isinstance(value, list | tuple | Mapping) else (value,)


Efficiency = Annotated[float, Field(strict=True, gt=0, le=1)]
Efficiencies = Annotated[tuple[Efficiency, ...], OneOrList(_as_list)]


class SceneSpec(SpecTable, frozen=True):
    """Where light comes from, measured from the plate.

    Attributes:
        near_m: depths of the obstruction, each once; may be empty where no objective looks at it.
        far_m: depths of the scene behind it, each once; "inf" in TOML for a star.
        occlusion: how an obstruction takes light from what lies behind it (`sim.imaging.occlusion`): "radiometric"
            follows the light and leaves the PSF its shape, "reciprocal" lets a shadow change that, "paper" is eq. 10,
            "paper_release" what the paper's public code does.
    """

    near_m: tuple[NearDepth, ...] = Field(default=(), examples=['["5 cm"]'])
    far_m: tuple[FarDepth, ...] = Field(min_length=1, examples=['["5 m", "10 m"]'])
    occlusion: Occlusion | None = optional()


Axis = Annotated[float, length(-1.0, 1.0)]
Tilt = Annotated[float, bounded("rad", -1.2, 1.2)]
Diameter = Annotated[float, length(1 * UM, 1.0)]
Quality = Annotated[float, share(1.0, 3.0)]


class IlluminationSpec(SpecTable, frozen=True):
    """The beam that lights the DOE, instead of a source at a depth. Energies are shares of its power.

    Attributes:
        kind: "gaussian"; "picture" for a measured beam with a plane wavefront; "plane" or "point" for light that is as
            bright all over the aperture, a plane wave or one that comes from a point.
        diameters_m: one diameter or [x, y] at the waist, between the places where the intensity is 1/e² of that in the
            middle.
        waist_distance_m: distance of the waist before the DOE, negative behind it.
        m_squared: beam quality M², one number or [x, y], up to 3: modes of which a beam is the incoherent sum grow in
            number with its square, and the time of a PSF with them.
        picture: a file with the beam's intensity, linear: PNG or TIFF, relative to the spec file.
        pixel_m: distance of its pixels on the DOE.
        centre_m: [x, y] of the beam's axis, or of the picture's middle, on the DOE.
        distance_m: distance of a point before the DOE.
        angles_rad: [x, y] between the beam's axis and that of the DOE, positive where light travels toward +x or +y.
            Images lie about the axis of the beam.
        tilt_rad: [x, y] of the beam against the axis of the DOE, for a sensor that stays where it is: images move by
            distance x sin(tilt), the focal length being the distance behind a lens, or by the angle itself where there
            is no sensor. Far field only. Spots and areas stay where they are asked for; orders of a unit cell move.
    """

    kind: Literal["plane", "gaussian", "picture", "point"] = "gaussian"
    diameters_m: Annotated[tuple[Diameter, ...], OneOrList(_as_list)] = optional((), example='"5 mm"')
    waist_distance_m: Annotated[float, length(-100.0, 100.0)] = optional(0.0)
    m_squared: Annotated[tuple[Quality, ...], OneOrList(_as_list)] = optional((1.0,))
    picture: str | None = optional(example='"beam.png"')
    pixel_m: Annotated[float, length(10 * NM, 10 * MM)] | None = optional(example='"3.45 um"')
    centre_m: tuple[Axis, Axis] = optional((0.0, 0.0))
    distance_m: FarDepth | None = optional(example='"10 cm"')
    angles_rad: tuple[Tilt, Tilt] = optional((0.0, 0.0))
    tilt_rad: tuple[Tilt, Tilt] = optional((0.0, 0.0))


class ObstructionSpec(SpecTable, frozen=True):
    """Obstruction in front of the scene.

    Attributes:
        kind: kind of obstruction; a mixed kind is one of its parts, by lot.
        options: physical parameters of the kind where they are not its usual ones (`sim.obstruction`): lengths and
            angles as text with a unit, ranges as lists of two. Its distance is `depth`; unless given, it lies between
            the nearest and the farthest of `scene.near`. In a mixed kind an option begins with the name of its part,
            such as `dirt_clump`.
    """

    kind: Annotated[str, known("kind of obstruction", OBSTRUCTION_KINDS)] = Field(examples=['"dirt"'])
    options: OptionsTable = optional(Options(), example='{ depth = ["5 cm", "8 cm"] }')


class SensorSpec(SpecTable, frozen=True):
    """The sensor behind the lens. What is said of light is in `sim.sensor`, whose usual values hold where nothing is.

    Attributes:
        pitch_m: distance of neighbouring photosites.
        pixel_angle_rad: in place of `pitch`, where there is neither lens nor `distance`: light is looked at by its
            direction, and a pixel in the middle is so wide. All pixels are equally wide in the sine of the angle, which
            is wavelength x order / period for a grating.
        resolution: photosites along x and along y (as in "4000 x 3000"); for captures alone.
        binning: photosites per pixel and axis.
        window: pixels per side of the square, centred on the chief ray, over which PSFs are computed; binned.
        fill_factor: side of a pixel's light-sensitive square over its pitch; a length ratio, so 0.9 collects
            81 % of the light.
        defocus_m: distance of the sensor beyond the focal plane.
        distance_m: distance of the sensor behind the DOE where there is no lens.
        full_well_e: electrons that a pixel holds, after binning.
        exposure: share of the full well that a white of the scene fills through a lossless lens.
        quantum_efficiency: electrons per photon, one number or one per colour.
        read_noise_e: standard deviation of a reading, electrons.
        dark_e: mean number of electrons of dark current.
        black_level: raw number of a pixel without electrons; by default a 64th of all raw numbers with "physical"
            noise, 0 with another.
        bits: bits of a raw number.
        bayer: the four upper left photosites of a mosaic, row by row; every pixel sees every colour if left out.
        noise: noise model (`sim.sensor`): "physical", which is that of electrons and the usual one, "tseng" or
            "release", those of other codes, or "none".
    """

    angles: ClassVar = {"pixel_angle_rad": ANGLE}

    pitch_m: Pitch | None = optional(example='"1.85 um"')
    pixel_angle_rad: Annotated[float, bounded("rad", 1e-8, 1.2)] | None = optional(example='"0.005 deg"')
    resolution: tuple[Count, Count] | None = optional(example="[4000, 3000]")
    binning: Annotated[int, Field(strict=True, ge=1, le=64)] = 1
    window: Annotated[int, Field(strict=True, ge=2, le=8192, examples=["512"])]
    fill_factor: Annotated[float, Field(strict=True, gt=0, le=1)] = 1.0
    defocus_m: Annotated[float, length(-10 * MM, 10 * MM)] = 0.0
    distance_m: Annotated[float, length(1 * UM, 1e6)] | None = optional(example='"50 mm"')
    full_well_e: Positive | None = optional(example="10000.0")
    exposure: Annotated[float, Field(strict=True, gt=0, le=100)] | None = optional(example="0.8")
    quantum_efficiency: Efficiencies = optional((), example="[0.5, 0.6, 0.55]")
    read_noise_e: NotNegative | None = optional(example="2.5")
    dark_e: NotNegative | None = optional(example="1.0")
    black_level: NotNegative | None = optional(example="64.0")
    bits: Annotated[int, Field(strict=True, ge=1, le=16)] | None = optional(example="12")
    bayer: Bayer | None = optional()
    noise: Noise | None = optional()

    @property
    def in_angles(self) -> bool:
        """Whether there is no sensor, but directions."""
        return self.pixel_angle_rad is not None

    @property
    def pixel_m(self) -> float:
        """Distance of neighbouring pixels after binning, or their width as a direction sine."""
        return self.binning * (sin(self.pixel_angle_rad) if self.pixel_angle_rad is not None else self.pitch_m or 0.0)

    @property
    def window_m(self) -> float:
        """Side of the window."""
        return self.pixel_m * self.window
