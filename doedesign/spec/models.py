"""The spec: one frozen table per section of the TOML, without arrays and without defaults hidden elsewhere.

`focal_length = "8 mm"` in TOML becomes `focal_length_m = 0.008` (`doedesign.spec.values.table`). Everything is
compared, hashed and stored by value. Rules between two tables are in `checks`; `doedesign.spec.load_spec` applies both.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from doedesign.spec.order import OrderSpec
from doedesign.spec.process import LimitSpec, ProcessSpec
from doedesign.spec.robust import RobustSpec
from doedesign.spec.scene import IlluminationSpec, ObstructionSpec, SceneSpec, SensorSpec
from doedesign.spec.targets.areas import AreaSpec
from doedesign.spec.targets.focus import FocusSpec
from doedesign.spec.targets.spots import SpotsSpec
from doedesign.spec.training import NetworkSpec, TrainSpec
from doedesign.spec.values import (
    DEPTHS_OBJECTIVES,
    HEIGHT_FILES,
    OBJECTIVES,
    STARTS,
    ColourName,
    Count,
    FarDepth,
    NotNegative,
    Options,
    OptionsTable,
    Pitch,
    Positive,
    Seed,
    Steps,
    accepted,
    broken,
    from_toml,
    is_start,
    length,
    share,
)
from doedesign.spec.values.aperture import ApertureSizes, MaskRows, Samples, shape_of
from doedesign.spec.values.table import SpecTable, optional
from doedesign.spec.wafer import WaferSpec
from fab.aperture import Aperture, aperture_from
from fab.units import DEGREES, MM, NM, UM, PlaceUnit, parse_length
from sim.camera import Light, Polarised
from sim.material import MATERIALS, is_material

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_FUNCTION = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")

Wavelength = Annotated[float, length(200 * NM, 20 * UM)]
Substrate = Annotated[
    str, accepted(is_material, "must be a known material, or an index as n=1.52 or n=1.586,V=29.9", MATERIALS)
]
Distortion = Annotated[float, share(-10.0, 10.0)]
SpecName = Annotated[
    str, accepted(_FILE_NAME.fullmatch, "must be a file name of at most 64 letters, digits, dots, dashes")
]
ObjectiveName = Annotated[
    str,
    accepted(
        lambda name: name in OBJECTIVES or _FUNCTION.fullmatch(name),
        'must be a known objective or a function as "module:function"',
        OBJECTIVES,
    ),
]
Start = Annotated[
    str,
    accepted(
        is_start,
        f"must be a known start or a height map file ({', '.join(HEIGHT_FILES)})",
        STARTS,
    ),
]


class ColourSpec(SpecTable, frozen=True):
    """Colour channel of the camera.

    Attributes:
        name: channel name, also in the files of PSF banks.
        wavelengths_m: vacuum wavelengths of the channel.
        weights: share of each wavelength; equal shares if none are given, and scaled to sum to 1.
    """

    name: ColourName = Field(examples=['"red"'])
    wavelengths_m: tuple[Wavelength, ...] = Field(min_length=1, examples=['["656 nm"]'])
    weights: tuple[Positive, ...] = Field(default=(), validate_default=True, examples=["[1.0]"])

    @field_validator("weights")
    @classmethod
    def _complete(cls, weights: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        count = len(info.data.get("wavelengths_m", weights))
        if not weights:
            return (1.0 / count,) * count if count else ()
        if len(weights) != count:
            raise broken(f"must have one entry per wavelength, {count} here", "Add or remove weights.")
        total = sum(weights)
        # Weights that already sum to 1 stay untouched, so that reading a spec twice changes no digit.
        shares = weights if abs(total - 1) < 1e-12 else tuple(weight / total for weight in weights)
        if not all(part > 0 for part in shares):
            raise broken("must be numbers whose shares of their sum are above 0", "Choose numbers nearer to 1.")
        return shares


class OpticsSpec(SpecTable, frozen=True):
    """Lens and light.

    Attributes:
        focal_length_m: focal length of the camera lens the DOE sits on; left out where there is none, and the sensor
            has a `distance` or a `pixel_angle`.
        design_wavelength_m: wavelength at which the full height of the levels should be one wave.
        colours: colour channels, in the order of a PSF bank's first axis. In TOML, `wavelengths = ["656 nm",
            "589 nm"]` is short for one channel of one wavelength each, named after it ("656nm"), and
            `spectral_response = "camera.csv"` for those of a measured camera (`doedesign.spec.response`).
        propagation: "far_field" (the lens cancels the quadratic phase, paper eqs. 7-9) or "fresnel" (the wave is
            propagated from the lens to the sensor, eq. 5; needs a fine pitch, eq. 6).
        mapping: where the lens images a direction: at a height of f sin(angle), "sine", as the bare Fourier transform
            has it, or of f tan(angle), "tangent", as a lens without distortion does.
        distortion: [k1, k2], by which that height r changes: to r (1 + k1 (r/f)² + k2 (r/f)⁴); negative numbers make
            a barrel, positive ones a pincushion. Far field only, as is "tangent".
        doe_distance_m: distance of the DOE before the lens. Depths of the scene count from the DOE, and the lens must
            let all its light pass. It matters only to a sensor out of focus. Far field only.
        light: "scalar" (a thin element) or "edges" (walls between cells add their light, certified against Maxwell's
            equations; up to one and a half times the time). The loss of objectives for cells has them; rings, spots,
            areas and foci are searched for as thin elements, and judged with their edges.
        polarisation: of the light at walls: "unpolarised", or "x" or "y", the axis of the electric field.
    """

    focal_length_m: Annotated[float, length(10 * UM, 100.0)] | None = optional(example='"8 mm"')
    design_wavelength_m: Wavelength = Field(examples=['"550 nm"'])
    colours: tuple[ColourSpec, ...] = Field(min_length=1)
    propagation: Literal["far_field", "fresnel"] = "far_field"
    mapping: Literal["sine", "tangent"] = optional("sine")
    distortion: tuple[Distortion, Distortion] = optional((0.0, 0.0))
    doe_distance_m: Annotated[float, length(0.0, 100.0)] = optional(0.0)
    light: Light = optional("scalar")
    polarisation: Polarised = optional("unpolarised")

    @model_validator(mode="before")
    @classmethod
    def _spread_wavelengths(cls, table: Any, info: ValidationInfo) -> Any:
        short = from_toml(info.context) and isinstance(table, dict) and "wavelengths" in table
        if not short or "colours" in table:
            return table  # beside colours, the short form is reported as a key too many
        colours = table["wavelengths"]
        if isinstance(colours, list):
            colours = [{"name": _colour_name(w, i), "wavelengths": [w]} for i, w in enumerate(colours)]
        return {key: value for key, value in table.items() if key != "wavelengths"} | {"colours": colours}


def _colour_name(wavelength: object, index: int) -> str:
    """Name of a channel after its wavelength, "656nm" or "532p5nm"; text that is no length is reported later."""
    try:
        nanometres = parse_length(str(wavelength)) / NM
    except ValueError:
        return f"colour{index}"
    return f"{nanometres:.6g}nm".replace(".", "p").replace("+", "")


class DoeSpec(SpecTable, frozen=True):
    """The DOE.

    Attributes:
        samples: cells per side, or [along x, along y] of a plate that is not square.
        pitch_m: edge of a cell.
        aperture_m: diameter of the relief, or [width, height] of a rectangle. The cells must span it to within half a
            pitch; as many per side its longer side. Or a picture (.png, .tif, .npy) beside the spec, "mask.png", whose
            white is the relief: it covers the cells, up in it is +y, and row 0 of an array is the lowest y. The spec
            keeps the open cells (`doedesign.spec.values.aperture`).
        material: substrate, a key of `sim.material.MATERIALS`; of others the refractive index, the same at every
            wavelength, "n=1.52"; that at 587.56 nm with its Abbe number, "n=1.586,V=29.9"; or Cauchy's coefficients,
            wavelengths in micrometres, "n=1.575,B=0.00785,C=0.0002".
    """

    samples: Samples = Field(examples=["2400"])
    pitch_m: Pitch = Field(examples=['"1.85 um"'])
    aperture_m: ApertureSizes = Field(examples=['"4.44 mm"'])
    material: Substrate = Field(examples=['"fused_silica"'])

    @field_validator("aperture_m")
    @classmethod
    def _on_cells(cls, aperture: ApertureSizes, info: ValidationInfo) -> ApertureSizes:
        samples = info.data.get("samples")
        if isinstance(aperture, MaskRows) and samples is not None:
            shape = shape_of(samples)
            if problem := aperture.problem(shape):
                rule = f"rows of a mask must be those of {shape[1]} x {shape[0]} cells, not {problem}"
                raise broken(rule, "Name the picture of the mask again.")
        return aperture

    @property
    def shape(self) -> tuple[int, int]:
        """Cells (ny, nx)."""
        return shape_of(self.samples)

    @property
    def relief(self) -> Aperture:
        """Outline of the relief."""
        if isinstance(self.aperture_m, MaskRows):
            return self.aperture_m.aperture(self.shape, self.pitch_m)
        return aperture_from(self.aperture_m)


class OptimizeSpec(SpecTable, frozen=True):
    """Optimisation of the height map.

    Attributes:
        parametrization: "freeform" (every cell) or "radial" (a profile over the radius).
        start: a built-in one, which with `steps = 0` is a design of its own: "flat", "random", "fresnel", "ring",
            "nlopt", "axicon", "vortex", "blazed", "lens_array", "cubic", "quartic", "axilens",
            "logarithmic_asphere" (`doedesign.design.starts`); or the path of a height map relative to the spec file.
        start_options: keyword arguments of the start; a file takes none.
        steps: optimisation steps; 0 evaluates the start.
        learning_rate: step size of Adam, in radians of phase at the design wavelength.
        seed: seed of everything random.
        quantisation: levels in the loop: "straight_through", "annealed", "gumbel", "stochastic" or "at_end"; "none"
            leaves heights continuous (`doedesign.design.levels.quantisation`).
        sampling: "sparse" takes one FFT of the bare grid per PSF and moves the image by a random fraction of a
            pixel at every step, so that what one step misses averages out; "exact" integrates every pixel to 0.2 %
            at several times the work, with the image on the axis (for patterns that must fall on certain pixels).
            Of near sources "sparse" keeps the cells' sinc about the axis, which "exact" and the reported PSFs do not.
        colours: "together", or "in_turn": a step looks at one colour, the next at the next. Such a step takes two
            fifths of the time, and a design half as many more of them. Not for terms that compare colours or depths.
        polish: moves of a descent on levels after the steps (`doedesign.design.descent`); each is kept only if the loss
            falls, and costs as much as the steps that see every depth twice.
        min_feature_m: narrowest line and space of every mask, as a rule that the result never breaks; corners of lines
            do not touch either. The second half of the steps looks at level maps that obey it
            (`doedesign.design.levels.printable`). None for any.
        wall_weight: with `min_feature`, cost of a wall as long as a cell and as deep as all levels together, in units
            of 1 - cos of the phase error of a cell. The walls of every mask count.
        drawn_pixel_m: side of the pixels that are drawn, a whole number of cells; None for one cell. Light is computed
            on the cells.
        checkpoint_every: steps between checkpoints.
    """

    parametrization: Literal["freeform", "radial"] = "freeform"
    start: Start = "flat"
    start_options: OptionsTable = Field(default=Options(), examples=['{ angle = "1 deg" }'])
    steps: Steps = 200
    learning_rate: Positive = 0.1
    seed: Seed = 0
    quantisation: Literal["straight_through", "annealed", "gumbel", "stochastic", "at_end", "none"] = "straight_through"
    sampling: Literal["sparse", "exact"] = "sparse"
    colours: Literal["together", "in_turn"] = optional("together")
    polish: Steps = optional(0)
    min_feature_m: Annotated[float, length(1 * NM, 1 * MM)] | None = optional(example='"2 um"')
    wall_weight: NotNegative = optional(0.0)
    drawn_pixel_m: Pitch | None = optional(example='"3.7 um"')
    checkpoint_every: Count = 25


class ObjectiveSpec(SpecTable, frozen=True):
    """Term of the objective.

    Attributes:
        name: a built-in objective, or a function of the user's own as "module:function".
        weight: factor of the term; a negative one maximises it.
        options: keyword arguments of the term. `image` is a path relative to the spec file.
        colours: names of the colour channels it looks at; all of them if none is named.
        depths_m: depths of the scene it looks at; all of them if none is given.
        over: "mean" of its colours and depths, or the "worst" of them. Where a term has depths of its own, asks for the
            worst or has one answer for all depths, every step looks at all depths, not at one near and one far one in
            turn.
    """

    name: ObjectiveName = Field(examples=['"far_spot"'])
    weight: Annotated[float, Field(strict=True)] = 1.0
    options: OptionsTable = Field(default=Options(), examples=["{ energy = 0.4 }"])
    colours: tuple[ColourName, ...] = optional((), example='["red"]')
    depths_m: tuple[FarDepth, ...] = optional((), example='["5 m"]')
    over: Literal["mean", "worst"] = optional("mean")

    @property
    def compares(self) -> bool:
        """Whether it needs all depths of the scene at once."""
        return bool(self.depths_m) or self.over == "worst" or self.name in DEPTHS_OBJECTIVES


class Spec(SpecTable, frozen=True):
    """All that a design depends on: its tables, and the name that runs and mask sets are called after.

    `objectives` are the terms of the loss, unless `spots`, `areas` or a `focus` say where light should go, and
    `limits` the conditions of a good DOE; `[[objective]]` and `[[limit]]` in TOML. One area is `[area]`, several are
    `[[area]]`.

    A file may leave out what its task says (`doedesign.spec.left_out`); here all is filled in.

    Attributes:
        name: name of the design, after which runs and mask sets are called.
        optics: lens, colours and the way light is computed.
        doe: cells, aperture and material.
        process: levels, etches and errors.
        scene: depths of obstruction and scene.
        illumination: beam that lights the DOE; None for sources at the depths of the scene.
        sensor: pixels and their response.
        obstruction: objects that cover part of the view in captures; None for none.
        optimize: how heights are sought.
        objectives: terms of the loss.
        spots: spots or orders; None without them.
        areas: areas of light.
        focus: foci on the axis; None without them.
        limits: conditions of a good plate.
        wafer: wafer, blanks and dies.
        order: terms of a mask order.
        robust: steps on plates as fabricated; None without them.
        network: the reconstruction network.
        train: its training.
    """

    name: SpecName = Field(examples=['"automotive"'])
    optics: OpticsSpec
    doe: DoeSpec
    process: ProcessSpec
    scene: SceneSpec
    illumination: IlluminationSpec | None = optional()
    sensor: SensorSpec
    obstruction: ObstructionSpec | None = optional()
    optimize: OptimizeSpec = OptimizeSpec()
    objectives: tuple[ObjectiveSpec, ...] = ()
    spots: SpotsSpec | None = optional()
    areas: tuple[AreaSpec, ...] = optional(())
    focus: FocusSpec | None = optional()
    limits: tuple[LimitSpec, ...] = optional(())
    wafer: WaferSpec = optional(WaferSpec())
    order: OrderSpec = optional(OrderSpec())
    robust: RobustSpec | None = optional()
    network: NetworkSpec = optional(NetworkSpec())
    train: TrainSpec = optional(TrainSpec())
    _file: Path | None = PrivateAttr(None)

    @property
    def all_steps(self) -> int:
        """Steps of [optimize] and of [robust]."""
        return self.optimize.steps + (0 if self.robust is None else self.robust.steps)

    @model_validator(mode="before")
    @classmethod
    def _one_area(cls, table: Any, info: ValidationInfo) -> Any:
        """Take one table for an array of one, in TOML and in JSON."""
        if not isinstance(table, Mapping) or "area" not in table:
            return table
        areas = [table["area"]] if isinstance(table["area"], Mapping) else table["area"]
        rest = {key: value for key, value in table.items() if key != "area"}
        return rest | {"area" if from_toml(info.context) else "areas": areas}

    @model_serializer(mode="wrap")
    def _one_area_again(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write what `_one_area` reads, so that the digests of specs with one area stay."""
        table = dump(self)
        if areas := table.pop("areas", None):
            table["area"] = areas[0] if len(areas) == 1 else areas
        return table

    @property
    def aims(self) -> bool:
        """Whether a table of its own says where light should go."""
        return bool(self.areas) or self.spots is not None or self.focus is not None

    def area_key(self, index: int) -> str:
        """Key of one of the areas in TOML."""
        return "area" if len(self.areas) == 1 else f"area[{index}]"

    @property
    def image_distance_m(self) -> float:
        """Distance of the sensor from the lens, or from the DOE where there is no lens; 1 where places are sines."""
        if self.sensor.in_angles:
            return 1.0
        return self.sensor.distance_m or (self.optics.focal_length_m or math.nan) + self.sensor.defocus_m

    @property
    def half_field(self) -> tuple[float, float]:
        """Tangents (y, x) of the field angles at the borders of a sensor whose resolution and pitch are given."""
        sensor = self.sensor
        assert sensor.resolution is not None
        assert sensor.pitch_m is not None
        width, height = (count * sensor.pitch_m / 2 / self.image_distance_m for count in sensor.resolution)
        return height, width

    @property
    def propagation(self) -> Literal["far_field", "fresnel"] | None:
        """How light is to get to the sensor behind a lens; None without one, where its distance says it."""
        return None if self.optics.focal_length_m is None else self.optics.propagation

    @property
    def moved_sines(self) -> tuple[float, float]:
        """Direction sines (y, x) by which a tilted beam moves images, with a window that follows none."""
        if self.illumination is None or not any(self.illumination.tilt_rad):
            return 0.0, 0.0
        x, y = map(math.tan, self.illumination.tilt_rad)
        longer = math.sqrt(1 + x**2 + y**2)
        return y / longer, x / longer

    def told_in(self, unit: PlaceUnit) -> PlaceUnit:
        """The unit in which to tell places: the one given, or degrees where there is no sensor."""
        return DEGREES if self.sensor.in_angles else unit

    @property
    def file(self) -> Path | None:
        """File it was read from, to which its paths are relative; no part of its content."""
        return self._file

    def __eq__(self, other: object) -> bool:
        """Compare content, wherever it was read."""
        return isinstance(other, Spec) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        """Hash of the content."""
        return hash(tuple(self.__dict__.values()))
