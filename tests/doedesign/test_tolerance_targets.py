"""Tolerance studies of designs that aim at spots, an area or foci: their numbers have limits and a yield."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import doedesign as dd
from doedesign.design.design import Design
from doedesign.prediction import predict
from doedesign.tolerancing.studies import study
from fab.errors import InputError
from fab.pictures import write_pixels
from fab.process import Variation
from tests.doedesign.test_areas import SPEC as AREA
from tests.doedesign.test_focus import SMALL as FOCUS
from tests.doedesign.test_spots_run import SPEC as SPOTS

PROCESS = "contact_aligner"


def designed(folder: Path, text: str, *overrides: str) -> Design:
    path = folder / "small.toml"
    path.write_text(text)
    return dd.optimize(dd.load_spec(path, ["optimize.steps=1", *overrides]))


@pytest.mark.parametrize(
    ("text", "limits"),
    [
        (SPOTS, {"on_target": ">= 1 %", "uniformity_error": "<= 90 %"}),
        (AREA, {"on_target": ">= 1 %", "contrast": "<= 500 %"}),
        (FOCUS, {"on_target": ">= 1 %", "focus_width": "<= 9"}),
    ],
    ids=["spots", "area", "focus"],
)
def test_numbers_of_what_light_should_make_have_a_yield(tmp_path: Path, text: str, limits: dict[str, str]):
    design = designed(tmp_path, text)
    asked = study(design, process=PROCESS, limits=[f"{name} {bound}" for name, bound in limits.items()], quiet=True)
    sample = asked.monte_carlo(2)
    assert sample.yield_ is not None
    assert sample.yield_.good == 2
    told = {row["quantity"]: row for row in sample.statistics() if row["colour"] is None}
    assert told.keys() >= limits.keys()
    (first, *_) = predict(design, asked.process, asked.variation(sample.keys[0])).rows
    for name in limits:
        assert sample.worst(name)[0] == first[name]
    assert told["on_target"]["std"] > 0
    assert {next(iter(told)), *list(told)[: len(limits)]} == limits.keys()  # they come first


@pytest.mark.slow
def test_spots_are_told_by_how_equal_they_are(tmp_path: Path):
    errors = {name: 0.0 for name in ("overlay_x_m", "overlay_y_m", "rotation_rad", "magnification", "sidewall_rad")}
    found = dd.tolerance(designed(tmp_path, SPOTS), process=PROCESS, errors=errors, draws=2)
    assert "of the variance of the uniformity error" in str(found)
    sample = found.sample
    assert sample.worst_draw == sample.keys[int(np.argmax(sample.worst("uniformity_error")))]


@pytest.mark.slow
@pytest.mark.parametrize("sensitivity", ["one_at_a_time", "sobol"])
def test_what_is_aimed_at_has_its_numbers_in_its_own_colour_alone(tmp_path: Path, sensitivity: Any):
    """A second colour has those of light in general."""
    two = 'optics.wavelengths=["532 nm", "450 nm"]'
    design = designed(tmp_path, SPOTS, two)
    errors = {name: 0.0 for name in ("overlay_x_m", "overlay_y_m", "rotation_rad", "magnification", "sidewall_rad")}
    found = dd.tolerance(design, process=PROCESS, errors=errors, draws=2, sensitivity=sensitivity, sobol=2)
    first, other = found.sample.colours
    assert found.sample.colours_of("uniformity_error") == (first,)
    assert found.sample.colours_of("zeroth_order") == (first, other)
    for row in found.effects or found.variance_shares or ():
        assert row.colour in (None, first) or row.quantity not in ("on_target", "uniformity_error")
    found.plot()


@pytest.mark.slow
def test_workers_and_a_study_on_disk_know_them_too(tmp_path: Path):
    design = designed(tmp_path, SPOTS)
    asked: dict[str, Any] = {"process": PROCESS, "limits": ["uniformity_error <= 90 %"], "out": tmp_path / "out"}
    asked["sensitivity"] = "none"
    dd.tolerance(design, **asked, draws=1, workers=1)
    grown = dd.tolerance(design, **asked, draws=2, workers=1)
    assert grown.yield_ is not None
    assert (grown.yield_.good, grown.yield_.plates) == (2, 2)
    assert all("uniformity_error" in row for row in grown.sample.rows)


def test_a_folder_keeps_draws_of_one_target(tmp_path: Path):
    """The same level map, whose light is judged by other spots; and draws from before there were numbers of spots."""
    design = designed(tmp_path, SPOTS)
    out = tmp_path / "out"
    with study(design, process=PROCESS, out=out).journal.open():
        kept = json.loads((out / "study.json").read_text())
    (out / "draws.jsonl").write_text("{}\n")  # a study without results would give way
    assert kept["target"]["tables"][0]["spots"]["count"] == [3, 3]
    assert design.spec is not None
    assert design.spec.spots is not None
    weighted = design.spec.spots.model_copy(update={"weights": (2.0, *[1.0] * 8)})
    other = replace(design, spec=design.spec.model_copy(update={"spots": weighted}))
    with (
        pytest.raises(InputError, match="belong to this study, but got one with another target"),
        study(other, process=PROCESS, out=out).journal.open(),
    ):
        pass
    del kept["target"]
    (out / "study.json").write_text(json.dumps(kept))
    with (
        pytest.raises(InputError, match="one with another target"),
        study(design, process=PROCESS, out=out).journal.open(),
    ):
        pass


def test_pictures_go_with_a_design_to_other_processes(tmp_path: Path):
    """Workers of a cluster have no files of this machine."""
    picture = np.zeros((16, 16), np.uint8)
    picture[4:12, 4:12] = 255
    write_pixels(tmp_path / "light.png", picture)
    text = AREA.replace('shape = "rectangle"', 'shape = "picture"\npicture = "light.png"').replace(
        'height = "200 um"\n', ""
    )
    design = designed(tmp_path, text)
    rows = predict(design, design.process(), Variation()).rows
    asked = study(design, process=PROCESS)
    sent = pickle.loads(pickle.dumps(asked.design))
    (tmp_path / "light.png").unlink()
    assert predict(sent, design.process(), Variation()).rows == rows
    assert rows[0]["on_target"] > 0
    assert asked.journal.study["target"]["pixels_sha256"]
    assert study(sent, process=PROCESS).journal.study["target"] == asked.journal.study["target"]
