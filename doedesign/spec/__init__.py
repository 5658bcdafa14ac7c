"""Specs: a design task as the user states it, read from TOML, checked, and compared by digest.

    spec = load_spec("examples/automotive.toml", ["process.levels=8"])
    spec.optics.focal_length_m      # 0.008
    spec_digest(spec)               # the same for the same content, however it was written

Every mistake in a file is an `InputError` that names the file, the key, the rule, the value and the cure; several
are reported together. `spec_warnings` returns what is allowed but probably not meant.

    values/     the types of value in a spec: lengths, names, options; common ground of all tables
    models      the tables, one per section of the TOML
    scene       the tables of scene, illumination, obstruction and sensor
    left_out    what a spec may leave out because its task says it
    response    colours of a camera from its spectral response
    process     the tables of the process: errors, defects, limits of a good DOE
    targets/    the tables of spots, areas and foci
    wafer       the table of the wafer: dies, mask blanks, chrome
    order       the table of what a mask shop is asked for
    training    the tables of the network and its training
    variation   files of their own: a process, the errors of one DOE
    checks      rules that join several tables; process_checks those of the process
    doubts      warnings of what is allowed but probably not meant
    errors      mistakes in words a user can act on
    text        a spec as TOML and as JSON
"""

import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from doedesign.spec.checks import find_problems
from doedesign.spec.doubts import spec_warnings
from doedesign.spec.errors import SpecError, Table, key_as_written, spec_error, validated
from doedesign.spec.left_out import one_wafer, with_left_out
from doedesign.spec.models import Spec
from doedesign.spec.order import OrderFile, OrderSpec
from doedesign.spec.process import DefectsSpec, ErrorsSpec, LimitSpec, ProcessSpec
from doedesign.spec.process_checks import process_problems, variation_problems
from doedesign.spec.response import with_response
from doedesign.spec.robust import RobustSpec
from doedesign.spec.text import (
    process_to_toml,
    spec_digest,
    spec_to_json,
    spec_to_resolved_toml,
    spec_to_toml,
    variation_to_toml,
)
from doedesign.spec.training import NetworkSpec, TrainSpec
from doedesign.spec.values import HEIGHT_FILES, STARTS, Options
from doedesign.spec.values.aperture import with_mask
from doedesign.spec.values.table import toml_key
from doedesign.spec.variation import ProcessFile, VariationFile
from doedesign.spec.wafer import WaferFile, WaferSpec
from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_bytes
from fab.levels import Levels
from fab.process import Variation
from fab.stock import IDEAL, STOCK

_OVERRIDE = re.compile(r"\s*([A-Za-z_][\w-]*(?:\.[\w-]+|\[\d+\])*)\s*=(.*)", re.DOTALL)


# What a file should hold and an example of it, for messages.
_FILES: dict[type, tuple[str, str]] = {
    Spec: ("a spec", "examples/quick.toml"),
    ProcessFile: ("a process", "the [process] table of examples/automotive.toml"),
    WaferFile: ("a wafer", "`[wafer]` with `dies = [2, 2]`"),
    OrderFile: ("the terms of an order", '`[order]` with `contact = "..."`'),
    VariationFile: ("a variation", "`[variation]` with `depth_scale = [0.02, 0.0, 0.0, 0.0]`"),
}
# The rules between the values of a file.
_PROBLEMS: dict[type, Callable[[Any], Iterable[InputError]]] = {
    Spec: find_problems,
    ProcessFile: lambda file: process_problems(file.process),
    VariationFile: variation_problems,
}


def load_spec(path: str | Path, overrides: Sequence[str] = (), **values: Any) -> Spec:
    """Read a spec from TOML.

    Args:
        path: the file.
        overrides: changes, or a single one, such as ``"process.levels=8"`` or ``"sensor.pitch=1.85 um"``: a dotted key
            (list entries by their number, ``objective[0].weight`` or ``objective.0.weight``) and a TOML value; quotes
            round text may be left out.
        values: further changes, as they read best in Python: a key of ``[optimize]`` (``steps=60``), one of another
            table with the table before it (``process__levels=8, sensor__pitch="1.85 um"``), or a whole table.

    Returns:
        The spec with its defaults, and what its task says (`doedesign.spec.left_out`). Files it names are not
        opened (see `input_files`), but for a spectral response, whose colours become part of the spec, and the
        picture of an aperture, whose open cells do.

    Raises:
        InputError: the file cannot be read, is no TOML, or breaks a rule.
    """
    if not isinstance(path, str | Path):
        rule, cure = "must be a spec or its TOML file", 'For example dd.load_spec("lens.toml", steps=60).'
        raise InputError("spec", rule, f"a {type(path).__name__}", cure)
    path = Path(path)
    raw = read_toml(path, *_FILES[Spec])
    given: Any = overrides if isinstance(overrides, tuple | list) else [overrides]
    if not all(isinstance(text, str) for text in given):
        rule, cure = "must be several changes, as text", 'For example ["process.levels=8"].'
        raise InputError("overrides", rule, repr(overrides), cure)
    keys = [_override(raw, text) for text in given]
    tables = {field.alias for field in Spec.model_fields.values()}
    for name, value in values.items():
        keys.append(key := name.replace("__", ".") if "__" in name or name in tables else f"optimize.{name}")
        _put(raw, key, value.tolist() if hasattr(value, "tolist") else value)  # numbers and arrays of NumPy
    filled = with_left_out(with_mask(with_response(raw, path), path), str(path), keys)
    spec = _checked(Spec, filled, str(path), keys)
    spec._file = path  # pyright: ignore[reportAttributeAccessIssue]
    return spec


def spec_from_json(data: Mapping[str, Any], source: str, file: Path | None = None) -> Spec:
    """Rebuild a spec from the JSON object that `spec_to_json` returned.

    Args:
        data: the object.
        source: what messages call it.
        file: the spec's file, to which the paths in it are relative.

    Raises:
        InputError: it breaks a rule.
    """
    spec = _checked(Spec, data, source, si=True)
    spec._file = file  # pyright: ignore[reportAttributeAccessIssue]
    return spec


def load_process(path: str | Path, levels: Levels | None = None) -> ProcessSpec:
    """Read a process from the `[process]` table of a TOML file; other tables of a spec are passed over.

    What the table leaves out of `levels`, `level_step` and `etch_depths` is that of a staircase, if one is given.

    Raises:
        InputError: the file cannot be read, is no TOML, or breaks a rule.
    """
    if path == "" or (not Path(path).suffix and not Path(path).exists()):
        names = ", ".join((*STOCK, IDEAL.name))
        rule = "must be a file with a [process] table or the name of a process"
        raise InputError(str(path) or "process", rule, "neither" if path else '""', f"Names are {names}.")
    return _load(ProcessFile, path, "process", {} if levels is None else {"process": _staircase(levels)}).process


def _staircase(levels: Levels) -> dict[str, Any]:
    """Keys of `[process]` that say which levels there are."""
    depths = {} if levels.is_binary else {"etch_depths": [f"{depth!r} m" for depth in levels.depths_m]}
    return {"levels": levels.count, "level_step": f"{levels.step_m!r} m", **depths}


def load_wafer(path: str | Path) -> WaferSpec:
    """Read a wafer from the `[wafer]` table of a TOML file; see `load_process`."""
    return _load(WaferFile, path, "wafer").wafer


def load_order(path: str | Path) -> OrderSpec:
    """Read the terms of a mask order from the `[order]` table of a TOML file; see `load_process`."""
    return _load(OrderFile, path, "order").order


def process_from_json(data: Mapping[str, Any], source: str) -> ProcessSpec:
    """Make a process from plain SI values by attribute; `source` names where they came from in messages."""
    return _checked(ProcessFile, {"process": data}, source, si=True).process


def load_variation(path: str | Path) -> Variation:
    """Read the errors of one DOE from TOML, as `variation_to_toml` writes them."""
    return _load(VariationFile, path).value()


def _load(
    model: type[Table],
    path: str | Path,
    table: str | None = None,
    usual: Mapping[str, Mapping[str, Any]] | None = None,
) -> Table:
    """Read a file; with a `table`, pass over the other tables of a spec. `usual` stands for keys that are left out."""
    if not isinstance(path, str | Path):
        what, example = _FILES[model]
        raise InputError(
            table or "variation", f"must be {what} or its TOML file", repr(path), f"For example {example}."
        )
    raw = read_toml(Path(path), *_FILES[model])
    raw |= {name: filled for name, filled in one_wafer(raw).items() if name in raw}
    others = {toml_key(name) for name in Spec.model_fields if table} - {table}
    raw = {key: value for key, value in raw.items() if key not in others}
    for name, keys in (usual or {}).items():
        if isinstance(raw.get(name), dict):
            raw[name] = {**keys, **raw[name]}
    return _checked(model, raw, str(path))


def _checked(
    model: type[Table], raw: Mapping[str, Any], source: str, overridden: Collection[str] = (), *, si: bool = False
) -> Table:
    """Return the tables of a file as a model that obeys the rules between its values, too; see `validated`."""
    value = validated(model, raw, source, overridden, si=si)
    mistakes = list(_PROBLEMS[model](value)) if model in _PROBLEMS else []
    for mistake in mistakes:
        mistake.where = mistake.where if si else key_as_written(mistake.where, raw)
    if mistakes:
        raise spec_error(source, mistakes, overridden)
    return value


def input_files(spec: Spec, only: str | None = None) -> dict[str, Path]:
    """Return the files a spec names by dotted key ("optimize.start", "objective[0].options.image"), or `only` one.

    They are found relative to the folder of the spec file, or to the current one; in a run, those that it keeps.
    """
    named = {} if spec.optimize.start in STARTS else {"optimize.start": spec.optimize.start}
    for index, objective in enumerate(spec.objectives):
        if "image" in objective.options:
            named[f"objective[{index}].options.image"] = str(objective.options["image"])
    named |= _pictures(spec)
    folder = Path() if spec.file is None else spec.file.parent
    if (folder / MANIFEST_NAME).is_file():  # that of a run
        named |= kept_pictures(spec)
    if only is not None:
        named = {only: named[only]}
    files = {key: folder / name for key, name in named.items()}
    missing = [
        InputError(key, "the file must exist", f'"{named[key]}"', f"Put it at {file} or change the path.")
        for key, file in files.items()
        if not file.is_file()
    ]
    if missing:
        raise spec_error(str(spec.file or spec.name), missing)
    return files


def _pictures(spec: Spec) -> dict[str, str]:
    """Pictures that more than the optimisation looks at, by dotted key."""
    tables = {spec.area_key(i): area for i, area in enumerate(spec.areas)} | {"illumination": spec.illumination}
    found = {f"{name}.picture": table.picture for name, table in tables.items() if table and table.picture}
    phases = {f"{spec.area_key(i)}.phase": area.phase_picture for i, area in enumerate(spec.areas)}
    return found | {key: name for key, name in phases.items() if name}


def kept_pictures(spec: Spec) -> dict[str, str]:
    """Names under which a run keeps its own copies of pictures, by dotted key, so that it needs nothing else."""
    names = _pictures(spec).items()
    plain = str.maketrans({"[": "_", "]": "", ".": "_"})
    return {key: f"{key.translate(plain)}{Path(name).suffix.lower()}" for key, name in names}


def read_toml(path: Path, what: str, example: str) -> dict[str, Any]:
    """Read the tables of a TOML file; `what` it should hold ("a spec") and an `example` of that are for messages."""
    cure = f"Give {what} such as {example}."
    beside = path.with_name(f"{path.name}.toml") if path.name else path
    if not path.exists() and beside.is_file():
        raise InputError(str(path), "the file must exist", "nothing of that name", f"Did you mean {beside}?")
    content = read_bytes(path, 1 << 24)
    try:
        return tomllib.loads(content.decode("utf-8-sig"))  # some editors begin a file with a mark of its encoding
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"{what} must be UTF-8 text", f"a foreign byte at {error.start}", cure) from error
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise InputError(str(path), f"{what} must be valid TOML", f'"{error}"', "Fix that line.") from error
    except RecursionError as error:
        raise InputError(str(path), f"{what} must be valid TOML", "brackets without end", cure) from error


def _override(raw: dict[str, Any], text: str) -> str:
    """Change one value of the tables that were read; return its dotted key."""
    try:
        text.encode()
    except UnicodeEncodeError as error:  # bytes of the command line that are none
        rule, cure = "an override must be UTF-8 text", "Rename the file, or type it again."
        raise InputError("overrides", rule, f'"{text}"', cure) from error
    found = _OVERRIDE.fullmatch(text)
    if not found:
        raise InputError("overrides", "an override must be KEY=VALUE", f'"{text}"', "For example process.levels=8.")
    # Messages name the entries of lists so: objective[0].weight.
    key, value = re.sub(r"\[(\d+)\]", r".\1", found[1]), found[2].strip()
    try:
        table = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        table = {}
    # Anything that is no TOML value is text, so that `sensor.pitch=1.85 um` needs no quotes.
    _put(raw, key, table["value"] if len(table) == 1 else value)
    return key


def _put(raw: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    place: Any = raw
    for depth, part in enumerate(parents, 1):
        if isinstance(place, dict):  # of a list that is not there, the first entry can be given
            place = place.setdefault(part, [] if (depth, last) == (len(parents), "0") else {})
        else:
            place = place[_index(place, part, key)]
    if isinstance(place, dict):
        place[last] = value
    elif isinstance(place, list) and last == str(len(place)):
        place.append(value)  # the entry after the last one: another objective or limit
    else:
        place[_index(place, last, key)] = value


def _index(place: Any, part: str, key: str) -> int:
    if isinstance(place, list) and part.isdecimal() and int(part) < len(place):
        return int(part)
    count = f"a list of {len(place)}" if isinstance(place, list) else "a single value"
    rule = f"`{part}` must be an entry of what the spec holds there"
    raise InputError(f"overrides: {key}", rule, count, "Fix the key.")
