"""Specs: what is read, what is refused and in which words, and that nothing depends on how a spec was written."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from doedesign.build import camera_from_spec
from doedesign.spec import (
    Options,
    SpecError,
    input_files,
    load_spec,
    spec_digest,
    spec_from_json,
    spec_to_json,
    spec_to_resolved_toml,
    spec_to_toml,
    spec_warnings,
)
from doedesign.templates import template_text
from fab.errors import InputError
from fab.files import canonical_json

EXAMPLES = Path(__file__).parents[2] / "examples"
AUTOMOTIVE = EXAMPLES / "automotive.toml"
ALL = sorted(EXAMPLES.glob("*.toml"))


@pytest.fixture
def edited(tmp_path: Path) -> Callable[..., Path]:
    """Write the automotive spec with some of its text replaced."""

    def write(*replacements: tuple[str, str]) -> Path:
        text = AUTOMOTIVE.read_text("utf-8")
        for old, new in replacements:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        path = tmp_path / "edited.toml"
        path.write_text(text, "utf-8")
        return path

    return write


def refusal(path: Path, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_spec(path, overrides)
    return str(caught.value)


# --- what is read -----------------------------------------------------------------------------------------------------


def test_automotive_is_the_papers_design_in_si_units():
    spec = load_spec(AUTOMOTIVE)
    assert (spec.doe.samples, spec.doe.pitch_m, spec.doe.aperture_m) == (2400, 1.85e-6, 4.44e-3)
    assert spec.optics.focal_length_m == 8e-3
    assert [colour.wavelengths_m for colour in spec.optics.colours] == [(656e-9,), (589e-9,), (486e-9,)]
    assert [colour.name for colour in spec.optics.colours] == ["656nm", "589nm", "486nm"]
    assert (spec.process.levels, spec.process.level_step_m) == (16, 75e-9)
    assert (min(spec.scene.near_m), max(spec.scene.near_m)) == (0.05, 0.12)
    assert (min(spec.scene.far_m), max(spec.scene.far_m)) == (5.0, 10.0)
    assert (spec.sensor.resolution, spec.sensor.window) == ((4000, 3000), 512)
    assert spec.sensor.pixel_m == pytest.approx(3.7e-6, rel=1e-15)  # one rounding of the product
    assert spec.sensor.window_m == pytest.approx(512 * 3.7e-6, rel=1e-15)


@pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)
def test_every_example_is_sound(path: Path):
    spec = load_spec(path)
    assert spec.name == path.stem
    assert spec_warnings(spec) == []
    assert input_files(spec) == {}


@pytest.mark.parametrize("path", ALL, ids=lambda path: path.stem)
def test_json_and_toml_read_back_to_the_same_spec(path: Path, tmp_path: Path):
    spec = load_spec(path)
    again = spec_from_json(spec_to_json(spec), "manifest.json")
    copy = tmp_path / "spec.toml"
    copy.write_text(spec_to_toml(spec, ["--set process.levels=16", "two\nlines"]), "utf-8")
    assert again == spec == load_spec(copy)
    assert len({again, spec, load_spec(copy)}) == 1
    assert len({spec_digest(again), spec_digest(spec), spec_digest(load_spec(copy))}) == 1
    assert canonical_json(spec_to_json(spec)).startswith(b"{")  # finite numbers only, whatever the depths


def test_digest_sees_content_and_not_spelling(edited: Callable[..., Path]):
    digest = spec_digest(load_spec(AUTOMOTIVE))
    assert spec_digest(load_spec(edited(('"8 mm"', '"0.8 cm"')))) == digest
    assert spec_digest(load_spec(edited(('"8 mm"', '"8.001 mm"')))) != digest
    assert spec_digest(load_spec(AUTOMOTIVE, ["process.levels=16"])) == digest
    assert spec_digest(load_spec(AUTOMOTIVE, ["optimize.seed=2"])) != digest


def test_colour_tables_complete_and_normalise_their_weights(edited: Callable[..., Path]):
    spec = load_spec(
        edited(
            ('wavelengths = ["656 nm", "589 nm", "486 nm"]', ""),
            (
                "[doe]",
                '[[optics.colours]]\nname = "red"\nwavelengths = ["640 nm", "656 nm"]\nweights = [1.0, 3.0]\n'
                '[[optics.colours]]\nname = "green"\nwavelengths = ["520 nm", "530 nm"]\n[doe]',
            ),
        )
    )
    assert [(c.name, c.weights) for c in spec.optics.colours] == [("red", (0.25, 0.75)), ("green", (0.5, 0.5))]


@pytest.mark.parametrize("weights", ["[1e308, 1e308]", "[1e-200, 1e200]"])
def test_weights_without_shares_of_their_sum_are_refused(weights: str, edited: Callable[..., Path]):
    """Their sum is infinite, or one is nothing beside it: the colour would be dark, and its spec not read again."""
    colours = f'colours = [{{ name = "red", wavelengths = ["640 nm", "656 nm"], weights = {weights} }}]'
    path = edited(('wavelengths = ["656 nm", "589 nm", "486 nm"]', colours))
    assert "optics.colours[0].weights: must be numbers whose shares of their sum are above 0" in refusal(path)


@given(weights=st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=6))
def test_reading_weights_again_changes_no_digit(weights: list[float]):
    table = [{"name": "white", "wavelengths_m": [500e-9 + 1e-9 * i for i in range(len(weights))], "weights": weights}]
    data = spec_to_json(load_spec(AUTOMOTIVE))
    data["optics"]["colours"] = table
    once = spec_from_json(data, "test")
    assert sum(once.optics.colours[0].weights) == pytest.approx(1, abs=1e-12)  # six roundings of 1e-16
    assert spec_from_json(spec_to_json(once), "test") == once


@given(pitch_m=st.floats(1e-8, 1e-3), focal_m=st.floats(1e-5, 100))
def test_toml_keeps_every_digit_of_a_length(pitch_m: float, focal_m: float, tmp_path_factory: pytest.TempPathFactory):
    data = spec_to_json(load_spec(AUTOMOTIVE))
    data["sensor"]["pitch_m"], data["optics"]["focal_length_m"] = pitch_m, focal_m
    data["optics"]["mapping"] = "tangent"  # which images any window
    spec = spec_from_json(data, "test")
    path = tmp_path_factory.mktemp("digits") / "spec.toml"
    path.write_text(spec_to_toml(spec), "utf-8")
    assert load_spec(path) == spec


def test_an_index_of_ones_own_is_a_material():
    spec = load_spec(AUTOMOTIVE, ["doe.material=n=1.46"])
    assert camera_from_spec(spec).waves_per_metre(550e-9) == pytest.approx(0.46 / 550e-9, rel=1e-12)
    assert spec_from_json(spec_to_json(spec), "test") == spec


def test_infinite_depth_survives_json():
    spec = load_spec(AUTOMOTIVE, ['scene.far=["5 m", "inf"]'])
    assert spec.scene.far_m == (5.0, math.inf)
    assert spec_to_json(spec)["scene"]["far_m"] == [5.0, "inf"]
    assert spec_from_json(spec_to_json(spec), "test").scene.far_m == (5.0, math.inf)


@pytest.mark.parametrize("far", ['["5 m", "inf"]', '["5 m", inf]'])
def test_an_infinite_depth_needs_no_quotes(far: str):
    """The quotes of a value may be left out, and TOML then has a number."""
    spec = load_spec(
        AUTOMOTIVE, [f"scene.far={far}", 'limit=[{ quantity = "strehl", min = 0.1 }]', "limit[0].depth=inf"]
    )
    assert spec.scene.far_m == (5.0, math.inf)
    assert spec.limits[0].depth_m == math.inf
    with pytest.raises(InputError, match=r"scene\.near\[0\]: must be a number with a unit"):
        load_spec(AUTOMOTIVE, ["scene.near=[inf]"])


def test_options_are_an_immutable_table():
    spec = load_spec(AUTOMOTIVE, ["optimize.start_options={radius=3, parts=[1, [2.5, 'a']], on=true}"])
    options = spec.optimize.start_options
    assert dict(options) == {"on": True, "parts": (1, (2.5, "a")), "radius": 3}
    assert hash(options) == hash(Options(tuple(sorted(options.items()))))
    assert spec_to_json(spec)["optimize"]["start_options"] == {"on": True, "parts": [1, [2.5, "a"]], "radius": 3}


def test_specs_are_frozen():
    spec = load_spec(AUTOMOTIVE)
    with pytest.raises(ValueError, match="frozen"):
        spec.process.levels = 8  # type: ignore[misc]


# --- overrides --------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize("changes", [None, 8, [8], {"process.levels": 8}])
def test_overrides_that_are_no_texts_are_told(changes: Any):
    with pytest.raises(InputError, match=r"overrides: must be several changes, as text, .*\[\"process\.levels=8\"\]"):
        load_spec(AUTOMOTIVE, changes)


def test_overrides_change_single_values():
    spec = load_spec(
        AUTOMOTIVE,
        [
            "process.levels=8",
            "process.level_step = 150 nm",
            'optics.wavelengths=["532 nm"]',
            "objective.1.weight=2.5",
            "optimize.start_options.far_energy=0.3",
            "sensor.defocus='-20 um'",
        ],
    )
    assert (spec.process.levels, spec.process.level_step_m) == (8, 150e-9)
    assert [colour.name for colour in spec.optics.colours] == ["532nm"]
    assert [objective.weight for objective in spec.objectives] == [1.0, 2.5, 0.8, 30.0]
    assert dict(spec.optimize.start_options) == {"far_energy": 0.3}
    assert spec.sensor.defocus_m == -20e-6


def test_an_override_of_the_entry_after_the_last_adds_one():
    added = "objective[4]={ name='ring_to_disc', weight=0.5, options={ least=1.5 } }"
    spec = load_spec(AUTOMOTIVE, [added, "objective[4].weight=0.7"])
    assert [one.name for one in spec.objectives][3:] == ["spot_energy", "ring_to_disc"]
    assert (spec.objectives[4].weight, dict(spec.objectives[4].options)) == (0.7, {"least": 1.5})
    assert "objective[4]: must" in refusal(AUTOMOTIVE, "objective[4]=far_spot")
    # Of a list that the spec has not, too.
    assert not load_spec(EXAMPLES / "quick.toml").limits
    spec = load_spec(EXAMPLES / "quick.toml", ["limit[0]={ quantity='strehl', min=0.5 }", "limit[0].min=0.6"])
    assert [(one.quantity, one.min) for one in spec.limits] == [("strehl", 0.6)]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("process.levels", 'an override must be KEY=VALUE, but got "process.levels"'),
        ("objective.5={ name='far_spot' }", "`5` must be an entry of what the spec holds there, but got a list of 4"),
        ("objective.7.weight=1", "`7` must be an entry of what the spec holds there, but got a list of 4"),
        ("focus[1].x=3", "focus.1: must be a known key of [focus], but got `1`"),
        (
            "areas[0].shape='disc'",
            "overrides: areas: must be a known key of the spec, but got `areas`. Did you mean `area`?",
        ),
        ("optimize.start=\udcff.exr", "overrides: an override must be UTF-8 text"),
        ("name.first=1", "`first` must be an entry of what the spec holds there, but got a single value"),
        ("process.levls=8", "overrides: process.levls: must be a known key of [process], but got `levls`. Did"),
        ("process.levels=8\nname='x'", "overrides: process.levels: must be a whole number"),
    ],
)
def test_a_wrong_override_is_named(override: str, message: str):
    assert message in refusal(AUTOMOTIVE, override)


@pytest.mark.parametrize(
    "start", ["\x07.exr", "a\x7f.exr", "\x00.exr", "a\n[doe]\nsamples = 2\n.exr", "a\r\x85\u2028.exr"]
)
def test_no_override_ends_the_remark_that_records_it(start: str, tmp_path: Path):
    overrides = [f"optimize.start={start}"]
    spec = load_spec(AUTOMOTIVE, overrides)
    path = tmp_path / "spec.toml"
    path.write_bytes(spec_to_resolved_toml(spec, overrides).encode())
    assert load_spec(path) == spec


# --- what is refused --------------------------------------------------------------------------------------------------

REFUSED = [
    # key, its new value, and what the message must say
    ("sensor.pich", '"2 um"', ["sensor.pich", "`pich`", "Did you mean `pitch`?"]),
    ("sensor.focal_length", '"2 um"', ["sensor.focal_length", "It belongs to [optics]."]),
    ("optics.focal_length", "8", ["optics.focal_length", 'a number with a unit such as "75 nm"', "got 8."]),
    ("optics.focal_length", '"8"', ["optics.focal_length", "a number with a unit", 'got "8"']),
    ("optics.focal_length", '"8 kg"', ["optics.focal_length", "a number with a unit", 'got "8 kg"']),
    ("optics.focal_length", '"-8 mm"', ["optics.focal_length", "between 10 um and 100 m", 'got "-8 mm"']),
    ("optics.wavelengths", '["656 nm", "1 nm"]', ["optics.wavelengths[1]", "between 200 nm and 20 um", "1 nm"]),
    ("optics.wavelengths", '["656 nm", "8 um"]', ["optics.wavelengths[1]", "210-6700 nm", "fused_silica", "8000 nm"]),
    ("optics.wavelengths", '["656 nm", "656 nm"]', ["optics.wavelengths[1]", "its own name", "'656nm' twice"]),
    ("optics.wavelengths", "[]", ["optics.wavelengths", "must not be empty"]),
    ("optics.wavelengths", '"656 nm"', ["optics.wavelengths", "must be a list"]),
    ("optics.colours", '[{name="red", wavelengths=["656 nm"]}]', ["optics.wavelengths", "must be stated once"]),
    ("optics.propagation", '"fresnell"', ["optics.propagation", "far_field, fresnel", "Did you mean `fresnel`?"]),
    ("optics.mapping", '"fisheye"', ["optics.mapping", "sine, tangent"]),
    ("optics.distortion", "[0.1]", ["optics.distortion"]),
    ("optics.distortion", "[0.1, 11.0]", ["optics.distortion", "must lie between -10 and 10"]),
    ("doe.material", '"fused_slica"', ["doe.material", "a known material", "Did you mean `fused_silica`?"]),
    ("doe.samples", "30000", ["doe.samples", "must be at most 20000", "30000"]),
    ("doe.samples", "2400.5", ["doe.samples", "must be a whole number", "2400.5"]),
    ("doe.samples", "2401", ["doe.aperture", "2401 x 1.85 um = 4.44185 mm", "4.44 mm", "samples = 2400"]),
    ("doe.aperture", '"4 mm"', ["doe.aperture", "to within half a pitch", "got 4 mm", 'aperture = "4.44 mm"']),
    ("process.levels", "1", ["process.levels", "must lie from 2 to 64", "got 1"]),
    ("process.levels", "128", ["process.levels", "must lie from 2 to 64"]),
    ("process.levels", "6.5", ["process.levels", "must be a whole number", "6.5"]),
    ("process.levels", "true", ["process.levels", "must be a whole number", "got true"]),
    ("scene.near", '["5 cm", "6 m"]', ["scene.near", "smaller than every far depth", "6 m near and 5 m far"]),
    ("scene.near", '["inf"]', ["scene.near[0]", "a number with a unit"]),
    ("scene.near", '["1 cm"]', ["scene.near", "16.9 mm", "cannot follow the wave", "got 10 mm"]),
    ("scene.near", "[]", ["objective[1].name", '"near_spread" looks at near depths', "an empty scene.near"]),
    ("scene.far", "[]", ["scene.far", "must not be empty"]),
    ("scene.far", '["5 m", "10 m", "5 m"]', ["scene.far[2]", "every depth must be given once", "5 m twice"]),
    ("scene.far", '["inf", "inf"]', ["scene.far[1]", "every depth must be given once", "inf twice"]),
    ("scene.near", '["5 cm", "5.00000000000001 cm"]', ["scene.near[1]", "every depth must be given once"]),
    ("sensor.resolution", "[4000]", ["sensor.resolution[1]", "must be given"]),
    ("sensor.fill_factor", "1.2", ["sensor.fill_factor", "must be at most 1"]),
    ("optimize.learning_rate", "nan", ["optimize.learning_rate", "must be finite"]),
    ("optimize.start", '"rings"', ["optimize.start", "a known start or a height map file", "Did you mean `ring`?"]),
    ("optimize.start_options", "{a = {b = 1}}", ["optimize.start_options", "lists of these"]),
    ("optimize.start_options", f"{{a = 1{'0' * 400}}}", ["optimize.start_options", "finite numbers"]),
    ("objective", "[]", ["objective", "must have something to improve", "no [[objective]]"]),
    ("objective", "{}", ["objective", "must be a list", "Write [[objective]] tables."]),
    ("objective.0.name", '"far_spott"', ["objective[0].name", "a known objective", "Did you mean `far_spot`?"]),
    ("objective.0.weight", "inf", ["objective[0].weight", "must be finite"]),
    ("name", '"a/b"', ["name", "must be a file name", 'got "a/b"']),
    # The short forms of colours belong to [optics], whatever tables choose among its colours.
    ("optimize.wavelengths", '["532 nm"]', ["known key of [optimize]", "It belongs to [optics]."]),
    ("optics.wavelenghts", "[]", ["known key of [optics]", "Did you mean `wavelengths`?"]),
    ("optics.lines", "3", ["known key of [optics]", "spectral_response, lines_per_colour."]),
    ("optimize.foo", "1", ["known key of [optimize]", "checkpoint_every."]),
    ("objective.0.foo", "1", ["known key of [objective[0]]", "over."]),
    ("lens", "{}", ["lens", "must be a known key of the spec", "`lens`"]),
    ("scene", "3", ["scene", "must be a table", "got 3"]),
]


@pytest.mark.parametrize(("key", "value", "parts"), REFUSED, ids=[f"{key}={value}" for key, value, _ in REFUSED])
def test_a_mistake_is_named_with_key_rule_value_and_cure(key: str, value: str, parts: list[str]):
    message = refusal(AUTOMOTIVE, f"{key}={value}")
    for part in parts:
        assert part in message
    assert len(message.splitlines()) == 1


def test_a_mistake_in_the_file_names_the_file(edited: Callable[..., Path]):
    path = edited(("levels = 16 ", "levls = 16 "))
    message = refusal(path)
    assert (
        f"{path}: process.levls: must be a known key of [process], but got `levls`. Did you mean `levels`?" in message
    )
    assert len(message.splitlines()) == 1  # and not that `levels` must be given


def test_options_of_a_start_that_is_a_file_are_refused():
    """They did nothing; an empty table is none."""
    given = [AUTOMOTIVE, "optimize.start=start.exr", "optimize.start_options.duty=0.3"]
    assert "optimize.start_options: a start that is a file takes none, but got duty. Leave" in refusal(*given)
    load_spec(AUTOMOTIVE, ["optimize.start=start.exr", "optimize.start_options={}"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[optics]", "[optic]"), "optic: must be a known key of the spec, but got `optic`. Did you mean `optics`?"),
        (("wavelengths =", "wavelenghts ="), "optics.wavelenghts: must be a known key of [optics]"),
    ],
)
def test_what_follows_from_a_slip_in_a_name_is_not_told(
    edited: Callable[..., Path], change: tuple[str, str], words: str
):
    message = refusal(edited(change))
    assert words in message
    assert "must be given" not in message


def test_unknown_keys_come_first_and_hide_nothing_else(edited: Callable[..., Path]):
    lines = refusal(edited(("samples = 2400", ""), ("levels = 16 ", "depth_of_all = 16 "))).splitlines()
    assert len(lines) == 3
    assert "process.depth_of_all: must be a known key" in lines[0]
    assert any("doe.samples: must be given" in line for line in lines[1:])
    assert any("process.levels: must be given" in line for line in lines[1:])


def test_a_spec_without_its_ending_is_proposed(tmp_path: Path):
    (tmp_path / "splitter.toml").touch()
    message = refusal(tmp_path / "splitter")
    assert f"{tmp_path / 'splitter'}: the file must exist" in message
    assert f"Did you mean {tmp_path / 'splitter.toml'}?" in message
    assert "Did you mean" not in refusal(tmp_path / "other")


def test_several_mistakes_are_told_together(edited: Callable[..., Path]):
    path = edited(("samples = 2400", "samples = 1"), ('"8 mm"', '"8 s"'), ('"fused_silica"', "3"))
    with pytest.raises(SpecError) as caught:
        load_spec(path)
    assert len(caught.value.mistakes) == 3
    assert len(str(caught.value).splitlines()) == 3


def test_missing_tables_and_values_are_named(tmp_path: Path):
    path = tmp_path / "empty.toml"
    path.write_text('name = "empty"\n[optics]\nfocal_length = "8 mm"\n', "utf-8")
    message = refusal(path)
    assert "optics.wavelengths: must be given" in message
    assert "optics.design_wavelength: must be given" in message
    for table in ("doe", "process", "scene", "sensor"):
        assert f"{table}: must be given, but got nothing. Add a table [{table}]." in message


def test_fresnel_needs_the_pitch_of_equation_6():
    message = refusal(AUTOMOTIVE, "optics.propagation=fresnel")
    # 2400 (1.85 um)^2 / 486 nm = 16.9 mm; the cure's grid must pass the same check.
    assert "16.9 mm > 8 mm at 486 nm" in message
    assert "at most 875.7 nm (samples = 5072" in message
    cured = ["optics.propagation=fresnel", "doe.samples=5072", "doe.pitch=875.4 nm", "doe.aperture=4.44 mm"]
    assert load_spec(AUTOMOTIVE, cured).optics.propagation == "fresnel"


def test_half_a_pitch_is_the_limit_of_the_aperture():
    assert load_spec(AUTOMOTIVE, ["doe.aperture=4.4409 mm"]).doe.aperture_m == 4.4409e-3
    assert "doe.aperture" in refusal(AUTOMOTIVE, "doe.aperture=4.44094 mm")


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (b'name = "x"\n[optics\n', ["must be valid TOML", "line 2, column 8"]),
        (b'name = "x"\nname = "y"\n', ["must be valid TOML", "line 2"]),
        (b"\xff\xfe\x00", ["must be UTF-8 text", "byte at 0"]),
        (b"v = " + b"[" * 100_000, ["must be valid TOML"]),
    ],
    ids=["cut", "twice", "binary", "nested"],
)
def test_a_file_that_is_no_toml_is_refused(tmp_path: Path, content: bytes, parts: list[str]):
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    message = refusal(path)
    for part in [str(path), *parts]:
        assert part in message


def test_a_mark_of_the_encoding_is_passed_over(tmp_path: Path):
    path = tmp_path / "marked.toml"
    path.write_text(AUTOMOTIVE.read_text("utf-8"), "utf-8-sig")
    assert load_spec(path) == load_spec(AUTOMOTIVE)


def test_truncation_anywhere_is_one_clear_message(tmp_path: Path):
    text = AUTOMOTIVE.read_bytes()
    path = tmp_path / "short.toml"
    for length in range(0, len(text), 101):
        path.write_bytes(text[:length])
        try:
            load_spec(path)
        except InputError as error:
            assert str(path) in str(error)  # noqa: PT017 - a cut in the last comment leaves a whole spec


def test_missing_files_are_named(tmp_path: Path):
    assert str(tmp_path / "none.toml") in refusal(tmp_path / "none.toml")
    assert str(tmp_path) in refusal(tmp_path)
    spec = load_spec(AUTOMOTIVE, ["optimize.start=start.exr", "objective.0.options.image=picture.png"])
    with pytest.raises(InputError, match=r"optimize\.start: the file must exist") as caught:
        input_files(spec)
    assert "objective[0].options.image" in str(caught.value)


def test_files_are_found_beside_the_spec(edited: Callable[..., Path]):
    path = edited(('"ring"', '"start.npy"'))
    (path.parent / "start.npy").touch()
    assert input_files(load_spec(path)) == {"optimize.start": path.parent / "start.npy"}


@pytest.mark.slow
@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5), st.lists))
def test_foreign_json_is_refused_as_bad_input(value: object):
    data = spec_to_json(load_spec(AUTOMOTIVE))
    for table in ("name", "optics", "scene", "objectives"):
        with pytest.raises(InputError):
            spec_from_json({**data, table: {"wavelengths": value, "near_m": value, "x": value}}, "manifest.json")


# --- warnings ---------------------------------------------------------------------------------------------------------


def test_a_plate_that_keeps_most_light_in_one_spot_needs_no_whole_wave():
    path, even = EXAMPLES / "snapshot_hdr.toml", ", ".join(["1"] * 9)
    assert spec_warnings(load_spec(path)) == []
    (warning,) = spec_warnings(load_spec(path, [f"spots.weights=[{even}]"]))
    assert warning.startswith("process.level_step: ")


def test_a_level_step_that_misses_the_wave_is_explained():
    (warning,) = spec_warnings(load_spec(AUTOMOTIVE, ["optics.design_wavelength=520 nm"]))
    assert "16 x 75 nm = 1.2 um of fused_silica is one wave at 552 nm" in warning
    # 1.2 um (n - 1) / 520 nm with Malitson's n = 1.46128
    assert "at the design wavelength of 520 nm it is 1.0645 waves, +6.4 % off" in warning
    assert 'A level_step of "70.46 nm" would.' in warning


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["process.level_step=1 nm"], "is one wave at no wavelength fused_silica is known for"),
        (["sensor.resolution=[600, 2000]"], "512 pixels are more than the 300 binned pixels"),
        (["sensor.window=600"], "only 1051 um far; beyond that the PSF repeats. At most 568 pixels avoid it."),
        (["sensor.window=128"], "the blur disc of a point at 50 mm is 710.4 um wide"),
    ],
)
def test_doubts_are_said(overrides: list[str], part: str):
    assert any(part in warning for warning in spec_warnings(load_spec(AUTOMOTIVE, overrides)))


@pytest.mark.parametrize(("template", "own"), [("splitter", "spots"), ("diffuser", "area")])
def test_a_target_that_is_not_for_the_design_wavelength_is_told(tmp_path: Path, template: str, own: str):
    path = tmp_path / "spec.toml"
    path.write_text(template_text(template))

    def told(*nanometres: int) -> list[str]:
        listed = ", ".join(f'"{each} nm"' for each in nanometres)
        return [w for w in spec_warnings(load_spec(path, [f"optics.wavelengths=[{listed}]"])) if "judged at" in w]

    assert not told(532)
    assert not told(532, 633)
    (warning,) = told(633, 532)
    assert f"[{own}] is designed and judged at 633 nm" in warning
    assert "not at the design wavelength of 532 nm. List it first" in warning


@pytest.mark.parametrize(
    ("template", "what"), [("splitter", "spots"), ("fan_out", "spots"), ("diffuser", "areas"), ("bifocal", "foci")]
)
def test_walls_that_no_search_looks_at_are_told(tmp_path: Path, template: str, what: str):
    path = tmp_path / "spec.toml"
    path.write_text(template_text(template))
    assert spec_warnings(load_spec(path)) == []
    (warning,) = spec_warnings(load_spec(path, ["optics.light=edges"]))
    assert warning.startswith("optics.light: ")
    assert f"is not in the search of {what}," in warning
    assert "the finished plate is judged with edges" in warning


def test_walls_in_the_loss_of_objectives_are_no_doubt():
    assert spec_warnings(load_spec(AUTOMOTIVE, ["optics.light=edges"])) == []


def test_an_occlusion_model_that_pictures_will_need_is_told_at_once(tmp_path: Path):
    text = AUTOMOTIVE.read_text()
    (tmp_path / "bare.toml").write_text("\n".join(li for li in text.splitlines() if not li.startswith("occlusion")))
    (warning,) = spec_warnings(load_spec(tmp_path / "bare.toml"))
    assert warning.startswith("scene.occlusion: not named")
    assert "reciprocal" in warning


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("process.chrome_overlap=1 mm", ""),
        ("process.chrome_overlap=2 mm", "process.chrome_overlap: must lie between"),
        ("sensor.defocus=-5 mm", "sensor.defocus: the sensor must stay beyond half the focal length, 8 mm"),
    ],
)
def test_impossible_openings_and_sensors(override: str, message: str):
    if message:
        assert message in refusal(AUTOMOTIVE, override)
    else:
        assert load_spec(AUTOMOTIVE, [override]).process.chrome_overlap_m == 1e-3


def test_a_lens_of_its_own():
    """It is read, changes the camera, is said, and leaves no trace where it is not given."""
    chosen = load_spec(AUTOMOTIVE, ["optics.mapping=tangent", "optics.distortion=[-0.1, 0.02]"])
    camera = camera_from_spec(chosen)
    assert (camera.mapping, camera.distortion) == ("tangent", (-0.1, 0.02))
    assert "mapping" not in spec_to_json(load_spec(AUTOMOTIVE))["optics"]
    assert spec_from_json(spec_to_json(chosen), "spec") == chosen
    folded = refusal(AUTOMOTIVE, "optics.distortion=[-10.0, 0.0]", "sensor.window=1024")
    assert "optics.distortion: the image must not fold over" in folded
    for override, key in (("mapping=tangent", "mapping"), ("distortion=[0.1, 0.0]", "distortion")):
        message = refusal(AUTOMOTIVE, f"optics.{override}", "optics.propagation=fresnel")
        assert f"optics.{key}: the direct path has the lens of eq. 5" in message
    assert "train.field" in refusal(AUTOMOTIVE, "optics.mapping=tangent", "train.field=random")


def test_a_doe_before_its_lens():
    chosen = load_spec(AUTOMOTIVE, ["optics.doe_distance=3 mm", "sensor.defocus=20 um"])
    assert camera_from_spec(chosen).doe_distance_m == 3e-3
    assert "DOE 3 mm before the lens" in camera_from_spec(chosen).lens_text
    assert "doe_distance_m" not in spec_to_json(load_spec(AUTOMOTIVE))["optics"]
    far = refusal(AUTOMOTIVE, "optics.doe_distance=50 m", "sensor.defocus=20 um")
    assert "optics.doe_distance: with the sensor beyond the focus it must stay below" in far
    assert "must lie between" in refusal(AUTOMOTIVE, "optics.doe_distance=-1 mm")
    assert "the DOE lies on the lens" in refusal(AUTOMOTIVE, "optics.doe_distance=1 mm", "optics.propagation=fresnel")


def test_a_bound_itself_is_inside():
    assert load_spec(AUTOMOTIVE, ["process.level_step=0.1 nm"]).process.level_step_m == pytest.approx(1e-10)


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 5000, "{a=" * 5000], ids=["digits", "brackets", "tables"])
def test_a_value_that_python_refuses_is_a_mistake_in_the_file(tmp_path: Path, value: str):
    path = tmp_path / "a.toml"
    path.write_text(f"value = {value}", "utf-8")
    with pytest.raises(InputError, match="must be valid TOML"):
        load_spec(path)
    with pytest.raises(InputError, match=r"process\.levels"):
        load_spec(Path("examples/quick.toml"), [f"process.levels={value}"])
