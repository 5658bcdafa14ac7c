"""Parts that a spec may leave out because others say them: scene, sensor, the steps of a design that is a formula.

A task is said by `[spots]`, `[area]`, `[focus]` or a classic start (`optimize.start = "axicon"`). What is left out then
becomes part of the spec, as if it had been written, by these rules:

    scene.far           "inf", a collimated beam; also where there is an [illumination]
    optimize.steps      0 for a classic start without objectives
    sensor.distance     the first of focus.distances, or the focal length of a start that is a lens, if no lens is there
    sensor.pixel_angle  if there is neither lens nor distance nor pitch: light is looked at by its direction
    sensor.pitch        half of what diffraction by the aperture can show, wavelength x distance / (2 x aperture), and
    or pixel_angle      as much in direction sines; wider where a window of 1024 pixels would not hold what is asked for
    sensor.window       what is asked for and a quarter more, at least 64 pixels; as far as cells steer light at most

Whatever the task, the size of the wafer is stated once: `process.wafer_radius` is half of `wafer.diameter`, whichever
of them is given.
"""

import math
from collections.abc import Collection, Mapping, Set
from typing import Any

from doedesign.spec.errors import validated
from doedesign.spec.models import Spec
from doedesign.spec.process import RADII_M
from doedesign.spec.targets.areas import AreaSpec
from doedesign.spec.targets.spots import corners
from doedesign.spec.values import STARTS, is_start
from fab.units import MM, format_length, parse_angle, parse_length

# Starts that are designs of their own, and which of them are lenses by one of their options.
_CLASSIC = tuple(start for start in STARTS if start not in ("flat", "random", "ring", "nlopt"))
_LENSES = {"fresnel": "focal_length", "lens_array": "focal_length", "axilens": "near", "logarithmic_asphere": "near"}
_AIMS = ("spots", "area", "focus")

_MARGIN = 1.25
_PER_DETAIL = 2  # pixels
_COARSEST_M = MM  # photosites that a spec may have
_LEAST, _MOST, _LARGEST = 64, 1024, 8192  # pixels of a window: at least, with pixels of our choice, and at all


def with_left_out(raw: Mapping[str, Any], source: str, overridden: Collection[str] = ()) -> dict[str, Any]:
    """Put what a spec leaves out into its tables, where its task says it.

    Args:
        raw: the tables as they were read.
        source: where they came from, for messages.
        overridden: keys that were given beside the file.

    Raises:
        InputError: a mistake in what the spec says, which has to be right before the rest can follow from it.
    """
    filled: dict[str, Any] = dict(raw) | one_wafer(raw)
    # A mistake in what says the task is told by itself, without all that would follow from it.
    aimed = any(name in raw for name in _AIMS)
    optimize, optics, sensor = (raw.get(name, {}) for name in ("optimize", "optics", "sensor"))
    classic = not isinstance(optimize, Mapping) or _is_classic(optimize.get("start", "flat"))
    if aimed or classic or isinstance(raw.get("illumination"), Mapping):
        scene = raw.get("scene", {})
        if isinstance(scene, Mapping) and not {"near", "far"} & scene.keys():
            filled["scene"] = {**scene, "far": ["inf"]}
    if classic and isinstance(optimize, Mapping) and not aimed and not raw.get("objective") and "steps" not in optimize:
        filled["optimize"] = {**optimize, "steps": 0}
    if not ((aimed or classic) and isinstance(optics, Mapping) and isinstance(sensor, Mapping)):
        return filled
    if not ("focal_length" in optics or {"distance", "pixel_angle"} & sensor.keys()):
        distance = _distance(raw)
        sensor = sensor if distance is None else {**sensor, "distance": distance}
    on_sensor = "focal_length" in optics or {"distance", "pitch"} & sensor.keys()
    pixel = "pitch" if on_sensor and "pixel_angle" not in sensor else "pixel_angle"
    usual = {"window": 2, pixel: "1 um" if pixel == "pitch" else "1 mrad"}
    stand_in = {key: value for key, value in usual.items() if key not in sensor}
    filled["sensor"] = {**sensor, **stand_in}
    if stand_in:
        spec = validated(Spec, filled, source, overridden)
        # Without a possible distance the rules between tables have something to say.
        found = _sensor(spec, stand_in.keys()) if 0 < spec.image_distance_m < math.inf else stand_in
        filled["sensor"] = {**sensor, **found}
    return filled


def one_wafer(raw: Mapping[str, Any]) -> dict[str, Any]:
    """The table that leaves out the size of the wafer, with that which the other one gives.

    Args:
        raw: the tables of a file as they were read.
    """
    process, wafer = raw.get("process", {}), raw.get("wafer", {})
    if not (isinstance(process, Mapping) and isinstance(wafer, Mapping)):
        return {}
    if ("wafer_radius" in process) == ("diameter" in wafer):
        return {}
    given = process["wafer_radius"] if "wafer_radius" in process else wafer["diameter"]
    try:
        radius_m = parse_length(given) / (1 if "wafer_radius" in process else 2)
    except ValueError:
        return {}  # told where the table is read, and so is a length out of range
    if not RADII_M[0] <= radius_m <= RADII_M[1]:
        return {}
    if "diameter" in wafer:
        return {"process": {**process, "wafer_radius": f"{radius_m!r} m"}}
    return {"wafer": {**wafer, "diameter": f"{2 * radius_m!r} m"}}


def _is_classic(start: Any) -> bool:
    """Whether a start is a design of its own, or no start at all."""
    return start in _CLASSIC or not (isinstance(start, str) and is_start(start))


def _distance(raw: Mapping[str, Any]) -> Any:
    """Distance at which foci or a start that is a lens bring light to a focus, as the spec has it, or None."""
    focus, optimize = raw.get("focus"), raw.get("optimize", {})
    if isinstance(focus, Mapping):
        distances = focus.get("distances")
        first = str(distances[0]) if isinstance(distances, list) and distances else ""
        try:
            return first if parse_length(first) > 0 else None
        except ValueError:
            return None
    options = optimize.get("start_options") if isinstance(optimize, Mapping) else None
    key = _LENSES.get(str(optimize.get("start"))) if isinstance(options, Mapping) else None
    return options.get(key) if key and isinstance(options, Mapping) else None


def _sensor(spec: Spec, missing: Set[str]) -> dict[str, Any]:
    """Keys of the sensor that are missing, for a spec that has stand-ins in their place."""
    sensor, distance = spec.sensor, spec.image_distance_m
    shortest = min(wavelength for colour in spec.optics.colours for wavelength in colour.wavelengths_m)
    detail = shortest * distance / spec.doe.relief.widest_m
    full = max(2 * _MARGIN * _reach_m(spec, detail), _LEAST / _PER_DETAIL * detail)
    # Cells steer light so far, directions end at 90 degrees, and nothing is computed beyond three apertures near by.
    most = shortest * distance / spec.doe.pitch_m
    most = min(most, 2.0 if sensor.in_angles else math.inf)
    most = most if sensor.distance_m is None else min(most, 3 * max(spec.doe.shape) * spec.doe.pitch_m)
    found: dict[str, Any] = {}
    pixel = sensor.pixel_m
    if missing - {"window"}:
        pixel = max(detail / _PER_DETAIL, min(full, most) / (_MOST if "window" in missing else sensor.window))
        pixel = pixel if sensor.in_angles else min(pixel, sensor.binning * _COARSEST_M)
        one = float(f"{pixel / sensor.binning:.3g}")
        if sensor.in_angles:
            degrees = float(f"{math.degrees(math.asin(min(1.0, one))):.3g}")
            found["pixel_angle"], one = f"{degrees:g} deg", math.sin(math.radians(degrees))
        else:
            found["pitch"] = format_length(one)
        pixel = one * sensor.binning
    if "window" in missing:
        window = min(2 * math.ceil(full / pixel / 2), 2 * int(most / pixel / 2), _LARGEST)
        found["window"] = max(2, window)
    return found


def _reach_m(spec: Spec, detail_m: float) -> float:
    """How far from the axis light is asked for, metres on the sensor; `detail_m` is what diffraction shows there."""
    distance, near = spec.image_distance_m, spec.sensor.distance_m is not None
    shadow = spec.doe.relief.reach_m if near else 0.0
    moved = max(map(abs, spec.moved_sines)) * distance
    longest = max(wavelength for colour in spec.optics.colours for wavelength in colour.wavelengths_m)
    if (spots := spec.spots) is not None:
        if spots.period_m is not None:
            highest = max((n - 1) // 2 if n % 2 else n - 1 for n in spots.count or (1, 1))
            return shadow + moved + highest * longest / spots.period_m * distance
        if not all(getattr(spots, name) for name in spots.needed):
            return 0.0
        return max(abs(part) for corner in corners(spots) for part in corner) + 2 * detail_m
    if spec.areas:
        return max(_far_end_m(area, detail_m) for area in spec.areas)
    if spec.focus is not None:
        return 4 * (spec.focus.widths_m or (0.0,))[0]
    start, sine = spec.optimize.start, _steepest(spec, longest)
    focuses = near and start in _LENSES
    return (spec.doe.relief.reach_m if start == "lens_array" else 0.0) if focuses else shadow + moved + sine * distance


def _far_end_m(area: AreaSpec, detail_m: float) -> float:
    """How far from the axis an area reaches; the height of a picture is not known before it is opened."""
    sizes = (max(area.size_m),) * 2 if area.shape == "picture" else area.size_m
    beside = area.dark_m + (area.edge_m or 2 * detail_m)
    return max(abs(at) + size / 2 for at, size in zip(area.offset_m[::-1], sizes, strict=True)) + beside


def _steepest(spec: Spec, wavelength_m: float) -> float:
    """Largest direction sine to which a classic start sends light; 0 where its options are still to be mended."""
    try:
        sine = _sine(spec, wavelength_m)
    except (ValueError, TypeError, ZeroDivisionError):
        return 0.0
    return sine if math.isfinite(sine) else 0.0


def _sine(spec: Spec, wavelength_m: float) -> float:
    start, options, radius = spec.optimize.start, spec.optimize.start_options, spec.doe.relief.reach_m
    if start == "axicon":
        return math.sin(abs(parse_angle(options.get("angle", ""))))
    if start == "blazed":
        return wavelength_m / parse_length(options.get("period", ""))
    if start == "lens_array":
        return parse_length(options.get("pitch", "")) / 2 / parse_length(options.get("focal_length", ""))
    if start in _LENSES:
        return radius / parse_length(options.get(_LENSES[start], ""))
    if start == "vortex":
        return 2 * abs(float(options.get("charge", 1))) * wavelength_m / (2 * radius)
    return 3 * abs(float(options.get("waves", 5))) * wavelength_m / radius
