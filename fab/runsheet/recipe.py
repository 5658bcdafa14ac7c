"""Recipe for each photomask, step by step, and the arithmetic of a run sheet.

The recipes are ordinary ones for fused silica: resist, reactive ions through it, chrome by lift-off or wet etch. Doses,
bakes and times belong to the lab and are left blank; what follows from the order is filled in. For another material the
words on cleaning, plasma, rates and resist, which hold for silica alone, are left out, and the lab's own are asked for.

Depth first: every etch has its own target, whatever another one did. If a design uses all sets of masks equally, the
light that goes where it should is a product with one factor per mask, cos^2(phi / 2) for a phase error phi of its
depth; no other factor can make up for it. The choice that keeps the full depth right (`next_target_m`) puts its own
mask wrong by as much, and so loses the factor twice.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from fab.layout.marks import alignment_notes
from fab.layout.part import Photomask
from fab.layout.structures import codes_by_depth
from fab.levels import Levels
from fab.process import Normal, Process
from fab.runsheet.tables import SILICA, RunSheet
from fab.units import NM, UM, format_length

Deposition = Literal["evaporated", "sputtered"]

# What plasmas of different power and gas do to silica; 20 nm/min is usual for plain reactive ion etching.
RATES_M_PER_S = tuple(rate * NM / 60 for rate in (10, 20, 30))
_TWO_SIGMA = 2.0
# Glass etched per resist lost. Usual recipes do better than 3; twice what is lost at 3 leaves a margin.
_SELECTIVITY, _THINNEST_M = 3.0, 1 * UM
_RESISTS: Mapping[str, str] = {
    "positive": "POSITIVE resist (light opens it)",
    "negative": "NEGATIVE or image-reversal resist (it stays where light falls)",
}
_STRIP = "Remover, then oxygen plasma."
_LIFTOFF_FOLD: Mapping[str, int] = {"evaporated": 5, "sputtered": 10}


class Action(NamedTuple):
    """One thing to do: its name ("Bake"), how it is done, and what is written down, each with its unit."""

    task: str
    how: str
    fill: tuple[str, ...] = ()


class Step(NamedTuple):
    """Actions with one photomask up to the developed resist and after it, and the deepest floor (metres) then."""

    photomask: Photomask
    before: tuple[Action, ...]
    after: tuple[Action, ...]
    deepest_m: float


def depths_m(levels: Levels, etches_m: Sequence[float] = ()) -> tuple[float, ...]:
    """Return the depths below the blank glass that all etches make together, blank glass first, metres.

    `etches_m` are the depths of the etches, first mask first; those of the levels by default. They come as the steps of
    the staircase do that is scanned, by what is asked for, even where an etch misses that by more than a step.
    """
    codes = (code for code in codes_by_depth(levels, range(levels.bits)) if code < levels.count)
    etches_m = etches_m or levels.depths_m
    return tuple(sum(depth for bit, depth in enumerate(etches_m) if code >> bit & 1) for code in codes)


def expected_m(photomask: Photomask, process: Process) -> float:
    """Return the depth that an etch is expected to have beside the DOE: its target, and a process's mean errors."""
    names = "common_depth_scale", f"depth_scale[{photomask.bit}]"
    means = math.prod(1 + process.spreads.get(name, Normal()).mean for name in names)
    return photomask.depth_m * means * process.depth_at_die


def next_target_m(target_m: float, measured_m: float, next_m: float) -> float:
    """Return the next etch's target that keeps the sum of all depths right, metres.

    Areas that both masks etch come out right, areas that neither etches stay right, and areas of the next mask alone
    become wrong by as much as those of this one are.
    """
    return next_m - (measured_m - target_m)


def lifts_off(photomask: Photomask) -> bool:
    """Return whether the chrome of a photomask is lifted off: it stays in polygons, and they open the resist."""
    return photomask.makes == "liftoff" or (photomask.makes == "zero layer" and photomask.opens)


def spread_of(process: Process, bit: int, common: str, own: str) -> Normal:
    """Return mean and standard deviation of an error of one mask, the part common to all masks included."""
    parts = [process.spreads.get(name, Normal()) for name in (common, f"{own}[{bit}]")]
    return Normal(sum(part.mean for part in parts), math.hypot(*(part.sigma for part in parts)))


def tone_words(photomask: Photomask) -> str:
    """Return in words what the polygons of a photomask are on the glass."""
    if photomask.tone == "clear":
        return "polygons are CLEAR: chrome all over, light passes in the polygons (dark-field plate)"
    return "polygons are DARK: glass all over, the polygons are chrome (clear-field plate)"


def _on(material: str, how: str) -> str:
    """How something is done that would harm, or fail on, another material than fused silica."""
    return how if material == SILICA else f"By the lab's recipe for {material}."


def _printing(
    photomask: Photomask, file: str, align: str, thickness_m: float, why: str, rim_m: float, material: str
) -> tuple[Action, ...]:
    """List the actions from the resist to the developed pattern, the same for every photomask."""
    return (
        Action("Prime", _on(material, "HMDS vapour, so that the resist sticks to the surface.")),
        Action(
            "Resist",
            f"Spin {_RESISTS[photomask.resist]}, {format_length(float(f'{thickness_m:.3g}'))} or thicker. {why}",
            ("thickness (um)", "resist, batch"),
        ),
        Action(
            "Bake",
            "Soft bake by the resist's data sheet. Glass warms slowly: give a hot plate more time than for silicon.",
            ("temperature (C)", "time (s)"),
        ),
        Action(
            "Edge bead",
            f"Take the resist off the rim, no farther in than the {format_length(rim_m)} that hold nothing: a bead "
            "keeps the plate away from the resist, and lines print with other widths.",
            ("width (mm)",),
        ),
        Action(
            "Load the mask",
            f"{photomask.name.capitalize()}, file {file}. The chrome of the plate faces the resist. On the plate: "
            f"{tone_words(photomask)}.",
            ("plate number",),
        ),
        Action("Align", align),
        Action(
            "Expose",
            "Vacuum contact. The wafer is transparent: light that the chuck reflects comes back and blurs lines. Put "
            "something matt and black under it, and take the dose from a test exposure on the same glass there.",
            ("wavelength (nm)", "dose (mJ/cm2)"),
        ),
        Action("Develop", "By the resist's data sheet. Rinse and dry.", ("developer, time (s)",)),
    )


def _etch_actions(photomask: Photomask, process: Process, material: str) -> tuple[Action, ...]:
    depth_m, bit = photomask.depth_m, photomask.bit or 0
    sigma = spread_of(process, bit, "common_depth_scale", "depth_scale").sigma
    usual = "" if not sigma else f" (usual for this process: within {_TWO_SIGMA * sigma * depth_m / NM:.3g} nm)"
    aim_m = expected_m(photomask, process)
    known = f" This process is known to etch {aim_m / NM:.6g} nm where it is told that." if aim_m != depth_m else ""
    ions = "Reactive ions (CHF3 or alike) into the glass"
    if material != SILICA:
        ions = f"Into the {material}, by the lab's recipe for it"
    return (
        Action(
            "Descum",
            _on(material, "Oxygen plasma, short, so that no film of resist is left in the openings."),
            ("time (s)",),
        ),
        Action(
            "Hard bake",
            "By the resist's data sheet, and not so hot that its edges flow: it has to stand the plasma.",
            ("temperature (C)", "time (s)"),
        ),
        Action(
            "Etch",
            f"{ions}, TARGET {photomask.depth}{usual}.{known} "
            "Find the rate on a test piece of the same glass, the same chamber and the same day. Time = target / rate.",
            ("rate (nm/min)", "time (min:s)", "recipe"),
        ),
        Action(
            "Short?",
            "If a step can be measured with the resist still on and the etch is too shallow: etch the rest, extra time "
            "= missing depth / rate. An etch that is too deep stays so.",
            ("extra time (s)",),
        ),
        Action("Strip", _on(material, _STRIP) + " No resist may stay at the edges of the openings."),
    )


def _chrome_actions(photomask: Photomask, chrome_m: float, deposition: Deposition, material: str) -> tuple[Action, ...]:
    thickness = format_length(chrome_m)
    if lifts_off(photomask):
        return (
            Action("Descum", _on(material, "Oxygen plasma, short. Metal holds on clean glass only."), ("time (s)",)),
            Action("Deposit", f"Chrome, {thickness}, {deposition}. Keep the wafer cool.", ("thickness (nm)",)),
            Action(
                "Lift off", _on(material, "Remover, warm, then ultrasound. Rinse while wet: flakes that dry stay."), ()
            ),
        )
    return (
        Action(
            "Hard bake", "By the resist's data sheet, so that it holds in the etch.", ("temperature (C)", "time (s)")
        ),
        Action("Etch the chrome", "Wet (ceric ammonium nitrate), until the glass is clear.", ("time (s)",)),
        Action("Strip", _on(material, _STRIP)),
    )


def least_resist(
    photomask: Photomask, chrome_m: float, deposition: Deposition, material: str = SILICA
) -> tuple[float, str]:
    """Return the least thickness of the resist, metres, and why.

    For lift-off it is five times the metal if that is evaporated and ten times if it is sputtered, because sputtered
    metal also covers the walls; for an etch of fused silica twice what it uses up at a selectivity of 3, and at least 1
    um. What an etch of another material uses up is not known here.
    """
    if photomask.makes == "etch" and material != SILICA:
        return (
            _THINNEST_M,
            f"Find out what an etch of {photomask.depth} into the {material} uses up, and take twice that.",
        )
    if photomask.makes == "etch":
        used = format_length(float(f"{photomask.depth_m / _SELECTIVITY:.3g}"))
        why = f"At a selectivity of {_SELECTIVITY:g} the etch uses up {used} of it; thicker resist prints coarser."
        return max(_THINNEST_M, 2 * photomask.depth_m / _SELECTIVITY), why
    if lifts_off(photomask):
        fold, thickness = _LIFTOFF_FOLD[deposition], format_length(chrome_m)
        why = f"For lift-off of {deposition} chrome: at least {fold} times its {thickness}, with overhanging edges."
        return fold * chrome_m, why
    return _THINNEST_M, "It only has to hold in the chrome etch."


def _by_the_edge(sheet: RunSheet) -> str:
    """Return in words how the first mask is brought to the wafer."""
    wafer = sheet.wafer
    if wafer.usual_flat_m:
        return "To the flat: its edge runs in the gaps between the two bars at either end of it, middle on middle."
    if wafer.notch_m:
        return "To the notch: its middle lies between the two upright bars below the wafer, middle on middle."
    return "By eye, middle on middle."


def _deepest_m(etched: Mapping[int, float], levels: Levels) -> float:
    """Return the depth of the deepest floor of a DOE after some etches, by bit and depth, metres."""
    return max(sum(depth for bit, depth in etched.items() if code >> bit & 1) for code in range(levels.count))


def steps_of(sheet: RunSheet) -> tuple[Step, ...]:
    """List the steps of a job, one per photomask in order of use."""
    chrome_m, deposition, process = sheet.chrome_m, sheet.deposition, sheet.process
    etched: dict[int, float] = {}
    steps = []
    for number, (photomask, note) in enumerate(zip(sheet.photomasks, alignment_notes(sheet.photomasks), strict=True)):
        etched |= {photomask.bit: expected_m(photomask, process)} if photomask.bit is not None else {}
        align = note if number else f"{_by_the_edge(sheet)} {note}"
        thickness_m, why = least_resist(photomask, chrome_m, deposition, sheet.material)
        how = "Acetone, isopropanol, water, then oxygen plasma or the lab's oxidising clean. Dry, 150 C for 10 min."
        if sheet.material != SILICA:
            how = f"By the lab's recipe for {sheet.material}. Dry."
        if number == 0:
            how = f"Check thickness, flat and both polished faces, and mark the side to be etched. {how}"
        before = [Action("Clean", how, ("wafer number",) if number == 0 else ())]
        if photomask.makes != "etch" and not lifts_off(photomask):
            how = f"Chrome all over, {format_length(chrome_m)}, {deposition}."
            before.append(Action("Deposit", how, ("thickness (nm)",)))
        before += _printing(
            photomask,
            sheet.files[photomask.name].file,
            align,
            thickness_m,
            why,
            sheet.wafer.edge_exclusion_m,
            sheet.material,
        )
        after = (
            _etch_actions(photomask, process, sheet.material)
            if photomask.makes == "etch"
            else _chrome_actions(photomask, chrome_m, deposition, sheet.material)
        )
        steps.append(Step(photomask, tuple(before), after, _deepest_m(etched, sheet.level_map.levels)))
    return tuple(steps)
