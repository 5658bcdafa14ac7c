import math

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.order.order import plan_order
from fab.process import DEVIATIONS, Defects, Normal, Process, error_names
from fab.stock import IDEAL, STOCK, Stock
from tests.fab.maps import wide_map


@pytest.mark.parametrize("stock", STOCK.values(), ids=STOCK)
def test_every_number_has_a_source(stock: Stock):
    numbers = list(stock.numbers())
    for number in numbers:
        assert number.source.kind in ("sourced", "estimate"), number
        assert len(number.source.text) > 15, number  # says something
        assert number.source.text in str(number)
    # None is left out: a sigma for each error, the limits of printing, every field of Defects.
    assert {n.name for n in numbers if n.kind == "sigma"} == set(DEVIATIONS)
    assert {n.name for n in numbers if n.kind == "mean"} == {k for k, t in stock.errors.items() if t.mean}
    assert {n.name for n in numbers if n.kind == "value"} == {
        "minimum_line_m",
        "minimum_space_m",
        "wafer_radius_m",
        *Defects.__dataclass_fields__,
    }


@pytest.mark.parametrize("stock", STOCK.values(), ids=STOCK)
def test_every_stock_is_a_process(stock: Stock):
    spreads = {
        flat: Normal(typical.mean, typical.sigma)
        for name, typical in stock.errors.items()
        for flat in error_names(4, name)
    }
    defects = Defects(**{name: figure.value for name, figure in stock.defects.items()})
    process = Process(
        Levels(16, 75e-9),
        spreads=spreads,
        defects=defects,
        tone=stock.tone,
        minimum_line_m=stock.minimum_line_m.value,
        minimum_space_m=stock.minimum_space_m.value,
        wafer_radius_m=stock.wafer_radius_m.value,
        name=stock.name,
    )
    assert STOCK[process.name] is stock
    # A chrome opening that strays by three standard deviations stays within the default overlap of 5 um.
    assert 3 * spreads["chrome_x_m"].sigma + 3 * spreads["chrome_diameter_m"].sigma / 2 < 5e-6


def test_published_numbers_are_those_of_their_sources():
    aligner, stepper, writer = (STOCK[name] for name in ("contact_aligner", "stepper", "direct_write"))
    # mems-exchange.org P1530: alignment tolerance 0.5 um, smallest feature 1 um, 4 inch.
    assert aligner.errors["overlay_x_m"].sigma == aligner.errors["overlay_y_m"].sigma == 0.5e-6
    assert aligner.minimum_line_m.value == aligner.minimum_space_m.value == 1e-6
    assert aligner.wafer_radius_m.value == 50e-3
    # photoplotstore.com: lines to +-0.5 um, two edges each; large openings to +-2.54 um; two standard deviations.
    assert aligner.errors["cd_bias_m"].sigma == pytest.approx(0.5e-6 / 2 / 2)
    assert aligner.errors["chrome_diameter_m"].sigma == pytest.approx(2.54e-6 / 2)
    # The same plates, printed at a fifth of their size.
    assert stepper.errors["cd_bias_m"].sigma == pytest.approx(aligner.errors["cd_bias_m"].sigma / 5)
    # Alberta nanoFAB, DWL-200 with the 4 mm lens.
    assert writer.minimum_line_m.value == 1e-6
    for stock in STOCK.values():
        sourced = {number.name for number in stock.numbers() if number.source.kind == "sourced"}
        assert sourced, stock.name


@pytest.mark.parametrize("stock", STOCK.values(), ids=STOCK)
def test_rotation_is_what_the_overlay_leaves_at_marks_70_mm_apart(stock: Stock):
    overlay_m = stock.errors["overlay_x_m"].sigma
    # The texts round to one digit.
    assert stock.errors["rotation_rad"].sigma == pytest.approx(overlay_m * math.sqrt(2) / 70e-3, rel=0.05)


def test_finer_lithography_is_finer():
    aligner, stepper = STOCK["contact_aligner"], STOCK["stepper"]
    for name in ("overlay_x_m", "cd_bias_m", "corner_radius_m", "chrome_x_m"):
        assert stepper.errors[name].sigma < aligner.errors[name].sigma
    assert stepper.minimum_line_m.value < aligner.minimum_line_m.value


def test_the_ideal_process_has_no_errors():
    assert not IDEAL.errors
    assert IDEAL.name not in STOCK
    assert Defects(**{name: figure.value for name, figure in IDEAL.defects.items()}) == Defects()
    assert IDEAL.wafer_radius_m.value == Process(Levels(2, 1e-7)).wafer_radius_m


# What any lab would call usual; a number outside is a slip of units.
USUAL = {
    "mean": {"corner_radius_m": (0.05e-6, 2e-6), "sidewall_rad": (0.0, 0.3), "etch_lag": (0.0, 0.3)},
    "sigma": {"magnification": 1e-5, "rotation_rad": 1e-4, "corner_radius_m": 1e-6, "sidewall_rad": 0.1},
}


@pytest.mark.parametrize("stock", STOCK.values(), ids=STOCK)
def test_numbers_are_those_of_a_cleanroom(stock: Stock):
    for key, typical in stock.errors.items():
        low, high = USUAL["mean"].get(key, (-1e-6 if key.endswith("_m") else -0.1, 1e-6 if key.endswith("_m") else 0.1))
        assert low <= typical.mean <= high, key
        most = USUAL["sigma"].get(key, 5e-6 if key.endswith("_m") else 0.1)
        assert 0 <= typical.sigma <= most, key


@pytest.mark.parametrize("name", sorted(STOCK))
def test_an_order_for_a_process_without_contact_masks_says_so(name, caplog):
    plate = wide_map(np.zeros((8, 8), np.uint8), Levels(4, 300e-9), Grid((8, 8), 2e-6), "s")
    plan_order(plate, process=name, one_to_one=True)
    told = [message for message in caplog.messages if message.startswith(f"process {name}: ")]
    assert len(told) == (name == "direct_write")
    caplog.clear()
    plan_order(plate, process=name, one_to_one=True, direct_write=True)
    assert not [message for message in caplog.messages if message.startswith(f"process {name}: ")]
    if name == "stepper":
        with pytest.raises(InputError, match="reticles hold one die, 5 times as large"):
            plan_order(plate, process=name)
