"""The reference of spec keys: complete, true to the model, and printed by `doedesign spec`."""

import json
import tomllib
from typing import Annotated, Any

import pytest
from pydantic import TypeAdapter

from doedesign.cli import main
from doedesign.reference.keys import KeyTable, SpecKey, every_key, found, key_tables
from doedesign.reference.options import choices_of
from doedesign.spec import STARTS, Spec
from doedesign.spec.process import SpreadSpec
from doedesign.spec.scene import OBSTRUCTION_KINDS
from doedesign.spec.values import FROM_TOML, IN_ANGLES, OBJECTIVES
from doedesign.spec.values.table import SpecTable, toml_key
from fab.errors import InputError

KEYS = every_key()


def fields(model: type[SpecTable], path: str = "") -> dict[str, tuple[type[SpecTable], str]]:
    """Every value of a model by its dotted key, found without the reference: its table and its attribute."""
    out: dict[str, tuple[type[SpecTable], str]] = {}
    for name, field in model.model_fields.items():
        key = f"{path}.{toml_key(name)}".removeprefix(".")
        text = str(field.annotation)
        inner = next(
            (
                m
                for m in tables_of_models()
                if f"{m.__module__}.{m.__qualname__}" in text or m.__name__ == getattr(field.annotation, "__name__", "")
            ),
            None,
        )
        if inner is None or inner.inline:
            out[key] = (model, name)
        if inner is not None and not issubclass(inner, SpreadSpec):
            out |= fields(inner, key)
    return out


def tables_of_models() -> list[type[SpecTable]]:
    def below(model: type[SpecTable]) -> list[type[SpecTable]]:
        return [model, *(one for each in model.__subclasses__() for one in below(each))]

    return below(SpecTable)[1:]


FIELDS = fields(Spec)


def test_every_value_of_the_model_has_its_entry() -> None:
    # The three short ways to say colours are read before the model.
    assert set(KEYS) - set(FIELDS) == {"optics.wavelengths", "optics.spectral_response", "optics.lines_per_colour"}
    assert set(FIELDS) <= set(KEYS)
    assert len(FIELDS) > 200


TABLES = [table.key for table in key_tables() if table.key]


def test_every_key_says_what_it_is() -> None:
    for key, one in KEYS.items():
        assert one.kind, key
        assert len(one.description) > 5, key
        assert one.description.endswith((".", ")")), key
        assert one.example.startswith(f"{one.name} = "), key
        # A length or an angle has limits in its unit, a text none or a rule.
        assert one.limits or one.unit not in ("m", "rad") or one.kind.startswith("list of lists"), key


def adapter(model: type[SpecTable], name: str) -> TypeAdapter[Any]:
    field = model.model_fields[name]
    kind: Any = field.annotation
    with_rules: Any = Annotated[kind, *field.metadata] if field.metadata else kind  # pyright: ignore[reportInvalidTypeForm]
    return TypeAdapter(with_rules)


def test_defaults_are_those_of_the_model() -> None:
    for key, (model, name) in FIELDS.items():
        field, one = model.model_fields[name], KEYS[key]
        assert one.required == field.is_required(), key
        if one.required or field.default in (None, ()):
            assert one.default == "", key
            continue
        expected = field.default
        read = adapter(model, name).validate_python(tomllib.loads(f"x = {one.default}")["x"], context=FROM_TOML)
        # A default is told with twelve digits; read again it is the same number but for them.
        assert read == (pytest.approx(expected, rel=1e-11) if isinstance(expected, float) else expected), key


def test_examples_are_accepted() -> None:
    for key, (model, name) in FIELDS.items():
        value: Any = tomllib.loads(KEYS[key].example)[KEYS[key].name]
        if name in ("aperture_m", "etches"):  # read with others of their table
            continue
        context = IN_ANGLES if name == "pixel_angle_rad" else FROM_TOML
        read = adapter(model, name).validate_python(value, context=context, by_alias=True, by_name=False)
        assert read is not None, key


@pytest.mark.parametrize("table", TABLES)
def test_every_key_is_printed(table: str, capsys: pytest.CaptureFixture[str]) -> None:
    shown = found(table)
    assert isinstance(shown, KeyTable)
    assert main(["spec", table]) == 0
    out = capsys.readouterr().out
    assert out.startswith(shown.header)
    assert all(f"\n{one.name}" in out for one in shown.keys)
    for one in shown.keys:
        assert main(["spec", one.key]) == 0
        words = capsys.readouterr().out.split()
        assert " ".join(one.example.split()) in " ".join(words)
        assert words[0] == one.key
        assert main(["spec", one.key, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["default"] == one.default


def test_all_tables_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["spec"]) == 0
    out = capsys.readouterr().out
    assert all(table.header in out for table in key_tables())
    assert main(["spec", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [table["table"] for table in listed] == [table.key for table in key_tables()]
    assert sum(len(table["keys"]) for table in listed) == len(KEYS)


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("optimize.stepz", "Did you mean `optimize.steps`?"),
        ("windo", "doedesign spec lists all tables."),
        ("optimise", "Did you mean `optimize`?"),
        ("pitch", "Did you mean `doe.pitch` or `sensor.pitch` or `wafer.pitch`?"),
    ],
)
def test_an_unknown_key_names_the_nearest(name: str, nearest: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="must be a table or a key of a spec"):
        found(name)
    assert main(["spec", name]) == 2
    assert nearest in capsys.readouterr().err


@pytest.mark.parametrize("name", ["objective[0].weight", "objective.0.weight", "[[objective]]", "[optimize]"])
def test_keys_as_messages_and_files_write_them_are_found(name: str) -> None:
    one = found(name)
    assert one.key in ("objective.weight", "objective", "optimize")


def test_an_error_has_one_entry_for_mean_and_sigma() -> None:
    one = found("process.errors.overlay_x.sigma")
    assert isinstance(one, SpecKey)
    assert one.key == "process.errors.overlay_x"


def test_options_are_those_of_functions_and_classes() -> None:
    starts, objectives, obstructions = (
        {choice.name: choice for choice in choices_of(key)}
        for key in ("optimize.start_options", "objective.options", "obstruction.options")
    )
    assert {name: tuple(one.options) for name, one in starts.items()} == STARTS
    assert set(objectives) == set(OBJECTIVES)
    assert objectives["spot_energy"].options == {"energy": "must be given"}
    assert set(obstructions) == set(OBSTRUCTION_KINDS)
    assert "clump" in obstructions["dirt"].options
    assert all(choice.about for one in (starts, objectives, obstructions) for choice in one.values())
    assert choices_of("optimize.steps") == ()
