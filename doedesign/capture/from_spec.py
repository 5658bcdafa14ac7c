"""From a spec to what stands before the camera and what lies behind it: obstruction, occlusion model, sensor, colours.

A spec may leave all of it out but the occlusion model, which has no default: the models differ most where it matters
(`sim.imaging.occlusion`), and a result has to say which one it was made with.
"""

from collections.abc import Mapping, Sequence
from dataclasses import Field, asdict, fields, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from doedesign.spec import Spec
from doedesign.spec.scene import OCCLUSION_MODELS
from doedesign.spec.values import nearest, unit_cure
from fab.errors import InputError
from fab.units import parse_angle, parse_length
from sim.camera import Camera
from sim.imaging.occlusion import Model, Outside
from sim.metrics import mean_wavelength_m
from sim.obstruction import OBSTRUCTIONS, MaskFolder, ObstructionKind
from sim.sensor import Sensor

# Luminance of linear sRGB (IEC 61966-2-1).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def occlusion_from_spec(spec: Spec | None, source: str, given: str | None = None) -> Model:
    """The occlusion model: the one given, or that of the spec, whose file messages name (`source`).

    Raises:
        InputError: neither names one, or there is none of that name.
    """
    if given is not None and given not in OCCLUSION_MODELS:
        rule = f"must be one of {', '.join(OCCLUSION_MODELS)}"
        raise InputError("occlusion", rule, f'"{given}"', nearest(given, OCCLUSION_MODELS))
    model = given or (spec and spec.scene.occlusion)
    if model is None:
        cure = 'Give `occlusion`: "reciprocal", the nearest to wave optics, "radiometric", or "paper" for eq. 10.'
        raise InputError(f"{source}: scene.occlusion", "the occlusion model must be named", "nothing", cure)
    return cast("Model", model)


def outside_from_kind(kind: ObstructionKind) -> Outside:
    """The obstruction's picture in eq. 10 where there is none: for drops nothing, as in the public code."""
    return "nothing" if "raindrop" in str(getattr(kind, "name", "")) else "scene"


def sensor_from_spec(spec: Spec | None) -> Sensor:
    """The sensor of a spec, with the usual values of `sim.sensor` where there is none or it says nothing.

    Raises:
        InputError: values that do not go together.
    """
    if spec is None:
        return Sensor()
    names = {field.name: "bayer" if field.name == "pattern" else field.name for field in fields(Sensor)}
    said = {name: getattr(spec.sensor, key) for name, key in names.items()}
    try:
        return Sensor(**{name: value for name, value in said.items() if value not in (None, ())})
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError("sensor", rule.replace("`", ""), got, "Change the sensor of the spec.") from error


def sensor_side(spec: Spec) -> int:
    """Binned pixels of the shorter side of a spec's sensor, of which pictures are taken.

    Raises:
        InputError: a spec without a sensor, or one that does not say how many photosites it has.
    """
    if spec.sensor.in_angles:
        cure = "Give optics.focal_length, sensor.pitch and sensor.resolution."
        raise InputError("sensor.pixel_angle", "pictures are taken by a sensor behind a lens", "directions", cure)
    if spec.sensor.resolution is None:
        cure = "For example `resolution = [4000, 3000]`."
        raise InputError("sensor.resolution", "pictures need the photosites of the sensor", "nothing", cure)
    return min(spec.sensor.resolution) // spec.sensor.binning


def obstruction_from_spec(
    spec: Spec | None, source: str, given: str | None = None, near_m: Sequence[float] = ()
) -> ObstructionKind:
    """The kind of obstruction before the scene: the one given, or that of the spec.

    Its distance is that of the spec's options, which hold for its own kind; otherwise it lies between the nearest and
    the farthest of the near depths, for which the DOE was designed (`near_m` without a spec); otherwise it is the usual
    one of the kind. A folder of masks may lie beside the spec's file (`source`). Options of a kind that others are
    mixed in begin with the name of the one that they are for, such as `dirt_clump`.

    Raises:
        InputError: no kind, an unknown one, or options that are not the kind's.
    """
    own = None if spec is None else spec.obstruction
    options: dict[str, Any] = dict(own.options) if own and given in (None, own.kind) else {}
    name = given or (own.kind if own else None)
    if name is None:
        kinds = ", ".join(OBSTRUCTIONS)
        cure = f'Give `obstruction`, such as "dirt". There are {kinds}.'
        raise InputError(f"{source}: obstruction.kind", "an obstruction must be named", "nothing", cure)
    if name not in OBSTRUCTIONS:
        if not Path(name).is_dir():
            rule = "must be a kind of obstruction, or a folder of masks"
            raise InputError("obstruction", rule, f'"{name}"', nearest(name, tuple(OBSTRUCTIONS)))
        name, options = "folder", {"folder": str(Path(name).resolve())}
    kind = OBSTRUCTIONS[name]
    where = f"{source}: obstruction.options" if own and options == dict(own.options) else "obstruction"
    parameters = _parameters(kind, options, where)
    if "folder" in parameters:
        beside = Path(source).parent / str(parameters["folder"])
        parameters["folder"] = str(beside if beside.is_dir() else parameters["folder"])
    made = _made(kind, parameters, where)
    near = near_m if spec is None else spec.scene.near_m
    if not near:
        return made
    try:
        return at_depth(made, (min(near), max(near)), options)
    except InputError as error:
        place = "near_m" if spec is None else f"{source}: scene.near"
        cure = "Move them, or give the obstruction a depth of its own."
        raise InputError(place, f"where obstructions lie {error.rule}", error.got, cure) from error


def require_options(spec: Spec, source: str) -> None:
    """Refuse options that are none of the obstruction of a spec; masks of a folder are not looked for.

    Args:
        spec: the spec.
        source: name of its file for messages.

    Raises:
        InputError: as `obstruction_from_spec`.
    """
    own = spec.obstruction
    if own is not None and OBSTRUCTIONS.get(own.kind) is not MaskFolder:
        obstruction_from_spec(spec, source)


def _made(kind: Any, parameters: Mapping[str, Any], where: str, within: str = "") -> Any:
    """A kind with parameters in SI, whose mistakes name the option; those of a part begin with its name (`within`)."""
    try:
        return kind(**parameters)
    except InputError as error:
        name, _, parameter = error.where.partition(": ")
        key = parameter.removesuffix("_m").removesuffix("_rad")
        place = f"{where}.{within}{key}" if name == kind.name and key else f"{where}: {error.where}"
        raise InputError(place, error.rule, error.got, error.cure) from error
    except TypeError as error:  # a parameter without which there is nothing
        raise InputError(where, "must hold all that the kind needs", f'"{error}"', "Add it.") from error


def at_depth(
    kind: Any, depth_m: tuple[float, float], options: Mapping[str, Any] = MappingProxyType({}), within: str = ""
) -> Any:
    """The same kind of obstruction, or all that it is mixed of, at distances from and to (`depth_m`, metres).

    Where the options of a spec give a distance, that stays; those of a part begin with its name (`within`).
    """
    names = {field.name for field in fields(kind)}
    if "depth_m" in names:
        return kind if f"{within}depth" in options else replace(kind, depth_m=depth_m)
    parts = {name: getattr(kind, name) for name in names if is_dataclass(getattr(kind, name))}
    return replace(kind, **{name: at_depth(part, depth_m, options, f"{name}_") for name, part in parts.items()})


def _parameters(
    kind: type[ObstructionKind], options: Mapping[str, Any], where: str, within: str = ""
) -> dict[str, Any]:
    """Options of a spec as parameters in SI; those that begin with the name of a part of a mixed kind make that."""
    # What makes no other kind of it, such as a function to call, is none of its parameters.
    own = [field for field in fields(cast("Any", kind)) if field.init and field.compare]
    parts = {f.name: f.default_factory for f in own if is_dataclass(f.default_factory)}
    known = {f.name.removesuffix("_m").removesuffix("_rad"): f for f in own if f.name not in parts}
    found: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for key, value in options.items():
        part = next((name for name in parts if key not in known and key.startswith(f"{name}_")), None)
        if part is not None:
            inner.setdefault(part, {})[key.removeprefix(f"{part}_")] = value
        elif key in known:
            found[known[key].name] = _parameter(known[key], value, f"{where}.{within}{key}")
        else:
            cure = nearest(f"{within}{key}", [f"{within}{name}" for name in known])
            raise InputError(where, "must be parameters of this kind", f"`{within}{key}`", cure)
    for part, given in inner.items():
        of_part = cast("type[ObstructionKind]", parts[part])
        inside = f"{within}{part}_"
        found[part] = _made(of_part, _parameters(of_part, given, where, inside), where, inside)
    return found


def _parameter(field: Field[Any], value: Any, where: str) -> Any:
    if isinstance(value, tuple):
        return tuple(_parsed(field.name, item, where) for item in value)
    item = _parsed(field.name, value, where)
    # A range is two numbers; one stands for both.
    is_range = isinstance(field.default, tuple) and len(field.default) == 2
    return (item, item) if is_range and isinstance(item, float | int) else item


def _parsed(name: str, value: Any, where: str) -> Any:
    """A length or an angle, as the ending of its name says, in SI; anything else as it is."""
    if not name.endswith(("_m", "_rad")):
        return value
    try:
        return parse_length(value) if name.endswith("_m") else parse_angle(value)
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError(where, rule, got, unit_cure("m" if name.endswith("_m") else "rad", value)) from error


def plain_parameters(kind: Any) -> dict[str, Any]:
    """Parameters of a kind of obstruction for JSON; of a folder of masks, what the files hold, too."""
    contents = {"files_sha256": kind.digest()} if isinstance(kind, MaskFolder) else {}
    return contents | {
        key: str(value) if isinstance(value, Path) else [str(v) for v in value] if key == "files" else value
        for key, value in asdict(kind).items()
        if not callable(value)
    }


def longest_first(wavelengths_m: Sequence[float]) -> list[int]:
    """Positions of colours from the longest wavelength to the shortest: red, green and blue."""
    return sorted(range(len(wavelengths_m)), key=lambda c: -wavelengths_m[c])


def channels_from_rgb(light: Float[np.ndarray, "3 y x"], camera: Camera) -> Float[np.ndarray, "c y x"]:
    """Light of red, green and blue in the colours of a camera: by wavelength, or its luminance where there is one.

    Raises:
        InputError: a camera of neither one colour nor three.
    """
    count = len(camera.colours)
    if count == 1:
        return np.tensordot(LUMINANCE, light, 1)[None].astype(np.float32)
    if count != 3:
        rule = "pictures in red, green and blue need a camera of three colours, or of one"
        raise InputError("optics.colours", rule, f"{count} colours", "Merge colours into channels.")
    return np.ascontiguousarray(light[np.argsort(longest_first([mean_wavelength_m(c) for c in camera.colours]))])


def rgb_from_channels(light: Float[np.ndarray, "c y x"], camera: Camera) -> Float[np.ndarray, "3 y x"]:
    """Inverse of `channels_from_rgb`, for pictures: the longest wavelength is red; one colour becomes grey."""
    if len(camera.colours) == 1:
        return np.repeat(light, 3, axis=0)
    return np.ascontiguousarray(light[longest_first([mean_wavelength_m(c) for c in camera.colours])])
