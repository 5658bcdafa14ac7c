"""Specs: what the user asks for, read from TOML, checked, and compared by digest.

    spec = load_spec("examples/automotive.toml", ["process.levels=8"])
    spec.optics.focal_length_m      # 0.008
    spec_digest(spec)               # the same for the same content, however it was written

Every mistake in a file is an `InputError` that names the file, the key, the rule, the value and the cure; several
are told together. `spec_warnings` returns what is allowed but probably not meant.

    values      the kinds of value a spec holds: lengths, names, options
    table       what all tables have in common
    models      the tables, one per section of the TOML
    scene       the tables of scene, obstruction and sensor
    response    colours of a camera from its spectral response
    process     the tables of the process: errors, defects, limits of a good plate
    wafer       the table of the wafer: dies, mask blanks, chrome
    training    the tables of the network and its training
    variation   files of their own: a process, the errors of one plate
    checks      rules that join several tables, and warnings; process_checks those of the process
    errors      what was wrong, in words a user can act on
    text        a spec as TOML and as JSON
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from doedesign.spec.checks import find_problems, spec_warnings
from doedesign.spec.errors import SpecError, SpecMistake, explain, key_as_written, spec_error
from doedesign.spec.models import (
    ColourSpec,
    DoeSpec,
    ObjectiveSpec,
    ObstructionSpec,
    OpticsSpec,
    OptimizeSpec,
    SceneSpec,
    SensorSpec,
    Spec,
)
from doedesign.spec.process import DefectsSpec, ErrorsSpec, EtchSpec, LimitSpec, ProcessSpec, SpreadSpec
from doedesign.spec.process_checks import process_problems, variation_problems
from doedesign.spec.response import with_response
from doedesign.spec.table import SpecTable, toml_key
from doedesign.spec.text import process_to_toml, spec_digest, spec_to_json, spec_to_toml, variation_to_toml
from doedesign.spec.training import NetworkSpec, TrainSpec, training_problems
from doedesign.spec.values import FROM_TOML, HEIGHT_FILES, OBJECTIVE_NAMES, START_NAMES, Options
from doedesign.spec.variation import ProcessFile, VariationFile
from doedesign.spec.wafer import WaferFile, WaferSpec
from fab.errors import InputError
from fab.files import explain_os_error
from fab.process import Variation

__all__ = [
    "HEIGHT_FILES",
    "OBJECTIVE_NAMES",
    "START_NAMES",
    "ColourSpec",
    "DefectsSpec",
    "DoeSpec",
    "ErrorsSpec",
    "EtchSpec",
    "LimitSpec",
    "NetworkSpec",
    "ObjectiveSpec",
    "ObstructionSpec",
    "OpticsSpec",
    "OptimizeSpec",
    "Options",
    "ProcessSpec",
    "SceneSpec",
    "SensorSpec",
    "Spec",
    "SpecError",
    "SpreadSpec",
    "TrainSpec",
    "WaferSpec",
    "explain",
    "input_files",
    "load_process",
    "load_spec",
    "load_variation",
    "load_wafer",
    "process_from_json",
    "process_to_toml",
    "spec_digest",
    "spec_error",
    "spec_from_json",
    "spec_to_json",
    "spec_to_toml",
    "spec_warnings",
    "variation_to_toml",
]

_Model = TypeVar("_Model", bound=SpecTable)

_OVERRIDE = re.compile(r"\s*([A-Za-z_][\w-]*(?:\.[\w-]+)*)\s*=(.*)", re.DOTALL)


def load_spec(path: str | Path, overrides: Sequence[str] = (), **values: Any) -> Spec:
    """Read a spec from TOML.

    Args:
        path: the file.
        overrides: changes such as ``"process.levels=8"`` or ``"sensor.pitch=1.85 um"``: a dotted key (list entries
            by their number) and a TOML value; quotes round text may be left out.
        values: further changes, as they read best in Python: a key of ``[optimize]`` (``steps=60``), or of another
            table with the table before it (``process__levels=8, sensor__pitch="1.85 um"``).

    Returns:
        The spec with every default filled in. Files it names are not opened (see `input_files`), but for a spectral
        response, whose colours become part of the spec.

    Raises:
        InputError: the file cannot be read, is no TOML, or breaks a rule.
    """
    path = Path(path)
    raw = _read_toml(path, "a spec")
    keys = [_override(raw, text) for text in overrides]
    for name, value in values.items():
        keys.append(key := name.replace("__", ".") if "__" in name else f"optimize.{name}")
        _put(raw, key, value)
    raw = with_response(raw, path)
    try:
        spec = Spec.model_validate(raw, by_alias=True, by_name=False, context=FROM_TOML)
    except ValidationError as error:
        raise spec_error(str(path), explain(error, raw), keys) from None
    spec._file = path  # pyright: ignore[reportAttributeAccessIssue]
    return _checked(spec, raw, str(path), keys)


def spec_from_json(data: Mapping[str, Any], source: str) -> Spec:
    """Rebuild a spec from what `spec_to_json` returned.

    Args:
        data: the JSON object.
        source: where it came from, for the message.

    Raises:
        InputError: the object is not a spec of this version.
    """
    try:
        spec = Spec.model_validate(data)
    except ValidationError as error:
        raise spec_error(source, explain(error, data)) from None
    return _checked(spec, data, source, [])


def load_process(path: str | Path) -> ProcessSpec:
    """Read a process from the `[process]` table of a TOML file: a file of its own, or a whole spec.

    Args:
        path: the file. Other tables of a spec are passed over.

    Raises:
        InputError: the file cannot be read, is no TOML, has no process, or breaks a rule.
    """
    raw = _alone(_read_toml(Path(path), "a process"), "process")
    process = _model_of_toml(ProcessFile, raw, str(path)).process
    if problems := [p._replace(key=key_as_written(p.key, raw)) for p in process_problems(process)]:
        raise spec_error(str(path), problems)
    return process


def load_wafer(path: str | Path) -> WaferSpec:
    """Read a wafer from the `[wafer]` table of a TOML file: a file of its own, or a whole spec.

    Args:
        path: the file. Other tables of a spec are passed over.

    Raises:
        InputError: the file cannot be read, is no TOML, has no wafer, or breaks a rule.
    """
    return _model_of_toml(WaferFile, _alone(_read_toml(Path(path), "a wafer"), "wafer"), str(path)).wafer


def _alone(raw: Mapping[str, Any], table: str) -> dict[str, Any]:
    """What was read without the other tables of a spec."""
    others = {toml_key(name) for name in Spec.model_fields} - {table}
    return {key: raw[key] for key in raw if key not in others}


def process_from_json(data: Mapping[str, Any], source: str) -> ProcessSpec:
    """Make a process from plain values in SI units, as `ProcessSpec.model_dump` returns them.

    Args:
        data: the values by attribute.
        source: where they came from, for the message.

    Raises:
        InputError: the values are not those of a process, or break a rule.
    """
    raw = {"process": data}
    try:
        process = ProcessFile.model_validate(raw).process
    except ValidationError as error:
        raise spec_error(source, explain(error, raw, ProcessFile)) from None
    if problems := list(process_problems(process)):
        raise spec_error(source, problems)
    return process


def load_variation(path: str | Path) -> Variation:
    """Read the errors of one plate from TOML, as `variation_to_toml` writes them.

    Raises:
        InputError: the file cannot be read, is no TOML, or breaks a rule.
    """
    file = _model_of_toml(VariationFile, _read_toml(Path(path), "a variation"), str(path))
    if problems := list(variation_problems(file)):
        raise spec_error(str(path), problems)
    return file.value()


def _model_of_toml(model: type[_Model], raw: Mapping[str, Any], source: str) -> _Model:
    try:
        return model.model_validate(raw, by_alias=True, by_name=False, context=FROM_TOML)
    except ValidationError as error:
        raise spec_error(source, explain(error, raw, model)) from None


def input_files(spec: Spec) -> dict[str, Path]:
    """Return the files a spec names, found relative to the folder of the spec file (or to the current one).

    Returns:
        For each dotted key ("optimize.start", "objective[0].options.image") the existing file.

    Raises:
        InputError: a file is missing.
    """
    named = {}
    if spec.optimize.start not in START_NAMES:
        named["optimize.start"] = spec.optimize.start
    for index, objective in enumerate(spec.objectives):
        if "image" in objective.options:
            named[f"objective[{index}].options.image"] = str(objective.options["image"])
    folder = Path() if spec.file is None else spec.file.parent
    files = {key: folder / name for key, name in named.items()}
    missing = [
        SpecMistake(key, "the file must exist", f'"{named[key]}"', f"Put it at {file} or change the path.")
        for key, file in files.items()
        if not file.is_file()
    ]
    if missing:
        raise spec_error(str(spec.file or spec.name), missing)
    return files


def _checked(spec: Spec, raw: Mapping[str, Any], source: str, overridden: Sequence[str]) -> Spec:
    of_training = training_problems(spec.network, spec.train, len(spec.optics.colours))
    found = [*find_problems(spec), *(SpecMistake(*told) for told in of_training)]
    problems = [problem._replace(key=key_as_written(problem.key, raw)) for problem in found]
    if problems:
        raise spec_error(source, problems, overridden)
    return spec


def _read_toml(path: Path, what: str) -> dict[str, Any]:
    cure = f"Give {what} such as {_EXAMPLES[what]}."
    try:
        content = path.read_bytes()
    except OSError as error:
        raise explain_os_error(error, path) from error
    try:
        return tomllib.loads(content.decode())
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"{what} must be UTF-8 text", f"a foreign byte at {error.start}", cure) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), f"{what} must be valid TOML", f'"{error}"', "Mend that line.") from error
    except RecursionError as error:
        raise InputError(str(path), f"{what} must be valid TOML", "brackets without end", cure) from error


_EXAMPLES = {
    "a spec": "examples/quick.toml",
    "a process": "the [process] table of examples/automotive.toml",
    "a wafer": "`[wafer]` with `dies = [2, 2]`",
    "a variation": "`[variation]` with `depth_scale = [0.02, 0.0, 0.0, 0.0]`",
}


def _override(raw: dict[str, Any], text: str) -> str:
    """Change one value of the tables that were read; return its dotted key."""
    found = _OVERRIDE.fullmatch(text)
    if not found:
        raise InputError("--set", "an override must be KEY=VALUE", f'"{text}"', "For example process.levels=8.")
    _put(raw, found[1], _override_value(found[2].strip()))
    return found[1]


def _put(raw: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    place: Any = raw
    for part in parents:
        place = place.setdefault(part, {}) if isinstance(place, dict) else _entry(place, part, key)
    if isinstance(place, dict):
        place[last] = value
    else:
        _entry(place, last, key)
        place[int(last)] = value


def _entry(place: Any, part: str, key: str) -> Any:
    if isinstance(place, list) and part.isdecimal() and int(part) < len(place):
        return place[int(part)]
    count = f"a list of {len(place)}" if isinstance(place, list) else "a single value"
    raise InputError(f"--set: {key}", f"`{part}` must be an entry of what the spec holds there", count, "Mend the key.")


def _override_value(text: str) -> Any:
    """Read a TOML value; what is none is text, so that `sensor.pitch=1.85 um` needs no quotes."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    return table["value"] if len(table) == 1 else text
