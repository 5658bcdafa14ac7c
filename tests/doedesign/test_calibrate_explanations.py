"""Explanations of a ratio, where ratio and throughput are known functions of the errors."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from doedesign.calibration import explanations
from doedesign.calibration.explanations import ExplanationSet, Targets, explain_ratio
from doedesign.design.design import Design
from fab.errors import InputError
from fab.process import Process, Variation
from tests.doedesign.calibration_fakes import PROBE_M, plate_drawn, usual_process

NEAR_M = 6e-3
BOTH = ("common_depth_scale", "common_cd_bias")
DEPTH_SIGMA, CD_SIGMA = 0.03, 0.15e-6
SHORT = ("common_depth_scale", "common_cd_bias_m")
LN2 = np.log(2)


@pytest.fixture(scope="module")
def plate() -> tuple[Design, Process]:
    design = plate_drawn(96, 4, window=16)
    return design, usual_process(design)


def explained(
    plate: tuple[Design, Process],
    monkeypatch: pytest.MonkeyPatch,
    errors: tuple[str, ...] = BOTH,
    *,
    widest: float = np.inf,
    targets: Targets | None = None,
    **options: Any,
) -> ExplanationSet:
    """Ratio 3 exp(-0.4 a - 0.3 b - 0.5 c), throughput 0.9 - 0.02 a, zeroth order 0.01 b² in standard deviations.

    `a` is of the depth, `b` of the line width, which the model refuses beyond `widest`, `c` of corners.
    """

    def predict(_: Design, __: Process, doe: Variation) -> Any:
        a, b, c = doe.common_depth_scale / DEPTH_SIGMA, doe.common_cd_bias_m / CD_SIGMA, doe.corner_radius_m / 0.2e-6
        if abs(b) > widest:
            raise InputError("cd_bias", "must leave something", f"{b:g}", "Less.")
        ratio = 3 * np.exp(-0.4 * a - 0.3 * b - 0.5 * c)
        row = {"ring_to_disc": ratio, "throughput": 0.9 - 0.02 * a, "zeroth_order": 0.01 * b**2, "strehl": 0.5}
        return SimpleNamespace(rows=[row])

    monkeypatch.setattr(explanations, "predict", predict)
    design, process = plate
    return explain_ratio(design, targets or Targets(PROBE_M, NEAR_M, 1.5), errors, process=process, **options)


def test_one_error_is_followed_to_where_the_ratio_is_met(
    plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch
):
    found = explained(plate, monkeypatch, pairs=False)
    assert [set(each.scores) for each in found.singles] == [{"common_depth_scale"}, {"common_cd_bias_m"}]
    # Closed in on to a hundredth of a standard deviation.
    assert [each.distance for each in found.singles] == pytest.approx([LN2 / 0.4, LN2 / 0.3], abs=0.01)
    depth, width = found.singles
    assert depth.values["common_depth_scale"] == pytest.approx(DEPTH_SIGMA * depth.distance)
    assert width.values["common_cd_bias_m"] == pytest.approx(CD_SIGMA * width.distance)
    assert depth.throughput == pytest.approx(0.9 - 0.02 * depth.distance)
    assert width.zeroth_order == pytest.approx(0.01 * width.distance**2)
    assert (found.pairs, found.none, found.unreached) == ([], [], [])
    assert found.nominal["ring_to_disc"] == pytest.approx(3)


def test_curves_are_the_ratio_at_every_standard_deviation(
    plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch
):
    curve = explained(plate, monkeypatch, pairs=False, reach=3.0).curves["common_depth_scale"]
    assert {-3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0} <= set(np.round(curve.scores, 6))
    assert list(curve.scores) == sorted(curve.scores)
    np.testing.assert_allclose(curve.ring_to_disc, 3 * np.exp(-0.4 * np.array(curve.scores)))
    np.testing.assert_allclose(curve.throughput, 0.9 - 0.02 * np.array(curve.scores))


@pytest.mark.parametrize(("reach", "found"), [(1.7, []), (1.75, ["common_depth_scale"]), (0.3, []), (4, [*SHORT])])
def test_errors_are_followed_to_the_end_of_the_reach_and_no_further(
    plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch, reach: float, found: list[str]
):
    """The ratio is met at ln 2 / 0.4 = 1.733 and at 2.310 standard deviations."""
    made = explained(plate, monkeypatch, pairs=False, reach=reach)
    assert [next(iter(each.scores)) for each in made.singles] == found
    assert max(made.curves["common_depth_scale"].scores) <= reach


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"throughput": 0.9, "throughput_sigma": 0.0}, "throughput_sigma: must be positive"),
        ({"throughput": 90.0}, "throughput: must be a share of the light"),
        ({"ring_to_disc": np.nan}, "ring_to_disc: must be positive"),
        ({"depth_m": 0.0}, "depth: must be positive"),
        ({"wavelength_m": -520e-9}, "probe: must be positive"),
        ({"reach": 0.0}, "reach: must be above 0 and up to 1000"),
    ],
)
def test_numbers_that_nothing_can_have_are_refused(
    plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch, changes: dict[str, float], rule: str
):
    targets = Targets(PROBE_M, NEAR_M, 1.5)._replace(**{k: v for k, v in changes.items() if k != "reach"})
    with pytest.raises(InputError, match=rule):
        explained(plate, monkeypatch, targets=targets, reach=changes.get("reach", 4.0))


def test_two_errors_share_as_is_most_plausible(plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch):
    """Shortest way to a plane: along its normal, (0.4, 0.3) ln 2 / 0.25."""
    (pair,) = explained(plate, monkeypatch).pairs
    # 120 proportions of the two: 3 degrees, of which at most half matters; lengths are tried by a twentieth.
    assert pair.distance == pytest.approx(LN2 / 0.5, abs=0.03)
    assert pair.scores["common_depth_scale"] == pytest.approx(0.8 * LN2 / 0.5, abs=0.15)
    assert pair.scores["common_cd_bias_m"] == pytest.approx(0.6 * LN2 / 0.5, abs=0.15)
    assert pair.ring_to_disc == pytest.approx(1.5, rel=0.01)


def test_a_measured_throughput_chooses_between_errors(plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch):
    """One and a half standard deviations of depth too much light: the depth must go the other way, the width further.

    With a = -1.5 the plane asks for b = (ln 2 + 0.6) / 0.3 = 4.31, a length of 4.56, beyond reach 4; so they meet
    between: least a² + b² + ((0.02 a + 0.03) / 0.004)² on 0.4 a + 0.3 b = ln 2.
    """
    targets = Targets(PROBE_M, NEAR_M, 1.5, 0.93, 0.004)
    found = explained(plate, monkeypatch, targets=targets, reach=6.0)
    a = np.linspace(-4, 4, 100001)
    b = (LN2 - 0.4 * a) / 0.3
    best = np.argmin(a**2 + b**2 + ((0.02 * a + 0.03) / 0.004) ** 2)
    (pair,) = found.pairs
    assert pair.scores["common_depth_scale"] == pytest.approx(a[best], abs=0.2)
    assert pair.scores["common_cd_bias_m"] == pytest.approx(b[best], abs=0.3)
    assert pair.fits == (abs(pair.throughput - 0.93) <= 0.008)
    assert [each.fits for each in found.singles] == [False, False]
    assert "*" not in str(found).partition("two errors")[0].partition("one error")[2]


def test_errors_beyond_what_the_model_describes_reach_nothing(
    plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch
):
    found = explained(plate, monkeypatch, pairs=False, widest=1.5)
    assert found.unreached == ["common_cd_bias_m"]
    assert found.none == [("common_cd_bias_m",)]
    assert found.curves["common_cd_bias_m"].scores == (-1.0, -0.5, 0.0, 0.5, 1.0)
    text = str(found)
    assert "none within 4 sigmas, where the ratio stays within:\n   2.22 to  4.05  " in text  # 3 exp(∓0.3)


def test_one_sided_errors_are_not_followed_below_zero(plate: tuple[Design, Process], monkeypatch: pytest.MonkeyPatch):
    wanted = Targets(PROBE_M, NEAR_M, 6.0)
    found = explained(plate, monkeypatch, ("corner_radius", *BOTH), targets=wanted, pairs=False)
    assert found.unreached == ["corner_radius_m"]
    assert [each.distance for each in found.singles] == pytest.approx([LN2 / 0.4, LN2 / 0.3], abs=0.01)
    assert all(next(iter(each.scores.values())) < 0 for each in found.singles)
    assert min(found.curves["corner_radius_m"].scores) == 0
    assert list(found.assumed) == ["corner_radius_m"]
