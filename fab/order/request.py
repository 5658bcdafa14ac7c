"""The request: everything that an order follows from, besides its level numbers, as the manifest records it.

Lengths are metres. Numbers are written with all their digits, so that what is drawn from a request that was read is
what was drawn at first.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from fab.aperture import aperture_from
from fab.errors import InputError
from fab.files import canonical_json
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.order.order import Order
from fab.rules.check import Rules, check

# The rules are those of the process, and a repaired level map needs no second repair.
_ASKED = tuple(field.name for field in fields(Order) if field.name not in ("rules", "repair"))
_IF_ANY = {field.name for field in fields(Order) if "if_any" in field.metadata}
_CURE = "Fetch the manifest again, or write the order again."


def _plain(value: Any) -> Any:
    """Turn a value into JSON values, fields by name; without fields that are there `IF_ANY`, and are default."""
    if is_dataclass(value):
        return _without_defaults(value, {field.name: _plain(getattr(value, field.name)) for field in fields(value)})
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return [_plain(part) for part in value] if isinstance(value, tuple | list) else value


def _without_defaults(value: Any, parts: Mapping[str, Any]) -> dict[str, Any]:
    usual = {field.name: _plain(field.default) for field in fields(value) if "if_any" in field.metadata}
    return {name: part for name, part in parts.items() if not (name in usual and part == usual[name])}


def request_of(order: Order) -> dict[str, Any]:
    """Return the request of an order as JSON values."""
    level_map = order.level_map
    drawn = {"name": level_map.name, "shape": list(level_map.shape), "pitch_m": level_map.grid.pitch_m}
    asked = _without_defaults(order, {name: _plain(getattr(order, name)) for name in _ASKED})
    return {"level_map": {**drawn, "aperture_m": level_map.relief.record()}, **asked}


def as_recorded(order: Order) -> Order:
    """Return an order whose values are of the kinds that its request gives back, 0.0 m where 0 m was asked for.

    Raises:
        InputError: a value of another kind than its field's.
    """
    hints, asked = get_type_hints(Order), {}
    for name in _ASKED:
        if name == "light":  # predicted, not asked for
            continue
        try:
            asked[name] = TypeAdapter(hints[name]).validate_python(_plain(getattr(order, name)))
        except ValidationError as errors:
            found = errors.errors(include_url=False)[0]
            where = ": ".join(map(str, (name, *found["loc"])))
            raise InputError(where, found["msg"], repr(found["input"])[:60], "Give a value of its kind.") from errors
    try:
        canonical_json(asked["source"])
    except (TypeError, ValueError) as error:  # another kind, NaN, or a list within itself
        cure = "Give text, finite numbers, lists and dictionaries."
        raise InputError("source", "must be what JSON can hold", repr(order.source), cure) from error
    return replace(order, **asked)


def order_from(request: Mapping[str, Any], level: NDArray[np.uint8], where: str) -> Order:
    """Return the order of a request and of level numbers ``[y, x]``; `where` names the file in errors.

    Raises:
        InputError: the request holds other keys or values than `request_of` writes, or does not fit the level numbers.
    """
    hints = get_type_hints(Order)
    try:
        given = [name for name in _ASKED if name in request or name not in _IF_ANY]
        asked = {name: TypeAdapter(hints[name]).validate_python(request[name]) for name in given}
        drawn = request["level_map"]
        grid = Grid(level.shape, float(drawn["pitch_m"]))
        relief = aperture_from(drawn["aperture_m"], shape=grid.shape)
        level_map = LevelMap(level, asked["process"].levels, grid, relief, drawn["name"])
    except ValidationError as errors:
        found = errors.errors(include_url=False)[0]
        raise InputError(f"{where}: request", found["msg"], repr(found["input"])[:60], _CURE) from errors
    except InputError as error:
        raise InputError(f"{where}: request: {error.where}", error.rule, error.got, _CURE) from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: request", "must be whole", f"{type(error).__name__}: {error}", _CURE) from error
    rules = Rules.from_process(asked["process"], asked["terms"].address_grid_m)
    order = Order(check(level_map, rules), **asked)
    if canonical_json(request_of(order)) != canonical_json(request):
        raise InputError(f"{where}: request", "must hold the keys and values of an order", "others", _CURE)
    return order
