"""The process in a spec: what is asked of the fab lab, how far it strays, and when a plate is good enough.

Every key besides levels and level step may be left out: `stock` names a set of usual numbers, each key that is given
replaces one of them, and without a stock process what is not given is zero. `ProcessSpec.filled` says what then holds.
The keys of `[process.errors]` are those of `fab.process.DEVIATIONS` without the unit.
"""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    TypeAdapter,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from doedesign.spec.values import ColourName, FarDepth, InWords, NotNegative, bounded, broken, known, length, share
from doedesign.spec.values.table import SpecTable, optional
from fab.levels import FEWEST, MOST
from fab.process import DEVIATIONS, Deviation, Normal
from fab.stock import IDEAL, STOCK
from fab.units import MM, NM, UM

# The numbers of `sim.metrics.METRICS` that a plate can be good or bad by; the last four of spots, areas and foci.
Quantity = Literal[
    "zeroth_order",
    "strehl",
    "throughput",
    "outside_window",
    "ring_to_disc",
    "far_spot",
    "on_target",
    "uniformity_error",
    "contrast",
    "focus_width",
]


def leading_quantity(names: Collection[str]) -> str:
    """The number that plates are told by where no limit names one: that of the task, or the relative Strehl ratio.

    Spots are to be equal, and areas and foci to get the light; the rest should be like its design.

    Args:
        names: of the numbers that there are, one at least.
    """
    return next((name for name in ("uniformity_error", "on_target", "strehl") if name in names), next(iter(names)))


Etch = Annotated[float, length(0.1 * NM, 1 * MM)]
Feature = Annotated[float, length(0.0, 1 * MM)]
Place = Annotated[float, length(-1.0, 1.0)]
DefectRadius = Annotated[float, length(1 * NM, 1 * MM)]
Density = Annotated[float, share(0.0, 1e4)]
Chance = Annotated[float, share(0.0, 1.0)]


OPTIMIZE: Literal["optimize"] = "optimize"
_DEPTHS: TypeAdapter[tuple[float, ...]] = TypeAdapter(Annotated[tuple[Etch, ...], Field(min_length=1)])


def _etch_depths(value: Any, info: ValidationInfo) -> tuple[float, ...] | Literal["optimize"]:
    if value == OPTIMIZE:
        return OPTIMIZE
    if not isinstance(value, list | tuple):
        raise broken(f'must be a list of depths or "{OPTIMIZE}"', 'For example ["75 nm", "150 nm"] for 4 levels.')
    return _DEPTHS.validate_python(value, context=info.context)


class EtchSpec(SpecTable, frozen=True):
    """One etch.

    Attributes:
        mask: number of its mask, from 0, the shallowest of 2^k steps.
        depth_m: its depth, which is that of `etch_depths` or of the levels; where given, it is checked against that.
    """

    inline: ClassVar[bool] = True

    mask: Annotated[int, Field(strict=True, ge=0, le=5, examples=["0"])]
    depth_m: Etch | None = optional(example='"75 nm"')


class SpreadSpec(SpecTable, frozen=True):
    """Mean and standard deviation of one error, in the SI unit that its name ends in; a tuple has a value per mask.

    In TOML `overlay_x = "0.5 um"` is short for `overlay_x = { sigma = "0.5 um" }`.
    """

    inline: ClassVar[bool] = True

    mean: float | tuple[float, ...] = optional(0.0)
    sigma: float | tuple[float, ...] = optional(0.0)

    @model_validator(mode="before")
    @classmethod
    def _sigma_alone(cls, value: Any) -> Any:
        return value if isinstance(value, Mapping | SpreadSpec) else {"sigma": value}

    def spreads(self, count: int) -> tuple[Normal, ...]:
        """Return mean and standard deviation of each of `count` errors, one per mask or one for the plate."""
        means, sigmas = (value if isinstance(value, tuple) else (value,) * count for value in (self.mean, self.sigma))
        return tuple(Normal(mean, sigma) for mean, sigma in zip(means, sigmas, strict=True))


def quantity_of(error: Deviation, low: float, high: float) -> Any:
    """Type of a value of an error between two bounds, SI units."""
    return Annotated[float, share(low, high) if error.unit == "1" else bounded(error.unit, low, high)]


def _spread_type(name: str, error: Deviation) -> type[SpreadSpec]:
    """Type of the spread of an error: values for the whole plate, or one for all masks or a list of one per mask."""

    def refuse_list(value: Any) -> Any:
        if isinstance(value, list | tuple):
            raise broken("must be one value, for it concerns the whole plate", "Remove the brackets.")
        return value

    def part(low: float) -> Any:
        of_one = quantity_of(error, low, error.largest)
        if not error.per_mask:
            return Annotated[of_one, BeforeValidator(refuse_list)]
        of_each: Any = tuple[of_one, ...]
        one, each = TypeAdapter(of_one), TypeAdapter(of_each)

        def validate(value: Any, info: ValidationInfo) -> float | tuple[float, ...]:
            return (each if isinstance(value, list | tuple) else one).validate_python(value, context=info.context)

        # Any, because a serialiser would be wary of a union.
        return Annotated[Any, PlainValidator(validate)]

    mean, sigma = part(0.0 if error.one_sided else -error.largest), part(0.0)
    fields: dict[str, Any] = {"mean": (mean, optional(0.0)), "sigma": (sigma, optional(0.0))}
    model = create_model(f"_spread_of_{name}", __base__=SpreadSpec, __module__=__name__, **fields)
    globals()[model.__name__] = model  # a spec is found again by its classes' names where it is sent to another process
    return model


_SPREADS: dict[str, Any] = {name: (_spread_type(name, error) | None, optional()) for name, error in DEVIATIONS.items()}
_Errors = create_model("_Errors", __base__=SpecTable, __module__=__name__, **_SPREADS)


class ErrorsSpec(_Errors, frozen=True):
    """How far the process strays: mean and standard deviation of every error of `fab.process.DEVIATIONS`.

    A value alone is the standard deviation; `{ mean = ..., sigma = ... }` says both. An error that is not given is that
    of the stock process, or zero without one.
    """


# Densities are per mm2 in a spec, where one per cm2 is 0.01, and per m2 elsewhere.
_PER_MM2 = {"particles_per_m2": "particles_per_mm2", "pinholes_per_m2": "pinholes_per_mm2"}


class DefectsSpec(SpecTable, frozen=True):
    """Rare events, as in `fab.process.Defects`: densities, mean radii, and the chances that an etch fails.

    Attributes:
        particles_per_mm2: particles that keep an etch off the glass, per mm² and etch.
        particle_radius_m: mean radius of the particles.
        pinholes_per_mm2: pinholes of the chrome, per mm².
        pinhole_radius_m: mean radius of the pinholes.
        missed: probability that an etch is left out.
        doubled: probability that an etch is done twice.
    """

    particles_per_mm2: Density | None = optional(example="0.01")
    particle_radius_m: DefectRadius | None = optional(example='"2 um"')
    pinholes_per_mm2: Density | None = optional(example="0.01")
    pinhole_radius_m: DefectRadius | None = optional(example='"2 um"')
    missed: Chance | None = optional(example="0.001")
    doubled: Chance | None = optional(example="0.001")

    @classmethod
    def from_si(cls, values: Mapping[str, float]) -> "DefectsSpec":
        """Return the spec of numbers by their name in `fab.process.Defects`."""
        per_mm2 = {_PER_MM2[name]: value / 1e6 for name, value in values.items() if name in _PER_MM2}
        return cls.model_validate(per_mm2 | {name: value for name, value in values.items() if name not in _PER_MM2})

    def in_si(self) -> dict[str, float]:
        """Return what is given, by its name in `fab.process.Defects`."""
        given = self.given()
        per_m2 = {name: given.pop(key) * 1e6 for name, key in _PER_MM2.items() if key in given}
        return per_m2 | given


def _level_count(count: int) -> int:
    if not FEWEST <= count <= MOST:
        raise broken(f"must lie from {FEWEST} to {MOST}", "For example 6 or 16; powers of two use every set of masks.")
    return count


RADII_M = (0.5 * MM, 250 * MM)  # of wafers


class ProcessSpec(SpecTable, frozen=True):
    """Levels that the fab lab makes, and how well.

    Attributes:
        levels: number of heights L, from 2 to 64. As many masks are drawn as L - 1 has binary digits: 6 levels take the
            three masks of 8, and leave its two deepest floors unused.
        level_step_m: height of one level; `levels` times this is the height of one wave of the design.
        etch_depths_m: depth of every mask, first mask first, where it is not 2^k level steps; "optimize" has
            `doedesign optimize` choose them. Level L - 1 - c is etched by the masks of the binary digits of c.
        chrome_overlap_m: how far the chrome reaches over the edge of the relief, so that a chrome mask aligned a
            little off uncovers no blank glass. Light passes an opening of `doe.aperture` less twice this.
        stock: a process of `fab.stock.STOCK` that stands in for what is not given here.
        etches: the etches in the order in which they are done, each mask once; shallow to deep where none is given.
        tone: what polygons are on photomasks: "clear" (dark field, for positive resist), which it is unless said, or
            "dark" (clear field, for a negative one).
        minimum_line_m: narrowest line the lithography prints.
        minimum_space_m: narrowest gap the lithography prints.
        die_m: where on the wafer the DOE lies (y, x).
        wafer_radius_m: radius of the wafer, half of `wafer.diameter`; one of them is enough.
        reduction: how many times as large as on the wafer the reticles of a stepper are; 1 for photomasks that print a
            whole wafer by contact, which is what `doedesign masks` draws.
        errors: how far the process strays.
        defects: rare events.
    """

    levels: Annotated[
        int, Field(strict=True), AfterValidator(_level_count), InWords("whole number", f"{FEWEST} to {MOST}")
    ] = Field(examples=["16"])
    level_step_m: Annotated[float, length(0.1 * NM, 100 * UM)] = Field(examples=['"75 nm"'])
    # Any, because a serialiser would be wary of a union.
    etch_depths_m: Annotated[
        Any,
        PlainValidator(_etch_depths),
        InWords(f'list of lengths, one per mask, or "{OPTIMIZE}"', "0.1 nm to 1 mm each"),
    ] = optional(example='["80 nm", "150 nm", "300 nm", "600 nm"]')
    chrome_overlap_m: Annotated[float, length(0.0, 1 * MM)] = 5e-6
    stock: Annotated[str, known("process", STOCK)] | None = optional()
    etches: tuple[EtchSpec, ...] = optional((), example='[{ mask = 0, depth = "75 nm" }, { mask = 1 }]')
    tone: Literal["clear", "dark"] | None = optional()
    minimum_line_m: Feature | None = optional(example='"1 um"')
    minimum_space_m: Feature | None = optional(example='"1 um"')
    die_m: tuple[Place, Place] | None = optional(example='["0 mm", "20 mm"]')
    wafer_radius_m: Annotated[float, length(*RADII_M)] | None = optional(example='"50 mm"')
    reduction: Annotated[int, Field(strict=True, ge=1, le=20)] | None = optional(example="5")
    errors: ErrorsSpec = optional(ErrorsSpec())
    defects: DefectsSpec = optional(DefectsSpec())

    @property
    def masks(self) -> int:
        """Number of etch masks."""
        return (self.levels - 1).bit_length()

    @property
    def chooses_depths(self) -> bool:
        """Whether `doedesign optimize` is to choose the depths of the etches."""
        return self.etch_depths_m == OPTIMIZE

    def depth_m(self, mask: int) -> float:
        """Return what a mask etches; 2^k level steps where depths are still to be chosen."""
        depths = self.etch_depths_m
        # A list that is too short is told of elsewhere.
        if isinstance(depths, tuple) and mask < len(depths):
            return depths[mask]
        return 2**mask * self.level_step_m

    def filled(self) -> "ProcessSpec":
        """Return the process with everything given: by itself, by its stock process, or as the ideal process has it."""
        stock = STOCK[self.stock] if self.stock else IDEAL
        usual = {
            "tone": stock.tone,
            "minimum_line_m": stock.minimum_line_m.value,
            "minimum_space_m": stock.minimum_space_m.value,
            "die_m": (0.0, 0.0),
            "wafer_radius_m": stock.wafer_radius_m.value,
            "reduction": stock.reduction,
            "etches": tuple(EtchSpec(mask=mask) for mask in sorted(range(self.masks), key=self.depth_m)),
        }
        errors = {name: {"mean": typical.mean, "sigma": typical.sigma} for name, typical in stock.errors.items()}
        defects = DefectsSpec.from_si({name: figure.value for name, figure in stock.defects.items()})
        tables = {
            "errors": ErrorsSpec.model_validate(errors | self.errors.given()),
            "defects": defects.model_copy(update=self.defects.given()),
        }
        return self.model_copy(update=usual | self.given() | tables)


# Numbers that may exceed 1.
_RATIOS = ("ring_to_disc", "contrast", "focus_width")


class LimitSpec(SpecTable, frozen=True):
    """One condition of a good plate: it must hold for every colour and depth it applies to.

    Attributes:
        quantity: what is limited, a column of the prediction's table.
        min: smallest value of a good plate.
        max: largest value of a good plate.
        colour: the colour channel it applies to; all where none is given.
        depth_m: the depth it applies to, one of `scene`; all that have the quantity where none is given.
    """

    quantity: Quantity = Field(examples=['"zeroth_order"'])
    min: NotNegative | None = optional(example="0.6")
    max: NotNegative | None = optional(example="0.05")
    colour: ColourName | None = optional(example='"red"')
    depth_m: FarDepth | None = optional(example='"5 m"')

    @field_validator("min", "max")
    @classmethod
    def _a_share(cls, value: float | None, info: ValidationInfo) -> float | None:
        quantity = info.data.get("quantity", "ring_to_disc")
        if value is not None and value > 1 and quantity not in _RATIOS:
            raise broken(f"must lie between 0 and 1, for {quantity} is a share", "Write 5 % as 0.05.")
        return value

    @model_validator(mode="after")
    def _limits_something(self) -> "LimitSpec":
        if self.min is None and self.max is None:
            raise broken("must state min, max or both", "For example `max = 0.05`.")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise broken(f"min must not exceed max, {self.min:g} > {self.max:g}", "Exchange them.")
        return self
