"""Rules that join several values of a spec, so that the optics are possible.

A broken rule is an `InputError` whose `where` is the key.
"""

import math
import operator
from collections.abc import Iterator

from doedesign.spec.models import Spec
from doedesign.spec.process_checks import process_problems
from doedesign.spec.robust import robust_problems
from doedesign.spec.targets.areas import area_problems
from doedesign.spec.targets.focus import focus_problems
from doedesign.spec.targets.spots import spot_problems
from doedesign.spec.training import training_problems
from doedesign.spec.values import BEAM_FILES, NEAR_OBJECTIVES, RANDOM_QUANTISATIONS, STARTS, nearest
from doedesign.spec.values.table import toml_key
from fab.aperture import MaskAperture
from fab.errors import InputError
from fab.units import MICROMETRES, format_length
from sim.lens import check_lens
from sim.material import refractive_index

# Keys of a beam of each kind: those that it needs, and those that it may have besides.
_BEAM_KEYS = {
    "gaussian": (("diameters_m",), ("waist_distance_m", "m_squared", "centre_m")),
    "picture": (("picture", "pixel_m"), ("centre_m",)),
    "plane": ((), ()),
    "point": (("distance_m",), ()),
}

_SAME_DEPTH = 1e-9  # relative


def find_problems(spec: Spec) -> list[InputError]:
    """Return every rule between values, each of them valid by itself, that a spec breaks."""
    rules = (_distance, _light, _doe, _sensor, _lens, _illumination, _scene, _fresnel_sampling, _objectives, _process)
    rules = (*rules, _start, _quantisation, _printing, robust_problems, _limits, _training)
    rules = (*rules, spot_problems, area_problems, focus_problems)
    return [problem for rule in rules for problem in rule(spec)]


def _light(spec: Spec) -> Iterator[InputError]:
    named = [("optics.design_wavelength", spec.optics.design_wavelength_m)]
    for index, colour in enumerate(spec.optics.colours):
        named += [(f"optics.colours[{index}].wavelengths", wavelength_m) for wavelength_m in colour.wavelengths_m]
    for key, wavelength_m in named:
        try:
            refractive_index(spec.doe.material, wavelength_m)
        except InputError as error:
            yield InputError(key, f"{error.rule} ({spec.doe.material})", str(error.got), error.cure)
    names = [colour.name for colour in spec.optics.colours]
    for index, name in enumerate(names):
        if name in names[:index]:
            key, rule = f"optics.colours[{index}].name", "every colour channel must have its own name"
            yield InputError(key, rule, f"{name!r} twice", "Rename or remove one of them.")


def _doe(spec: Spec) -> Iterator[InputError]:
    doe, overlap = spec.doe, spec.process.chrome_overlap_m
    relief, aperture = doe.relief, str(doe.relief)
    # As many cells per side span the longer side of a rectangle; of two numbers each spans its own.
    sides = relief.extent_m if isinstance(doe.samples, tuple) else (relief.widest_m,)
    # One part in a million of slack, for values that lie on the limit in decimal.
    spanned = () if isinstance(relief, MaskAperture) else zip(sides, doe.shape, strict=False)
    if any(abs(side - n * doe.pitch_m) > doe.pitch_m / 2 * (1 + 1e-6) for side, n in spanned):
        spans = [format_length(n * doe.pitch_m) for n in reversed(doe.shape)][: len(sides)]
        counts: list[int] | int = [max(2, round(side / doe.pitch_m)) for side in reversed(sides)]
        given: list[int] | int = list(doe.samples) if isinstance(doe.samples, tuple) else doe.samples
        wanted = f'["{spans[0]}", "{spans[-1]}"]'
        if isinstance(given, int):
            counts, wanted = counts[0], f'"{spans[0]}"'
        rule = f"must equal samples x pitch = {given} x {format_length(doe.pitch_m)} = {' x '.join(spans)}"
        cure = f"Set aperture = {wanted} or samples = {counts}."
        yield InputError("doe.aperture", f"{rule} to within half a pitch", aperture, cure)
    if spec.optimize.parametrization == "radial" and not isinstance(doe.aperture_m, float):
        rule, cure = "rings fill a round aperture", 'Use "freeform", or give the diameter of the aperture.'
        yield InputError("optimize.parametrization", rule, f'"radial" in {aperture}', cure)
    if relief.shrunk(overlap).narrowest_m < 2 * doe.pitch_m:
        rule = f"twice the overlap must leave an opening in an aperture of {aperture}"
        yield InputError("process.chrome_overlap", rule, format_length(overlap), "Choose a smaller overlap.")


def _distance(spec: Spec) -> Iterator[InputError]:
    """A camera has a lens or none; what belongs to a lens or a sensor only."""
    optics, sensor = spec.optics, spec.sensor
    if optics.focal_length_m is None and sensor.distance_m is None and not sensor.in_angles:
        cure = (
            'Add it, for example focal_length = "8 mm", or sensor.distance or sensor.pixel_angle for light without one.'
        )
        yield InputError("optics.focal_length", "a camera has a lens, or a sensor at a distance", "neither", cure)
    if optics.focal_length_m is not None and sensor.distance_m is not None:
        cure = "Remove it, or optics.focal_length."
        yield InputError("sensor.distance", "it is for light without a lens", "both", cure)
    if sensor.in_angles:
        yield from _directions(spec)
    elif sensor.pitch_m is None:
        yield InputError("sensor.pitch", "must be given", "nothing", 'For example `pitch = "1.85 um"`.')
    if optics.focal_length_m is not None:
        return
    alone = {
        "optics.mapping": optics.mapping != "sine",
        "optics.distortion": any(optics.distortion),
        "optics.doe_distance": optics.doe_distance_m > 0,
        "optics.propagation": optics.propagation != "far_field",
        "sensor.defocus": sensor.defocus_m != 0,
    }
    for key, given in alone.items():
        if given:
            yield InputError(key, "it belongs to a lens, and there is none", "a value", "Leave it out.")
    if spec.scene.near_m:
        rule = "obstructions are looked past through a lens"
        yield InputError("scene.near", rule, "depths", "Leave them out, or give optics.focal_length.")


def _directions(spec: Spec) -> Iterator[InputError]:
    """Keys that cannot stand beside pixels that are angles, and how far these may reach."""
    sensor, rule = spec.sensor, "directions are looked at without lens and sensor"
    beside = {
        "optics.focal_length": spec.optics.focal_length_m,
        "sensor.distance": sensor.distance_m,
        "sensor.pitch": sensor.pitch_m,
        "sensor.resolution": sensor.resolution,
    }
    for key, value in beside.items():
        if value is not None:
            yield InputError(key, rule, "also sensor.pixel_angle", "Leave one of them out.")
    if sensor.window_m > 2:
        most = int(2 / sensor.pixel_m)
        got = f"{sensor.window} pixels of {pixel_text(spec)}, a sine of {sensor.window_m / 2:.4g} at their edge"
        yield InputError("sensor.window", "directions end at 90 deg, a sine of 1", got, f"Set window = {most} or less.")


def pixel_text(spec: Spec) -> str:
    """Write the size of a pixel, in micrometres or degrees."""
    return f"{float(spec.told_in(MICROMETRES).of(spec.sensor.pixel_m)):.4g} {spec.told_in(MICROMETRES).suffix}"


def _sensor(spec: Spec) -> Iterator[InputError]:
    sensor, colours = spec.sensor, spec.optics.colours
    focal = spec.optics.focal_length_m or math.inf
    if sensor.defocus_m <= -focal / 2:
        rule = f"the sensor must stay beyond half the focal length, {format_length(focal)}, from the lens"
        yield InputError("sensor.defocus", rule, format_length(sensor.defocus_m), "Choose a smaller defocus.")
    count = len(sensor.quantum_efficiency)
    if count not in (0, 1, len(colours)):
        rule = f"must be one number or one per colour, {len(colours)} here"
        yield InputError("sensor.quantum_efficiency", rule, f"{count}", "Add or remove numbers.")
    means = [sum(map(operator.mul, c.wavelengths_m, c.weights)) for c in colours]
    if sensor.bayer and not (len(means) == 3 and means[0] > means[1] > means[2]):
        rule = "a mosaic needs three colours, from the longest wavelength to the shortest"
        got = ", ".join(colour.name for colour in colours)
        yield InputError("sensor.bayer", rule, got, "State the colours as red, green, blue, or leave `bayer` out.")


def _lens(spec: Spec) -> Iterator[InputError]:
    optics, sensor = spec.optics, spec.sensor
    if optics.propagation == "fresnel":
        cure = 'Set propagation = "far_field", or leave it out.'
        rule = "the direct path has the lens of eq. 5, whose mapping cannot be chosen"
        if optics.mapping != "sine":
            yield InputError("optics.mapping", rule, f'"{optics.mapping}"', cure)
        if any(optics.distortion):
            yield InputError("optics.distortion", rule, f"{list(optics.distortion)}", cure)
        if optics.doe_distance_m:
            rule = "on the direct path the DOE lies on the lens"
            yield InputError("optics.doe_distance", rule, format_length(optics.doe_distance_m), cure)
    if optics.focal_length_m is None:
        return
    if optics.doe_distance_m * sensor.defocus_m >= optics.focal_length_m**2 / 2:
        rule = "with the sensor beyond the focus it must stay below focal_length² / (2 defocus)"
        got, cure = format_length(optics.doe_distance_m), "Move the DOE to the lens or the sensor into focus."
        yield InputError("optics.doe_distance", rule, got, cure)
    distance_m = optics.focal_length_m + sensor.defocus_m
    if optics.mapping == "sine" and not any(optics.distortion) and sensor.window_m > 2 * distance_m * (1 + 1e-9):
        rule, cure = "a lens that images sines ends at a sine of 1", "Choose a smaller window."
        yield InputError("sensor.window", rule, f"{sensor.window_m / 2 / distance_m:.3g} at the window's edge", cure)
        return
    corner = sensor.window_m / math.sqrt(2) / distance_m
    try:
        check_lens(optics.mapping, optics.distortion, corner, "optics.{}".format)
    except InputError as error:
        yield error


def _scene(spec: Spec) -> Iterator[InputError]:
    near, far, least_m = spec.scene.near_m, spec.scene.far_m, _nyquist_length_m(spec)
    if near and max(near) >= min(far):
        got = f"{format_length(max(near))} near and {format_length(min(far))} far"
        rule = "every near depth must be smaller than every far depth"
        yield InputError("scene.near", rule, got, "Move the obstruction closer or the scene away.")
    # Neighbouring cells must see a source less than half a wave apart: the bound of eq. 6 for the depth.
    for key, depths in (("scene.near", near), ("scene.far", far)):
        if depths and min(depths) < least_m:
            rule = f"every depth must be at least samples x pitch^2 / wavelength = {rounded(least_m)}, "
            rule += "or the cells cannot follow the wave of the source"
            cure = "Move the source away or choose a finer pitch for the same aperture."
            yield InputError(key, rule, format_length(min(depths)), cure)
        # Banks name a PSF by its depth, to twelve digits; no two PSFs differ for less.
        for index, depth_m in enumerate(depths):
            if any(math.isclose(depth_m, other, rel_tol=_SAME_DEPTH) for other in depths[:index]):
                rule, cure = "every depth must be given once", "Leave one of them out."
                yield InputError(f"{key}[{index}]", rule, f"{format_length(depth_m)} twice", cure)


def shortest_m(spec: Spec) -> float:
    """Return the shortest wavelength, metres."""
    return min(wavelength_m for colour in spec.optics.colours for wavelength_m in colour.wavelengths_m)


def _nyquist_length_m(spec: Spec) -> float:
    """Radius of the strongest wavefront curvature the cells can sample (paper eq. 6), at the shortest wavelength."""
    return max(spec.doe.shape) * spec.doe.pitch_m**2 / shortest_m(spec)


def rounded(length_m: float) -> str:
    """Write a derived length with four digits."""
    return format_length(float(f"{length_m:.4g}"))


def _illumination(spec: Spec) -> Iterator[InputError]:
    beam = spec.illumination
    if beam is None:
        return
    needed, allowed = _BEAM_KEYS[beam.kind]
    given = beam.given()
    for name in needed:
        if name not in given:
            cure = f"Add `{toml_key(name)}`."
            yield InputError(
                f"illumination.{toml_key(name)}", f'a beam of kind "{beam.kind}" needs it', "nothing", cure
            )
    for name in sorted({key for keys in _BEAM_KEYS.values() for one in keys for key in one} - {*needed, *allowed}):
        if name in given:
            takes = map(toml_key, (*needed, *allowed, "angles_rad", "tilt_rad"))
            rule = f'a beam of kind "{beam.kind}" takes: {", ".join(takes)}'
            yield InputError(f"illumination.{toml_key(name)}", rule, toml_key(name), "Remove it.")
    for name in ("diameters_m", "m_squared"):
        if len(getattr(beam, name)) > 2:
            count = f"{len(getattr(beam, name))}"
            yield InputError(f"illumination.{toml_key(name)}", "must be one number or [x, y]", count, "Remove some.")
    if beam.picture is not None and not beam.picture.lower().endswith(BEAM_FILES):
        rule, got = f"must be a file of {', '.join(BEAM_FILES)}", f'"{beam.picture}"'
        yield InputError("illumination.picture", rule, got, "Save the picture as one of these.")
    least_m = _nyquist_length_m(spec)
    if beam.distance_m is not None and beam.distance_m < least_m:
        rule = f"must be at least samples x pitch^2 / wavelength = {rounded(least_m)}, "
        rule += "or the cells cannot follow the wave of the point"
        cure = "Move the point away or choose a finer pitch for the same aperture."
        yield InputError("illumination.distance", rule, format_length(beam.distance_m), cure)
    if any(beam.tilt_rad) and spec.optics.propagation == "fresnel":
        rule, cure = "a beam is tilted in the far field", "Give its angle, which the sensor follows, or leave it out."
        yield InputError("illumination.tilt", rule, '"fresnel"', cure)
    if spec.scene.near_m or spec.scene.far_m != (math.inf,):
        cure = 'Write far = ["inf"]; the curvature of the beam is that of its waist_distance, or its point\'s distance.'
        yield InputError("scene.far", "a beam takes the place of sources at depths", "depths", cure)
    if spec.optimize.parametrization == "radial":
        rule = "rings are computed for even light"
        yield InputError("optimize.parametrization", rule, '"radial"', 'Use "freeform".')


def _fresnel_sampling(spec: Spec) -> Iterator[InputError]:
    wavelength_m, focal_m, needed_m = shortest_m(spec), spec.optics.focal_length_m, _nyquist_length_m(spec)
    if spec.optics.propagation != "fresnel" or focal_m is None or needed_m <= focal_m:
        return
    span_m = max(spec.doe.shape) * spec.doe.pitch_m
    samples = math.ceil(span_m**2 / (wavelength_m * focal_m))
    samples += samples % 2
    yield InputError(
        "optics.propagation",
        '"fresnel" needs samples x pitch^2 / wavelength <= focal_length at every wavelength (eq. 6)',
        f"{rounded(needed_m)} > {format_length(focal_m)} at {format_length(wavelength_m)}",
        f"For this aperture the pitch may be at most {rounded(wavelength_m * focal_m / span_m)} "
        f'(samples = {samples}, pitch = "{rounded(span_m / samples)}"); or set propagation = "far_field".',
    )


def _start(spec: Spec) -> Iterator[InputError]:
    optimize = spec.optimize
    if optimize.start not in STARTS and optimize.start_options:
        rule, cure = "a start that is a file takes none", "Leave them out, or start_options = {}."
        yield InputError("optimize.start_options", rule, ", ".join(optimize.start_options), cure)


def _quantisation(spec: Spec) -> Iterator[InputError]:
    process, quantisation = spec.process, spec.optimize.quantisation
    if quantisation in RANDOM_QUANTISATIONS and process.etch_depths_m is not None:
        rule = f'"{quantisation}" draws levels of equal steps'
        cure = "Leave process.etch_depths out, or use another quantisation."
        yield InputError("optimize.quantisation", rule, "etch depths of their own", cure)
    if spec.optimize.polish and (quantisation == "none" or process.etch_depths_m is not None):
        rule, cure = "a descent on levels needs levels of equal steps", "Leave polish out."
        got = "continuous heights" if quantisation == "none" else "etch depths of their own"
        yield InputError("optimize.polish", rule, got, cure)


def _printing(spec: Spec) -> Iterator[InputError]:
    """Rules for the keys that say what masks may hold."""
    optimize, doe = spec.optimize, spec.doe
    if optimize.min_feature_m is not None:
        refused = (
            ("polish", optimize.polish > 0, "moves of cells would break it", "Leave polish out."),
            ("quantisation", optimize.quantisation == "none", "masks have levels", "Choose a quantisation."),
            (
                "parametrization",
                optimize.parametrization == "radial",
                "rings break it at 45 degrees",
                'Use "freeform".',
            ),
        )
        for name, broken, rule, cure in refused:
            if broken:
                got = f"{getattr(optimize, name)}"
                yield InputError(f"optimize.{name}", f"with a min_feature, {rule}", got, cure)
        if spec.process.chooses_depths:
            cure = "Give them, or leave min_feature out."
            yield InputError("process.etch_depths", "with a min_feature, the depths must be known", '"optimize"', cure)
    elif optimize.wall_weight:
        cure = 'Add min_feature = "1 um", or leave it out.'
        yield InputError("optimize.wall_weight", "goes with a min_feature", optimize.wall_weight, cure)
    if optimize.drawn_pixel_m is None:
        return
    block = round(optimize.drawn_pixel_m / doe.pitch_m)
    if block < 1 or abs(optimize.drawn_pixel_m - block * doe.pitch_m) > 1e-6 * doe.pitch_m:
        rule, got = f"must be a whole number of cells of {format_length(doe.pitch_m)}", optimize.drawn_pixel_m
        cure = f'For example "{format_length(2 * doe.pitch_m)}".'
        yield InputError("optimize.drawn_pixel", rule, format_length(got), cure)
    elif any(count % block for count in doe.shape):
        rule = f"must divide the {' x '.join(map(str, doe.shape))} cells"
        yield InputError("optimize.drawn_pixel", rule, f"{block} cells", "Change doe.samples and doe.aperture.")
    elif optimize.parametrization == "radial":
        yield InputError("optimize.drawn_pixel", "rings are drawn of cells", '"radial"', 'Use "freeform".')


def _objectives(spec: Spec) -> Iterator[InputError]:
    if not (spec.objectives or spec.aims):
        own = spec.optimize
        focused = own.start == "fresnel" and "focal_length" not in dict(own.start_options)
        for judged, got, cure in (
            (own.steps > 0, "no [[objective]]", "Add one, or steps = 0."),
            (own.polish > 0, "no [[objective]] for polish", "Add one, or leave polish out."),
            (own.start == "nlopt", 'no [[objective]] for start = "nlopt"', "Add one, or choose another start."),
            (focused, "no [[objective]] for the best focal length", "Add one, or start_options.focal_length."),
        ):
            if judged:
                yield InputError("objective", "an optimisation must have something to improve", got, cure)
                break
    for index, objective in enumerate(spec.objectives):
        if objective.name in NEAR_OBJECTIVES and not spec.scene.near_m:
            rule = f'"{objective.name}" looks at near depths, so scene.near must hold one'
            cure = "Add a depth to scene.near or remove the objective."
            yield InputError(f"objective[{index}].name", rule, "an empty scene.near", cure)
        if spec.optimize.colours == "in_turn" and (
            objective.name == "equal_colours" or objective.colours or objective.compares
        ):
            rule = "must look at any colour alone, where every step looks at one of them"
            cure = 'Use optimize.colours = "together", or objectives for all colours and depths alike.'
            yield InputError(f"objective[{index}]", rule, "one that compares or names them", cure)
        yield from _cases(spec, index)


def _cases(spec: Spec, index: int) -> Iterator[InputError]:
    """Rules for the colours and depths that an objective names."""
    objective, scene = spec.objectives[index], spec.scene
    colours = [colour.name for colour in spec.optics.colours]
    for name in objective.colours:
        if name not in colours:
            rule, cure = "must be colour channels of the spec", nearest(name, colours)
            yield InputError(f"objective[{index}].colours", rule, f'"{name}"', cure)
    if not objective.depths_m:
        return
    looks = {
        **dict.fromkeys(("far_spot", "spot_energy", "equal_colours", "target_pattern", "filtered_error"), ("far",)),
        "near_spread": ("near",),
        "ring_to_disc": ("near",),
        "handcrafted": ("near", "far"),
    }
    depths = {"near": scene.near_m, "far": scene.far_m}
    wanted = looks.get(objective.name, ())
    allowed = [depth for side in wanted or depths for depth in depths[side]]
    listed = ", ".join(map(format_length, allowed))
    for depth_m in objective.depths_m:
        if depth_m not in allowed:
            rule = f'depths that "{objective.name}" looks at in this scene are: {listed or "none"}'
            yield InputError(f"objective[{index}].depths", rule, format_length(depth_m), "Name some of these.")
    for side in wanted:
        if not set(depths[side]) & set(objective.depths_m):
            rule = f'"{objective.name}" needs a {side} depth'
            yield InputError(f"objective[{index}].depths", rule, "none", f"Add one of scene.{side}.")


def _process(spec: Spec) -> Iterator[InputError]:
    yield from process_problems(spec.process)
    process = spec.process.filled()
    die_m, radius_m = process.die_m or (0.0, 0.0), process.wafer_radius_m or math.inf
    reach_m = math.hypot(*die_m) + spec.doe.relief.reach_m
    if reach_m > radius_m:
        rule = f"the DOE must lie on the wafer of radius {format_length(radius_m)}"
        cure = "Move the die inward or choose a larger process.wafer_radius."
        yield InputError("process.die", rule, f"a DOE that reaches {rounded(reach_m)} from its middle", cure)
    stated = "diameter_m" in spec.wafer.model_fields_set and spec.process.wafer_radius_m is not None
    if stated and abs(2 * radius_m - spec.wafer.diameter_m) > 1e-6:
        rule = f"must be half of wafer.diameter, {format_length(spec.wafer.diameter_m)}"
        yield InputError("process.wafer_radius", rule, format_length(radius_m), "Give one of them alone.")
    moves = spec.wafer.edge_moves_m
    if moves and len(moves) != process.masks:
        rule = f"must have one entry per mask, {process.masks} for {process.levels} levels"
        yield InputError("wafer.edge_moves", rule, f"a list of {len(moves)}", "Add or remove entries.")
    if moves and spec.wafer.compensate:
        rule = "edges are moved by these lengths, or against the bias of the process (wafer.compensate)"
        yield InputError("wafer.edge_moves", rule, "both", "Leave one of them out.")


def _limits(spec: Spec) -> Iterator[InputError]:
    colours = [colour.name for colour in spec.optics.colours]
    for index, limit in enumerate(spec.limits):
        if limit.colour is not None and limit.colour not in colours:
            rule, cure = "must be a colour channel of the spec", nearest(limit.colour, colours)
            yield InputError(f"limit[{index}].colour", rule, f'"{limit.colour}"', cure)


def _training(spec: Spec) -> Iterator[InputError]:
    yield from training_problems(spec.network, spec.train, len(spec.optics.colours))
    if spec.train.field == "random" and (spec.optics.mapping != "sine" or any(spec.optics.distortion)):
        rule = 'scenes off the axis need optics.mapping = "sine" without distortion, for all steps share one plan'
        cure = 'Set field = "off", or leave mapping and distortion out while training.'
        yield InputError("train.field", rule, '"random"', cure)
