"""What is looked for, how far, and what is believed of it before."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.calibration.estimate import calibrate
from doedesign.calibration.unknowns import unknowns_of
from fab.errors import InputError
from fab.levels import Levels
from fab.process import Normal, Process

PITCH_M = 2e-6
LEVELS = Levels(4, 0.3e-6)
# Five standard deviations of two masks, of which neither is known.
LARGEST = {"rotation": 5 * np.sqrt(2) * 3e-4, "magnification": 5 * np.sqrt(2) * 3e-5}


def process(**spreads: Normal) -> Process:
    return Process(LEVELS, spreads=spreads, name="usual")


@pytest.mark.parametrize(
    ("errors", "limit"),
    [
        (["common_cd_bias"], 0.45 * PITCH_M),
        # A mask's own bias comes on top of the common one: each has half of what a cell can lose.
        (["common_cd_bias", "cd_bias[1]"], 0.225 * PITCH_M),
        (["overlay_x[1]"], 2.5 * PITCH_M),
        (["sidewall"], 0.7),
    ],
)
def test_nothing_is_looked_for_beyond_what_the_model_follows(errors: list[str], limit: float):
    names = {"common_cd_bias_m": 5e-6, "cd_bias_m[1]": 5e-6, "overlay_x_m[1]": 50e-6, "sidewall_rad": 1.0}
    wide = process(**{name: Normal(0.0, sigma) for name, sigma in names.items()})
    found = unknowns_of(wide, errors, PITCH_M)
    np.testing.assert_allclose(found.high, limit)
    np.testing.assert_allclose(found.low, 0.0 if errors == ["sidewall"] else -limit)


def test_a_bias_that_is_not_looked_for_takes_its_part_of_the_range():
    """Of 0.9 um that a cell of 2 um can lose to either side, where mask 1 has 0.3 um and all have 0.2 um."""
    means = {"common_cd_bias_m": Normal(0.2e-6, 5e-6), "cd_bias_m[1]": Normal(0.3e-6, 5e-6)}
    wide = process(**means)
    own, common = (unknowns_of(wide, [error], PITCH_M) for error in ("cd_bias[1]", "common_cd_bias"))
    assert [*own.low, *own.high] == pytest.approx([-1.1e-6, 0.7e-6])
    # Mask 0 has none, which bounds what is taken away, mask 1 what is added.
    assert [*common.low, *common.high] == pytest.approx([-0.9e-6, 0.6e-6])
    both = unknowns_of(wide, ["common_cd_bias", "cd_bias[0]"], PITCH_M)
    assert both.high == pytest.approx([0.45e-6, 0.45e-6])


@pytest.mark.parametrize("error", ["rotation", "magnification"])
def test_masks_that_are_turned_lie_off_by_two_and_a_half_cells_at_most(error: str):
    """At the corner of the DOE that is farthest from the middle of the wafer, 30 mm and 3 mm."""
    off = Process(LEVELS, die_m=(0.0, 30e-3))
    assert unknowns_of(off, [error], PITCH_M, 3e-3).high == pytest.approx([min(2.5 * PITCH_M / 33e-3, LARGEST[error])])
    middle = Process(LEVELS)
    assert unknowns_of(middle, [error], PITCH_M).high == pytest.approx([LARGEST[error]])


def test_corners_are_rounded_by_half_a_cell_at_most():
    found = unknowns_of(process(corner_radius_m=Normal(0.0, 5e-6)), ["corner_radius"], PITCH_M)
    assert found.high == pytest.approx([0.49 * PITCH_M])
    assert found.low == pytest.approx([0.0])
    assert found.start == pytest.approx([0.49 * PITCH_M])  # half a standard deviation, as far as it may go


def test_what_is_known_well_is_looked_for_within_five_standard_deviations():
    found = unknowns_of(process(common_depth_scale=Normal(0.01, 0.002)), ["common_depth_scale"], PITCH_M)
    assert (found.low, found.start, found.high) == (pytest.approx([0.0]), pytest.approx([0.01]), pytest.approx([0.02]))
    assert found.assumed == ()


def test_places_of_masks_share_that_of_mask_0():
    """Two masks relative to a third, each uncertain by 3 and 4: 5 apart, and correlated by what they share."""
    names = {"overlay_x_m[0]": 3e-7, "overlay_x_m[1]": 4e-7, "overlay_x_m[2]": 4e-7}
    three = Process(Levels(8, 0.1e-6), spreads={n: Normal(0.0, s) for n, s in names.items()}, name="three")
    found = unknowns_of(three, ["overlay_x"], PITCH_M)
    assert found.names == ("overlay_x_m[1]", "overlay_x_m[2]")
    assert found.sigma == pytest.approx([5e-7, 5e-7])
    assert (found.root @ found.root.T)[0, 1] == pytest.approx(9e-14)
    with pytest.raises(InputError, match="something must be left to find"):
        unknowns_of(three, ["overlay_x[0]"], PITCH_M)


def test_a_mask_0_that_is_known_exactly_is():
    """As the estimate of a calibration says, to which all others are relative."""
    spreads = {"overlay_x_m[1]": Normal(1e-7, 1e-8)}
    found = unknowns_of(Process(Levels(4, 0.1e-6), spreads=spreads, name="known"), ["overlay_x"], PITCH_M)
    assert found.sigma == pytest.approx([1e-8])
    # A process that says nothing of overlay leaves both to be assumed.
    silent = unknowns_of(Process(Levels(4, 0.1e-6), name="silent"), ["overlay_x"], PITCH_M)
    assert silent.sigma == pytest.approx([np.sqrt(2) * 1e-6])


def test_a_mean_that_no_model_follows_is_told():
    spreads = {"common_cd_bias_m": Normal(0.3e-6, 0.01e-6)}
    with pytest.raises(InputError, match="common_cd_bias_m: must have a mean that the model follows"):
        unknowns_of(Process(Levels(4, 0.1e-6), spreads=spreads), ["cd"], 1e-6)


def test_scores_are_standard_normal():
    names = {"overlay_x_m[0]": 3e-7, "overlay_x_m[1]": 4e-7, "overlay_x_m[2]": 2e-7}
    three = Process(Levels(8, 0.1e-6), spreads={n: Normal(1e-7, s) for n, s in names.items()}, name="three")
    found = unknowns_of(three, ["overlay_x"], PITCH_M)
    values = found.values(np.random.default_rng(1).normal(size=(2, 40000)).T[0])
    np.testing.assert_allclose(found.scores(values), np.random.default_rng(1).normal(size=(2, 40000)).T[0], atol=1e-9)
    drawn = np.array([found.values(z) for z in np.random.default_rng(2).normal(size=(20000, 2))])
    np.testing.assert_allclose(np.cov(drawn.T), found.root @ found.root.T, rtol=0.05)  # of 20000: 0.7 % each
    np.testing.assert_allclose(drawn.mean(axis=0), found.mean, atol=2e-8)


@pytest.mark.parametrize("number", ["evaluations", "polish", "seed"])
def test_a_search_without_end_or_a_seed_below_0_is_refused(number: str):
    wrong: dict[str, Any] = {number: -1}
    with pytest.raises(InputError, match=f"{number}: must be 0 or more, but got -1"):
        calibrate(Path("none"), Path("none.toml"), **wrong)


def test_a_seed_is_a_number_that_the_search_takes():
    with pytest.raises(InputError, match=r"seed: must be below 2\^63, but got 18446744073709551616"):
        calibrate(Path("none"), Path("none.toml"), seed=2**64)
