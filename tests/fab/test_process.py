import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab.errors import InputError
from fab.levels import Levels
from fab.process import DEVIATIONS, Defects, Disc, MaskDisc, Normal, Process, Variation, error_names, variation_of

SIXTEEN = Levels(16, 75e-9)


# --- errors -----------------------------------------------------------------------------------------------------------


def test_every_error_is_a_field_of_a_variation_with_its_unit_in_the_name():
    fields = {f.name: f.default for f in dataclasses.fields(Variation)}
    for name, error in DEVIATIONS.items():
        assert fields[name] == (() if error.per_mask else 0.0)
        assert name.endswith("_m") == (error.unit == "m")
        assert name.endswith("_rad") == (error.unit == "rad")
    # What is left draws no numbers of its own.
    assert set(fields) - set(DEVIATIONS) == {"repeats", "particles", "pinholes", "seed"}


def test_flat_names_follow_the_errors_and_the_masks():
    names = error_names(2)
    assert names[:3] == ("common_depth_scale", "depth_scale[0]", "depth_scale[1]")
    assert len(names) == sum(2 if error.per_mask else 1 for error in DEVIATIONS.values())
    # The order is that of the table, not that of the question.
    assert error_names(2, "cd_bias_m", "etch_lag", "overlay_x_m") == (
        "overlay_x_m[0]",
        "overlay_x_m[1]",
        "cd_bias_m[0]",
        "cd_bias_m[1]",
        "etch_lag",
    )


# --- one plate --------------------------------------------------------------------------------------------------------


def test_a_plate_without_errors_is_nominal():
    assert Variation().nominal
    # A seed, and a correlation length without roughness, move nothing; lists of zeros say what empty ones say.
    assert Variation(seed=7, correlation_m=1e-6, overlay_x_m=(0.0, 0.0), repeats=(0, 0)).nominal


@pytest.mark.parametrize("name", [name for name in DEVIATIONS if name != "correlation_m"])
def test_any_error_makes_a_plate_other_than_nominal(name: str):
    value = (0.0, 0.0, 1e-12, 0.0) if DEVIATIONS[name].per_mask else 1e-12
    assert not Variation(**{name: value}).nominal  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "events",
    [{"repeats": (0, -1)}, {"particles": (MaskDisc(0, 0.0, 0.0, 1e-6),)}, {"pinholes": (Disc(0.0, 0.0, 1e-6),)}],
)
def test_any_event_makes_a_plate_other_than_nominal(events):
    assert not Variation(**events).nominal


@given(st.data())
def test_values_come_back_by_flat_name(data: st.DataObject):
    chosen = data.draw(st.dictionaries(st.sampled_from(error_names(4)), st.floats(-1, 1)))
    variation = variation_of(4, chosen, seed=3)
    assert variation.seed == 3
    for name in error_names(4):
        assert variation.value(name) == chosen.get(name, 0.0)


# --- a process --------------------------------------------------------------------------------------------------------


def test_a_plain_process_is_ideal_and_etches_shallow_to_deep():
    process = Process(SIXTEEN)
    assert (process.masks, process.order) == (4, (0, 1, 2, 3))
    assert process.depths_m() == pytest.approx([75e-9, 150e-9, 300e-9, 600e-9], rel=1e-15)  # powers of two
    assert process.expected().nominal


def test_the_expected_plate_has_every_error_at_its_mean():
    process = Process(SIXTEEN, spreads={"overlay_x_m[2]": Normal(1e-6, 5e-7), "etch_lag": Normal(0.05, 0.0)})
    assert process.expected() == Variation(overlay_x_m=(0.0, 0.0, 1e-6, 0.0), etch_lag=0.05)


def test_a_process_can_be_hashed_and_sent_to_another_process_and_keeps_its_own_numbers():
    spreads = {"etch_lag": Normal(0.05, 0.02)}
    process = Process(SIXTEEN, spreads=spreads)
    spreads["etch_lag"] = Normal(0.5, 0.5)
    assert process.spreads == {"etch_lag": Normal(0.05, 0.02)}
    again = pickle.loads(pickle.dumps(process))
    assert again == process
    assert hash(again) == hash(process)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"order": (0, 1, 2)}, r"process: order: must name each of the masks 0 to 3 once, but got \(0, 1, 2\)"),
        ({"order": (0, 1, 2, 2)}, "process: order"),
        ({"order": (1, 2, 3, 4)}, "process: order"),
        ({"spreads": {"overlay": Normal()}}, "process: spreads: overlay: must be a known error"),
        ({"spreads": {"overlay_x_m": Normal()}}, r"must be a known error.*overlay_x_m\[0\]"),
        ({"spreads": {"overlay_x_m[4]": Normal()}}, r"process: spreads: overlay_x_m\[4\]: must be a known error"),
        ({"spreads": {"etch_lag[0]": Normal()}}, "must be a known error"),
        ({"spreads": {"etch_lag": Normal(0.0, -1e-3)}}, "sigma must be finite and not negative"),
        ({"spreads": {"etch_lag": Normal(0.0, math.nan)}}, "sigma must be finite"),
        ({"spreads": {"etch_lag": Normal(math.inf, 0.0)}}, "must be finite"),
        ({"spreads": {"etch_lag": Normal(-0.01, 0.0)}}, "never negative must not be negative"),
        ({"spreads": {"corner_radius_m": Normal(-1e-9, 1e-6)}}, "never negative must not be negative"),
        ({"tone": "grey"}, 'process: tone: must be "clear" or "dark", but got grey'),
        ({"minimum_line_m": -1e-6}, "process: minimum_line_m: must be finite and not negative"),
        ({"minimum_space_m": math.nan}, "process: minimum_space_m"),
        ({"wafer_radius_m": math.inf}, "process: wafer_radius_m"),
        ({"die_m": (0.04, 0.04)}, "process: die_m: must lie on the wafer of radius 0.05 m"),
        ({"die_m": (math.nan, 0.0)}, "process: die_m: must lie on the wafer"),
    ],
)
def test_impossible_processes_are_refused(changes: dict, message: str):
    with pytest.raises(InputError, match=message):
        Process(SIXTEEN, **changes)


@pytest.mark.parametrize("order", [[2, 0, 1, 3], np.array([2, 0, 1, 3])])
def test_an_order_is_a_tuple_of_whole_numbers(order: Any):
    process = Process(SIXTEEN, order=order)
    assert process == Process(SIXTEEN, order=(2, 0, 1, 3))
    assert [type(mask) for mask in process.order] == [int] * 4


def test_means_below_zero_are_for_errors_that_go_both_ways():
    assert Process(SIXTEEN, spreads={"common_cd_bias_m": Normal(-1e-7, 0.0)}).expected().common_cd_bias_m == -1e-7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"particles_per_m2": -1.0}, "defects: particles_per_m2: must be finite and not negative, but got -1.0"),
        ({"pinhole_radius_m": math.nan}, "defects: pinhole_radius_m"),
        ({"missed": 0.7, "doubled": 0.4}, "missed and doubled must sum to at most 1, but got 0.7 and 0.4"),
    ],
)
def test_impossible_defects_are_refused(changes: dict, message: str):
    with pytest.raises(InputError, match=message):
        Defects(**changes)


def test_what_is_believed_of_an_unknown_process_is_that_of_a_cleanroom():
    """Lengths to some micrometres, shares to a tenth; a number outside is a slip of units."""
    for name, error in DEVIATIONS.items():
        most = {"m": 5e-6, "rad": 0.2}.get(error.unit, 0.1)
        assert 0 <= (error.prior_sigma or 0) <= most, name
