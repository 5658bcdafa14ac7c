"""The page of a run: what it gathers, when a part appears, and what it refuses."""

import base64
import csv
import json
import math
import re
import shutil
import zlib
from html import unescape
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

import doedesign as dd
import sim
from doedesign.report.page import tiles
from doedesign.report.page.blocks import (
    BarBlock,
    ChartBlock,
    DividerBlock,
    MapBlock,
    PageContent,
    PictureBlock,
    PsfBlock,
    TableBlock,
)
from doedesign.report.page.compare import compared
from doedesign.report.page.files import open_files, picture_image, safe_json
from doedesign.report.page.gather import gather
from doedesign.report.page.maps import height_block
from doedesign.report.page.numbers import LABELS, SHARES
from doedesign.report.page.reached import asked_block, reached_section
from doedesign.report.page.write import watch_report
from doedesign.runs.folder import LEVEL_MAP, alone_in, load_checkpoint, open_run
from doedesign.runs.results import results_folder
from doedesign.spec.models import ObjectiveSpec
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, sha256_bytes, sha256_file
from fab.grid import Grid
from fab.level_map import LevelMap, read_level_map
from fab.levels import Levels
from fab.order.write import write_order
from sim.metrics import METRICS
from sim.store import read_stored_bank, write_bank
from tests.doedesign.small_runs import SPREAD, call

# As `tolerance` writes them, of three plates of which one breaks a limit.
_ROW = {"colour": "550 nm", "depth_m": None, "key": "nominal", "strehl": 1.0, "zeroth_order": 0.3}
_SPREAD = {"max": 0.99, "mean": 0.93, "median": 0.95, "min": 0.85, "p05": 0.86, "p95": 0.985, "std": 0.06}
_WORST = {"colour": None, "depth_m": None, **_SPREAD}
_SHARE = {"share": 2 / 3, "low": 0.2, "high": 0.94, "good": 2, "plates": 3}
_EFFECT = {"error": "overlay_x_m[1]", "source": "overlay", "quantity": "strehl", "colour": None}
PLATES: dict[str, Any] = {
    "count": 3,
    "statistics": [{"quantity": name, **_WORST} for name in ("strehl", "zeroth_order")],
    "yield": {**_SHARE, "limits": [{"limit": "strehl >= 0.9", **_SHARE}]},
}
STUDY: dict[str, Any] = {
    "design": "small",
    "plan": {"draws": 3, "wanted": 0.9},
    "seed": 0,
    "nominal": [_ROW],
    "one_at_a_time": [{**_EFFECT, "low": 0.9, "expected": 1.0, "high": 0.91, "variance": 0.01}],
    "plates": PLATES,
    "shares": {"strehl": {"overlay": 0.8, "depth": 0.2}},
}
DRAWS = "key,colour,depth_m,strehl,zeroth_order\n" + "".join(
    f"normal/{k},550 nm,inf,{value},0.3\n" for k, value in enumerate((0.85, 0.95, 0.99))
)


def made(folder: Path, spec: str) -> Path:
    """Optimise a spec into FOLDER/run, with its pictures."""
    (folder / "small.toml").write_text(spec)
    code, _, told = call("optimize", folder / "small.toml", "--out", folder / "run")
    assert code == 0, told
    return folder / "run"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with PSFs and a tolerance study."""
    run = made(tmp_path_factory.mktemp("page"), SPREAD)
    design = dd.open_design(run, False)
    with results_folder(run / "psf", "small", run) as folder:
        assert folder is not None
        write_bank(folder / "quantised.exr", sim.psf(design, depths=["6 mm", "inf"]))
    write_study(run, STUDY)
    return run


def write_study(run: Path, study: dict[str, Any]) -> None:
    with results_folder(run / "tolerance", "small", run) as folder:
        assert folder is not None
        (folder / "results.json").write_bytes(canonical_json(study))
        (folder / "draws.csv").write_text(DRAWS)


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run that may be changed."""
    return Path(shutil.copytree(finished, tmp_path / "runs" / "small"))


def blocks(content: PageContent, kind: type) -> list[Any]:
    return [block for part in content.sections for block in part.blocks if isinstance(block, kind)]


def names(content: PageContent) -> list[str]:
    return [part.name for part in content.sections]


def bars(content: PageContent) -> dict[str, Any]:
    return {bar.label: bar for block in blocks(content, BarBlock) for bar in block.bars}


def test_parts_appear_when_their_data_exist(run: Path):
    assert names(gather(run)) == ["reached", "map", "light", "budget", "tolerance", "provenance"]
    for folder in ("psf", "tolerance"):
        shutil.rmtree(run / folder)
    content = gather(run)
    assert names(content) == ["reached", "map", "light", "budget", "provenance"]
    assert blocks(content, PsfBlock) == []


def test_what_was_asked_stands_beside_what_was_reached(run: Path):
    found, metrics = bars(gather(run)), json.loads((run / "metrics.json").read_text())
    near, far = metrics["psf"]
    assert found["light in the far spot"].value == pytest.approx(far["far_spot"])
    spread = found["concentration of near light"]
    assert (spread.value, spread.mark) == pytest.approx((near["concentration"], near["concentration_bound"]))
    assert found["plates that obey every limit"].state == "missed"
    assert found["plates that obey every limit"].mark == 0.9
    assert found["overlay"].value == 0.8
    drawn = found["as drawn, a thin element"]
    assert drawn.value == pytest.approx(far["zeroth_order"])
    fabricated = found["as fabricated, 3 plates, their worst colour"]
    assert (fabricated.low, fabricated.value, fabricated.high) == (0.86, 0.95, 0.985)
    write_study(run, STUDY | {"plates": PLATES | {"yield": None}})
    assert "No limits were given" in blocks(gather(run), BarBlock)[-1].note


@pytest.mark.parametrize(
    ("name", "quantity", "label"),
    [
        ("ring_to_disc", "ring_to_disc", "ring:disc of near light"),
        ("window_share", "throughput", "throughput, light in the window"),
    ],
)
def test_what_an_objective_keeps_from_below_is_marked(run: Path, name: str, quantity: str, label: str):
    """Met where every colour and depth reaches it."""
    files, metrics = open_files(run), json.loads((run / "metrics.json").read_text())
    least = min(row[quantity] for row in metrics["psf"] if row.get(quantity) is not None)
    for share, state in ((0.9, "met"), (1.1, "missed")):
        asked = ObjectiveSpec.model_validate({"name": name, "options": {"least": share * least}})
        objectives = (*files.spec.objectives, asked)
        block = asked_block(files._replace(spec=files.spec.model_copy(update={"objectives": objectives})), metrics)
        assert block is not None
        bar = next(bar for bar in block.bars if bar.label == label)
        assert (bar.mark, bar.state) == (pytest.approx(share * least), state)


@pytest.mark.parametrize(
    ("over", "value", "text", "state"),
    [
        ((1.0, 1.0, 1.0), 1.0, "100.00 %", ""),
        ((1.0, None, None), 3.0, "2 of 3 beyond 400 %, others 100.00 %", "missed"),
        ((1.0, 1.5, None), 6.5 / 3, "1 of 3 beyond 400 %, others 125.00 % (100.00 % to 150.00 %)", "missed"),
        ((None, None), 4.0, "2 of 2 beyond 400 %", "missed"),
    ],
)
def test_foci_too_wide_to_have_a_width_are_told(
    run: Path, over: tuple[float | None, ...], value: float, text: str, state: str
):
    wanted = {"width_wanted_m": 1e-5, "strength": 0.5, "share": 0.5}
    widths = [None if one is None else 1e-5 * one for one in over]
    foci = [{"width_x_m": width, "width_y_m": 1e-5, **wanted} for width in widths]
    block = asked_block(open_files(run), {"focus": {"foci": foci}})
    assert block is not None
    bar = next(bar for bar in block.bars if bar.label.startswith("width of the foci"))
    assert (bar.value, bar.text, bar.state) == (pytest.approx(value), text, state)


@pytest.mark.parametrize(
    ("wanted", "title"), [(True, "0th order (one of the spots)"), (False, "0th order"), (None, "0th order")]
)
def test_a_zeroth_order_that_is_a_spot_is_told_as_one(run: Path, wanted: bool | None, title: str):
    metrics = json.loads((run / "metrics.json").read_text())
    if wanted is not None:
        orders = {"on_target": 0.9, "uniformity_error": 0.001, "spots": [0.1], "zeroth_order_wanted": wanted}
        metrics["orders"] = orders
    part = reached_section(open_files(run), metrics, ())
    assert part is not None
    assert title in [block.title for block in part.blocks if isinstance(block, BarBlock)]


def test_a_zeroth_order_within_the_area_is_told_as_that(run: Path):
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["area"] = {"on_target": 0.9, "contrast": 0.1, "zeroth_order_wanted": True}
    part = reached_section(open_files(run), metrics, ())
    assert part is not None
    assert "0th order (within the area)" in [block.title for block in part.blocks if isinstance(block, BarBlock)]


def test_curves_are_those_of_the_table(run: Path):
    charts = {chart.title: chart for chart in blocks(gather(run), ChartBlock)}
    near, far = (charts[f"MTF, source at {depth}"] for depth in ("6 mm", "∞"))
    assert (near.x_log, far.x_log) == (True, False)
    rows = [row for row in csv.DictReader((run / "mtf.csv").read_text().splitlines()) if row["depth_m"] == "inf"]
    plate, without = far.series
    assert far.x == tuple(float(row["frequency_per_mm"]) for row in rows)
    assert plate.y == tuple(float(row["design"]) for row in rows)
    assert without.y == tuple(float(row["without"]) for row in rows)
    assert (plate.hue, without.hue, without.dashed) == (0, 0, True)
    assert charts["Encircled energy, source at 6 mm"].x_label == "radius (µm)"
    # Without the tables, as in runs of before, the pictures stand there.
    record = json.loads((run / MANIFEST_NAME).read_text())
    for name in ("mtf.csv", "encircled.csv"):
        del record["results_sha256"][name]
    (run / MANIFEST_NAME).write_bytes(canonical_json(record))
    assert {"MTF", "Encircled energy"} <= {block.title for block in blocks(gather(run), PictureBlock)}


def test_histograms_count_every_plate_once(run: Path):
    charts = [chart for chart in blocks(gather(run), ChartBlock) if chart.title.startswith("Plates by")]
    assert [chart.title for chart in charts] == ["Plates by relative Strehl ratio"]  # the 0th order of all is the same
    counts = charts[0].series[0].y
    assert sum(count for count in counts if count is not None) == 3
    assert (charts[0].x[0], charts[0].x[-1]) == (0.85, 0.99)


def test_the_map_is_that_of_the_run(run: Path):
    level_map = read_level_map(run / LEVEL_MAP)
    block = blocks(gather(run), MapBlock)[0]
    assert block.views == ("height", "mask 1", "mask 2")
    data = block.data
    assert (data["width"], data["height"], data["reductions"]) == (48, 48, [1])
    shown = np.where(level_map.relief.inside(level_map.grid), level_map.level, np.uint8(255))[::-1]
    assert data["whole"] == [[tiles.tile_data(np.ascontiguousarray(shown))]]
    levels = next(table for table in blocks(gather(run), TableBlock) if table.title == "Levels")
    assert len(levels.rows) == 4


def test_psfs_keep_their_light(run: Path):
    block = blocks(gather(run), PsfBlock)[0]
    bank = read_stored_bank(run / "psf" / "quantised.exr")
    assert block.depths == ("6 mm", "∞")
    assert block.data["peak"]["1,0"] == pytest.approx(float(bank.energy[0, 1].max()), rel=1e-4)
    assert set(block.data["pictures"]) == {"0,0,0", "0,1,0"}


@pytest.mark.slow
def test_an_order_adds_its_files(run: Path):
    level_map = read_level_map(run / LEVEL_MAP)
    order = run.parent.parent / "masks" / "small"
    write_order(order, level_map, source={"kind": "run", "level_map_sha256": level_map.digest})
    content = gather(run)
    assert "order" in names(content)
    kinds = [block.kind for part in content.sections if part.name == "order" for block in part.blocks]
    assert {"model", "table"} <= set(kinds)
    glb = next(order.glob("*_RELIEF.glb"))
    glb.write_bytes(glb.read_bytes() + b" ")
    with pytest.raises(InputError, match="must be the file that the manifest lists"):
        gather(run)


@pytest.mark.slow
def test_the_order_of_another_run_is_left_aside_and_refused_if_given(run: Path):
    level_map = read_level_map(run / LEVEL_MAP)
    other = level_map.with_level(np.zeros_like(level_map.level))
    order = run.parent.parent / "masks" / "small"
    write_order(order, other, source={"kind": "run", "level_map_sha256": other.digest})
    assert "order" not in names(gather(run))
    with pytest.raises(InputError, match="must be the mask order of this run"):
        gather(run, order)


def test_no_other_file_is_replaced(run: Path):
    spec = (run / "spec.toml").read_bytes()
    with pytest.raises(InputError, match="a report must not replace another file"):
        dd.write_report(run, out=run / "spec.toml")
    assert (run / "spec.toml").read_bytes() == spec


def test_same_inputs_same_bytes(run: Path, tmp_path: Path):
    first = dd.write_report(run, out=tmp_path / "a.html").read_bytes()
    assert dd.write_report(run, out=tmp_path / "b.html").read_bytes() == first
    assert dd.write_report(run, out=tmp_path / "a.html").read_bytes() == first  # an earlier one is replaced
    code, said, _ = call("report", run, "--json")
    assert code == 0
    path = Path(json.loads(said)["paths"][0])
    assert path == run / "report.html"
    assert path.read_bytes() == first


def test_nothing_on_the_page_needs_a_network(run: Path):
    text = dd.write_report(run).read_text()
    assert "default-src 'none'" in text
    own = re.sub(r"<script[^>]*>.*?</script>|<style>.*?</style>|<pre.*?</pre>", "", text, flags=re.DOTALL)
    addresses = re.findall(r"(?:src|href)=\"([^\"]*)\"", own)
    assert addresses
    assert [one for one in addresses if not one.startswith(("data:", "#"))] == []


EVIL = "</script><img src=x onerror=alert(1)>\u2028&amp;"


def test_text_of_files_is_escaped(run: Path):
    """A name with HTML in it, in every file that a page quotes: spec, manifests, tables."""
    manifest = json.loads((run / MANIFEST_NAME).read_text())
    manifest["version"] = EVIL
    (run / MANIFEST_NAME).write_bytes(canonical_json(manifest))
    found = {**_SHARE, "limits": [{"limit": f"strehl >= 0.9 {EVIL}", **_SHARE}]}
    plates = PLATES | {"yield": found}
    write_study(run, STUDY | {"plates": plates, "shares": {"strehl": {EVIL: 1.0}}})
    text = dd.write_report(run).read_text()
    assert "<img src=x" not in text
    assert f"strehl >= 0.9 {EVIL}" in unescape(text)


def test_data_cannot_end_their_script():
    text = safe_json({"a": EVIL, "b": "<!--<script>"})
    assert "<" not in text
    assert ">" not in text
    assert json.loads(text) == {"a": EVIL, "b": "<!--<script>"}


@pytest.mark.parametrize("file", ["metrics.json", "psf/quantised.exr", "tolerance/results.json", "tolerance/draws.csv"])
def test_changed_files_are_refused(run: Path, file: str):
    with (run / file).open("ab") as stream:
        stream.write(b" ")
    code, said, told = call("report", run)
    assert code == 2
    assert said == ""
    assert file.rpartition("/")[2] in told
    assert "must be the file that the manifest lists" in told
    assert not (run / "report.html").exists()


def test_results_of_another_form_are_refused(run: Path):
    """Such as those of a version to come: the message names the part, and there is no traceback."""
    write_study(run, {"plates": {"count": 3}})
    code, _, told = call("report", run)
    assert code == 2
    assert "small: what was reached: must hold what the commands of this version write" in told
    (run / "trained").mkdir()
    shutil.rmtree(run / "tolerance")
    (run / "trained" / "history.jsonl").write_text('{"step": 0, "loss": "much"}\n')
    code, _, told = call("report", run)
    assert code == 2
    assert "small: training: must hold" in told


def captured(run: Path) -> dict[str, str]:
    """Give the run a simulated item as `simulate` writes it; digests of its pictures by kind."""
    item = run / "simulated" / "0000_cat"
    item.mkdir(parents=True)
    for level, kind in enumerate(("conventional", "capture", "clean")):
        imageio.imwrite(item / f"{kind}.png", np.full((8, 8, 3), 60 * level, np.uint8))
    digests = {path.name: sha256_file(path) for path in sorted(item.iterdir())}
    images = {name.removesuffix(".png"): {"file": name} for name in digests}
    (item / MANIFEST_NAME).write_bytes(canonical_json({"images": images, "sha256": digests}))
    key = f"{item.name}/{MANIFEST_NAME}"
    listed = {"format": "doedesign simulation 1", "results_sha256": {key: sha256_file(item / MANIFEST_NAME)}}
    (item.parent / MANIFEST_NAME).write_bytes(canonical_json(listed))
    return {name.removesuffix(".png"): digest for name, digest in digests.items()}


def test_reconstructions_are_shown_with_their_captures(run: Path):
    capture, folder = captured(run)["capture"], run.parent.parent / "reconstructed"
    folder.mkdir()
    for level, name in enumerate(("cat.png", "cat_beside.png", "dog.png")):
        imageio.imwrite(folder / name, np.full((8, 8 * (level + 1), 3), 200, np.uint8))
    record = {
        name: {"sha256": sha256_file(folder / name), "capture_sha256": of}
        for name, of in {"cat.png": capture, "cat_beside.png": capture, "dog.png": "another run's"}.items()
    }
    (folder / "dog.png").write_bytes(b"changed since")  # which is no picture of this run
    manifest = folder / MANIFEST_NAME
    manifest.write_bytes(canonical_json({"format": "doedesign reconstructions 1", "results": record}))
    ((_, pictures),) = blocks(gather(run), DividerBlock)[0].scenes
    found = dict(pictures)
    assert list(found) == ["camera without the plate", "camera with the plate", "reconstruction", "scene"]
    assert found["reconstruction"] == picture_image(folder / "cat.png", photo=True).source
    (folder / "cat.png").write_bytes(b"changed since")
    with pytest.raises(InputError, match="must be the file that the manifest lists"):
        gather(run)


@pytest.mark.parametrize("text", ["no JSON", "[]", '{"results": {"a.png": {}}}', '{"format": "another program"}'])
def test_what_others_left_in_reconstructed_is_no_part_of_a_run(run: Path, text: str, caplog: pytest.LogCaptureFixture):
    captured(run)
    folder = run.parent.parent / "reconstructed"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"")
    (folder / MANIFEST_NAME).write_text(text)
    assert len(blocks(gather(run), DividerBlock)[0].scenes[0][1]) == 3
    assert "no reconstructions are shown" in caplog.text


def repeated(run: Path) -> list[str]:
    """The commands of a page that make its run and its results again."""
    text = unescape(dd.write_report(run).read_text())
    found = re.findall(r"^.*?(doedesign [a-z]+ .*?)(?:</pre>)?$", text, re.MULTILINE)
    return [line for line in found if "runs/small" in line]


def test_psfs_off_the_axis_are_told_as_such(run: Path, tmp_path: Path):
    bank = sim.psf(dd.open_design(run, False), depths=["6 mm", "inf"], field_rad=(math.radians(1), math.radians(-2)))
    with results_folder(run / "psf", "small", run) as folder:
        assert folder is not None
        write_bank(folder / "quantised.exr", bank)
    ((label,),) = [block.banks for block in blocks(gather(run), PsfBlock)]
    assert label == "as drawn, field angle 1° along y, -2° along x"
    assert f"Off the axis: {label}." in blocks(gather(run), PsfBlock)[0].note
    assert "doedesign psf runs/small --field-deg 1 -2" in repeated(run)
    again, other = (Path(shutil.copytree(run, tmp_path / name)) for name in ("again", "other"))
    with results_folder(other / "psf", "small", other) as folder:
        assert folder is not None
        write_bank(folder / "quantised.exr", sim.PsfBank(bank.energy, bank.colours, bank.depths_m, bank.pixel_m))
    assert [len(blocks(compared([run, one]), PsfBlock)) for one in (again, other)] == [1, 0]


def test_commands_to_repeat_a_run_have_their_options(run: Path):
    """Those that results tell of."""
    plan = {"draws": 8, "wanted": 0.8, "sensitivity": "sobol", "sobol": 32, "corners": True, "budget": "overlay_x"}
    write_study(run, STUDY | {"plan": plan})
    with results_folder(run / "fabricated", "small", run, plate="draw normal/3 of seed 7 of the process small"):
        pass
    with results_folder(run / "explanations", "small", run) as folder:
        assert folder is not None
        targets = {"wavelength_m": 520e-9, "depth_m": 0.1, "ring_to_disc": 1.2}
        targets |= {"throughput": 0.86, "throughput_sigma": 0.02}
        (folder / "explanations.json").write_bytes(canonical_json({"targets": targets, "reach": 4.0}))
    captured(run)
    (run / "evaluation" / "table2-dirt-paper").mkdir(parents=True)
    table = {"table": 2, "pairs": 3, "rows": [], "study": {"obstruction": "dirt", "occlusion": "paper", "seed": 4}}
    (run / "evaluation" / "table2-dirt-paper" / "table.json").write_bytes(canonical_json(table))
    (run / "trained").mkdir()
    trained = {
        "occlusion": "paper",
        "obstruction": "dirt",
        "overrides": ["train.steps=3"],
        "perceptual": "lpips_squeeze",
    }
    (run / "trained" / MANIFEST_NAME).write_bytes(canonical_json(trained))
    (run / "trained" / "pictures.json").write_bytes(canonical_json({"training": ["mine.png"]}))
    assert repeated(run) == [
        "doedesign optimize spec.toml --out runs/small",
        "doedesign psf runs/small",
        "doedesign psf runs/small --fabricated --seed 7 --draw normal/3",
        "doedesign tolerance runs/small --draws 8 --seed 0 --sensitivity sobol --sobol 32 --corners --budget overlay_x "
        "--yield 0.8 --limit 'strehl >= 0.9'",
        "doedesign simulate runs/small",
        "doedesign train runs/small --occlusion paper --obstruction dirt --images PICTURES --lpips-weights WEIGHTS "
        "--set train.steps=3",
        "doedesign evaluate runs/small --table 2 --obstruction dirt --occlusion paper --seed 4 --pairs 3",
        "doedesign calibrate runs/small --ring-to-disc 1.2 --probe '520 nm' --depth '100 mm' --throughput 0.86 "
        "--throughput-sigma 0.02 --reach 4",
        "doedesign report runs/small",
    ]
    masks = {"obstruction": "folder", "obstruction_parameters": {"folder": "my masks"}}
    (run / "trained" / MANIFEST_NAME).write_bytes(canonical_json(masks))
    assert "doedesign train runs/small --obstruction 'my masks' --images PICTURES" in repeated(run)
    with results_folder(run / "fabricated", "small", run, plate="errors of my plate.toml"):
        pass
    assert "doedesign psf runs/small --fabricated --variation 'my plate.toml'" in repeated(run)


def test_a_command_on_the_page_can_be_pasted(run: Path, tmp_path: Path):
    shutil.rmtree(run / "psf")
    named = Path(shutil.copytree(run, tmp_path / "runs" / "my run"))
    notes = [block.note for block in blocks(gather(named), PictureBlock) if block.title == "PSFs"]
    assert notes == ["To look through depths and colours: doedesign psf 'runs/my run', and this report again."]


def test_no_run_no_page(tmp_path: Path):
    code, _, told = call("report", tmp_path / "nothing")
    assert code == 2
    assert "must be a run folder" in told


@pytest.mark.slow
def test_a_run_at_work_shows_its_loss(run: Path, tmp_path: Path):
    """Up to its last checkpoint, also where it was stopped; then, once it is done, all of it."""
    spec = tmp_path / "steps.toml"
    spec.write_text(SPREAD.replace("steps = 0", "steps = 3\ncheckpoint_every = 1"))
    folder = tmp_path / "runs" / "steps"
    halt = iter(range(2))

    def stop(*_: object) -> None:
        if next(halt, None) is None:
            raise KeyboardInterrupt

    from doedesign.runs import folder as folders

    before = folders.save_checkpoint
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("doedesign.optimization.save_checkpoint", lambda *given: (before(*given), stop()))
        assert call("optimize", spec, "--out", folder)[0] == 130
    assert "stopped" in gather(folder).summary[0]
    # Nothing works there, so there is nothing to wait for.
    assert [b"stopped" in path.read_bytes() for path in watch_report(folder, out=tmp_path / "live.html")] == [True]
    with alone_in(folder):
        content = gather(folder)
        pages = watch_report(folder, out=tmp_path / "live.html", every_s=0.01)
        first = next(pages).read_bytes()
    assert names(content)[0] == "history"
    assert "at work" in content.summary[0]
    assert len(blocks(content, ChartBlock)[0].x) >= 2
    # Of one colour, one near and one far depth every step sees all, so that there is no jump to explain.
    assert blocks(content, ChartBlock)[0].note == ""
    terms = next(block for block in blocks(content, TableBlock) if block.title == "Objectives")
    assert terms.note == "Values without weights."
    assert b"at work" in first
    assert call("optimize", spec, "--out", folder)[0] == 0
    assert [path.read_bytes() != first for path in pages] == [True]  # once more, and it ends with the run
    assert load_checkpoint(open_run(folder), []) is None
    assert "map" in names(gather(folder))


@pytest.mark.slow
def test_runs_side_by_side(run: Path, tmp_path: Path):
    other = tmp_path / "other"
    other.mkdir()
    second = made(other, SPREAD.replace('start = "ring"', 'start = "flat"'))
    content = compared([run, second])
    assert [part.name for part in content.sections] == ["reached", "metrics", "maps", "specs"]
    table = next(block for block in blocks(content, TableBlock) if block.title.startswith("Metrics"))
    metrics = [json.loads((one / "metrics.json").read_text())["psf"] for one in (run, second)]
    row = next(row for row in table.rows if row[:2] == ("0th order", "∞"))
    off = metrics[1][1]["zeroth_order"] - metrics[0][1]["zeroth_order"]
    assert row[4].startswith(f"{'+' if off >= 0 else '−'}{100 * abs(off):.2f} %")
    difference = blocks(content, MapBlock)[2]
    changed = read_level_map(run / LEVEL_MAP).level != read_level_map(second / LEVEL_MAP).level
    inside = read_level_map(run / LEVEL_MAP).relief.inside(read_level_map(run / LEVEL_MAP).grid)
    assert f"{100 * changed[inside].mean():.2f} % of the pixels differ" in difference.data["views"][0]["legend"]
    specs = next(block for block in blocks(content, TableBlock) if block.title.startswith("Keys"))
    assert ("optimize.start", "ring", "flat") in specs.rows
    code, said, _ = call("report", run, "--compare", second)
    assert code == 0
    assert Path(said.strip()) == run / "comparison.html"
    code, _, told = call("report", run, "--compare", second, "--watch")
    assert code == 2
    assert "--watch" in told


def test_of_several_areas_the_worst_is_compared(run: Path, tmp_path: Path):
    one = {"on_target": 0.5, "contrast": 0.1, "zeroth_order": 0.01, "side_lobe": 1.0}
    own = {"one": one, "two": [one, {**one, "on_target": 0.4, "contrast": 0.2, "zeroth_order": 0.0}]}
    for name, area in own.items():
        shutil.copytree(run, tmp_path / name)
        path, manifest = tmp_path / name / "metrics.json", tmp_path / name / MANIFEST_NAME
        path.write_bytes(canonical_json({**json.loads(path.read_text()), "area": area}))
        record = json.loads(manifest.read_text())
        record["results_sha256"]["metrics.json"] = sha256_file(path)
        manifest.write_bytes(canonical_json(record))
    content = compared([tmp_path / "one", tmp_path / "two"])
    table = next(block for block in blocks(content, TableBlock) if block.title == "What is aimed at")
    assert [row[:3] for row in table.rows] == [
        ("contrast, worst area", "10.00 %", "20.00 %"),
        ("light on the target, worst area", "50.00 %", "40.00 %"),
        ("0th order, worst area", "1.00 %", "1.00 %"),
    ]


def test_tiles_cover_maps_of_any_shape():
    """Every pixel lies in one tile, and sizes of all tiles have heads."""
    for shape in ((1, 1), (512, 512), (513, 512), (1030, 2049)):
        factors = tiles.reductions_of(shape)
        assert max(tiles.reduced_shape(shape, factors[-1])) <= tiles.TILE
        heads = tiles.heads(shape, factors)
        numbers = np.zeros(shape, np.uint8)
        rows = tiles.tile_rows(numbers)
        assert (len(rows), len(rows[0])) == tuple(-(-n // tiles.TILE) for n in shape)
        means = dict(tiles.reduced(np.ones(shape), factors))
        assert list(means) == list(factors[1:])
        for factor, mean in means.items():
            assert mean.shape == tiles.reduced_shape(shape, factor)
            np.testing.assert_allclose(mean, 1.0)
        assert all(re.fullmatch(r"\d+x\d+", name) for name in heads)


def test_reduced_copies_of_a_map_begin_at_its_top_row():
    """Rows 38 and 39 from the top of 1025 are row 19 of halves and row 9 of quarters, wherever the padding lies."""
    level = np.zeros((1025, 100), np.uint8)
    level[::-1][38:40] = 3
    level_map = LevelMap(level, Levels(4, 300e-9), Grid(level.shape, 1e-6), math.inf)
    data = height_block("heights", level_map).data
    assert data["reductions"] == [1, 2, 4]
    for factor, row in ((2, 19), (4, 9)):
        tile = zlib.decompress(base64.b64decode(data["views"][0]["reduced"][str(factor)][0][0])[8:-4])
        numbers = np.frombuffer(tile, np.uint8).reshape(-1, 100 // factor + 1)
        assert np.flatnonzero((numbers != numbers[0]).any(axis=1)).tolist() == [row]


def test_digests_of_results_are_told(run: Path):
    table = next(block for block in blocks(gather(run), TableBlock) if block.title == "Digests")
    told = dict(table.rows)
    assert told["tolerance/draws.csv"] == sha256_bytes(DRAWS.encode())


def test_numbers_have_the_names_of_the_table_of_metrics():
    assert {name: one.label for name, one in METRICS.items()} == dict(LABELS)
    assert {name for name, one in METRICS.items() if one.unit == "%"} == SHARES
