"""The process in a spec: what it means, what is refused and in which words, and files that keep every bit."""

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from doedesign.build import process_from_spec, spec_from_process
from doedesign.spec import (
    ErrorsSpec,
    LimitSpec,
    ProcessSpec,
    load_process,
    load_spec,
    load_variation,
    load_wafer,
    process_from_json,
    process_to_toml,
    spec_digest,
    spec_from_json,
    spec_to_json,
    spec_to_toml,
    spec_warnings,
    variation_to_toml,
)
from fab.errors import InputError
from fab.levels import Levels
from fab.process import DEVIATIONS, Defects, Disc, MaskDisc, Normal, Process, Variation, error_names
from fab.stock import STOCK

EXAMPLES = Path(__file__).parents[2] / "examples"
AUTOMOTIVE = EXAMPLES / "automotive.toml"
QUICK = EXAMPLES / "quick.toml"
DSLR = EXAMPLES / "dslr.toml"
IDEAL = 'process={levels = 16, level_step = "75 nm"}'

FULL = """
levels = 16
level_step = "75 nm"
chrome_overlap = "3 um"
stock = "contact_aligner"
etches = [{ mask = 3, depth = "600 nm" }, { mask = 0 }, { mask = 1 }, { mask = 2, depth = "0.3 um" }]
tone = "dark"
minimum_line = "1.5 um"
minimum_space = "1.2 um"
die = ["0 mm", "30 mm"]
wafer_radius = "75 mm"

[process.errors]
overlay_x = "0.2 um"
overlay_y = ["0.1 um", "0.2 um", "0.3 um", "0.4 um"]
cd_bias = { mean = ["0.1 um", "0 um", "-0.1 um", "0.2 um"], sigma = "50 nm" }
sidewall = { mean = "3 deg" }
rotation = "20 urad"
depth_scale = 0.03
roughness = "0 nm"

[process.defects]
particles_per_mm2 = 0.05
missed = 0.01
"""


@pytest.fixture
def written(tmp_path: Path) -> Callable[..., Path]:
    """Write text to a file of its own."""

    def write(text: str, name: str = "file.toml") -> Path:
        path = tmp_path / name
        path.write_text(text, "utf-8")
        return path

    return write


def refusal(read: Callable[..., object], *arguments: object) -> str:
    with pytest.raises(InputError) as caught:
        read(*arguments)
    return str(caught.value)


# --- what is read -----------------------------------------------------------------------------------------------------


def test_every_error_of_the_process_model_has_its_key():
    assert set(ErrorsSpec.model_fields) == set(DEVIATIONS)
    assert all(field.alias and not field.alias.endswith(("_m", "_rad")) for field in ErrorsSpec.model_fields.values())


def test_the_size_of_the_wafer_is_stated_once():
    for stated in ('wafer.diameter="150 mm"', 'process.wafer_radius="75 mm"'):
        spec = load_spec(AUTOMOTIVE, [stated])
        assert (process_from_spec(spec.process).wafer_radius_m, spec.wafer.diameter_m) == (0.075, 0.15)
    both = ['process.wafer_radius="50 mm"', 'wafer.diameter="150 mm"']
    message = refusal(load_spec, AUTOMOTIVE, both)
    assert "process.wafer_radius: must be half of wafer.diameter, 150 mm, but got 50 mm" in message
    assert load_spec(AUTOMOTIVE, ['wafer.diameter="100 mm"', 'process.wafer_radius="50 mm"'])


def test_the_size_of_the_wafer_is_stated_once_in_files_of_a_process_and_of_a_wafer(written: Callable[..., Path]):
    process, wafer = '[process]\nlevels = 4\nlevel_step = "300 nm"\n', "[wafer]\ndies = [2, 2]\n"
    for path in (
        written(process + wafer + 'diameter = "150 mm"\n'),
        written(process + 'wafer_radius = "75 mm"\n' + wafer),
    ):
        assert process_from_spec(load_process(path)).wafer_radius_m == 0.075
        assert load_wafer(path).diameter_m == 0.15


def test_reticles_of_a_stepper_stay_larger():
    """Also where a process is written with every number given, as calibrations and pre-compensations do."""
    stepper = STOCK["stepper"].process(Levels(16, 75e-9))
    assert process_from_spec(spec_from_process(stepper)).reduction == stepper.reduction == 5
    assert process_from_spec(load_spec(AUTOMOTIVE, ['process.stock="stepper"']).process).reduction == 5
    assert process_from_spec(load_spec(AUTOMOTIVE, ["process.reduction=4"]).process).reduction == 4
    assert "process.reduction" in refusal(load_spec, AUTOMOTIVE, ["process.reduction=0"])
    with pytest.raises(InputError, match="process: reduction: must be a whole number, 1 or more"):
        replace(stepper, reduction=0)


def test_a_process_in_full(written: Callable[..., Path]):
    spec = load_process(written("[process]" + FULL))
    process = process_from_spec(spec)
    stock = STOCK["contact_aligner"]
    assert process.levels == Levels(16, 75e-9)
    assert process.order == (3, 0, 1, 2)
    assert (process.tone, process.minimum_line_m, process.minimum_space_m) == ("dark", 1.5e-6, 1.2e-6)
    assert (process.die_m, process.wafer_radius_m, process.name) == ((0.0, 0.03), 0.075, "contact_aligner")
    spreads = process.spreads
    assert [spreads[f"overlay_x_m[{k}]"] for k in range(4)] == [Normal(0, 0.2e-6)] * 4
    assert [spreads[f"overlay_y_m[{k}]"].sigma for k in range(4)] == pytest.approx([1e-7, 2e-7, 3e-7, 4e-7], rel=1e-15)
    assert [spreads[f"cd_bias_m[{k}]"] for k in (0, 2)] == [Normal(1e-7, 5e-8), Normal(-1e-7, 5e-8)]
    # What is said of an error replaces both its numbers: no sigma here, though the stock process has one.
    assert spreads["sidewall_rad"].mean == pytest.approx(math.radians(3), rel=1e-14)  # fifteen digits of text
    assert spreads["sidewall_rad"].sigma == 0
    assert spreads["rotation_rad[3]"] == Normal(0, 20e-6)
    assert "roughness_m" not in spreads
    # What is not said comes from the stock process.
    assert spreads["etch_lag"] == stock.errors["etch_lag"][:2]
    assert process.defects == Defects(
        particles_per_m2=0.05e6,
        particle_radius_m=stock.defects["particle_radius_m"].value,
        pinholes_per_m2=stock.defects["pinholes_per_m2"].value,
        pinhole_radius_m=stock.defects["pinhole_radius_m"].value,
        missed=0.01,
    )


@pytest.mark.parametrize("name", STOCK)
def test_a_stock_process_alone_has_all_its_numbers(name: str):
    process = process_from_spec(ProcessSpec(levels=8, level_step_m=150e-9, stock=name))
    stock = STOCK[name]
    expected = {
        flat: Normal(typical.mean, typical.sigma)
        for error, typical in stock.errors.items()
        for flat in error_names(3, error)
    }
    assert process.spreads == expected
    assert process.minimum_line_m == stock.minimum_line_m.value
    assert vars(process.defects) == {key: figure.value for key, figure in stock.defects.items()}


def test_a_process_that_says_nothing_of_errors_is_ideal_and_leaves_no_trace():
    spec = load_spec(QUICK, [IDEAL])
    assert process_from_spec(spec.process) == Process(Levels(spec.process.levels, spec.process.level_step_m))
    # The very keys of a spec before there were errors, so digests of older runs still hold.
    assert list(spec_to_json(spec)["process"]) == ["levels", "level_step_m", "chrome_overlap_m"]
    assert "limits" not in spec_to_json(spec)
    for word in ("errors", "defects", "limit"):
        assert word not in spec_to_toml(spec)


def test_nothing_said_and_the_same_said_are_one_digest_only_where_they_mean_one():
    base = load_spec(DSLR, ["process.stock=contact_aligner"])
    same = load_spec(DSLR, ["process.stock=contact_aligner", "process.errors={}", "process.defects={}", "limit=[]"])
    assert spec_digest(same) == spec_digest(base)
    assert spec_digest(load_spec(QUICK, ["process.errors.overlay_x=0 nm"])) != spec_digest(base)  # overrides a stock
    short = load_spec(QUICK, ["process.errors.overlay_x=0.5 um"])
    long = load_spec(QUICK, ['process.errors.overlay_x={mean = "0 um", sigma = "500 nm"}'])
    assert short == long
    assert spec_digest(short) == spec_digest(long)


def test_a_whole_spec_reads_back(tmp_path: Path):
    text = AUTOMOTIVE.read_text("utf-8")
    start, end = text.index("[process]"), text.index("[scene]")
    path = tmp_path / "full.toml"
    path.write_text(text[:start] + "[process]" + FULL + text[end:], "utf-8")
    spec = load_spec(path)
    again = tmp_path / "again.toml"
    again.write_text(spec_to_toml(spec), "utf-8")
    assert load_spec(again) == spec == spec_from_json(spec_to_json(spec), "manifest.json")
    assert len({spec_digest(load_spec(again)), spec_digest(spec)}) == 1
    assert load_process(path) == spec.process  # a spec is a process file, too
    assert pickle.loads(pickle.dumps(spec)) == spec
    for line in ("overlay_x", 'overlay_x = "200 nm"', 'sidewall = { mean = "3 deg" }', 'rotation = "20 urad"'):
        assert line in again.read_text("utf-8")


def test_limits_of_the_automotive_example():
    limits = load_spec(AUTOMOTIVE).limits
    assert [(limit.quantity, limit.min, limit.max) for limit in limits] == [
        ("zeroth_order", None, 0.25),
        ("ring_to_disc", 1.2, None),
    ]
    spec = load_spec(AUTOMOTIVE, ["limit.1.colour=656nm", "limit.1.depth=5 cm", "limit.1.max=9.0"])
    assert spec.limits[1] == LimitSpec(quantity="ring_to_disc", min=1.2, max=9.0, colour="656nm", depth_m=0.05)


def test_a_limit_may_hold_at_infinity(tmp_path: Path):
    changes = ['scene.far=["5 m", "inf"]', 'limit=[{quantity = "far_spot", min = 0.3, depth = "inf"}]']
    spec = load_spec(AUTOMOTIVE, changes)
    assert spec_warnings(spec) == []
    assert spec_to_json(spec)["limits"] == [{"quantity": "far_spot", "min": 0.3, "depth_m": "inf"}]
    assert spec_from_json(spec_to_json(spec), "manifest.json") == spec
    path = tmp_path / "spec.toml"
    path.write_text(spec_to_toml(spec), "utf-8")
    assert load_spec(path) == spec


# --- what is refused --------------------------------------------------------------------------------------------------

E = "process.errors."
REFUSED = [
    # key, its new value, and what the message must say
    (f"{E}overlay_z", '"1 um"', ["overlay_z", "a known key of [process.errors]", "Did you mean `overlay_y`?"]),
    (f"{E}overlay_x_m", "1e-6", ["overlay_x_m", "Did you mean `overlay_x`?"]),
    ("process.overlay_x", '"1 um"', ["process.overlay_x", "It belongs to [process.errors]."]),
    ("process.particles_per_mm2", "1.0", ["It belongs to [process.defects]."]),
    ("process.stock", '"contact_alinger"', ["process.stock", "a known process", "Did you mean `contact_aligner`?"]),
    (f"{E}overlay_x", "1", [f"{E}overlay_x: must be a number with a unit", "got 1."]),
    (f"{E}overlay_x", '"1 deg"', [f"{E}overlay_x: ", "a number with a unit", 'got "1 deg"']),
    (f"{E}rotation", '"1 um"', [f"{E}rotation: ", 'a unit such as "2 deg"', 'got "1 um"']),
    (f"{E}overlay_x", '["1 um", "2 um"]', [f"{E}overlay_x: must have one entry per mask, 4 for 16", "a list of 2"]),
    (f"{E}overlay_x", '["1 um", "2 um", "x", "1 um"]', [f"{E}overlay_x[2]: ", 'got "x"']),
    (
        f"{E}overlay_x",
        '{mean = "1 um", sigma = ["1 um"]}',
        [f"{E}overlay_x.sigma: ", "one entry per mask", "all masks"],
    ),
    (f"{E}overlay_x", '{men = "1 um"}', [f"{E}overlay_x.men", "Did you mean `mean`?"]),
    (f"{E}overlay_x", '"101 um"', [f"{E}overlay_x: ", "between 0 nm and 100 um", "101 um"]),
    (f"{E}cd_bias", '{mean = "-0.11 mm"}', [f"{E}cd_bias.mean: ", "between -100 um and 100 um"]),
    (f"{E}common_cd_bias", '"-1 nm"', [f"{E}common_cd_bias: ", "between 0 nm and 100 um", '"-1 nm"']),
    (f"{E}depth_scale", "0.51", [f"{E}depth_scale: ", "between 0 and 0.5", "0.51", "Write 5 % as 0.05."]),
    (f"{E}depth_scale", '"2 %"', [f"{E}depth_scale: must be a number", '"2 %"', "Write 5 % as 0.05."]),
    (f"{E}depth_scale", "nan", [f"{E}depth_scale: ", "between 0 and 0.5", "nan"]),
    (f"{E}depth_scale", "true", [f"{E}depth_scale: must be a number", "true"]),
    (f"{E}sidewall", '"46 deg"', [f"{E}sidewall: ", "between 0 deg and 45 deg", '"46 deg"']),
    (f"{E}sidewall", '{mean = "-1 deg"}', [f"{E}sidewall.mean: ", "between 0 deg and 45 deg", '"-1 deg"']),
    (f"{E}etch_lag", "{mean = -0.1}", [f"{E}etch_lag.mean: ", "between 0 and 0.5"]),
    (f"{E}rotation", '"2 deg"', [f"{E}rotation: ", "between 0 deg and 1 deg"]),
    (f"{E}magnification", "0.02", [f"{E}magnification: ", "between 0 and 0.01"]),
    (f"{E}roughness", '"2 um"', [f"{E}roughness: ", "between 0 nm and 1 um"]),
    (f"{E}corner_radius", '["1 um"]', [f"{E}corner_radius: must be one value", "the whole plate", "Remove the"]),
    ("process.errors", "3", ["process.errors: must be a table", "got 3"]),
    (
        "process.etches",
        "[{mask = 0}, {mask = 1}]",
        ["process.etches: every mask of 16 levels, 0 to 3", "mask 2: 0 times"],
    ),
    ("process.etches", "[{mask = 0}, {mask = 1}, {mask = 2}, {mask = 4}]", ["mask 3: 0 times", "mask 4"]),
    ("process.etches", "[{mask = 0}, {mask = 0}, {mask = 2}, {mask = 3}]", ["mask 0: 2 times, mask 1: 0 times"]),
    (
        "process.etches",
        '[{mask = 0}, {mask = 1, depth = "140 nm"}, {mask = 2}, {mask = 3}]',
        ["process.etches[1].depth: mask 1 must etch 2^1 level steps, 150 nm", "got 140 nm", "leave it out"],
    ),
    ("process.etches", "{mask = 1}", ["process.etches: must be a list", "Write [[process.etches]] tables."]),
    ("process.etches", "[{}]", ["process.etches[0].mask: must be given", "For example `mask = 0`."]),
    ("process.tone", '"claer"', ["process.tone: must be one of clear, dark", "Did you mean `clear`?"]),
    ("process.die", '["1 mm"]', ["process.die[1]: must be given"]),
    ("process.die", '["0 mm", "48 mm"]', ["process.die: the DOE must lie on the wafer of radius 50 mm", "50.22 mm"]),
    ("process.wafer_radius", '"2 mm"', ["process.die: the DOE must lie on the wafer of radius 2 mm"]),
    ("process.wafer_radius", '"1 m"', ["process.wafer_radius: must lie between 500 um and 250 mm"]),
    ("wafer", '{diameter = "1 um"}', ["wafer.diameter: must lie between 1 mm and 500 mm"]),
    ("process.minimum_line", '"2 mm"', ["process.minimum_line: ", "between 0 nm and 1 mm"]),
    ("process.defects.missed", "1.2", ["process.defects.missed: ", "between 0 and 1", "1.2"]),
    ("process.defects", "{missed = 0.6, doubled = 0.6}", ["sum to at most 1", "0.6 + 0.6"]),
    ("process.defects.particle_per_mm2", "1.0", ["Did you mean `particles_per_mm2`?"]),
    ("process.defects.particles_per_mm2", "-1.0", ["process.defects.particles_per_mm2: ", "between 0 and 10000"]),
    ("limit", "[{max = 0.1}]", ["limit[0].quantity: must be given", 'For example `quantity = "zeroth_order"`.']),
    (
        "limit",
        '[{quantity = "zeroth", max = 0.1}]',
        ["limit[0].quantity: must be one of", "Did you mean `zeroth_order`?"],
    ),
    ("limit", '[{quantity = "strehl"}]', ["limit[0]: must state min, max or both", "For example `max = 0.05`."]),
    ("limit", '[{quantity = "strehl", min = 0.9, max = 0.1}]', ["limit[0]: min must not exceed max, 0.9 > 0.1"]),
    ("limit", '[{quantity = "zeroth_order", max = 5}]', ["limit[0].max: must lie between 0 and 1", "5 % as 0.05"]),
    ("limit", '[{quantity = "ring_to_disc", min = -1.0}]', ["limit[0].min: must be at least 0"]),
    (
        "limit",
        '[{quantity = "strehl", min = 0.1, colour = "red"}]',
        ["limit[0].colour: ", "one of 656nm, 589nm, 486nm"],
    ),
    ("limit", '[{quantity = "strehl", min = 0.1, depth = "5"}]', ["limit[0].depth: ", "a number with a unit"]),
    ("limit", "{}", ["limit: must be a list", "Write [[limit]] tables."]),
    ("limits", "[]", ["limits: must be a known key of the spec", "Did you mean `limit`?"]),
]


@pytest.mark.parametrize(("key", "value", "parts"), REFUSED, ids=[f"{key}={value}" for key, value, _ in REFUSED])
def test_a_mistake_is_named_with_key_rule_value_and_cure(key: str, value: str, parts: list[str]):
    message = refusal(load_spec, AUTOMOTIVE, [f"{key}={value}"])
    assert message.startswith(("overrides: ", str(AUTOMOTIVE)))
    for part in parts:
        assert part in message
    assert len(message.splitlines()) == 1


def test_largest_values_are_allowed():
    spec = load_spec(
        AUTOMOTIVE,
        [
            f"{E}overlay_x=100 um",
            f"{E}depth_scale=0.5",
            f'{E}cd_bias={{mean = "-100 um"}}',
            f"{E}sidewall=45 deg",
            "sensor.defocus=-10 mm",
            "optics.focal_length=50 mm",
        ],
    )
    assert process_from_spec(spec.process).spreads["cd_bias_m[2]"].mean == pytest.approx(
        -1e-4, rel=1e-12
    )  # the bound's slack
    assert spec.sensor.defocus_m == -0.01


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        (["process.minimum_line=2 um"], "process.minimum_line: cells of 1.85 um are finer than the lines of 2 um"),
        (["process.minimum_space=2 um"], "process.minimum_space: cells of 1.85 um are finer than the gaps of 2 um"),
        (
            ["doe.pitch=0.9 um", "doe.samples=4934", "doe.aperture=4.4406 mm"],
            "process.minimum_line: cells of 900 nm are finer than the lines of 1 um",  # said by the stock process
        ),
        (['limit=[{quantity = "strehl", min = 0.5, depth = "7 cm"}]'], "limit[0]: strehl at 70 mm limits nothing"),
        (
            ['limit=[{quantity = "far_spot", min = 0.5, depth = "5 cm"}]'],
            "limit[0]: far_spot at 50 mm limits nothing; the scene's far depths are: 5 m, 10 m.",
        ),
        (
            ["scene.near=[]", "objective=[{name = 'far_spot'}]"],
            "limit[1]: ring_to_disc limits nothing; the scene's near depths are: none.",
        ),
    ],
)
def test_doubts_are_said(overrides: list[str], part: str):
    assert any(warning.startswith(part) for warning in spec_warnings(load_spec(AUTOMOTIVE, overrides)))


# --- a process of its own ---------------------------------------------------------------------------------------------

# Numbers with all their bits, as a fit gives them; none in the denormal range, where text with a unit loses digits.
_digits = st.floats(1e-12, 1.0).filter(lambda x: x > 0)


@st.composite
def processes(draw: st.DrawFn) -> Process:
    masks = draw(st.integers(1, 6))
    largest = {"1": 0.009, "m": 1e-6, "rad": 0.017}  # within every error's bounds
    chosen = draw(st.lists(st.sampled_from(error_names(masks)), unique=True, max_size=12))
    spreads = {}
    for name in chosen:
        error = DEVIATIONS[name.partition("[")[0]]
        sign = 1 if error.one_sided else draw(st.sampled_from([-1, 1]))
        spreads[name] = Normal(sign * draw(_digits) * largest[error.unit], draw(_digits) * largest[error.unit])
    return Process(
        Levels(2**masks, float(f"{draw(st.floats(1e-9, 1e-6)):.17g}")),
        order=tuple(draw(st.permutations(range(masks)))),
        spreads=spreads,
        defects=Defects(
            particles_per_m2=draw(st.integers(0, 10**6)) * 1e3, missed=draw(_digits) / 2, doubled=draw(_digits) / 2
        ),
        tone=draw(st.sampled_from(["clear", "dark"])),
        minimum_line_m=draw(_digits) * 1e-3,
        die_m=(draw(st.floats(-0.02, 0.02)), draw(st.floats(-0.02, 0.02))),
    )


@given(process=processes())
def test_a_process_survives_its_file_to_the_last_bit(process: Process, tmp_path_factory: pytest.TempPathFactory):
    like = ProcessSpec(levels=2, level_step_m=75e-9, chrome_overlap_m=3e-6, stock="stepper")
    spec = spec_from_process(process, like)
    path = tmp_path_factory.mktemp("process") / "process-estimate.toml"
    path.write_text(process_to_toml(spec, ["fitted to measurements", "two\nlines"]), "utf-8")
    assert load_process(path) == spec
    assert (spec.chrome_overlap_m, spec.stock) == (3e-6, None)
    again = process_from_spec(load_process(path))
    # The name says where a process came from, and no number.
    assert replace(again, name=process.name, defects=process.defects) == process
    # Densities are per mm2 in a file: a division and a multiplication, each rounded.
    assert vars(again.defects) == pytest.approx(vars(process.defects), rel=3e-16, abs=0)


@pytest.mark.parametrize("name", [None, *STOCK])
def test_a_stock_process_said_in_full_is_the_same(name: str | None):
    spec = ProcessSpec(levels=16, level_step_m=75e-9, stock=name)
    said = spec_from_process(process_from_spec(spec), spec)
    assert said.stock is None
    assert replace(process_from_spec(said), name=name or "ideal") == process_from_spec(spec)
    assert said.filled().errors == spec.filled().errors
    text = process_to_toml(said)
    # Round numbers stay round on their way through SI units.
    assert not any(
        len(digits) > 7 for digits in text.replace('"', " ").replace("_", " ").split() if digits[0].isdigit()
    )


def test_a_process_beyond_what_a_spec_may_hold_is_refused():
    process = Process(Levels(2, 75e-9), spreads={"depth_scale[0]": Normal(0.6, 0.01)}, name="estimate")
    message = refusal(spec_from_process, process, ProcessSpec(levels=2, level_step_m=75e-9))
    assert "process estimate: process.errors.depth_scale.mean: must lie between -0.5 and 0.5, but got 0.6." in message


def test_mistakes_in_a_process_file(written: Callable[..., Path], tmp_path: Path):
    path = written('[process]\nlevels = 16\nlevel_step = "75 nm"\n[process.errors]\noverlay_x = ["1 um"]\nover = 1\n')
    assert f"{path}: process.errors.over: must be a known key of [process.errors]" in refusal(load_process, path)
    path = written('[process]\nlevels = 16\nlevel_step = "75 nm"\n[process.errors]\noverlay_x = ["1 um"]\n')
    assert f"{path}: process.errors.overlay_x: must have one entry per mask" in refusal(load_process, path)
    path = written('[proces]\nlevels = 16\nlevel_step = "75 nm"\n')
    message = refusal(load_process, path)
    assert "proces: must be a known key of the spec, but got `proces`. Did you mean `process`?" in message
    assert len(message.splitlines()) == 1
    message = refusal(load_process, written("[glass]\nlevels = 16\n"))
    assert "process: must be given, but got nothing. Add a table [process]." in message
    assert "a process must be valid TOML" in refusal(load_process, written("[process\n"))
    assert str(tmp_path / "none.toml") in refusal(load_process, tmp_path / "none.toml")


def test_foreign_values_are_no_process():
    assert "process.levels: must be given" in refusal(process_from_json, {"level_step_m": 75e-9}, "x.json")
    data = {"levels": 4, "level_step_m": 75e-9, "errors": {"cd_bias_m": {"sigma": [1e-7]}}}
    assert "x.json: process.errors.cd_bias.sigma: must have one entry per mask" in refusal(
        process_from_json, data, "x.json"
    )


# --- the errors of one plate ------------------------------------------------------------------------------------------

_value = st.floats(-1e-3, 1e-3, allow_subnormal=False)
_positive = st.floats(0, 1e-3, allow_subnormal=False)
_place = st.floats(-1e-2, 1e-2, allow_subnormal=False)


@st.composite
def variations(draw: st.DrawFn) -> Variation:
    masks = draw(st.integers(1, 6))
    values: dict[str, object] = {}
    for name, error in DEVIATIONS.items():
        one = _positive if error.one_sided else _value
        lists = st.just(()) | st.tuples(*[one] * masks)
        values[name] = draw(lists if error.per_mask else one)
    repeats = draw(st.just(()) | st.tuples(*[st.integers(-1, 1)] * masks))
    discs = draw(st.lists(st.tuples(st.integers(0, masks - 1), _place, _place, _positive), max_size=3))
    return Variation(
        **values,  # type: ignore[arg-type]
        repeats=repeats,
        particles=tuple(MaskDisc(*disc) for disc in discs),
        pinholes=tuple(Disc(*disc[1:]) for disc in discs),
        seed=draw(st.integers(0, 2**63 - 1)),
    )


@given(variation=variations())
def test_a_variation_survives_its_file_to_the_last_bit(variation: Variation, tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("variation") / "variation.toml"
    path.write_text(variation_to_toml(variation, ["draw 7"]), "utf-8")
    assert load_variation(path) == variation


def test_a_variation_as_a_person_writes_it(written: Callable[..., Path]):
    path = written(
        """
        [variation]
        common_depth_scale = 0.02
        depth_scale = [0.02, 0.02, 0.01, 0]
        overlay_x = ["0.3 um", "-0.1 um", "0 um", "0.2 um"]
        rotation = ["1 urad", "0 deg", "0 deg", "-0.5 mrad"]
        sidewall = "5 deg"
        repeats = [0, 0, -1, 0]

        [[particle]]
        mask = 2
        x = "0.1 mm"
        y = "-0.3 mm"
        radius = "4 um"

        [[pinhole]]
        x = "1 mm"
        y = "2 mm"
        radius = "3 um"
        """
    )
    assert load_variation(path) == Variation(
        common_depth_scale=0.02,
        depth_scale=(0.02, 0.02, 0.01, 0.0),
        overlay_x_m=(0.3e-6, -0.1e-6, 0.0, 0.2e-6),
        rotation_rad=(1e-6, 0.0, 0.0, -0.5e-3),
        sidewall_rad=0.0872664625997165,  # five degrees to fifteen digits
        repeats=(0, 0, -1, 0),
        particles=(MaskDisc(2, -0.3e-3, 0.1e-3, 4e-6),),
        pinholes=(Disc(2e-3, 1e-3, 3e-6),),
    )
    text = variation_to_toml(load_variation(path))
    for line in ('rotation = ["1 urad", "0 deg", "0 deg", "-500 urad"]', 'sidewall = "5 deg"', "mask = 2"):
        assert line in text


def test_a_nominal_plate_is_an_empty_table(written: Callable[..., Path]):
    assert variation_to_toml(Variation()) == "[variation]\n"
    assert load_variation(written("[variation]")) == Variation()
    assert load_variation(written("[variation]")).nominal


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["variation: must be given", "Add a table [variation]."]),
        ("[variaton]", ["Did you mean `variation`?"]),
        ("[variation]\noverlay = 1", ["variation.overlay: must be a known key of [variation]", "Did you mean"]),
        ('[variation]\noverlay_x = "1 um"', ["variation.overlay_x: must be a list in [ ]"]),
        ('[variation]\noverlay_x = ["1"]', ["variation.overlay_x[0]: must be a number with a unit"]),
        ('[variation]\ncorner_radius = "-1 um"', ["variation.corner_radius: must be finite and not neg", '"-1 um"']),
        ('[variation]\nsidewall = "-1 deg"', ["variation.sidewall: must be finite and not negative"]),
        ("[variation]\netch_lag = -1", ["variation.etch_lag: must be finite and not negative"]),
        ("[variation]\netch_lag = inf", ["variation.etch_lag: must be finite"]),
        (f"[variation]\ndepth_scale = [1{'0' * 400}]", ["variation.depth_scale[0]: must be a number"]),
        ("[variation]\nrepeats = [-2]", ["variation.repeats[0]: must be at least -1"]),
        (
            '[variation]\ndepth_scale = [0.1, 0.1]\noverlay_x = ["1 um"]',
            ["variation.overlay_x: must have one entry per mask, 2 as in variation.depth_scale", "a list of 1"],
        ),
        (
            '[variation]\nrepeats = [0, 0]\n[[particle]]\nmask = 2\nx = "1 um"\ny = "1 um"\nradius = "1 um"',
            ["particle[0].mask: must be one of the 2 masks of variation.repeats", "got 2"],
        ),
        ("[variation]\n[[particle]]\nmask = 2", ["particle[0].x: must be given", 'For example `x = "0.1 mm"`.']),
        ("[variation\n", ["a variation must be valid TOML"]),
    ],
)
def test_mistakes_in_a_variation_file(text: str, parts: list[str], written: Callable[..., Path]):
    path = written(text)
    message = refusal(load_variation, path)
    assert message.startswith(str(path))
    for part in parts:
        assert part in message


def test_what_no_plate_can_have_is_not_written():
    with pytest.raises(ValueError, match="corner_radius"):
        variation_to_toml(Variation(corner_radius_m=-1e-6))
    with pytest.raises(ValueError, match="overlay_x"):
        variation_to_toml(Variation(overlay_x_m=(math.nan,)))


def test_a_whole_spec_has_the_process_of_its_table():
    spec = load_spec(QUICK)
    assert process_from_spec(spec) == process_from_spec(spec.process)
