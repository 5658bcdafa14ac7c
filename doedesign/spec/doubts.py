"""Warnings of what is allowed in a spec but probably not meant, a sentence or two each."""

import math
from collections.abc import Iterator

from doedesign.spec.checks import pixel_text, rounded, shortest_m
from doedesign.spec.models import Spec
from fab.aperture import MaskAperture
from fab.errors import InputError
from fab.units import DEGREES, MICROMETRES, NM, format_length
from sim.lens import image_place
from sim.material import full_wave_wavelength_m, waves_per_metre

_WAVE_TOLERANCE = 0.02
_FINEST = 16  # pixels per wavelength / aperture
_DEPTHS_OF = {"ring_to_disc": "near depth", "far_spot": "far depth"}  # all others exist at every depth


def spec_warnings(spec: Spec) -> list[str]:
    """Return what is allowed in a valid spec but probably not meant, one sentence or two each."""
    rules = (_level_warning, _printing_warning, _window_warnings, _pixel_warning, _occlusion_warning, _limit_warnings)
    rules = (*rules, _mask_warning, _walls_warning, _colour_warning)
    return [warning for rule in rules for warning in rule(spec)]


def _mask_warning(spec: Spec) -> Iterator[str]:
    """Warn of parts of a mask that are too narrow for the overlap of the chrome."""
    relief, overlap = spec.doe.relief, spec.process.chrome_overlap_m
    if isinstance(relief, MaskAperture) and (closed := relief.parts_closed(overlap))[1]:
        yield (
            f"doe.aperture: the chrome, which reaches {format_length(overlap)} over every edge, closes {closed[1]} of "
            f"the {closed[0]} parts of the mask. A smaller process.chrome_overlap leaves them open."
        )


def _walls_warning(spec: Spec) -> Iterator[str]:
    """Warn that the light of walls has no part in a search which looks at thin elements alone."""
    targets = {"spots": spec.spots, "areas": spec.areas, "foci": spec.focus}
    if spec.optics.light == "edges" and (searched := [name for name, table in targets.items() if table]):
        yield (
            f'optics.light: the light of walls that "edges" adds is not in the search of {searched[0]}, which gives '
            "the same design without it; the finished plate is judged with edges."
        )


def _colour_warning(spec: Spec) -> Iterator[str]:
    """Warn that spots and areas without a colour are for the first wavelength, where that is not the design one."""
    wavelengths = [wavelength for colour in spec.optics.colours for wavelength in colour.wavelengths_m]
    listed = any(math.isclose(each, spec.optics.design_wavelength_m, rel_tol=1e-6) for each in wavelengths[1:])
    own = (
        "spots"
        if spec.spots and not spec.spots.colours
        else "area"
        if any(area.colour is None for area in spec.areas)
        else ""
    )
    if own and listed and not math.isclose(wavelengths[0], spec.optics.design_wavelength_m, rel_tol=1e-6):
        design, first = (format_length(each) for each in (spec.optics.design_wavelength_m, wavelengths[0]))
        cure = "List it first" + (", or give every area its colour." if own == "area" else ".")
        yield (
            f"optics.wavelengths: [{own}] is designed and judged at {first}, the first of them, and not at the design "
            f"wavelength of {design}. {cure}"
        )


def _level_warning(spec: Spec) -> Iterator[str]:
    process, material = spec.process, spec.doe.material
    height_m = process.levels * process.level_step_m
    sine = _beam_sine(spec)
    wave_m = 1 / float(waves_per_metre(material, spec.optics.design_wavelength_m, sine**2))
    waves = height_m / wave_m
    whole = max(1, round(waves))  # a relief of several waves parts colours
    if abs(waves / whole - 1) <= _WAVE_TOLERANCE or (waves < 1 and _nearly_flat(spec)):
        return
    try:
        exact = f"of {material} is one wave at {full_wave_wavelength_m(material, height_m) / NM:.0f} nm"
    except InputError:
        exact = f"is one wave at no wavelength {material} is known for"
    if sine:  # of another wavelength nothing is known to be one wave of oblique glass
        exact = f"of {material} is passed by the beam {math.degrees(math.asin(sine)):.3g} degrees off the axis"
    yield (
        f"process.level_step: {process.levels} x {format_length(process.level_step_m)} = {rounded(height_m)} {exact}; "
        f"at the design wavelength of {format_length(spec.optics.design_wavelength_m)} it is "
        f"{waves:.4f} waves, {100 * (waves / whole - 1):+.1f} % off, so the top of the staircase does not meet its "
        f'foot. A level_step of "{whole * wave_m / process.levels / NM:.2f} nm" would.'
    )


def _beam_sine(spec: Spec) -> float:
    """Direction sine at which the beam of a spec lights the DOE; 0 along the axis and without a beam."""
    light = spec.illumination
    if light is None:
        return 0.0
    tangent = math.hypot(*(math.tan(sum(pair)) for pair in zip(light.angles_rad, light.tilt_rad, strict=True)))
    return tangent / math.hypot(1.0, tangent)


def _nearly_flat(spec: Spec) -> bool:
    """Whether one spot should keep most of the light, for which a relief of less than a wave is right."""
    weights = spec.spots.weights if spec.spots is not None else ()
    return bool(weights) and max(weights) > sum(weights) / 2


def _image_share(spec: Spec, sine: float) -> float:
    """Where light with a direction sine lands, focal lengths from the axis."""
    optics = spec.optics
    if optics.mapping == "tangent" and sine >= 1:
        return math.inf
    return image_place(optics.mapping, optics.distortion, 0.0, sine)[1]


def _window_warnings(spec: Spec) -> Iterator[str]:
    sensor, focal_m, pitch_m = spec.sensor, spec.optics.focal_length_m or spec.image_distance_m, spec.doe.pitch_m
    binned = min(sensor.resolution or (math.inf,)) // sensor.binning
    if sensor.window > binned:
        yield (
            f"sensor.window: {sensor.window} pixels are more than the {binned} binned pixels of the sensor's shorter "
            "side; PSFs will reach beyond the sensor."
        )
    # Cells steer light about the direction in which it arrives.
    moved_m = focal_m * max(map(abs, spec.moved_sines))
    wavelength_m, half_m = shortest_m(spec), sensor.window_m / 2 + moved_m
    reach_m, unit = focal_m * _image_share(spec, wavelength_m / (2 * pitch_m)), spec.told_in(MICROMETRES)
    if half_m > reach_m:
        axis = "where light arrives" if moved_m else "the axis"
        most = int(2 * max(reach_m - moved_m, 0.0) / sensor.pixel_m)
        ends, reaches = (
            f"{unit.of(at):{'.4g' if unit.in_degrees else '.0f'}} {unit.suffix}" for at in (half_m, reach_m)
        )
        yield (
            f"sensor.window: it ends {ends} from {axis}, but cells of {format_length(pitch_m)} steer "
            f"{format_length(wavelength_m)} only {reaches} far; "
            f"beyond that the PSF repeats. At most {most} pixels avoid it."
        )
    depth_m = min(spec.scene.near_m, default=math.inf)
    disc_m = spec.doe.relief.widest_m * focal_m / depth_m
    if disc_m > sensor.window_m:
        yield (
            f"sensor.window: the blur disc of a point at {format_length(depth_m)} is {rounded(disc_m)} wide, "
            f"more than the window's {rounded(sensor.window_m)}; its rim is cut off."
        )


def _pixel_warning(spec: Spec) -> Iterator[str]:
    """Warn of directions told apart far more finely than diffraction by the aperture lets them differ."""
    detail = shortest_m(spec) / spec.doe.relief.widest_m
    if spec.sensor.in_angles and spec.sensor.pixel_m < detail / _FINEST:
        yield (
            f"sensor.pixel_angle: pixels of {pixel_text(spec)} are more than {_FINEST} times finer than what an "
            f"aperture of {spec.doe.relief} can show, {DEGREES.of(detail):.4g} deg at "
            f'{format_length(shortest_m(spec))}; "{DEGREES.of(detail / 4):.2g} deg" is enough.'
        )


def _occlusion_warning(spec: Spec) -> Iterator[str]:
    """Warn of an obstruction whose effect on light is not said: no command that takes pictures goes on without it."""
    if (spec.obstruction or spec.scene.near_m) and spec.scene.occlusion is None:
        yield (
            "scene.occlusion: not named, so `simulate` and `train` will ask for it: how the obstruction takes light "
            'from what is behind it has no default. Add occlusion = "reciprocal", the nearest to wave optics for '
            'plates of every kind, "radiometric", or "paper" for eq. 10.'
        )


def _printing_warning(spec: Spec) -> Iterator[str]:
    """Warn of cells finer than what the lithography prints: bit 0 may have lines of a single cell."""
    process, pitch_m = spec.process.filled(), spec.doe.pitch_m
    for key, smallest_m, what in (
        ("minimum_line", process.minimum_line_m, "lines"),
        ("minimum_space", process.minimum_space_m, "gaps"),
    ):
        if smallest_m and pitch_m < smallest_m * (1 - 1e-9):
            yield (
                f"process.{key}: cells of {format_length(pitch_m)} are finer than the {what} of "
                f"{format_length(smallest_m)} that the process prints, so single cells of the finest mask (bit 0) are "
                "lost. Choose a coarser pitch, a finer process, or accept that they will not be there."
            )


def _limit_warnings(spec: Spec) -> Iterator[str]:
    """Warn of limits that every plate obeys, for there is nothing at the depths of the scene that they apply to."""
    near, far = spec.scene.near_m, spec.scene.far_m
    for index, limit in enumerate(spec.limits):
        where, depths = _DEPTHS_OF.get(limit.quantity, "depth"), (*near, *far)
        if limit.quantity in _DEPTHS_OF:
            depths = near if where == "near depth" else far
        at = "" if limit.depth_m is None else f" at {format_length(limit.depth_m)}"
        if limit.depth_m not in (None, *depths) or not depths:
            listed = ", ".join(format_length(depth_m) for depth_m in depths) or "none"
            yield f"limit[{index}]: {limit.quantity}{at} limits nothing; the scene's {where}s are: {listed}."
