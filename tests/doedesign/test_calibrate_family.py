"""What explains two measured numbers: every explanation, put into the model, gives the measured ratio."""

from dataclasses import replace

import numpy as np
import pytest

from doedesign.calibration.explanations import ExplanationSet, Targets, explain_ratio
from doedesign.design.design import Design
from doedesign.prediction import predict
from fab.errors import InputError
from fab.process import Process, variation_of
from sim.camera import Colour
from tests.doedesign.calibration_fakes import PROBE_M, plate_drawn, usual_process

pytestmark = pytest.mark.slow

NEAR_M = 6e-3
ERRORS = ("common_depth_scale", "overlay_x", "common_cd_bias", "etch_lag")


@pytest.fixture(scope="module")
def plate() -> tuple[Design, Process]:
    design = plate_drawn(64, 4, window=32)
    return design, usual_process(design)


@pytest.fixture(scope="module")
def family(plate: tuple[Design, Process]) -> ExplanationSet:
    design, process = plate
    nothing = explain_ratio(
        design, Targets(PROBE_M, NEAR_M, 1.0), ("etch_lag",), process=process, pairs=False, reach=1.0
    )
    ratio, throughput = (nothing.nominal[key] for key in ("ring_to_disc", "throughput"))
    targets = Targets(PROBE_M, NEAR_M, 0.9 * ratio, throughput, 0.02)
    return explain_ratio(design, targets, ERRORS, process=process)


def test_every_explanation_gives_the_ratio(plate: tuple[Design, Process], family: ExplanationSet):
    design, process = plate
    assert len(family.singles) >= 2
    assert family.pairs
    probe = replace(design.camera, colours=(Colour("p", (PROBE_M,), (1.0,)),))
    design = replace(design, camera=probe, near_m=(NEAR_M,), far_m=())
    for each in [*family.singles, *family.pairs[:2]]:
        (row,) = predict(design, process, variation_of(process.masks, each.values)).rows
        assert row["ring_to_disc"] == pytest.approx(each.ring_to_disc, rel=1e-5)
        # A crossing is found to a hundredth of a standard deviation, along which the ratio changes by a few per cent.
        assert row["ring_to_disc"] == pytest.approx(family.targets.ring_to_disc, rel=0.01)
        assert row["throughput"] == pytest.approx(each.throughput, rel=1e-5)
        assert each.distance == pytest.approx(np.sqrt(sum(z * z for z in each.scores.values())))
        assert each.fits == (abs(row["throughput"] - (family.targets.throughput or 0)) <= 0.04)


def test_explanations_come_in_order_and_within_reach(family: ExplanationSet):
    for rows in (family.singles, family.pairs):
        distances = [each.distance for each in rows]
        assert distances == sorted(distances)
        assert all(0 < d <= family.reach + 1e-9 for d in distances)
    assert family.assumed == {"etch_lag": 0.05}  # the process says nothing of it
    named = {name for each in family.singles for name in each.values} | {n for names in family.none for n in names}
    assert {"common_depth_scale", "common_cd_bias_m", "etch_lag", "overlay_x_m[0]", "overlay_x_m[1]"} <= named


def test_values_are_scores_times_sigmas(plate: tuple[Design, Process], family: ExplanationSet):
    _, process = plate
    for each in family.singles:
        for name, value in each.values.items():
            sigma = process.spreads[name].sigma if name in process.spreads else family.assumed[name]
            assert value == pytest.approx(each.scores[name] * sigma)
            assert name != "etch_lag" or value > 0


def test_none_is_an_answer(plate: tuple[Design, Process], family: ExplanationSet):
    """A ratio a hundred times as large is not to be had from a little depth."""
    design, process = plate
    targets = Targets(PROBE_M, NEAR_M, 100 * family.nominal["ring_to_disc"])
    found = explain_ratio(design, targets, ("common_depth_scale", "common_cd_bias"), process=process, reach=2.0)
    assert not found.singles
    assert not found.pairs
    assert ("common_depth_scale",) in found.none
    assert ("common_depth_scale", "common_cd_bias_m") in found.none
    assert all(ratio > 0 for ratio in found.curves["common_depth_scale"].ring_to_disc)


def test_impossible_targets_are_refused(plate: tuple[Design, Process]):
    design, process = plate
    with pytest.raises(InputError, match="ring_to_disc: must be positive"):
        explain_ratio(design, Targets(PROBE_M, NEAR_M, 0.0), process=process)
    with pytest.raises(InputError, match="depth: the source must be near enough"):
        explain_ratio(design, Targets(PROBE_M, 1e3, 1.0), process=process)
    with pytest.raises(InputError, match="in a definite way, but got weather"):
        explain_ratio(design, Targets(PROBE_M, NEAR_M, 1.0), ("weather",), process=process)
