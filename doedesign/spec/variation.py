"""Files of their own beside the spec: a process, and the errors of one plate.

    [variation]
    depth_scale = [0.02, 0.02, 0.01, 0.0]
    overlay_x = ["0.3 um", "-0.1 um", "0 um", "0.2 um"]
    repeats = [0, 0, -1, 0]

    [[particle]]
    mask = 2
    x = "0.1 mm"
    y = "-0.3 mm"
    radius = "4 um"

Keys are those of `fab.process.DEVIATIONS` without the unit; what is not said is zero.
"""

import math
from typing import Annotated, Any

from pydantic import Field, create_model

from doedesign.spec.process import ProcessSpec, quantity_of
from doedesign.spec.values import length
from doedesign.spec.values.table import SpecTable, optional
from fab.process import DEVIATIONS, Deviation, Disc, MaskDisc, Variation

Place = Annotated[float, length(-1.0, 1.0)]
Radius = Annotated[float, length(0.0, 1.0)]


class ProcessFile(SpecTable, frozen=True):
    """TOML file of a process."""

    process: ProcessSpec


def _error_type(error: Deviation) -> tuple[Any, Any]:
    value = quantity_of(error, 0.0 if error.one_sided else -math.inf, math.inf)
    return (tuple[value, ...], optional(())) if error.per_mask else (value, optional(0.0))


_VALUES: dict[str, Any] = {name: _error_type(error) for name, error in DEVIATIONS.items()}
_Values = create_model("_Values", __base__=SpecTable, __module__=__name__, **_VALUES)


class VariationSpec(_Values, frozen=True):
    """The errors of one plate, under their names in `fab.process.DEVIATIONS`.

    Attributes, besides these:
        repeats: how often each mask was etched more than once: -1 missed, 1 doubled.
        seed: which roughness, of all with the same statistics.
    """

    repeats: tuple[Annotated[int, Field(strict=True, ge=-1, le=9)], ...] = optional((), example="[0, 0, -1, 0]")
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)] = optional(0)


class PinholeSpec(SpecTable, frozen=True):
    """A pinhole in the chrome (`fab.process.Disc`).

    Attributes:
        x_m: place of its middle from the middle of the DOE, +x to the right as seen along the light.
        y_m: the same, +y up.
        radius_m: its radius.
    """

    x_m: Place = Field(examples=['"0.1 mm"'])
    y_m: Place = Field(examples=['"0.1 mm"'])
    radius_m: Radius = Field(examples=['"2 um"'])


class ParticleSpec(SpecTable, frozen=True):
    """A particle that kept one etch off a disc (`fab.process.MaskDisc`).

    Attributes:
        mask: number of the mask whose etch it kept off, from 0.
        x_m: place of its middle from the middle of the DOE, +x to the right as seen along the light.
        y_m: the same, +y up.
        radius_m: its radius.
    """

    mask: Annotated[int, Field(strict=True, ge=0, le=5, examples=["0"])]
    x_m: Place = Field(examples=['"0.1 mm"'])
    y_m: Place = Field(examples=['"0.1 mm"'])
    radius_m: Radius = Field(examples=['"4 um"'])


class VariationFile(SpecTable, frozen=True):
    """TOML file of the errors of one plate.

    Attributes:
        variation: the errors.
        particles: particles that kept an etch off.
        pinholes: pinholes in the chrome.
    """

    variation: VariationSpec
    particles: tuple[ParticleSpec, ...] = optional(())
    pinholes: tuple[PinholeSpec, ...] = optional(())

    def value(self) -> Variation:
        """Return the errors as the physics takes them."""
        return Variation(
            **self.variation.given(),
            particles=tuple(MaskDisc(p.mask, p.y_m, p.x_m, p.radius_m) for p in self.particles),
            pinholes=tuple(Disc(p.y_m, p.x_m, p.radius_m) for p in self.pinholes),
        )


def variation_file(variation: Variation) -> VariationFile:
    """Return the file that says what a variation is, whose errors may be numbers of any kind that `float` takes."""
    errors = {name: getattr(variation, name) for name in DEVIATIONS}
    plain = {name: tuple(map(float, v)) if DEVIATIONS[name].per_mask else float(v) for name, v in errors.items()}
    particles, pinholes = (
        [{key: float(getattr(disc, key)) for key in ("y_m", "x_m", "radius_m")} for disc in discs]
        for discs in (variation.particles, variation.pinholes)
    )
    for particle, disc in zip(particles, variation.particles, strict=True):
        particle["mask"] = int(disc.mask)
    rest = {"repeats": tuple(map(int, variation.repeats)), "seed": int(variation.seed)}
    return VariationFile.model_validate({"variation": plain | rest, "particles": particles, "pinholes": pinholes})
