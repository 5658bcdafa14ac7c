"""`doedesign evaluate`: the same pairs for everybody, methods as published, intervals, and other people's programs."""

import csv
import io
import json
import re
import shutil
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage import data, restoration

import doedesign.evaluation.evaluate as evaluate_module
from doedesign.calibration.measurement import load_measurement
from doedesign.capture.from_spec import plain_parameters
from doedesign.capture.images import Pictures, sample_files
from doedesign.capture.scenes import SceneData
from doedesign.evaluation.candidates import candidates_of
from doedesign.evaluation.evaluate import evaluate
from doedesign.evaluation.external import ExternalMethod
from doedesign.evaluation.methods import METHODS, MethodInputs, as_seen
from doedesign.evaluation.pairs import PairSet
from doedesign.evaluation.plates import PlateBanks, plates_of
from doedesign.evaluation.published import TABLE_1, TABLE_2, published_scores
from doedesign.evaluation.rivals.files import rival_named
from doedesign.evaluation.rivals.training import rival_options
from doedesign.evaluation.rows import FLAT, ROBUST, TRAININGS, MethodRow, rows_of, trainings_of
from doedesign.evaluation.scoring import PairWork
from doedesign.evaluation.statistics import BootstrapInterval, bootstrap_mean
from doedesign.evaluation.tables import LATER, REGIONS, SCORES, EvaluationTable, TableRow
from doedesign.evaluation.trainings import TrainingPlan, require_asked, train_missing
from doedesign.recon.weights import NETWORK_NAME
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from doedesign.spec.values.table import SpecTable
from doedesign.training.train import prepared
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json
from fab.pictures import write_pixels
from sim.light import linear_from_srgb, srgb_from_linear
from sim.obstruction import MaskFolder
from sim.optic import HeightOptic
from sim.psf_bank import PsfBank, psf
from sim.sensor import Sensor
from tests.doedesign import small_runs
from tests.doedesign.local_cluster import Cluster
from tests.doedesign.small_runs import call, finished_run

# A camera of three colours before dirt, and a network that is trained in moments.
SPEC = (
    small_runs.SPEC.replace('["550 nm"]', '["656 nm", "589 nm", "486 nm"]')
    .replace('near = ["6 mm"]\nfar = ["inf"]', 'near = ["6 mm", "9 mm"]\nfar = ["0.6 m"]\nocclusion = "paper"')
    .partition("[[limit]]")[0]
    + """
[obstruction]
kind = "dirt"
[network]
width = 3
depth = 1
[train]
size = 32
steps = 2
perceptual = 0.0
validation = 2
validate_every = 2
"""
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("small"), SPEC)


@pytest.fixture(scope="module")
def pairs(run: Path) -> PairSet:
    return PairSet.of(load_spec(run / "spec.toml"), "spec.toml", sample_files()[:3])


# Statistics.


def test_an_interval_of_independent_pictures_is_the_textbooks(rng: np.random.Generator):
    values = rng.normal(20, 3, (1, 400))
    found = bootstrap_mean(values, [f"{k}" for k in range(400)])
    assert found is not None
    assert found.low is not None
    assert found.high is not None
    width = 2 * 1.96 * values.std(ddof=1) / np.sqrt(400)
    # 2000 resamples: a quantile near 2.5 % is known to 3 % of the width.
    assert found.high - found.low == pytest.approx(width, rel=0.1)
    assert found.mean == pytest.approx(values.mean())
    assert (found.pairs, found.pictures, found.seeds) == (400, 400, 1)


def test_many_pairs_of_one_photograph_prove_no_more_than_one(rng: np.random.Generator):
    once = rng.normal(20, 3, (1, 30))
    names = [f"{k}" for k in range(30)]
    alone, often = bootstrap_mean(once, names), bootstrap_mean(np.repeat(once, 9, axis=1), np.repeat(names, 9).tolist())
    assert alone is not None
    assert often is not None
    assert often[:3] == pytest.approx(alone[:3])
    assert often.pairs == 9 * alone.pairs


def test_seeds_are_drawn_again_too(rng: np.random.Generator):
    """Two seeds that differ by much: however many pairs there are, the interval holds both."""
    values = rng.normal(0, 0.01, (2, 50)) + np.array([[20.0], [22.0]])
    found = bootstrap_mean(values, [f"{k}" for k in range(50)])
    assert found is not None
    assert found.low == pytest.approx(20, abs=0.02)
    assert found.high == pytest.approx(22, abs=0.02)
    assert found.mean == pytest.approx(21, abs=0.02)


def test_one_photograph_has_no_interval():
    """However many pairs it has: what another photograph would give is not known."""
    found = bootstrap_mean(np.array([[20.0, 22.0, 24.0]]), ["a"] * 3)
    assert found == BootstrapInterval(22.0, None, None, 3, 1, 1)
    several = bootstrap_mean(np.array([[20.0], [22.0]]), ["a"])
    assert several is not None
    assert (several.low, several.high) == (20.0, 22.0)  # the seeds differ


def test_a_pair_without_a_score_does_not_count():
    values = np.array([[1.0, np.nan, 3.0]])
    found = bootstrap_mean(values, ["a", "b", "c"])
    assert found is not None
    assert (found.mean, found.pairs) == (2.0, 2)
    assert bootstrap_mean(np.array([[np.nan]]), ["a"]) is None
    with pytest.raises(ValueError, match="finite"):
        bootstrap_mean(np.array([[np.inf]]), ["a"])
    with pytest.raises(ValueError, match="one per pair"):
        bootstrap_mean(values, ["a"])


# Pairs.


def test_a_pair_follows_from_the_seed_and_its_number(run: Path, pairs: PairSet):
    again = PairSet.of(load_spec(run / "spec.toml"), "spec.toml", sample_files()[:3])
    later = again.scene(5)
    for one, other in zip(_leaves(pairs.scene(5).scene), _leaves(later.scene), strict=True):
        assert np.array_equal(one, other)
    assert pairs.scene(5).name == later.name
    moved = PairSet.of(load_spec(run / "spec.toml"), "spec.toml", sample_files()[:3], seed=1)
    assert not np.array_equal(moved.scene(5).scene.background, later.scene.background)


def test_obstructions_of_a_single_distance_are_none_of_those_of_a_training(run: Path, pairs: PairSet):
    """With the same seed they began with the same numbers, and their masks were the same: correlation 0.999."""
    single = PairSet.of(
        load_spec(run / "spec.toml", ['scene.far=["1.2 m"]']), "spec.toml", sample_files()[:3], border="reflect"
    )
    for judged in (single, replace(pairs, model=single.model)):
        kind, far = judged.kind, (min(judged.far_m), max(judged.far_m))
        trained = SceneData(Pictures(judged.files), kind, judged._view, far, judged.seed)
        for number in range(4):
            one, other = (data(number).scene.obstructions[0].mask for data in (judged.scene, trained.item))
            # Of 65 x 65 pixels with few clumps: those of other seeds correlate by 0.2 at most here.
            assert abs(np.corrcoef(np.ravel(one), np.ravel(other))[0, 1]) < 0.4


def test_depths_are_those_whose_psfs_are_known(pairs: PairSet):
    depths = [pairs.depths(k) for k in range(40)]
    assert {d.near_m for d in depths} == set(pairs.near_m)  # all eight, in forty pairs
    assert min(pairs.near_m) == pytest.approx(6e-3)
    assert max(pairs.near_m) == pytest.approx(9e-3)
    # Evenly in 1/z.
    assert np.diff(1 / np.array(sorted(pairs.near_m))) == pytest.approx(np.full(7, (1 / 9e-3 - 1 / 6e-3) / 7))
    for number in range(8):
        scene = pairs.scene(number).scene
        assert float(scene.obstructions[0].depth_m) == pytest.approx(depths[number].near_m)
        assert float(scene.background_depth_m) == pytest.approx(depths[number].far_m)


def test_a_pair_of_several_obstructions_has_the_depth_of_the_one_that_it_is():
    """Dirt and drops at 5 to 12 cm, a fence at 40 to 80 cm: none is where another lies."""
    kind = ["obstruction.kind=dirt_raindrop_fence", 'obstruction.options={fence_depth=["40 cm", "80 cm"]}']
    path = Path(__file__).parents[2] / "examples" / "automotive.toml"
    spec = load_spec(path, [*kind, "sensor.window=64", "train.size=64"])
    several = PairSet.of(spec, "a.toml", sample_files()[:3], occlusion="paper")
    found: dict[str, list[float]] = {"dirt": [], "raindrop": [], "fence": []}
    for number in range(60):
        part: Any = several._part(number)
        found[part.name].append(several.depths(number).near_m)
    assert all(len(depths) > 8 for depths in found.values())  # a third each, of 60: 20, which strays by 4
    assert {depth for depths in found.values() for depth in depths} <= set(several.near_m)
    for name, (least, most) in {"dirt": (0.05, 0.12), "raindrop": (0.05, 0.12), "fence": (0.4, 0.8)}.items():
        assert least - 1e-9 < min(found[name]) < max(found[name]) < most + 1e-9
    assert published_scores(2, "dirt_raindrop_fence") == {}


def test_a_worker_of_several_threads_mixes_no_pairs(pairs: PairSet):
    """What was made of a pair is kept by thread."""
    work, together = PairWork(pairs, {}, ()), threading.Barrier(4)

    def both(number: int) -> tuple[int, int]:
        together.wait()
        first = work._kept(number, "first", lambda _: (time.sleep(0.01), number)[1])
        together.wait()
        return first, work._kept(number, "second", lambda _: number)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(both, range(8))) == [(number, number) for number in range(8)]


def test_pictures_of_one_name_are_refused(run: Path, tmp_path: Path):
    for film in ("one", "two"):
        (tmp_path / "test" / film).mkdir(parents=True)
        (tmp_path / "test" / film / "0001.png").write_bytes(sample_files()[0].read_bytes())
    with pytest.raises(InputError, match=r"must have names of their own, but got .*0001\.png"):
        evaluate(run, tmp_path / "out", test=tmp_path / "test", pairs=1, workers=0)


def test_a_robust_plate_is_learnt_for_as_the_others_are(run: Path, tmp_path: Path):
    """Whatever the spec of its own run says of scenes and of training."""
    other = finished_run(tmp_path, SPEC.replace("steps = 2\n", "steps = 9\n").replace('"ring"', '"flat"'))
    plan = TrainingPlan(run, tmp_path / "out", "paper", "dirt", robust=other)
    spec, own = plan.design(TRAININGS[ROBUST], 0).spec, plan.design(TRAININGS["proposed"], 0).spec
    assert spec is not None
    assert own is not None
    assert spec.train == own.train.model_copy(update={"freeze": "optics"})
    assert (spec.network, spec.obstruction, spec.sensor) == (own.network, own.obstruction, own.sensor)


@pytest.mark.slow
def test_a_capture_lies_on_its_scene(pairs: PairSet):
    """Far from the obstruction a plain lens shows the scene itself, blurred by its own spot alone."""
    camera = pairs.model.camera
    bank = psf(HeightOptic.of(camera), camera, pairs.depths_m)
    number = min(range(12), key=lambda k: float(pairs.shown(pairs.scene(k))[1].mean()))
    scene = pairs.scene(number)
    capture, (clean, mask) = pairs.photographed(number, scene, bank), pairs.shown(scene)
    assert capture.shape == clean.shape == (3, pairs.size, pairs.size)
    assert mask.shape == clean.shape[1:]
    free = mask < 0.01
    # The best shift of the capture against the scene is none.
    shifts = {(dy, dx): np.roll(capture, (dy, dx), (1, 2)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)}
    scaled = {at: image * (clean * image)[:, free].sum() / (image**2)[:, free].sum() for at, image in shifts.items()}
    errors = {at: float(np.mean((image - clean)[:, free] ** 2)) for at, image in scaled.items()}
    assert min(errors, key=lambda at: errors[at]) == (0, 0)


def _leaves(value: Any) -> list[np.ndarray]:
    if is_dataclass(value):
        return [leaf for one in fields(value) for leaf in _leaves(getattr(value, one.name))]
    if isinstance(value, tuple):
        return [leaf for one in value for leaf in _leaves(one)]
    return [np.asarray(value)]


# Methods.


@pytest.fixture
def inputs(rng: np.random.Generator) -> MethodInputs:
    light = linear_from_srgb((data.astronaut()[64:128, 64:128] / 255).astype(np.float32).transpose(2, 0, 1))
    y, x = np.mgrid[-5:6, -5:6]
    blob = np.exp(-(x**2 + y**2) / 6).astype(np.float32)
    psfs = np.stack([0.8 * blob / blob.sum()] * 3)
    mask = np.zeros((64, 64), np.float32)
    mask[20:30, 25:40] = 1
    return MethodInputs(light, psfs, psfs[:, ::-1], mask, Sensor())


@pytest.mark.parametrize("name", ["wiener_far", "wiener_near", "richardson_lucy_far", "richardson_lucy_near"])
def test_deconvolution_without_a_blur_is_the_capture(inputs: MethodInputs, name: str):
    point = np.zeros((3, 5, 5), np.float32)
    point[:, 2, 2] = 1
    found = METHODS[name](inputs._replace(far=point, near=point))
    # The Wiener filter damps noise by a thousandth or so.
    assert np.abs(found - as_seen(inputs)).max() < 0.02


def test_deconvolution_is_scikit_images(inputs: MethodInputs):
    """In one channel, called as its manual shows; the PSF of unit energy, the light divided by the rest."""
    wide = np.pad(inputs.light[1].astype(float) / inputs.far[1].sum(), 15, mode="symmetric")
    unit = inputs.far[1].astype(float) / inputs.far[1].sum()
    direct = restoration.richardson_lucy(wide, unit, num_iter=30, clip=False, filter_epsilon=1e-6)[15:-15, 15:-15]
    found = METHODS["richardson_lucy_far"](inputs)[1]
    assert np.abs(found - srgb_from_linear(direct.astype(np.float32))).max() < 1e-4  # single precision


def test_deconvolution_brings_lost_light_back(inputs: MethodInputs):
    even = inputs._replace(light=np.full((3, 32, 32), 0.4, np.float32))  # of 0.5: the PSF loses a fifth
    for name in ("wiener_far", "richardson_lucy_far"):
        assert METHODS[name](even) == pytest.approx(float(srgb_from_linear(np.full(1, 0.5))[0]), abs=8e-3)  # 1 %


@pytest.mark.parametrize("name", ["biharmonic", "telea", "navier_stokes"])
def test_inpainting_fills_the_hole_and_leaves_the_rest(inputs: MethodInputs, name: str):
    if name != "biharmonic":
        pytest.importorskip("cv2")
    found, before = METHODS[name](inputs), as_seen(inputs)
    hole = inputs.mask >= 0.5
    assert np.abs(found - before)[:, ~hole].max() <= 0.5 / 255 + 1e-6  # of eight bits
    assert np.abs(found - before)[:, hole].max() > 0.02
    # Of an even picture nothing is hidden.
    even = inputs._replace(light=np.where(hole, 0, 0.25).astype(np.float32) * np.ones((3, 1, 1), np.float32))
    assert np.abs(METHODS[name](even) - srgb_from_linear(np.full(1, 0.25))).max() < 0.01


@pytest.mark.parametrize("name", ["biharmonic", "telea", "navier_stokes"])
def test_nothing_is_found_in_a_picture_that_is_all_hole(inputs: MethodInputs, name: str):
    """A clump may cover a whole capture: what is behind it is not handed back as if it had been found."""
    if name != "biharmonic":
        pytest.importorskip("cv2")
    assert not METHODS[name](inputs._replace(mask=np.ones((64, 64), np.float32))).any()


# Rows.


def test_every_row_of_the_paper_has_one_of_ours():
    assert {row.paper for row in rows_of(1, "dirt") if row.paper} == set(TABLE_1)
    for obstruction, published in TABLE_2.items():
        assert {row.paper for row in rows_of(2, obstruction) if row.paper} == set(published)
    with pytest.raises(InputError, match="must be 1 or 2"):
        rows_of(3, "dirt")


def test_a_wide_psf_is_mirrored_over_as_often_as_it_needs(rng: np.random.Generator):
    """One that is a point leaves the picture, whatever its window; noise is next to none."""
    light = rng.random((3, 16, 16)).astype(np.float32)
    psf = np.zeros((3, 41, 41), np.float32)
    psf[:, 20, 20] = 1
    bright = Sensor(exposure=1e9, full_well_e=1e12)
    shown = METHODS["wiener_far"](MethodInputs(light, psf, psf, np.zeros((16, 16), np.float32), bright))
    np.testing.assert_allclose(shown, srgb_from_linear(light), atol=1e-3)


def test_rows_are_named_once_and_their_trainings_are_known():
    for rows in (rows_of(1, "dirt"), rows_of(2, "fence", robust=True), rows_of(2, "raindrop")):
        assert len({row.name for row in rows}) == len(rows)
        needed = [one.name for one in trainings_of(rows)]
        assert len(set(needed)) == len(needed)
        for row in rows:
            assert row.plate == FLAT or row.plate in needed
            assert row.training is None or row.training in needed
            assert row.method in {*METHODS, "network", "rival"}
        for name in needed:  # a plate is there before the network behind it
            plate = TRAININGS[name].plate
            assert plate in (None, FLAT) or needed.index(plate) < needed.index(name)


def test_a_plate_that_no_training_moves_takes_none(run: Path, tmp_path: Path):
    """It is looked through without; a network behind it takes one."""
    rows = rows_of(2, "dirt", robust=True, names=("robust_capture", "conventional_capture"))
    assert trainings_of(rows) == ()
    behind = rows_of(2, "dirt", robust=True, names=("robust", "capture"))
    assert {one.name for one in trainings_of(behind)} == {"proposed", "robust"}
    assert [one.name for one in trainings_of(rows_of(1, "dirt", names=("sequential",)))] == ["sequential"]
    plan = TrainingPlan(run, tmp_path, "paper", "dirt", robust=run)
    pairs = PairSet.of(load_spec(run / "spec.toml"), "spec.toml", sample_files()[:1])
    plates = plates_of(rows, plan, pairs, (0,), {}, None, 0)
    assert plates.keys() == {FLAT, "robust@0"}
    ready, left = candidates_of(rows, plan, (0,), {}, plates, sample_files()[:1])
    assert [one.row.name for one in ready] == ["robust_capture", "conventional_capture"]
    assert not left


def test_changes_of_trainings_are_changes_that_a_spec_takes(run: Path):
    for one in TRAININGS.values():
        spec = open_design(run, False, overrides=one.changes, free=TRAINING_TABLES).spec
        assert isinstance(spec, SpecTable)


def test_a_network_is_not_judged_by_what_it_was_trained_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Nor by a plate as fabricated where its process makes none; both rows say so."""
    judged_by = sample_files()[:1]
    row = next(one for one in rows_of(2, "dirt") if one.name == "proposed")
    made = MethodRow("proposed_fabricated", "", "network", "proposed", "proposed", fabricated=True)
    plan = TrainingPlan(run, tmp_path, "paper", "dirt")
    about = {"pictures": {"training": ["other.png", f"sub/{judged_by[0].name}"]}}
    (plan.folder(TRAININGS["proposed"], 0)).mkdir(parents=True)
    (plan.folder(TRAININGS["proposed"], 0) / NETWORK_NAME).write_bytes(b"")
    monkeypatch.setattr("doedesign.evaluation.candidates.read_network", lambda _: (None, about))
    bank = PsfBank(np.ones((1, 1, 3, 3), np.float32), ("green",), (1.0,), 1e-6)
    plates = {"proposed@0": PlateBanks(bank, why_none="no errors")}
    ready, left = candidates_of((row, made), plan, (0,), {}, plates, judged_by)
    assert ready == ()
    assert [one.why for one in left] == [
        f"trained on {judged_by[0].name}, which is among the pictures to judge by",
        "no errors",
    ]
    ready, left = candidates_of((row,), plan, (0,), {}, plates, sample_files()[1:])
    assert [one.row for one in ready] == [row]
    assert left == ()


@pytest.mark.parametrize("name", ["table2-raindrop-paper", "table2-raindrop-radiometric", "table2-fence-radiometric"])
def test_rows_with_fewer_pairs_over_the_full_image_are_those_that_the_page_names(name: str):
    """A picture that equals its scene has no finite PSNR; only rows that return the scene exactly have any."""
    text = (Path(__file__).parents[2] / "examples" / "results" / f"{name}.csv").read_text()
    full = [one for one in csv.DictReader(text.splitlines()) if (one["region"], one["score"]) == ("full", "psnr")]
    fewer = {one["row"] for one in full if one["pairs"] != "100"}
    assert fewer == {"biharmonic", "fourier_inpainting", "two_stream_inpainting"}
    counts = {one["pairs"] for one in full if one["pairs"] != "100"}
    page = (Path(__file__).parents[2] / "docs" / "validation-network.md").read_text()
    (said,) = [part for part in page.split("\n\n") if "does not count" in part]
    assert len(counts) == 1
    assert counts <= set(re.findall(r"\d+", said))


ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "examples" / "results"
TABLES = sorted(path.stem for path in RESULTS.glob("table?-*.csv"))
PAGES = {"dirt": "validation-dirt.md", "raindrop": "validation-raindrop.md", "fence": "validation-fence.md"}


CAPTURES = {"capture_fabricated", "robust_capture", "robust_capture_fabricated"}
# Rows of `later/captures` that are of another run than their table; of dirt under the reciprocal model they are of the
# very trainings of it, looked at again. Optics alone are joined where theirs were of a run that was not kept.
JOINED_CAPTURES = {
    "table2-dirt-reciprocal": set(),
    "table2-fence-paper": CAPTURES,
    "table2-fence-radiometric": CAPTURES,
    "table2-raindrop-paper": CAPTURES | {"optics_only", "optics_only_fabricated"},
    "table2-raindrop-radiometric": CAPTURES | {"optics_only_fabricated"},
}


def lines_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.parametrize("name", TABLES)
def test_rows_of_later_runs_are_marked(name: str):
    """A row's mean less its difference is the proposed row that it was compared with: that of the table, or it is of a
    later run."""
    lines = lines_of(RESULTS / f"{name}.csv")
    proposed = {(one["region"], one["score"]): one for one in lines if one["row"] == "proposed"}
    found, marked = set(), {one["row"] for one in lines if one["run"] != "1"}
    for one in lines:
        own = proposed[one["region"], one["score"]]
        if one["row"] == "proposed" or one["pairs"] != own["pairs"]:
            continue  # of fewer pairs another mean
        # Six digits of each of three numbers.
        if not one["gain"] or abs(float(one["mean"]) - float(one["gain"]) - float(own["mean"])) > 2e-4:
            found.add(one["row"])
    assert found == marked
    text = (RESULTS / f"{name}.tex").read_text()
    assert text.count(r"$^\dagger$") == len(marked) + bool(marked)


@pytest.mark.parametrize("path", sorted((RESULTS / "later").rglob("*.csv")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_rows_that_were_joined_are_those_of_the_later_run(path: Path):
    table = {(o["row"], o["region"], o["score"]): o for o in lines_of(RESULTS / path.name)}
    joined = [one for one in lines_of(path) if table[one["row"], one["region"], one["score"]]["run"] != "1"]
    assert {one["row"] for one in joined} == {
        "seed1": set(),
        "robust": {"robust", "robust_fabricated", "robust_untold"},
        "biharmonic": {"biharmonic_of_capture"},
        "optics": {"optics_only_fabricated"},
        "captures": JOINED_CAPTURES.get(path.stem, set()),
    }[path.parent.name]
    for one in joined:
        other = table[one["row"], one["region"], one["score"]]
        same = set(one) - {"paper", "run"}
        assert {key: other[key] for key in same} == {key: one[key] for key in same}


@pytest.mark.parametrize("name", TABLES)
def test_the_page_has_the_rows_of_the_file(name: str):
    """All of them, in the order of the file, with its three scores, differences and the paper's numbers."""
    lines = lines_of(RESULTS / f"{name}.csv")
    expected = []
    for row in dict.fromkeys(one["row"] for one in lines):
        own = {(one["region"], one["score"]): one for one in lines if one["row"] == row}
        cells = []
        for score, digits in (("psnr", 2), ("ssim", 3), ("closeness", 3)):
            inner, whole = (float(own[region, score]["mean"]) for region in ("occluded", "full"))
            cells.append(f"{inner:.{digits}f} ({whole:.{digits}f})")
        psnr = own["occluded", "psnr"]
        mean, low, high = (psnr[key] for key in ("gain", "gain_low", "gain_high"))
        cells.append(f"{float(mean):+.2f} ({float(low):+.2f} to {float(high):+.2f})" if mean else "")
        expected.append((psnr["run"] != "1", cells))
    page = (ROOT / "docs" / PAGES[name.split("-")[1]]).read_text()
    parts = [part.splitlines() for part in page.split("\n\n")]
    (table,) = [p for p in parts if len(p) == len(expected) + 2 and f"| {expected[0][1][0]} |" in p[2]]
    shown = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table[2:]]
    assert [("†" in cells[0], cells[1:5]) for cells in shown] == expected


def test_a_table_says_which_rows_are_of_a_later_run_and_how_many_seeds_it_has():
    interval = BootstrapInterval(20.0, 19.0, 21.0, 8, 4, 1)
    scores = {region: dict.fromkeys(SCORES, interval) for region in REGIONS}
    first, other, _, _, later, *_ = rows_of(2, "dirt", robust=True)
    rows = (TableRow(first, scores, {}), TableRow(other, scores, scores), TableRow(later, scores, scores, run=2))
    table = EvaluationTable(2, "dirt", rows, (), {"occlusion": "paper"})
    found = {one["row"]: one["run"] for one in csv.DictReader(io.StringIO(table.csv()))}
    assert found == {first.name: "1", other.name: "1", later.name: "2"}
    for text in (table.text(), table.latex(), caption(table)):
        assert LATER in text
    assert table.text().count("†") == 2
    assert "one seed" in caption(table)
    alone = replace(table, rows=rows[:2])
    assert "†" not in alone.text() + alone.latex() + caption(alone)
    two = {region: dict.fromkeys(SCORES, interval._replace(seeds=2)) for region in REGIONS}
    assert "photographs and seeds" in caption(replace(alone, rows=(TableRow(first, two, {}),)))
    one = {region: dict.fromkeys(SCORES, BootstrapInterval(20.0, None, None, 2, 1, 1)) for region in REGIONS}
    trial = replace(alone, rows=(TableRow(first, one, {}),))
    assert "no interval" in caption(trial)
    assert [row["low"] for row in csv.DictReader(io.StringIO(trial.csv()))] == [""] * len(REGIONS) * len(SCORES)


def caption(table: EvaluationTable) -> str:
    drawn: Any = table.plot()
    return " ".join(drawn.get_supxlabel().split())


# Programs of other people.

COPY = """
import shutil, sys
from pathlib import Path
given, found = map(Path, sys.argv[1:])
for path in given.glob("*.png"):
    if "mask" not in path.name:
        shutil.copy(path, found / path.name)
"""


@pytest.fixture
def copies(tmp_path: Path) -> str:
    (tmp_path / "copy.py").write_text(COPY)
    return f"{sys.executable} {tmp_path / 'copy.py'} {{in}} {{out}}"


def scores_by_row(out: Path, name: str = "table2-dirt-paper") -> dict[str, dict[str, float]]:
    rows = csv.DictReader(io.StringIO((out / name / "table.csv").read_text()))
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        if row["mean"]:
            found.setdefault(row["row"], {})[f"{row['region']} {row['score']}"] = float(row["mean"])
    return found


@pytest.mark.slow
def test_a_program_that_copies_scores_as_the_capture_does(run: Path, copies: str, tmp_path: Path):
    out = tmp_path / "out"
    table = evaluate(run, out, pairs=4, methods=[f"copy={copies}", f"hole:scene={copies}"], workers=0)
    found = scores_by_row(out)
    # Eight bits: an error of a two hundred and fiftieth at most beside errors of a tenth.
    assert found["copy"] == pytest.approx(found["conventional_capture"], rel=2e-3)
    assert found["hole"]["occluded psnr"] < found["conventional_capture"]["full psnr"]
    # Nothing is trained, and the table says so.
    assert {one.row.name for one in table.rows if one.why} >= {"proposed", "conventional_network", "optics_only"}
    assert "not trained for seed 0" in table.text()
    # All is there, so the program is not asked again.
    (tmp_path / "copy.py").write_text("raise SystemExit(3)")
    again = evaluate(run, out, pairs=4, methods=[f"copy={copies}", f"hole:scene={copies}"], workers=0)
    assert again.json() == table.json()
    with pytest.raises(InputError, match=r"method copy.*exit code 3"):
        evaluate(run, out, pairs=5, methods=[f"copy={copies}"], workers=0)


def test_a_program_has_a_name_of_its_own(run: Path, copies: str, tmp_path: Path):
    for methods in ([f"capture={copies}"], [f"copy={copies}", f"copy:scene={copies}"]):
        with pytest.raises(InputError, match="must have a name of its own"):
            evaluate(run, tmp_path / "out", pairs=1, methods=methods, workers=0)


def test_what_a_program_left_behind_is_not_taken_for_an_answer(run: Path, copies: str, tmp_path: Path):
    """Another command under the same name that writes nothing: pictures of the first one are gone."""
    evaluate(run, tmp_path / "out", pairs=2, methods=[f"copy={copies}"], workers=0)
    with pytest.raises(InputError, match=r"must write 0000.png for every pair"):
        evaluate(run, tmp_path / "out", pairs=2, methods=[f"copy={sys.executable} -c pass {{in}} {{out}}"], workers=0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lama", "a name and a command"),
        ("=x {in} {out}", "a name and a command"),
        ("a/b=x {in} {out}", "a name and a command"),
        ("lama:sharp=x {in} {out}", "what it sees must be one of"),
        ("lama=x {in}", "must name the folder {out}"),
        ("lama=x '{in} {out}", "must be a command line"),
    ],
)
def test_a_wrong_program_is_refused_before_anything_is_computed(run: Path, tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError, match=words):
        evaluate(run, tmp_path / "out", methods=[text])
    assert not (tmp_path / "out").exists()


def test_an_unfinished_robust_design_is_refused_before_anything_is_trained(run: Path, tmp_path: Path):
    robust = tmp_path / "robust"
    shutil.copytree(run, robust)
    (robust / "level_map.npz").unlink()
    with pytest.raises(InputError, match="robust"):
        evaluate(run, tmp_path / "out", robust=robust, train=True)
    assert not (tmp_path / "out").exists()


def test_a_robust_design_of_another_camera_is_refused(run: Path, tmp_path: Path):
    (tmp_path / "more").mkdir()
    other = finished_run(tmp_path / "more", SPEC.replace('focal_length = "1 mm"', 'focal_length = "1.1 mm"'))
    with pytest.raises(
        InputError, match=r"a robust design must have this camera's focal_length_m, 0.001, but got 0.0011"
    ):
        evaluate(run, tmp_path / "out", robust=other, train=True)
    assert not (tmp_path / "out").exists()


def test_a_robust_design_in_scalar_light_beside_one_with_edges_says_what_helps(run: Path, tmp_path: Path):
    lit = finished_run(tmp_path, SPEC.replace("[optics]", '[optics]\nlight = "edges"'))
    with pytest.raises(InputError, match=r'camera.s light, edges, but got scalar. .*optics\.light = "scalar"'):
        evaluate(lit, tmp_path / "out", robust=run, train=True)


def test_what_nothing_is_trained_for_is_scored_once(run: Path, tmp_path: Path):
    """Two seeds are no two draws of a camera without a network, nor of a robust plate that stays as it is."""
    names = ("conventional_capture", "robust_capture")
    table = evaluate(run, tmp_path / "out", pairs=2, rows=names, seeds=(3, 4), robust=run, workers=0)
    assert [one.row.name for one in table.rows] == [*reversed(names)]
    assert {found.seeds for one in table.rows if (found := one.scores["full"]["psnr"])} == {1}


def test_a_folder_of_masks_is_named_by_its_last_part():
    assert published_scores(2, "/data/fence_test/raindrop_masks") is published_scores(2, "raindrop")
    names = {row.name for row in rows_of(2, "/data/fence_test/raindrop_masks")}
    assert names == {row.name for row in rows_of(2, "raindrop")} != {row.name for row in rows_of(2, "fence")}


def test_pictures_to_judge_by_are_none_of_those_trained_on(run: Path, tmp_path: Path):
    """Said before hours of training: by their names, as rows are left out by them."""
    first, second, *_ = sample_files()
    for folder, files in (("images", (first, second)), ("test", (second,))):
        (tmp_path / folder).mkdir()
        for path in files:
            shutil.copy(path, tmp_path / folder)
    with pytest.raises(InputError, match=f"must not be trained on, but got {second.name} in .*images, too"):
        evaluate(run, tmp_path / "out", images=tmp_path / "images", test=tmp_path / "test", train=True)
    assert not (tmp_path / "out" / "trained").exists()
    # Without a folder to train on, scikit-image's samples are; not all of them are for judging then.
    with pytest.raises(InputError, match=f"must not be trained on, but got {second.name} in .*trained_on, too"):
        evaluate(run, tmp_path / "out", test=tmp_path / "test", train=True)
    assert not (tmp_path / "out" / "trained").exists()


def test_a_seed_named_twice_and_what_no_row_looks_at_are_refused(run: Path, tmp_path: Path):
    """Twice the same scores would stand in the table as two trainings."""
    with pytest.raises(InputError, match=r"seeds: must differ.*but got 0, 1, 0"):
        evaluate(run, tmp_path / "out", seeds=(0, 1, 0))
    with pytest.raises(InputError, match="robust: has rows in table 2 alone"):
        evaluate(run, tmp_path / "out", table=1, robust=run)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"process: is that of plates as fabricated.*but got no row with such a plate"):
        evaluate(run, tmp_path / "out", table=1, process="contact_aligner")


def test_a_program_sees_the_plate_whichever_rows_are_asked_for(
    run: Path, copies: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As if a training of no steps had left the plate as it was."""
    monkeypatch.setattr(evaluate_module, "lacking", lambda *_: {})
    monkeypatch.setattr(TrainingPlan, "design_after", TrainingPlan.design)
    how: Any = {"pairs": 1, "rows": ("conventional_capture",), "workers": 0}
    table = evaluate(run, tmp_path / "out", methods=[f"copy:plate={copies}"], **how)
    rows = {one.row.name: one for one in table.rows}
    assert not rows["copy"].why
    assert rows["copy"].scores["full"]["psnr"] != rows["conventional_capture"].scores["full"]["psnr"]
    # What is not trained yet is still not there.
    monkeypatch.setattr(evaluate_module, "lacking", lambda *_: {"proposed": "not trained for seed 0"})
    table = evaluate(run, tmp_path / "other", methods=[f"copy:plate={copies}"], **how)
    assert {one.row.name: one.why for one in table.rows}["copy"] == "there is no proposed plate yet"


def test_a_program_is_found_out(run: Path, tmp_path: Path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="must be a program that can be run"):
        evaluate(run, out, pairs=2, methods=["x=/nowhere/x {in} {out}"], workers=0)
    with pytest.raises(InputError, match=r"must write 0000.png for every pair"):
        evaluate(run, out, pairs=2, methods=[f"x={sys.executable} -c pass {{in}} {{out}}"], workers=0)
    # What it says in an encoding of its own is no reason for a traceback.
    says = "import sys; sys.stderr.buffer.write(bytes([255])); sys.exit(3)"
    with pytest.raises(InputError, match=r"method x: must end without an error, but got exit code 3: \ufffd"):
        evaluate(run, out, pairs=1, methods=[f'x={sys.executable} -c "{says}" {{in}} {{out}}'], workers=0)
    small = (
        "import sys,imageio,numpy;[imageio.imwrite(f'{sys.argv[2]}/000{k}.png',numpy.zeros((8,8,3),'u1'))for k in(0,1)]"
    )
    with pytest.raises(InputError, match="must keep the size of 32 x 32 pixels"):
        evaluate(run, out, pairs=1, methods=[f'x={sys.executable} -c "{small}" {{in}} {{out}}'], workers=0)


def test_a_command_line_is_not_a_shell():
    one = ExternalMethod.parse("x=echo {in};ls $HOME {out}")
    assert one.command == ("echo", "{in};ls", "$HOME", "{out}")


# The command.


@pytest.mark.slow
def test_stopped_and_gone_on_with_it_ends_the_same(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = evaluate(run, tmp_path / "whole", pairs=4, workers=0)
    stop_after, done = 2, []
    original = evaluate_module.evaluate_here

    def stopped(*given: Any, **options: Any):
        for item in original(*given, **options):
            if len(done) == stop_after:
                raise KeyboardInterrupt
            done.append(item)
            yield item

    monkeypatch.setattr(evaluate_module, "evaluate_here", stopped)
    with pytest.raises(KeyboardInterrupt):
        evaluate(run, tmp_path / "parts", pairs=4, workers=0)
    kept = (tmp_path / "parts/table2-dirt-paper/scores.jsonl").read_text().splitlines()
    assert len({json.loads(line)["key"].rpartition("/")[2] for line in kept}) == stop_after
    asked: list[Any] = []

    def counted(*given: Any, **options: Any):
        for item in original(*given, **options):
            asked.append(item)
            yield item

    monkeypatch.setattr(evaluate_module, "evaluate_here", counted)
    rest = evaluate(run, tmp_path / "parts", pairs=4, workers=0)
    assert len(asked) == 4 - stop_after
    assert rest.json() == whole.json()
    for name in ("table.csv", "table.json", "table.tex", "pairs.csv", "pictures.png"):
        one, other = (tmp_path / part / "table2-dirt-paper" / name for part in ("whole", "parts"))
        assert one.read_bytes() == other.read_bytes()


def test_some_rows_alone_are_what_they_are_among_all(run: Path, tmp_path: Path):
    """In any order; beside rows that were scored before, and without the row that others are compared to."""
    names = ("conventional_capture", "telea")
    some = evaluate(run, tmp_path / "out", pairs=2, rows=names[::-1], workers=0)
    assert [one.row.name for one in some.rows] == list(names)
    every = evaluate(run, tmp_path / "out", pairs=2, workers=0)
    assert {one.row.name: one.scores for one in some.rows}.items() < {o.row.name: o.scores for o in every.rows}.items()


@pytest.mark.parametrize("scores", ["[1]", "3", '{"full": 2}'])
def test_a_line_that_holds_no_scores_is_refused(run: Path, tmp_path: Path, scores: str):
    how: Any = {"pairs": 1, "rows": ("conventional_capture",), "workers": 0}
    evaluate(run, tmp_path / "out", **how)
    journal = tmp_path / "out" / "table2-dirt-paper" / "scores.jsonl"
    journal.write_text(f'{{"key": "conventional_capture@0#0/0", "scores": {scores}}}\n')
    with pytest.raises(InputError, match="line 1: must be one finished score"):
        evaluate(run, tmp_path / "out", **how)


def test_another_question_needs_another_folder(run: Path, tmp_path: Path):
    evaluate(run, tmp_path / "out", pairs=1, workers=0)
    with pytest.raises(InputError, match=r"one with another .*seed"):
        evaluate(run, tmp_path / "out", pairs=1, seed=1, workers=0)


def finished_training(plan: TrainingPlan, name: str) -> Path:
    """The folder of a training as it would be left, without its network."""
    one = TRAININGS[name]
    options = {} if one.rival is None else rival_options(rival_named(one.rival))
    own = plan.occlusion, plan.obstruction, plan.lpips_weights, plan.licence
    made = prepared(plan.design(one, 0), plan.images, plan.validation, *own, options)
    folder = plan.folder(one, 0)
    folder.mkdir(parents=True)
    (folder / NETWORK_NAME).touch()
    (folder / MANIFEST_NAME).write_bytes(canonical_json({**made.settings, "state": "done"}))
    return folder


@pytest.mark.parametrize("name", ["proposed", "fourier_inpainting", ROBUST])
def test_a_network_that_was_trained_otherwise_is_refused(run: Path, tmp_path: Path, name: str):
    """Networks are found by their names, which say nothing of spec, plate, obstruction and pictures."""
    (tmp_path / "images").mkdir()
    for file in sample_files()[:4]:
        (tmp_path / "images" / file.name).write_bytes(file.read_bytes())
    plan = TrainingPlan(run, tmp_path, "paper", "dirt", images=tmp_path / "images", robust=run)

    def asked(plan: TrainingPlan, pictures: bool = False) -> None:
        require_asked(plan, [TRAININGS[name]], (0,), pictures=pictures, loss=False)

    asked(plan)  # nothing is there
    finished_training(plan, name)
    asked(plan, pictures=True)
    with pytest.raises(InputError, match="differs in its spec"):
        asked(replace(plan, overrides=("train.steps=7",)))
    # Some options are those of a spec; an obstruction of another kind has a folder of its own.
    with pytest.raises(InputError, match="in its spec, obstruction"):
        asked(replace(plan, overrides=("obstruction.options={coverage=0.2}",)))
    if name == ROBUST:
        other = finished_run(tmp_path, SPEC.replace('"ring"', '"flat"'))
        with pytest.raises(InputError, match="in its spec, plate"):
            asked(replace(plan, robust=other))
    (tmp_path / "images" / sample_files()[4].name).write_bytes(sample_files()[4].read_bytes())
    asked(plan)  # none are given
    with pytest.raises(InputError, match="in its pictures"):
        asked(plan, pictures=True)


def test_a_training_of_the_run_itself_stands_for_the_proposed_one_whatever_it_was_made_of(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """It says so."""
    shutil.copytree(run, tmp_path / "run")
    plan = TrainingPlan(tmp_path / "run", tmp_path / "out", "paper", "dirt")
    shutil.copytree(finished_training(plan, "proposed"), tmp_path / "run" / "trained")
    monkeypatch.setattr(TrainingPlan, "_is_same", lambda _, folder, __: (folder / NETWORK_NAME).is_file())
    require_asked(plan, [TRAININGS["proposed"]], (0,), pictures=False, loss=False)
    assert not caplog.messages
    changed = json.loads((tmp_path / "run" / "trained" / MANIFEST_NAME).read_text()) | {"spec_sha256": "0"}
    (tmp_path / "run" / "trained" / MANIFEST_NAME).write_bytes(canonical_json(changed))
    require_asked(plan, [TRAININGS["proposed"]], (0,), pictures=False, loss=False)
    assert "stands for proposed; what is asked for differs from it in its spec" in caplog.text


def test_a_training_of_the_run_behind_masks_of_a_folder_stands_for_the_proposed_one(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The kind that it tells is "folder", whatever that is called: masks are known by what they show."""
    own, masks = tmp_path / "run", tmp_path / "masks"
    shutil.copytree(run, own)
    (own / NETWORK_NAME).touch()
    masks.mkdir()
    write_pixels(masks / "a.png", np.eye(8, dtype=np.uint8) * 255)
    (masks / "a.json").write_text('{"pitch_um": 50}')
    about = {"occlusion": "paper", "obstruction": "folder", "camera": "doe"}
    about |= {"obstruction_parameters": plain_parameters(MaskFolder(masks))}
    monkeypatch.setattr("doedesign.evaluation.trainings.read_network", lambda _: (None, about))
    plan = TrainingPlan(own, tmp_path / "out", "paper", str(masks))
    assert plan.folder(TRAININGS["proposed"], 0) == own
    assert replace(plan, obstruction="dirt").folder(TRAININGS["proposed"], 0) != own
    write_pixels(masks / "a.png", np.ones((8, 8), np.uint8) * 255)
    assert plan.folder(TRAININGS["proposed"], 0) != own


@pytest.mark.study
def test_networks_are_trained_scored_and_kept(run: Path, tmp_path: Path):
    """Every network of the two tables, at a size that says nothing: it is there, and scored."""
    out = tmp_path / "out"
    rows = tuple(row for table in (1, 2) for row in rows_of(table, "dirt"))
    own = {row.name for row in rows if row.method == "network"}
    for table in (1, 2):
        evaluate(run, out, table=table, pairs=3, train=True, workers=0, draws=2)
    found = scores_by_row(out, "table1-dirt-paper") | scores_by_row(out)
    assert own <= set(found)
    told = json.loads((out / "table2-dirt-paper" / "table.json").read_text())
    by_name = {row["name"]: row for row in told["rows"]}
    assert by_name["proposed_fabricated"]["gain_over_proposed"]["full"]["psnr"]["mean"] != 0
    assert by_name["proposed"]["paper"]["psnr"] == TABLE_2["dirt"]["proposed"].psnr


@pytest.mark.study
def test_trainings_side_by_side_are_those_one_after_the_other(run: Path, tmp_path: Path, capfd: Any):
    """By processes of one thread each: the same networks but for the order of sums; the second waits for its plate."""
    trainings, networks = [TRAININGS[name] for name in ("proposed", "plain_unet")], []
    for name, workers in (("beside", 2), ("after", 0)):
        plan = TrainingPlan(run, tmp_path / name, "paper", "dirt")
        train_missing(plan, trainings, (0,), workers)
        assert all(plan.done(one, 0) for one in trainings)
        networks.append([np.load(plan.folder(one, 0) / NETWORK_NAME, allow_pickle=False) for one in trainings])
        told = capfd.readouterr().err
        assert ("steps of 2 trainings: 4/4" in told) == (workers == 2)
        assert ("training: 2/2" in told) == (workers == 0)
    for beside, after in zip(*networks, strict=True):
        arrays = [key for key in after.files if after[key].dtype.kind == "f"]
        assert arrays
        for key in arrays:
            # Adam's first steps have the size of the rate whatever that of a gradient: where it is next to nothing, its
            # last bits decide.
            assert np.isclose(beside[key], after[key], rtol=1e-3, atol=1e-5).mean() > 0.999


@pytest.mark.slow
def test_a_cluster_gives_the_table_of_this_machine(run: Path, tmp_path: Path):
    pytest.importorskip("distributed", reason="the cluster extra is not installed")
    here = evaluate(run, tmp_path / "here", pairs=4, workers=2)
    cluster = Cluster(tmp_path)
    try:
        cluster.staff(2)
        there = evaluate(run, tmp_path / "there", pairs=4, scheduler=cluster.address)
    finally:
        cluster.close()
    # One thread each, the same program: the same bytes.
    assert there.json() == here.json()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("figure", "folder", "files"),
    [
        ("4", "figure4", {"plates.csv"}),
        ("8", "figure8", {"depths.csv"}),
        ("bench", "bench", {"measurement.toml", "hidden.toml", "images.csv", "throughput.json"}),
    ],
)
def test_a_figure_has_its_numbers_beside_it(run: Path, tmp_path: Path, figure: str, folder: str, files: set[str]):
    named = ("--draws", 1, "--process", "contact_aligner") if figure == "8" else ()  # as everywhere, a file or a name
    code, said, told = call("evaluate", run, "--figure", figure, "--out", tmp_path, *named)
    assert code == 0, told
    names = {path.name for path in (tmp_path / folder).iterdir()}
    assert {*files, "figure.png", "manifest.json"} <= names
    assert set(said.splitlines()) == {str(tmp_path / folder), *(str(tmp_path / folder / name) for name in names)}
    if figure == "bench":
        assert load_measurement(tmp_path / folder / "measurement.toml").image
    else:
        rows = list(csv.DictReader(io.StringIO((tmp_path / folder / min(files)).read_text())))
        expected = {"thin lens", "Fresnel", "random", "ring", "proposed"} if figure == "4" else {"as drawn", "draw 0"}
        assert {row["plate"] for row in rows} == expected


def test_the_paper_has_no_other_figure_of_optics(run: Path):
    code, _, told = call("evaluate", run, "--figure", "5")
    assert code == 2
    assert "--figure: must be one of 4, 8, bench" in told


def test_the_command_prints_where_the_table_is(run: Path, tmp_path: Path):
    code, said, told = call("evaluate", run, "--pairs", 1, "--workers", 0, "--out", tmp_path / "out")
    assert code == 0, told
    assert str(tmp_path / "out/table2-dirt-paper/table.csv") in said.splitlines()
    assert "Conventional capture" in told
    for options, words in (
        (("--table", 3), "must be 1 or 2"),
        (("--pairs", 0), "must be at least 1"),
        (("--seed", -1), "--seed: must be from 0 to 4294967295"),
        (("--rows", "proposed", "--rows", "mine"), "--rows: must be among proposed, "),
        (("--images", tmp_path), "--test"),
        (("--occlusion", "real"), "must be one of"),
        (("--method", "x"), "--method"),
    ):
        code, _, told = call("evaluate", run, *options, "--out", tmp_path / "other")
        assert code == 2
        assert words in told
