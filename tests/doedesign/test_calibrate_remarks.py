"""What a user must know before relying on a calibration, said where it is so and only there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from doedesign.calibration.estimate import Calibration, remarks_on
from tests.doedesign.analytic_plate import SIDE, analytic_calibration, analytic_objective

BASE = np.hypot(*(np.indices((SIDE, SIDE)) - np.array([4.0, 7.0])[:, None, None])) < 5  # a disc off both diagonals


def said(result: Calibration, expected: np.ndarray | None = None) -> list[str]:
    return list(remarks_on(result, result.fit.at.matches[0].model if expected is None else expected))


def test_of_a_good_fit_only_what_was_assumed_is_said():
    (remark,) = said(analytic_calibration())
    assert remark.startswith("The process says nothing of common_depth_scale, common_cd_bias_m")


@pytest.mark.parametrize(("rises", "warned"), [((), False), ((0.6, 1.9), False), ((1.0, 2.5), True), ((0.4,), True)])
def test_a_posterior_that_is_not_normal_is_told(rises: Sequence[float], warned: bool):
    remarks = [one for one in said(analytic_calibration(rises=rises)) if "not normal" in one]
    assert len(remarks) == warned
    if warned:
        assert f"rises by {', '.join(f'{rise:g}' for rise in rises)} instead of 1" in remarks[0]


@pytest.mark.parametrize(("chi2", "words"), [(0.5, "less noisy than stated"), (1.6, "does not explain the images")])
def test_noise_that_does_not_fit_is_told(chi2: float, words: str):
    first, *_ = said(analytic_calibration(chi2_per_pixel=chi2))
    assert words in first
    assert f"chi2 per pixel is {chi2:g} where noise alone gives 1" in first
    assert not [one for one in said(analytic_calibration(chi2_per_pixel=1.4)) if words in one]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_the_way_in_which_images_look_like_the_design_is_named(turns: int, mirrored: bool):
    """The picture is turned to the right and then mirrored, so that mirroring it and turning it to the left helps."""
    result = analytic_calibration(chi2_per_pixel=9.0)
    target = result.objective.targets[0]
    # Rows count upwards: numpy's turn to the left is one to the right.
    picture = np.rot90(BASE.astype(float), turns)
    picture = (picture[:, ::-1] if mirrored else picture).copy()
    shown = replace(result.objective, targets=(target._replace(psf=target.psf._replace(rate=picture)),))
    result = replace(result, fit=result.fit._replace(at=result.fit.at._replace(objective=shown)))
    remarks = [one for one in said(result, BASE.astype(float)) if "turned" in one]
    if (turns, mirrored) == (0, False):
        assert not remarks
        return
    after = " after mirroring them" if mirrored else ""
    assert f"when turned left by {turns} more quarter turns{after}: check quarter_turns and mirrored" in remarks[0]


def test_errors_at_the_end_of_their_range_and_unknown_ones_are_named():
    high = np.array([1.0, 2.5])
    result = analytic_calibration(analytic_objective(np.array([1.3, -0.4]), high=high), ratio=np.array([0.1, 0.7]))
    ends, unknown = (next(one for one in said(result) if one.startswith(w)) for w in ("At the end", "Not determined"))
    assert ends == "At the end of the range that was looked at: common_depth_scale."
    assert unknown == "Not determined by the images, hardly better known than before: common_cd_bias_m."
