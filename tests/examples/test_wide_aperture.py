"""The wide aperture behind dirt: its numbers by closed forms, and the whole example at a size that shows it works."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.capture.images import Pictures, sample_files
from doedesign.spec import load_spec
from fab.errors import InputError
from sim.source import path_at_m

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import dirty_scenes  # pyright: ignore[reportMissingImports]
import wide_aperture  # pyright: ignore[reportMissingImports]
import wide_cameras  # pyright: ignore[reportMissingImports]
import wide_plates  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("nearest_m", "waves"), [(1.0, 14.8), (2.0, 7.4), (5.0, 3.0)])
def test_a_plain_wide_aperture_is_out_of_focus_at_both_ends(nearest_m: float, waves: float):
    """D² / 8 |1/z - 1/z0| waves at the rim, z0 the middle of the range in dioptres."""
    middle = 2 * nearest_m
    assert 0.0114**2 / 8 * (1 / nearest_m - 1 / middle) / 550e-9 == pytest.approx(waves, abs=0.05)


def test_the_lens_is_focused_in_the_middle_of_its_range():
    camera, spec = wide_cameras.camera_of(wide_cameras.CAMERAS[-1])
    rim = np.array([camera.aperture_m / 2])
    ends = [path_at_m(camera, rim, np.zeros(1), depth)[0] / 550e-9 for depth in (2.0, 4.0, np.inf)]
    # Chrome takes 5 um of the rim all round, 0.2 % of the waves.
    assert ends == pytest.approx([7.384, 0.0, -7.384], abs=0.02)
    depths = np.array(wide_cameras.depths_of(spec))
    assert np.diff(1 / depths) == pytest.approx(-np.full(6, 1 / 12), abs=1e-9)


def test_every_camera_exposes_as_long():
    white = {}
    for kind in wide_cameras.CAMERAS:
        bench = wide_cameras.Bench(kind, 32, Path(), None)
        white[kind.name] = float(bench.sensor().white_e(3).mean())
    assert white["open"] == white["plate"] == 16000
    assert white["stop"] == pytest.approx(16000 * (4.44 / 11.4) ** 2, rel=5e-3)  # chrome on the rim
    assert white["f2"] == pytest.approx(16000 * (8 / 11.4) ** 2, rel=5e-3)


def test_scenes_are_about_dirt_and_what_is_believed_of_it_is_off():
    plan = wide_aperture.Plan(size=40)
    pictures = Pictures(sample_files()[:1], 256)
    scenes = wide_aperture.scenes_of(pictures, plan, 3, 0)
    again = wide_aperture.scenes_of(pictures, plan, 3, 0)
    for scene, same in zip(scenes, again, strict=True):
        assert np.array_equal(scene.believed, same.believed)
        assert scene.covered[16, 16] > 0.3  # coarse pixels are eight wide, and linear between
        assert 0.05 <= scene.near_m <= 0.12
        assert abs(scene.believed_m / scene.near_m - 1) == pytest.approx(0.03)
        assert np.abs(scene.believed_radiance / scene.radiance - 1) == pytest.approx(0.07, rel=1e-3)
        assert 0 < np.mean(np.abs(scene.believed - scene.blocked)) < 0.2


def test_bars_are_straight_and_at_one_distance():
    """4 mm at 8 cm are 216 pixels of 3.7 um; coarse ones are eight of them wide."""
    pictures = Pictures(sample_files()[:1], 256)
    for scene in wide_aperture.scenes_of(pictures, wide_aperture.Plan(size=40, behind="bars"), 3, 0):
        assert scene.near_m == pytest.approx(0.08)
        share = float(np.mean(scene.blocked))
        # 4 of 12 to 16 mm; the layer is one and a half to two meshes wide, with a bar in its middle.
        assert 0.2 < share < 0.5
        middle = scene.blocked[dirty_scenes.DIRT_PX // 2, dirty_scenes.DIRT_PX // 2]
        assert middle > 0.4


@pytest.mark.parametrize("wrong", [{"size": 32}, {"size": 44}, {"judged": 0}, {"scenes": 0}, {"steps": -1}])
def test_a_plan_that_nothing_comes_of_is_refused(wrong: dict[str, Any]):
    with pytest.raises(InputError, match=f"{next(iter(wrong))}: must be"):
        wide_aperture.Plan(**wrong)
    assert wide_aperture.Plan(scenes=0, steps=0).scenes == 0


def test_plates_as_fabricated_are_judged_together():
    """Picture by picture, over the depths and at the one that is worst for each."""
    rows = [
        wide_aperture.Judged(camera, plate, "filter", 1.0, depth, scene, f"{scene}.png", psnr + scene)
        for camera, plate, psnrs in (
            ("stop", "drawn", (20.0, 21.0)),
            ("plate", "fabricated 0", (22.0, 22.0)),
            ("plate", "fabricated 1", (23.0, 24.0)),
        )
        for depth, psnr in zip((2.0, np.inf), psnrs, strict=True)
        for scene in range(3)
    ]
    found = wide_aperture.summary_of(rows)
    name = "plate / as fabricated / filter / 1.0 over stop"
    assert found["worst depth, plate over rival"][name][:3] == pytest.approx([2.5, 2.5, 2.5])
    assert found["mean of the depths, plate over rival"][name][:3] == pytest.approx([2.25, 2.25, 2.25])


@pytest.mark.parametrize(("name", "way"), [("wide_aperture", "network"), ("wide_aperture_bars", "filter")])
def test_the_page_has_the_means_of_the_scores(name: str, way: str):
    """Of both tables, and the differences at the worst depth, picture by picture."""
    text = (ROOT / "examples" / "results" / f"{name}.csv").read_text()
    rows = [
        wide_aperture.Judged(
            one["camera"],
            one["plate"],
            one["way"],
            float(one["light"]),
            float(one["depth_m"]),
            int(one["scene"]),
            one["picture"],
            float(one["psnr"]),
        )
        for one in csv.DictReader(text.splitlines())
    ]
    found = wide_aperture.summary_of(rows)
    page = " ".join((ROOT / "docs" / "tasks" / "wide-aperture.md").read_text().split()).replace("**", "")
    for camera in ("stop", "f2", "open", "plate", "quartic", "cubic", "logarithmic_asphere"):
        told = []
        for which in [(way, 1.0), ("filter", 1.0), (way, 0.1)]:
            one = found["scores"][f"{camera} / drawn / {which[0]} / {which[1]}"]
            told.append(" / ".join(f"{one[depth]:.1f}" for depth in ("2", "4", "inf")))
        if way == "filter":
            told[1] = f"{found['scores'][f'{camera} / drawn / filter / 1.0']['mean']:.1f}"
        assert f"| {' | '.join(told)} |" in page, camera
    over = found["worst depth, plate over rival"]
    for rival in ("stop", "f2", "open", "quartic", "cubic", "logarithmic_asphere"):
        mean, low, high, _ = over[f"plate / as fabricated / {way} / 1.0 over {rival}"]
        assert f"{mean:.1f} ({low:.1f} to {high:.1f})" in page.replace(" dB", ""), rival


def test_the_spec_says_what_is_designed():
    spec = load_spec(wide_cameras.SPEC)
    assert (spec.optimize.parametrization, spec.process.levels) == ("radial", 16)
    assert spec.objectives[0].name == "filtered_error"


@pytest.mark.parametrize("start", wide_plates.TRIES)
def test_every_try_is_a_spec(start: str):
    """With its own options, cells or rings as the start needs them, and the lens focused where its zones begin."""
    for options in wide_plates.TRIES[start]:
        spec = wide_plates.spec_of(start, options, 7)
        assert (spec.optimize.start, dict(spec.optimize.start_options), spec.optimize.steps) == (start, options, 7)
        assert spec.optimize.parametrization == ("freeform" if start == "cubic" else "radial")
        asphere = start == "logarithmic_asphere"
        assert (spec.sensor.defocus_m == 0) == asphere
        kind = wide_cameras.CameraKind(start, "11.4 mm", 1500, 7, start)
        assert (wide_cameras.camera_of(kind)[0].defocus_m == 0) == asphere


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of the aperture and a few steps."""
    text = wide_cameras.SPEC.read_text().replace("steps = 1000", "steps = 4").replace("samples = 1500", "samples = 300")
    spec = tmp_path / "small.toml"
    spec.write_text(text.replace('"11.4 mm"', '"2.28 mm"'))
    monkeypatch.setattr(wide_cameras, "SPEC", spec)


@pytest.mark.slow
def test_classic_plates_are_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: None):
    """Of each kind the strength that leaves least, and what the optimiser makes of it."""
    tries = {"quartic": [{"waves": 0.0}, {"waves": 9.0}], "cubic": [{"waves": 12.0}]}
    monkeypatch.setattr(wide_plates, "TRIES", tries)
    # From 8 cm on, for a fifth of the aperture is out of focus by as many waves at a twenty-fifth of the distance.
    near = wide_cameras.SPEC.read_text().replace("64.257 um", "1.778 mm")
    depths = '"2 m", "2.4 m", "3 m", "4 m", "6 m", "12 m", "inf"'
    wide_cameras.SPEC.write_text(near.replace(depths, '"8 cm", "16 cm", "inf"'))
    rows = wide_plates.run(tmp_path / "out", 6)
    assert [(row.start, row.steps) for row in rows] == [(start, steps) for start in tries for steps in (0, 6)]
    tried = [wide_plates.plate("quartic", options).worst for options in tries["quartic"]]
    assert rows[0].worst == min(tried) == tried[1] < 0.9 * tried[0]
    for classic, optimised in zip(rows[::2], rows[1::2], strict=True):
        assert optimised.worst < classic.worst
    for row in rows:
        assert row.mean < row.worst
        assert row.known < row.worst  # a filter for every depth can do no worse than one for all
    assert len((tmp_path / "out" / "plates.csv").read_text().splitlines()) == 1 + len(rows)
    assert wide_plates.run(tmp_path / "out", 6) == rows


@pytest.mark.study
def test_the_whole_comparison(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small: None):
    """With smaller apertures, few steps and scenes: every table and picture, and the same again from files."""
    monkeypatch.setattr(wide_aperture, "DRAWS", 1)
    kinds = (
        wide_cameras.CameraKind("stop", "1.14 mm", 150, 2),
        wide_cameras.CameraKind("plate", "2.28 mm", 300, 3, "optimised"),
    )
    monkeypatch.setattr(wide_cameras, "CAMERAS", kinds)
    monkeypatch.setattr(wide_cameras, "CLASSIC", (wide_cameras.CameraKind("quartic", "2.28 mm", 300, 3, "quartic"),))
    plan = wide_aperture.Plan(size=48, scenes=2, judged=2, steps=2, width=4)
    files = sample_files()
    found = wide_aperture.run(tmp_path / "out", plan, files[:2], files[2:4])
    rows = list(csv.DictReader((tmp_path / "out" / "scores.csv").read_text().splitlines()))
    # Two ways, three depths, two scenes: both cameras in two lights, and a plate as fabricated.
    assert len(rows) == 2 * 3 * 2 * (2 + 2 + 1)
    assert json.loads((tmp_path / "out" / "summary.json").read_text()).keys() == found.keys()
    assert (tmp_path / "out" / "wide_aperture.png").stat().st_size > 10_000
    assert "plate / fabricated 0 / network / 1.0 over stop" in found["worst depth, plate over rival"]
    assert wide_aperture.run(tmp_path / "out", plan, files[:2], files[2:4]) == found
    alone = wide_aperture.run(
        tmp_path / "bars", replace(plan, steps=0, behind="bars", classic=True), files[:2], files[2:4]
    )
    assert all(" / filter / " in name for name in alone["scores"])
    assert "plate / drawn / filter / 1.0 over quartic" in alone["worst depth, plate over rival"]
