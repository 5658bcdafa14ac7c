"""Every number of a metrics.json: one name, one unit, one definition.

A name of `metrics.json` means the same in every table and for every kind of task; names of other files are in
`doedesign.reference.other_numbers`. What a plate is judged by stands in `sim.metrics.METRICS` and is taken from there.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from sim.metrics import METRICS


class ResultNumber(NamedTuple):
    """A name in a result.

    Attributes:
        unit: "1" for a ratio, "share" for a part of the light or of plates, "m", "rad", "nm", "dB", "count" or "text".
        range: smallest and largest value, in words.
        definition: what it is, with its formula where it has one.
        source: function or class that computes it.
    """

    unit: str
    range: str
    definition: str
    source: str


class NumberGroup(NamedTuple):
    """Names that stand together.

    Attributes:
        title: of the group, for the reference.
        files: files that hold them.
        numbers: what they are, by name.
    """

    title: str
    files: str
    numbers: Mapping[str, ResultNumber]


_SHARE, _RATIO = ("share", "0 to 1"), ("1", "0 or more")
_ROUND = "share; 0 to 1 but for rounding"


def _of_plates() -> dict[str, ResultNumber]:
    """Numbers that `sim.metrics.METRICS` defines."""
    units = {"%": "share", "m": "m", "1": "1"}
    ranges = {"%": "0 to 1", "m": "above 0", "1": "0 or more"}
    special = {
        "strehl": "0 to 1",
        "chrome": "-1 to 1",
        "contrast": "0 or more",
        "focus_width": "above 0",
        "outside_window": "0 to 1, but for rounding",
        "ring_to_disc": "0 or more; null where the disc is dark",
        "concentration_bound": "0 to 1; null without a far depth",
    }
    return {
        name: ResultNumber(
            "1" if name in ("contrast", "focus_width") else units[metric.unit],
            special.get(name, ranges[metric.unit]),
            metric.definition,
            "sim.metrics.METRICS",
        )
        for name, metric in METRICS.items()
    }


_LABELS = {
    "colour": ResultNumber("text", "a channel of the camera", "colour channel", "optics.colours"),
    "depth_m": ResultNumber("m", "above 0; null for infinity", "distance of the source from the DOE", "scene"),
    "light": ResultNumber(
        "text",
        "scalar, edges, or rigorous with its terms",
        "how light passed the relief: as a thin element, with the light of its walls, or by Maxwell's equations",
        "optics.light",
    ),
    "lens": ResultNumber(
        "text", "a sentence", "what the lens does to directions and fields", "sim.camera.Camera.lens_text"
    ),
}
_BUDGET = {
    "blocked": ResultNumber(
        *_SHARE, "share of the beam that the chrome around the opening blocks; 0 without a beam", ""
    ),
    "reflected": ResultNumber(*_SHARE, "share that both faces of the substrate reflect: 1 - fresnel_transmission", ""),
    "window_beside_spot": ResultNumber(
        *_SHARE, "share in the sensor window outside the far spot: throughput - far_spot, at every depth", ""
    ),
    "uncollected": ResultNumber(
        "share",
        "0 to 1, but for rounding",
        "share within the band of the DOE's grid, outside the window or between light-sensitive squares",
        "",
    ),
    "higher_orders": ResultNumber(
        *_SHARE, "share at angles beyond wavelength / (2 pitch), scattered by the square cells and the rim", ""
    ),
}
_SPLIT = {
    "leaked": ResultNumber(*_SHARE, "share in the window by light that the relief does not diffract", ""),
    "diffracted": ResultNumber(*_SHARE, "share in the window by light that it diffracts", ""),
    "interference": ResultNumber(
        "share", "-1 to 1", "share that both add or take together; leaked + diffracted + interference = throughput", ""
    ),
}
_CERTIFIED = {
    "wavelength_m": ResultNumber("m", "above 0", "vacuum wavelength", ""),
    "scalar": ResultNumber(*_SHARE, "0th order of the whole design as a thin element", ""),
    "edges": ResultNumber(*_SHARE, "the same with the light of walls", ""),
    "cut_scalar": ResultNumber(*_SHARE, "0th order of the cut-outs that were solved, as thin elements", ""),
    "cut_edges": ResultNumber(*_SHARE, "the same with the light of walls", ""),
    "cut_rigorous": ResultNumber(*_SHARE, "the same by Maxwell's equations", ""),
}
_ACCURACY = {
    "numerics": ResultNumber(
        *_RATIO, "relative error of pixel energies by the transform, predicted from its weights", ""
    ),
    "rim": ResultNumber(
        *_RATIO, "relative error of intensities by cells on the rim that pass the mean of their open part", ""
    ),
    "walls": ResultNumber(
        *_RATIO, "relative change of pixel energies by the light of walls; null where they have it", ""
    ),
    "lens_mapping": ResultNumber(
        *_RATIO,
        "relative change of pixel energies by a lens that images tangents where sines are in force, or the "
        "other way round; null without a lens",
        "",
    ),
}
_PATTERN = {
    "uniformity": ResultNumber(
        "1",
        "at most 1",
        "of a target pattern: 1 - uniformity_error over its spots, or 1 - standard deviation / mean of "
        "the pixels that are an Airy radius inside its area",
        "doedesign.design.metrics.DrawnPattern",
    ),
}
_ETCHES = {
    "depths_nm": ResultNumber("nm", "above 0", "depth of every etch, first mask first, as it was chosen", ""),
    "light_cost": ResultNumber(*_SHARE, "light that rounding to the chosen depths takes from the design", ""),
    "light_cost_of_equal_steps": ResultNumber(*_SHARE, "the same for 2^k equal steps", ""),
}
_AIMED = {
    "fresnel_transmission": ResultNumber(
        *_SHARE,
        "share of the light that passes both faces of the substrate; on_target, spots, zeroth_order_efficiency, "
        "strongest_stray and share leave its loss out",
        "sim.material.fresnel_transmission",
    ),
    "ceiling": ResultNumber(
        "share",
        "0 to 1; null where none is known",
        "largest on_target that is known for equal spots of so many levels, by free phases on a fine grid; few phases "
        "or unequal spots may pass it",
        "",
    ),
    "ceiling_source": ResultNumber(
        "text", "a sentence", "where the ceiling is from", "doedesign.spots.orders.ceiling_of"
    ),
    "spots": ResultNumber("share", "list, 0 to 1", "efficiency of every spot, in the order of orders.csv", ""),
    "rmse": ResultNumber(
        *_RATIO, "root mean square of the relative deviations of the spots from their wanted share", ""
    ),
    "zeroth_order_efficiency": ResultNumber(
        *_SHARE,
        "efficiency of the order that goes straight on, computed as that of a spot: over the whole periods "
        "within the aperture where spots are orders of a unit cell, for which zeroth_order has the whole aperture",
        "",
    ),
    "zeroth_order_wanted": ResultNumber(
        "yes or no",
        "true or false",
        "whether a spot or an area lies where light goes straight on, so that the 0th order is wanted and no leakage",
        "doedesign.spots.orders.OrderTable, doedesign.areas.shape.AreaTable",
    ),
    "strongest_stray": ResultNumber(
        "share",
        "0 to 1; null without a lattice",
        "efficiency of the strongest order around the spots that should have none",
        "",
    ),
    "signal_to_noise": ResultNumber(
        "1", "0 or more; null without stray light", "mean efficiency of a spot / strongest_stray", ""
    ),
    "in_wave": ResultNumber(*_SHARE, "share of the light in the wave whose phases are given", ""),
    "in_wave_ceiling": ResultNumber(*_SHARE, "largest in_wave of a DOE of any phase: all of its cells in step", ""),
    "phase_rmse_rad": ResultNumber(
        "rad", "0 or more", "root mean square of phase less given phase, after the best common one", ""
    ),
    "pixel_contrast": ResultNumber(
        "1",
        "0 or more; null for pictures",
        "standard deviation / mean of the sensor's pixels in the flat part of an area",
        "",
    ),
    "side_lobe": ResultNumber(
        *_RATIO, "strongest light where less than 13.5 % is wanted, over the mean of the flat part", ""
    ),
    "size_x_m": ResultNumber(
        "m",
        "above 0; null without edges",
        "distance of the outermost places along x with half the light; size_x_rad without a sensor",
        "",
    ),
    "size_y_m": ResultNumber("m", "above 0; null without edges", "the same along y; size_y_rad without a sensor", ""),
    "edge_x_m": ResultNumber(
        "m",
        "above 0; null without edges",
        "distance along x over which light falls from 90 to 13.5 %, mean of both sides; edge_x_rad without a sensor",
        "",
    ),
    "edge_y_m": ResultNumber("m", "above 0; null without edges", "the same along y; edge_y_rad without a sensor", ""),
    "distance_m": ResultNumber(
        "m", "above 0", "distance of an area or a focus from the lens, or from the DOE without one", ""
    ),
    "width_wanted_m": ResultNumber("m", "above 0", "full width at half maximum that a focus should have at most", ""),
    "width_x_m": ResultNumber(
        "m",
        "above 0; null beyond 4 times the wanted one",
        "full width of a focus along x at half of the light on the axis",
        "",
    ),
    "width_y_m": ResultNumber("m", "above 0; null beyond 4 times the wanted one", "the same along y", ""),
    "strength": ResultNumber(
        "1",
        "0 to 1",
        "light on the axis at a focus over that of an ideal lens of the same aperture, the Strehl ratio of "
        "optics textbooks; strehl compares with the design instead",
        "",
    ),
    "share": ResultNumber(*_SHARE, "share of the light within a circle as wide as a focus should be", ""),
}
_PRECOMPENSATION = {
    "mask": ResultNumber("count", "1 or more", "mask, numbered from 1", ""),
    "designed_nm": ResultNumber("nm", "above 0", "depth that the design has", ""),
    "commanded_nm": ResultNumber("nm", "above 0", "depth to command", ""),
    "expected_nm": ResultNumber("nm", "above 0", "depth that the process is expected to make of it", ""),
    "edge_move_nm": ResultNumber("nm", "any", "how far edges are drawn outward", ""),
    "expected_edge_nm": ResultNumber("nm", "any", "how far outward they are expected to come out", ""),
}
_REFINEMENT = {
    "cell": ResultNumber("text", "before, printable or refined", "unit cell that a row is of", "doedesign.refinement"),
    "terms": ResultNumber(
        "count", "0 or more", "terms of the rigorous solution; 0 for scalar light", "doedesign.refinement"
    ),
}


def sourced(numbers: Mapping[str, ResultNumber], source: str) -> dict[str, ResultNumber]:
    """Numbers of one place, each with the `source` where it has none."""
    return {name: one if one.source else one._replace(source=source) for name, one in numbers.items()}


METRICS_GROUPS: tuple[NumberGroup, ...] = (
    NumberGroup("Where and what", "all tables", MappingProxyType(_LABELS)),
    NumberGroup(
        "Light of a plate",
        "rows of a colour and a depth: `psf` of a run, each design of `psf/`, `nominal` and "
        "`fabricated` of `fabricated/`, draws of `tolerance/`",
        MappingProxyType(_of_plates()),
    ),
    NumberGroup(
        "Energy budget",
        "`budget` of a row; six shares, with far_spot, sum to 1",
        MappingProxyType(sourced(_BUDGET, "sim.metrics.EnergyBudget")),
    ),
    NumberGroup(
        "Leaked and diffracted light",
        "`split` of a row of `fabricated/`",
        MappingProxyType(sourced(_SPLIT, "sim.surface.leakage.SplitPsf")),
    ),
    NumberGroup(
        "Certified 0th orders",
        "`certified` of a row of `psf/`, where the run has a certificate",
        MappingProxyType(sourced(_CERTIFIED, "fab.runsheet.tables.CertifiedOrder")),
    ),
    NumberGroup(
        "Error budget of the prediction",
        "`accuracy` of a run",
        MappingProxyType(sourced(_ACCURACY, "doedesign.design.accuracy.Accuracy")),
    ),
    NumberGroup("Target patterns", "`patterns` of a run", MappingProxyType(_PATTERN)),
    NumberGroup(
        "Chosen etch depths", "`etches` of a run", MappingProxyType(sourced(_ETCHES, "doedesign.optimization"))
    ),
    NumberGroup(
        "Spots, areas and foci",
        "`orders`, `area` and `focus` of a run and of `fabricated/`",
        MappingProxyType(sourced(_AIMED, "summary of OrderTable, AreaTable and FocusTable")),
    ),
    NumberGroup("Refined cells", "`refinement` of a refined run; refinement.csv", MappingProxyType(_REFINEMENT)),
    NumberGroup(
        "Pre-compensated masks",
        "`precompensation` of a pre-compensated run; precompensation.csv",
        MappingProxyType(sourced(_PRECOMPENSATION, "doedesign.precompensation")),
    ),
)


def metrics_numbers() -> dict[str, ResultNumber]:
    """Every name of a metrics.json, each with its one definition.

    Raises:
        ValueError: a name stands in two groups.
    """
    out: dict[str, ResultNumber] = {}
    for group in METRICS_GROUPS:
        if twice := out.keys() & group.numbers.keys():
            raise ValueError(f"defined twice: {', '.join(sorted(twice))}")
        out |= group.numbers
    return out


def number(name: str) -> ResultNumber | None:
    """Definition of a name of metrics.json, as a length on a sensor or as the angle without one; None for another."""
    known = metrics_numbers()
    return known.get(name, known.get(f"{name.removesuffix('_rad')}_m") if name.endswith("_rad") else None)
