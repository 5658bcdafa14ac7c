"""Rules that join several values of a spec: the optics must be possible, and what is doubtful is said aloud.

A broken rule is a `SpecMistake`; a doubt is a sentence. Neither changes the spec.
"""

import math
import operator
from collections.abc import Iterator

from doedesign.spec.errors import SpecMistake
from doedesign.spec.models import Spec
from doedesign.spec.process_checks import (
    limit_problems,
    limit_warnings,
    printing_warning,
    process_problems,
    wafer_problem,
)
from fab.errors import InputError
from fab.units import NM, UM, format_length
from sim.material import full_wave_height_m, full_wave_wavelength_m, refractive_index

__all__ = ["find_problems", "spec_warnings"]

_NEAR_OBJECTIVES = ("near_spread", "handcrafted")
_WAVE_TOLERANCE = 0.02


def find_problems(spec: Spec) -> list[SpecMistake]:
    """Return every rule between tables that a spec breaks.

    Args:
        spec: a spec whose single values are valid.
    """
    rules = (
        _materials,
        _colours,
        _aperture,
        _opening,
        _sensor,
        _efficiencies,
        _mosaic,
        _depth_order,
        _source_sampling,
        _fresnel_sampling,
        _objectives,
        _process,
        wafer_problem,
        limit_problems,
    )
    return [problem for rule in rules for problem in rule(spec)]


def _process(spec: Spec) -> Iterator[SpecMistake]:
    return process_problems(spec.process)


def _opening(spec: Spec) -> Iterator[SpecMistake]:
    overlap, aperture = spec.process.chrome_overlap_m, spec.doe.aperture_m
    if aperture - 2 * overlap < 2 * spec.doe.pitch_m:
        yield SpecMistake(
            "process.chrome_overlap",
            f"twice the overlap must leave an opening in an aperture of {format_length(aperture)}",
            format_length(overlap),
            "Choose a smaller overlap.",
        )


def _sensor(spec: Spec) -> Iterator[SpecMistake]:
    focal, defocus = spec.optics.focal_length_m, spec.sensor.defocus_m
    if defocus <= -focal / 2:
        yield SpecMistake(
            "sensor.defocus",
            f"the sensor must stay beyond half the focal length, {format_length(focal)}, from the lens",
            format_length(defocus),
            "Choose a smaller defocus.",
        )


def _efficiencies(spec: Spec) -> Iterator[SpecMistake]:
    given, colours = len(spec.sensor.quantum_efficiency), len(spec.optics.colours)
    if given not in (0, 1, colours):
        rule = f"must be one number or one per colour, {colours} here"
        yield SpecMistake("sensor.quantum_efficiency", rule, f"{given}", "Add or remove numbers.")


def _mosaic(spec: Spec) -> Iterator[SpecMistake]:
    means = [sum(map(operator.mul, c.wavelengths_m, c.weights)) for c in spec.optics.colours]
    if spec.sensor.bayer and not (len(means) == 3 and means[0] > means[1] > means[2]):
        yield SpecMistake(
            "sensor.bayer",
            "a mosaic needs three colours, from the longest wavelength to the shortest",
            ", ".join(colour.name for colour in spec.optics.colours),
            "State the colours as red, green, blue, or leave `bayer` out.",
        )


def _wavelengths(spec: Spec) -> list[float]:
    return sorted({w for colour in spec.optics.colours for w in colour.wavelengths_m})


def _materials(spec: Spec) -> Iterator[SpecMistake]:
    named = [("optics.design_wavelength", spec.optics.design_wavelength_m)]
    for index, colour in enumerate(spec.optics.colours):
        named += [(f"optics.colours[{index}].wavelengths", wavelength_m) for wavelength_m in colour.wavelengths_m]
    for key, wavelength_m in named:
        try:
            refractive_index(spec.doe.material, wavelength_m)
        except InputError as error:
            yield SpecMistake(key, f"{error.rule} ({spec.doe.material})", str(error.got), error.cure)


def _colours(spec: Spec) -> Iterator[SpecMistake]:
    names = [colour.name for colour in spec.optics.colours]
    for index, name in enumerate(names):
        if name in names[:index]:
            yield SpecMistake(
                f"optics.colours[{index}].name",
                "every colour channel must have its own name",
                f"{name!r} twice",
                "Rename or remove one of them.",
            )


def _aperture(spec: Spec) -> Iterator[SpecMistake]:
    doe = spec.doe
    span_m = doe.samples * doe.pitch_m
    # One part in a million of slack, for values that lie on the limit in decimal.
    if abs(doe.aperture_m - span_m) > doe.pitch_m / 2 * (1 + 1e-6):
        yield SpecMistake(
            "doe.aperture",
            f"must equal samples x pitch = {doe.samples} x {format_length(doe.pitch_m)} = {format_length(span_m)} "
            "to within half a pitch",
            format_length(doe.aperture_m),
            f'Set aperture = "{format_length(span_m)}" or samples = {max(2, round(doe.aperture_m / doe.pitch_m))}.',
        )


def _depth_order(spec: Spec) -> Iterator[SpecMistake]:
    near, far = spec.scene.near_m, spec.scene.far_m
    if near and max(near) >= min(far):
        yield SpecMistake(
            "scene.near",
            "every near depth must be smaller than every far depth",
            f"{format_length(max(near))} near and {_depth_text(min(far))} far",
            "Move the obstruction closer or the scene away.",
        )


def _depth_text(depth_m: float) -> str:
    return "inf" if math.isinf(depth_m) else format_length(depth_m)


def _nyquist_length_m(spec: Spec, wavelength_m: float) -> float:
    """Return N pitch^2 / lambda: the shortest radius of curvature the cells can sample (paper eq. 6)."""
    return spec.doe.samples * spec.doe.pitch_m**2 / wavelength_m


def _source_sampling(spec: Spec) -> Iterator[SpecMistake]:
    """Check that neighbouring cells see a source less than half a wave apart: the bound of eq. 6 for the depth."""
    shortest_m = _nyquist_length_m(spec, _wavelengths(spec)[0])
    for key, depths in (("scene.near", spec.scene.near_m), ("scene.far", spec.scene.far_m)):
        if depths and min(depths) < shortest_m:
            yield SpecMistake(
                key,
                f"every depth must be at least samples x pitch^2 / wavelength = {_round_length(shortest_m)}, "
                "or the cells cannot follow the wave of the source",
                format_length(min(depths)),
                "Move the source away or choose a finer pitch for the same aperture.",
            )


def _round_length(length_m: float) -> str:
    """Write a derived length with four digits."""
    return format_length(float(f"{length_m:.4g}"))


def _fresnel_sampling(spec: Spec) -> Iterator[SpecMistake]:
    if spec.optics.propagation != "fresnel":
        return
    wavelength_m, focal_m = _wavelengths(spec)[0], spec.optics.focal_length_m
    needed_m = _nyquist_length_m(spec, wavelength_m)
    if needed_m <= focal_m:
        return
    span_m = spec.doe.samples * spec.doe.pitch_m
    samples = math.ceil(span_m**2 / (wavelength_m * focal_m))
    samples += samples % 2
    yield SpecMistake(
        "optics.propagation",
        '"fresnel" needs samples x pitch^2 / wavelength <= focal_length at every wavelength (eq. 6)',
        f"{_round_length(needed_m)} > {format_length(focal_m)} at {format_length(wavelength_m)}",
        f"For this aperture the pitch may be at most {_round_length(wavelength_m * focal_m / span_m)} "
        f'(samples = {samples}, pitch = "{_round_length(span_m / samples)}"); or set propagation = "far_field".',
    )


def _objectives(spec: Spec) -> Iterator[SpecMistake]:
    if not spec.objectives and spec.optimize.steps > 0:
        yield SpecMistake(
            "objective", "an optimisation must have something to improve", "no [[objective]]", "Add one, or steps = 0."
        )
    for index, objective in enumerate(spec.objectives):
        if objective.name in _NEAR_OBJECTIVES and not spec.scene.near_m:
            yield SpecMistake(
                f"objective[{index}].name",
                f'"{objective.name}" looks at near depths, so scene.near must hold one',
                "an empty scene.near",
                "Add a depth to scene.near or remove the objective.",
            )


def spec_warnings(spec: Spec) -> list[str]:
    """Return what is allowed but probably not meant, one sentence or two each.

    Args:
        spec: a valid spec.
    """
    rules = (_level_warning, printing_warning, _sensor_warning, _reach_warning, _disc_warning, limit_warnings)
    return [warning for rule in rules for warning in rule(spec)]


def _level_warning(spec: Spec) -> Iterator[str]:
    process, material = spec.process, spec.doe.material
    design_m = spec.optics.design_wavelength_m
    height_m = process.levels * process.level_step_m
    wave_m = full_wave_height_m(material, design_m)
    waves = height_m / wave_m
    if abs(waves - 1) <= _WAVE_TOLERANCE:
        return
    product = f"{process.levels} x {format_length(process.level_step_m)} = {_round_length(height_m)}"
    try:
        exact_m = full_wave_wavelength_m(material, height_m)
    except InputError:
        exact = f"is one wave at no wavelength {material} is known for"
    else:
        exact = f"of {material} is one wave at {exact_m / NM:.0f} nm"
    yield (
        f"process.level_step: {product} {exact}; at the design wavelength of {format_length(design_m)} it is "
        f"{waves:.4f} waves, {100 * (waves - 1):+.1f} % off, so the top of the staircase does not meet its foot. "
        f'A level_step of "{wave_m / process.levels / NM:.2f} nm" would.'
    )


def _sensor_warning(spec: Spec) -> Iterator[str]:
    sensor = spec.sensor
    binned = min(sensor.resolution) // sensor.binning
    if sensor.window > binned:
        yield (
            f"sensor.window: {sensor.window} pixels are more than the {binned} binned pixels of the sensor's shorter "
            "side; PSFs will reach beyond the sensor."
        )


def _reach_warning(spec: Spec) -> Iterator[str]:
    wavelength_m = _wavelengths(spec)[0]
    reach_m = spec.optics.focal_length_m * wavelength_m / (2 * spec.doe.pitch_m)
    if spec.sensor.window_m / 2 > reach_m:
        yield (
            f"sensor.window: it ends {spec.sensor.window_m / 2 / UM:.0f} um from the axis, but cells of "
            f"{format_length(spec.doe.pitch_m)} steer {format_length(wavelength_m)} only {reach_m / UM:.0f} um far; "
            f"beyond that the PSF repeats. At most {int(2 * reach_m / spec.sensor.pixel_m)} pixels avoid it."
        )


def _disc_warning(spec: Spec) -> Iterator[str]:
    if not spec.scene.near_m:
        return
    depth_m = min(spec.scene.near_m)
    disc_m = spec.doe.aperture_m * spec.optics.focal_length_m / depth_m
    if disc_m > spec.sensor.window_m:
        yield (
            f"sensor.window: the blur disc of a point at {format_length(depth_m)} is {_round_length(disc_m)} wide, "
            f"more than the window's {_round_length(spec.sensor.window_m)}; its rim is cut off."
        )
