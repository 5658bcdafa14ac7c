"""Statistics, limits, yield, sensitivities and budgets against numbers that can be worked out by hand."""

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import foldnorm

from doedesign.spec import LimitSpec
from doedesign.tolerancing import result_files
from doedesign.tolerancing.analysis import QUANTITIES, Sample, limit_from_text, limit_text, sample_of, yield_of
from doedesign.tolerancing.budget import budget_of
from doedesign.tolerancing.pool import DrawModel, OutOfModel, Rows
from doedesign.tolerancing.results import ToleranceResult, tolerance
from doedesign.tolerancing.sensitivity import Effect, source_shares
from doedesign.tolerancing.studies import Study, study
from fab.errors import InputError
from fab.process import Normal, Process, Variation
from sim.illumination import EvenBeam, MeasuredBeam
from tests.pictures import leave_out_pictures


@pytest.fixture(scope="module")
def fakes():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parent)
        yield import_module("tolerance_fakes")


def one_after_another(model: DrawModel, plates: Mapping[str, Variation]) -> Iterator[tuple[str, Rows]]:
    """Evaluate in this process; how plates are handed to workers is tested elsewhere."""
    for key, variation in plates.items():
        yield key, model.evaluate(model.design, model.process, variation)


@pytest.fixture(scope="module")
def ask(fakes) -> Callable[..., Study]:
    def make(**settings: Any) -> Study:
        made = study(fakes.design(), **{"process": fakes.process(), "evaluate": fakes.rows, "quiet": True, **settings})
        return dataclasses.replace(made, run=one_after_another)

    return make


def row(colour: str, depth_m: float | None, **values: float | None) -> dict[str, Any]:
    return {"colour": colour, "depth_m": depth_m, **values}


TWO = sample_of(
    {
        "normal/0": [
            row("red", 0.05, zeroth_order=0.01, strehl=0.9, ring_to_disc=3.0),
            row("red", None, zeroth_order=0.01, strehl=0.9, far_spot=0.4),
            row("blue", 0.05, zeroth_order=0.04, strehl=0.8, ring_to_disc=None),
            row("blue", None, zeroth_order=0.04, strehl=0.8, far_spot=0.3),
        ],
        "normal/1": [
            row("red", 0.05, zeroth_order=0.02, strehl=0.7, ring_to_disc=1.0),
            row("red", None, zeroth_order=0.02, strehl=0.7, far_spot=0.5),
            row("blue", 0.05, zeroth_order=0.03, strehl=0.95, ring_to_disc=5.0),
            row("blue", None, zeroth_order=0.03, strehl=0.95, far_spot=0.2),
        ],
    }
)


def limited(sample: Sample, limits: list[LimitSpec]) -> Sample:
    return dataclasses.replace(sample, limits=tuple(limits))


def test_the_worst_row_is_the_highest_or_the_lowest():
    assert TWO.worst("zeroth_order").tolist() == [0.04, 0.03]
    assert TWO.worst("strehl").tolist() == [0.8, 0.7]
    assert TWO.worst("strehl", "blue").tolist() == [0.8, 0.95]
    assert TWO.worst("far_spot").tolist() == [0.3, 0.2]  # of the rows that have one
    assert TWO.worst("ring_to_disc").tolist() == [3.0, 1.0]
    assert TWO.worst("ring_to_disc", "blue").tolist() == [math.inf, 5.0]  # no light in the disc
    assert TWO.worst("far_spot", "red", math.inf).tolist() == [0.4, 0.5]
    assert TWO.of(["normal/1"]).worst("far_spot").tolist() == [0.2]
    assert TWO.colours == ("red", "blue")


def test_statistics_of_every_row_and_of_the_worst():
    found = {(s["quantity"], s["colour"], s["depth_m"]): s for s in TWO.statistics()}
    worst = found["zeroth_order", None, None]
    assert worst["mean"] == pytest.approx(0.035)
    assert worst["std"] == pytest.approx(0.01 / math.sqrt(2))
    assert (worst["min"], worst["max"], worst["median"]) == pytest.approx((0.03, 0.04, 0.035))
    assert worst["p05"] == pytest.approx(0.0305)
    assert worst["p95"] == pytest.approx(0.0395)
    assert found["far_spot", "red", math.inf]["mean"] == pytest.approx(0.45)
    assert ("far_spot", "red", 0.05) not in found
    assert found["ring_to_disc", "blue", 0.05]["mean"] == math.inf
    one = {(s["quantity"], s["colour"], s["depth_m"]): s for s in TWO.of(["normal/1"]).statistics()}
    assert (one["strehl", "red", 0.05]["mean"], one["strehl", "red", 0.05]["std"]) == (0.7, 0.0)
    # Four quantities, of which two have four rows and two have two.
    assert len(found) == 4 + 2 * 4 + 2 * 2


def test_percentiles_beside_an_infinite_ratio_are_numbers():
    """Of 21 plates one has no light in the disc: p95 is the twentieth of them, and the rest do not know of it."""
    ratios = [*map(float, range(1, 21)), None]
    draws = {f"normal/{i}": [row("red", 0.05, ring_to_disc=ratio)] for i, ratio in enumerate(ratios)}
    worst = sample_of(draws).statistics()[0]
    assert [worst[name] for name in ("p05", "median", "p95", "max")] == [2.0, 11.0, 20.0, math.inf]
    few = sample_of(dict(list(draws.items())[-2:])).statistics()[0]  # 20 and infinite
    assert [few[name] for name in ("min", "p05", "max")] == [20.0, math.inf, math.inf]


def test_plates_with_other_rows_are_refused():
    rows = [row("red", None, strehl=1.0)]
    with pytest.raises(ValueError, match="the same rows"):
        sample_of({"normal/0": rows, "normal/1": [row("blue", None, strehl=1.0)]})
    with pytest.raises(ValueError, match="at least one draw with rows"):
        sample_of({})


def test_yield_is_a_share_with_wilson_interval():
    found = yield_of(np.arange(10) < 8)
    # Wilson's interval for 8 of 10: (0.490, 0.943), E. B. Wilson, JASA 22 (1927).
    assert (found.share, found.good, found.plates) == (0.8, 8, 10)
    assert (found.low, found.high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert str(found) == "80.0 % (49.0 to 94.3 %)"
    assert yield_of(np.ones(5, dtype=bool)).high == 1.0
    with pytest.raises(ValueError, match="at least one draw"):
        yield_of(np.zeros(0, dtype=bool))


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("zeroth_order <= 3.5 %", [False, True]),
        ("zeroth_order<=0.04", [True, True]),
        ("zeroth_order <= 1.5 % for red", [True, False]),
        ("strehl >= 0.75", [True, False]),
        ("strehl >= 0.75 for blue", [True, True]),
        ("far_spot >= 25 %", [True, False]),
        ("far_spot >= 25 % for red at inf", [True, True]),
        ("ring_to_disc >= 2", [True, False]),
        ("ring_to_disc >= 2 at 5 cm", [True, False]),
        ("ring_to_disc >= 2 for blue", [True, True]),  # an infinite ratio is large enough
        ("ring_to_disc <= 4 for blue", [False, False]),  # and too large for a limit from above
    ],
)
def test_a_limit_holds_for_every_row_it_speaks_of(text: str, good: list[bool]):
    limit = limit_from_text(text)
    assert TWO.obeys(limit).tolist() == good
    assert limit_from_text(limit_text(limit)) == limit


def test_a_good_plate_obeys_every_limit():
    limits = [limit_from_text("zeroth_order <= 3.5 %"), limit_from_text("ring_to_disc >= 2")]
    assert limited(TWO, limits).good.tolist() == [False, False]
    assert limited(TWO, []).good.tolist() == [True, True]
    both = LimitSpec(quantity="zeroth_order", min=0.015, max=0.035, colour="red")
    assert TWO.obeys(both).tolist() == [False, True]
    assert limit_text(both) == "zeroth_order >= 0.015 and <= 0.035 for red"


@pytest.mark.parametrize("text", ["throughput <= 5 %", "strehl >= 0.5 for green", "strehl >= 0.5 at 7 cm"])
def test_a_limit_on_what_is_not_there_is_refused(text: str):
    with pytest.raises(InputError, match=r"must match a colour and depth.*red at 50 mm, red at inf"):
        TWO.obeys(limit_from_text(text))


@pytest.mark.parametrize(
    "text",
    ["zeroth order <= 5 %", "brightness >= 1", "strehl > 0.5", "strehl >= 1e", "strehl >= 1 at 5"],
)
def test_words_that_are_no_limit_are_refused(text: str):
    with pytest.raises(InputError, match=r"limit: must be a quantity.*zeroth_order <= 5 %"):
        limit_from_text(text)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("strehl >= 5", r"min: must lie between 0 and 1, for strehl is a share, but got 5.*Write 5 % as 0\.05"),
        ("far_spot >= 150 %", r"min: must lie between 0 and 1, for far_spot is a share, but got 1\.5"),
        ("zeroth_order <= -1 %", r"max: must be .*-0\.01"),
    ],
)
def test_a_limit_with_an_impossible_number_is_refused_by_the_rule_that_it_breaks(text: str, rule: str):
    with pytest.raises(InputError, match=rf'limit "{text}": {rule}'):
        limit_from_text(text)


def test_a_plate_beyond_the_model_is_bad_and_nothing_else():
    rows = [row("red", 0.05, strehl=0.9, zeroth_order=0.1, ring_to_disc=None)]
    table = sample_of({"normal/0": OutOfModel("too much"), "normal/1": rows, "normal/2": rows})
    assert table.within.tolist() == [False, True, True]
    assert limited(table, []).good.tolist() == [False, True, True]
    assert table.obeys(limit_from_text("strehl >= 0")).tolist() == [False, True, True]
    assert table.obeys(limit_from_text("strehl <= 1")).tolist() == [False, True, True]  # nor from the other side
    assert limited(table, []).worst_draw == "normal/1"
    assert limited(table, [limit_from_text("strehl >= 0.95")]).worst_draw == "normal/1"
    assert [found["min"] for found in table.statistics() if found["quantity"] == "strehl"] == [0.9, 0.9]
    with pytest.raises(ValueError, match="at least one draw with rows"):
        sample_of({"normal/0": OutOfModel("too much")})


def test_the_worst_plate_is_farthest_beyond_a_limit():
    assert limited(TWO, []).worst_draw == "normal/1"  # Strehl 0.7
    assert limited(TWO, [limit_from_text("zeroth_order <= 1 %")]).worst_draw == "normal/0"
    assert limited(TWO, [limit_from_text("zeroth_order <= 1.5 % for red")]).worst_draw == "normal/1"
    # 0.2 below 0.3 is worse than 0.04 above 0.035, against the size of the limits.
    limits = [limit_from_text("far_spot >= 0.3"), limit_from_text("zeroth_order <= 3.5 %")]
    assert limited(TWO, limits).worst_draw == "normal/1"
    # And 0.04, twice what may be, is worse than a fifth less than may be, of a larger number.
    limits = [limit_from_text("far_spot >= 0.25"), limit_from_text("zeroth_order <= 2 %")]
    assert limited(TWO, limits).worst_draw == "normal/0"


def test_one_at_a_time_finds_slope_and_curvature(ask: Callable[..., Study]):
    changes = {(c.error, c.quantity, c.colour): c for c in ask().one_at_a_time()}
    # Light outside is 0.03 + (sum of depth errors) / 10: sigma 0.02 moves it by 0.002 either way.
    outside = changes["depth_scale[1]", "outside_window", None]
    assert (outside.low, outside.expected, outside.high) == pytest.approx((0.028, 0.03, 0.032))
    assert outside.variance == pytest.approx(0.002**2)
    # The 0th order of blue is 0.02 + 2 z²: its variance is 2 (2 sigma²)².
    zeroth = changes["depth_scale[0]", "zeroth_order", None]
    assert zeroth.low == pytest.approx(0.02 + 2 * 0.02**2)
    assert zeroth.variance == pytest.approx(2 * (2 * 0.02**2) ** 2)
    assert changes["depth_scale[0]", "zeroth_order", "red"].variance == pytest.approx(2 * 0.02**4)
    # Corner rounding is |z| sigma; |z| varies by 1 - 2 / pi.
    corners = changes["corner_radius_m", "far_spot", None]
    assert corners.low is None
    assert corners.variance == pytest.approx((1 - 2 / math.pi) * 0.02**2)
    assert changes["overlay_x_m[0]", "zeroth_order", None].variance == 0


@pytest.mark.parametrize("mean", [0.0, 0.05, 0.25, 0.5, 1.0, 1.5, 3.0])
def test_an_error_folded_at_zero_varies_as_a_folded_normal_one(ask: Callable[..., Study], fakes, mean: float):
    """Of an effect in proportion to the error the variance is that of |mean + z|; below zero there is nothing."""
    process = Process(fakes.LEVELS, spreads={"corner_radius_m": Normal(mean * 0.2e-6, 0.2e-6)})
    effects = {(one.quantity, one.colour): one for one in ask(process=process).one_at_a_time()}
    # Beyond two standard deviations it is taken for normal: 7 % less at two, 0.5 % at three.
    exact = 0.02**2 * float(np.asarray(foldnorm.var(mean)))
    assert effects["far_spot", None].variance == pytest.approx(exact, rel=0.006 if mean > 2 else 1e-9)


def test_an_error_that_leaves_the_model_leaves_nothing_to_share():
    """It may well do the most; what the others do is no share of the whole."""
    known = Effect("depth_scale[0]", "depth", "strehl", None, 0.9, 1.0, 0.9, 0.01)
    assert source_shares([known], "strehl") == {"depth": 1.0}
    beyond = Effect("overlay_x_m[0]", "overlay", "strehl", None, -math.inf, 1.0, -math.inf, math.nan)
    assert source_shares([known, beyond], "strehl") == {}
    of_a_colour = beyond._replace(colour="red")
    assert source_shares([known, of_a_colour], "strehl") == {"depth": 1.0}


@pytest.mark.slow
def test_shares_of_variance_agree_with_those_worked_out(ask: Callable[..., Study]):
    asked = ask()
    # The far spot is 0.4 - two depth errors of 0.02 - |z| 0.02.
    depth, corners = 2 * 0.02**2, (1 - 2 / math.pi) * 0.02**2
    exact = {"depth": depth / (depth + corners), "corners": corners / (depth + corners)}
    assert source_shares(asked.one_at_a_time(), "far_spot") == pytest.approx(exact)
    found = {one.source: one for one in asked.sobol(1024) if (one.quantity, one.colour) == ("far_spot", None)}
    for source, share in exact.items():
        # About one in twenty intervals would miss; these two are repeatable, and they do not.
        assert found[source].first.low <= share <= found[source].first.high
        assert found[source].total.low <= share <= found[source].total.high
        # 1024 rows leave an index an uncertainty of about 0.03.
        assert found[source].total.value == pytest.approx(share, abs=0.06)
    assert found["overlay"].total.value == 0


def test_what_errors_do_together_shows_in_the_total_index(ask: Callable[..., Study], fakes):
    def together(design: object, process: Process, variation: Variation) -> Rows:
        return [row("red", None, strehl=1e5 * variation.depth_scale[0] * variation.overlay_x_m[0])]

    process = Process(fakes.LEVELS, spreads={"depth_scale[0]": Normal(0, 0.02), "overlay_x_m[0]": Normal(0.0, 0.5e-6)})
    found = {one.source: one for one in ask(process=process, evaluate=together).sobol(1024) if one.colour is None}
    assert set(found) == {"depth", "overlay"}
    for one in found.values():
        # A product of two centred errors varies only where both do.
        assert one.first.value == pytest.approx(0, abs=0.12)
        assert one.total.value == pytest.approx(1, abs=0.15)


def test_sobol_indices_are_the_same_every_time_and_need_a_power_of_two(ask: Callable[..., Study]):
    assert ask().sobol(32) == ask().sobol(32)
    assert ask().sobol(32) != ask(seed=1).sobol(32)
    # What does not vary has no shares, nor has what only DOEs with a target have.
    varying = {name for name, metric in QUANTITIES.items() if not metric.aimed} - {"throughput"}
    assert {one.quantity for one in ask().sobol(32)} == varying
    for count in (0, 1, 48):
        with pytest.raises(InputError, match="power of two"):
            ask().sobol(count)


def test_plates_beyond_the_model_count_as_the_worst_of_the_others_in_sobol_indices(ask: Callable[..., Study], fakes):
    """Shifts of more than a standard deviation are refused; the study still has shares, and overlay the largest."""
    some = dataclasses.replace(
        ask(evaluate=fakes.refused), run=lambda model, plates: ((key, model(one)) for key, one in plates.items())
    )
    found = {one.source: one.total.value for one in some.sobol(32) if (one.quantity, one.colour) == ("strehl", None)}
    assert max(found, key=lambda source: found[source]) == "overlay"


@pytest.mark.slow
def test_the_budget_for_overlay_agrees_with_the_one_worked_out(ask: Callable[..., Study]):
    asked = ask(limits=["strehl >= 0.9"])
    # Strehl is 1 - (d0² + d1²) / 10 with shifts d in um: good where d0² + d1² <= 1, so the yield at sigma s is
    # 1 - exp(-1 / 2 s²), and 90 % are good at s = (2 ln 10)^-1/2 = 0.466 um, 0.932 times what the process has.
    budget = asked.budget("overlay", 0.9, 600)
    assert budget.verdict == "found"
    # 600 plates know a yield of 90 % to 1.2 % (one sigma), which is 0.024 of the factor.
    assert budget.factor == pytest.approx(0.932, abs=0.075)
    assert budget.low < 0.932 < budget.high
    assert budget.sigmas["overlay_x_m[1]"] == pytest.approx(budget.factor * 0.5e-6)
    for factor, found in zip(budget.factors, budget.yields, strict=True):
        exact = 1 - math.exp(-2 / factor**2) if factor else 1.0
        assert found.share == pytest.approx(exact, abs=0.06)  # three sigma at a yield of 50 %
    assert str(budget).startswith("overlay x 0.9")
    assert asked.budget("overlay_x[0]", 0.9, 100, (0.0, 0.5, 1.0)).sigmas.keys() == {"overlay_x_m[0]"}


@pytest.fixture
def toleranced(fakes, monkeypatch: pytest.MonkeyPatch) -> Callable[..., ToleranceResult]:
    """`tolerance` of four plates that are evaluated in this process."""

    def asked(design: Any, **settings: Any) -> Study:
        return dataclasses.replace(study(design, quiet=True, **settings), run=one_after_another)

    monkeypatch.setattr("doedesign.tolerancing.results.study", asked)
    settings = {"process": fakes.process(), "evaluate": fakes.rows, "limits": ["strehl >= 0.9"], "draws": 4}
    return functools.partial(tolerance, fakes.design(), **settings)


def test_a_result_holds_what_was_asked_for(toleranced: Callable[..., ToleranceResult]):
    few = toleranced(sensitivity="none")
    assert (few.effects, few.variance_shares, few.corners, few.budget) == (None, None, None, None)
    more = toleranced(sensitivity="sobol", sobol=4, corners=True, budget="overlay")
    assert (few.effects, more.effects) == (None, None)
    assert more.variance_shares
    assert more.corners is not None
    assert all(key.startswith("corner") for key in more.corners.keys)
    assert more.budget is not None
    assert more.budget.what == "overlay"
    assert {key.partition("/")[0] for key in few.keys} == {"nominal", "expected", "normal"}
    assert set(few.keys) < set(more.keys)
    assert toleranced().effects
    # Of the worst row of every plate, and with what sources do together.
    for quantity, shares in more.shares.items():
        own = [one for one in more.variance_shares if (one.quantity, one.colour) == (quantity, None)]
        assert shares == {one.source: one.total.value for one in own}


PICTURE = np.linspace(0.0, 1.0, 16).reshape(4, 4)


@pytest.mark.parametrize(
    ("change", "other"),
    [
        ({"focal_length_m": np.inf, "distance_m": 0.1}, {"focal_length_m": np.inf, "distance_m": 0.2}),
        ({"focal_length_m": np.inf, "distance_m": np.inf}, {}),
        ({"beam": EvenBeam(np.inf)}, {"beam": EvenBeam(0.1)}),
        ({"beam": MeasuredBeam(PICTURE, 1e-4)}, {"beam": MeasuredBeam(PICTURE[::-1], 1e-4)}),
    ],
    ids=["no lens", "angles", "plane wave", "measured beam"],
)
def test_a_study_on_disk_of_any_camera_goes_on(fakes, tmp_path: Path, change: dict[str, Any], other: dict[str, Any]):
    """JSON has no infinity and no pictures; the folder is known again, and that of another camera is refused."""

    def of(camera: dict[str, Any]) -> Study:
        made = dataclasses.replace(fakes.design(), camera=dataclasses.replace(fakes.CAMERA, **camera))
        asked = study(made, process=fakes.process(), evaluate=fakes.rows, out=tmp_path / "study", quiet=True)
        return dataclasses.replace(asked, run=one_after_another)

    first = of(change).monte_carlo(2)
    again = of(change)
    assert again.monte_carlo(2).values["strehl"].tolist() == first.values["strehl"].tolist()
    with pytest.raises(InputError, match="one with another design"):
        of(other).monte_carlo(2)


def test_results_take_the_place_of_older_ones_and_of_nothing_else(
    toleranced: Callable[..., ToleranceResult], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    leave_out_pictures(monkeypatch, result_files)
    monkeypatch.setattr(ToleranceResult, "plot", lambda _: None)
    monkeypatch.setattr(result_files, "evaluate_here", lambda model, plates, workers: ((key, None) for key in plates))
    out, letter = tmp_path / "out", tmp_path / "letter.txt"
    toleranced(budget="overlay", out=out)
    before = {path.name for path in out.iterdir()}
    assert {"budget.png", "one_at_a_time.png", "yield.png"} < before
    letter.write_text("mine")
    manifest = json.loads((out / "manifest.json").read_text())
    manifest["results_sha256"]["../letter.txt"] = "0" * 64
    (out / "manifest.json").write_text(json.dumps(manifest))
    toleranced(sensitivity="none", out=out)
    assert {path.name for path in out.iterdir()} == before - {"budget.png", "one_at_a_time.png"}
    assert letter.read_text() == "mine"


def test_a_limit_on_what_is_not_there_leaves_earlier_results(
    toleranced: Callable[..., ToleranceResult], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """All draws are on the disk by then, so that nothing is evaluated that could tell."""
    leave_out_pictures(monkeypatch, result_files)
    monkeypatch.setattr(ToleranceResult, "plot", lambda _: None)
    monkeypatch.setattr(result_files, "evaluate_here", lambda model, plates, workers: ((key, None) for key in plates))
    toleranced(out=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match="limit on far_spot: must match a colour and depth"):
        toleranced(limits=["far_spot >= 0.3 at 7 m"], out=tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_result_in_words_names_the_source_behind_the_limit_that_most_plates_break(
    toleranced: Callable[..., ToleranceResult],
):
    """All plates break that of the far spot, which depth and corners move; none that of the Strehl ratio."""
    for limits in (["strehl >= 0.0", "far_spot >= 0.9"], ["far_spot >= 0.9", "strehl >= 0.0"]):
        # Two depth errors of 0.02 and one of 0.36 of that variance: 85 %.
        assert "most important: depth, 85 % of the variance of the far spot" in str(toleranced(limits=limits))


def test_a_result_in_words_ends_with_the_sigmas_that_a_budget_allows(toleranced: Callable[..., ToleranceResult], fakes):
    few = toleranced(sensitivity="none")

    def words(*shares: float) -> str:
        budget = budget_of(fakes.process(), "overlay", 0.9, (0, 1, 2), yields(*shares))
        return str(dataclasses.replace(few, budget=budget)).rpartition("; ")[2]

    assert words(1.0, 0.9, 0.2).endswith(" gives a yield of 90 %, sigma of overlay_x 500 nm")
    assert words(1.0, 0.99, 0.95) == "overlay x 2 still gives a yield of 90 %, sigma of overlay_x 1 um"
    assert words(0.7, 0.6, 0.5).endswith("no budget gives a yield of 90 %")


def yields(*shares: float, plates: int = 100) -> list[Any]:
    return [yield_of(np.arange(plates) < round(share * plates)) for share in shares]


def test_a_budget_of_a_yield_that_rises_by_chance(fakes):
    process = fakes.process()
    found = budget_of(process, "overlay", 0.9, (0, 1, 2, 3), yields(1.0, 0.88, 0.94, 0.2))
    # 0.88 and 0.94 are taken as 0.91 each; the crossing lies beyond both.
    assert found.verdict == "found"
    assert 2 <= found.factor < 2.2
    assert found.low < found.factor < found.high < 3


def test_a_budget_that_no_error_size_decides(fakes):
    process = fakes.process()
    beyond = budget_of(process, "overlay", 0.9, (0, 1, 2), yields(1.0, 0.99, 0.95))
    assert (beyond.verdict, beyond.factor) == ("beyond", 2)
    assert str(beyond) == "overlay x 2 still gives a yield of 90 %"
    just = budget_of(process, "overlay", 0.9, (0, 1, 2), yields(1.0, 0.95, 0.9))
    assert (just.verdict, just.factor) == ("beyond", 2)
    never = budget_of(process, "overlay", 0.9, (0, 1, 2), yields(0.7, 0.6, 0.5))
    assert (never.verdict, never.factor, never.low, never.high) == ("out of reach", 0, 0, 0)
    assert "no budget gives a yield of 90 %" in str(never)
    few = budget_of(process, "overlay", 0.9, (0, 1, 2), yields(1.0, 0.9, 0.5, plates=10))
    assert few.factor == 1
    assert few.low == 0  # ten plates cannot show that the yield is 90 %
    assert few.high > 1


@pytest.mark.parametrize(
    ("settings", "call", "match"),
    [
        ({}, lambda asked: asked.budget("overlay"), "a yield needs limits"),
        ({"limits": ["strehl >= 0.9"]}, lambda asked: asked.budget("overlay", 1.0), "between 0 and 1"),
        ({"limits": ["strehl >= 0.9"]}, lambda asked: asked.budget("overlay", 0.9, 0), "at least 1"),
        ({"limits": ["strehl >= 0.9"]}, lambda asked: asked.budget("overlay", 0.9, 9, (0.5, 1)), "must grow from 0"),
        ({"limits": ["strehl >= 0.9"]}, lambda asked: asked.budget("rotation"), "must name errors that vary"),
        ({}, lambda asked: asked.monte_carlo(0), "draws: must be at least 1"),
        ({"evaluate": functools.partial(print)}, lambda asked: asked, "evaluate: must be a function"),
        ({"seed": -1}, lambda asked: asked, "must not be negative"),
        ({"workers": 0}, lambda asked: asked, "workers: must be at least 1"),
        ({"workers": 2, "scheduler": "tcp://x"}, lambda asked: asked, "brings its own workers"),
        ({"errors": {"overlay_q": "1 um"}}, lambda asked: asked, "overlay_q: must be a known key"),
        ({"errors": {"overlay_x": "1 kg"}}, lambda asked: asked, r"overlay_x\.sigma: must be a number with a unit"),
        ({"errors": {"overlay_x": ["1 um"] * 5}}, lambda asked: asked, "errors.overlay_x"),
        ({"errors": {"overlay_x_m": -1e-6}}, lambda asked: asked, "errors.overlay_x"),
    ],
)
def test_what_cannot_be_studied_is_refused(ask: Callable[..., Study], settings: dict, call: Callable, match: str):
    with pytest.raises(InputError, match=match):
        call(ask(**settings))


def test_a_process_without_errors_is_refused_with_a_cure(ask: Callable[..., Study], fakes):
    with pytest.raises(InputError, match=r'errors that vary.*process with errors, such as "contact_aligner"'):
        ask(process=Process(fakes.LEVELS))


def test_a_process_of_other_levels_is_refused(ask: Callable[..., Study]):
    with pytest.raises(InputError, match="must be for"):
        ask(process=Process(dataclasses.replace(ask().process.levels, step_m=80e-9)))


def test_errors_can_be_changed_as_text_or_as_numbers(ask: Callable[..., Study]):
    changed = ask(errors={"overlay_x": {"sigma": ["0.3 um", "0.4 um"]}, "rotation_rad": 1e-4, "depth_scale": 0.01})
    spreads = changed.process.spreads
    assert [spreads[f"overlay_x_m[{k}]"] for k in range(2)] == [Normal(0, 0.3e-6), Normal(0, 0.4e-6)]
    assert spreads["rotation_rad[1]"] == Normal(0, 1e-4)
    assert spreads["depth_scale[0]"] == Normal(0, 0.01)
    assert spreads["corner_radius_m"] == Normal(0, 0.2e-6)  # as it was


def test_plates_as_rows_and_without_limits(ask: Callable[..., Study]):
    plates = ask().monte_carlo(3)
    assert plates.yield_ is None
    assert len(plates.rows) == 3 * 4
    assert plates.rows[0]["key"] == "normal/0"
    assert ("ring_to_disc" in plates.rows[0], "far_spot" in plates.rows[0]) == (True, False)
    assert plates.rows[1]["depth_m"] == math.inf
    assert len(ask().corners().keys) == 2**5


def test_a_plate_is_evaluated_once(ask: Callable[..., Study], fakes):
    counted: list[str] = []

    def counting(model: DrawModel, plates: Mapping[str, Variation]) -> Iterator[tuple[str, Rows]]:
        counted.extend(plates)
        yield from one_after_another(model, plates)

    asked = dataclasses.replace(ask(limits=["strehl >= 0.9"]), run=counting)
    asked.monte_carlo(20)
    asked.monte_carlo(30)
    asked.budget("overlay", 0.9, 10, (0.0, 1.0))
    assert len(counted) == len(set(counted)) == 30 + 10
