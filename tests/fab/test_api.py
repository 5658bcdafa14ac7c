"""The public names of `fab`: lazy, documented, and the session of a lab as its documentation writes it."""

import dataclasses
import inspect
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest

import fab
from doedesign.build import process_from_spec
from doedesign.spec.process import ProcessSpec
from fab.units import UM
from tests.fab.maps import level_map_from
from tests.orders import named

NAMES = dir(fab)
UNITS = {"m": "metre", "m2": "metre", "rad": "radian", "e": "electron"}


def test_nothing_heavy_is_imported_before_it_is_used():
    heavy = ("numpy", "numba", "klayout", "matplotlib", "pint", "scipy")
    code = f"import sys, fab; dir(fab); fab.InputError; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_is_there_and_says_its_units(name):
    one = getattr(fab, name)
    assert name in dir(fab)
    if name == "STOCK":
        assert set(one) == {"contact_aligner", "stepper", "direct_write"}
        return
    assert one.__module__.startswith("fab.")
    text = inspect.getdoc(one) or ""
    assert text.partition("\n")[0].endswith("."), f"{name} has no first sentence"
    fields = [f.name for f in dataclasses.fields(one)] if dataclasses.is_dataclass(one) else []
    for quantity in {*fields, *(inspect.signature(one).parameters if inspect.isfunction(one) else ())}:
        unit = UNITS.get(quantity.rpartition("_")[2]) if "_" in quantity else None
        assert unit is None or unit in text, f"{name} does not say the unit of {quantity}"
        assert fields or quantity in text, f"{name} does not say what {quantity} is"


@pytest.mark.parametrize("name", ["contact_aligner", "stepper", "direct_write"])
def test_a_stock_process_is_that_of_a_spec(name):
    levels = fab.Levels(16, 75e-9)
    wanted = process_from_spec(ProcessSpec(levels=16, level_step_m=75e-9, stock=name))
    assert fab.STOCK[name].process(levels) == fab.process_from(name, levels) == wanted
    assert fab.process_from(wanted, levels) is wanted
    assert fab.process_from("ideal", levels) == fab.process_from(None, levels) == fab.Process(levels)


def test_what_is_no_process_is_refused():
    with pytest.raises(fab.InputError, match=r"process: must be .*'steper'. Name contact_aligner or stepper or"):
        fab.process_from("steper", fab.Levels(16, 75e-9))
    with pytest.raises(fab.InputError, match="must be for 16 levels of 75 nm"):
        fab.process_from(fab.Process(fab.Levels(8, 150e-9)), fab.Levels(16, 75e-9))


@pytest.mark.parametrize(("value", "metres"), [("75 nm", 75e-9), (2, 2.0), (np.float32(0.5), 0.5), (-1e-6, -1e-6)])
def test_lengths_are_numbers_of_metres_or_text_with_a_unit(value, metres):
    assert fab.metres(value) == metres


@pytest.mark.parametrize("value", ["75", "75 s", "inf", float("nan"), float("inf"), 10**400, True, None, [1.0], 1j])
def test_any_other_length_is_refused_with_rule_and_cure(value):
    with pytest.raises(fab.InputError, match=r"pitch: must be metres or text with a unit .*Give a number"):
        fab.metres(value, "pitch")
    if value in ("inf", float("inf")):
        assert fab.metres(value, infinite=True) == float("inf")


class _Sound(HTMLParser):
    """Counts open tags and pictures."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.pictures = 0, 0
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.open += tag != "img"
        self.pictures += tag == "img"

    def handle_endtag(self, tag):
        self.open -= 1


@pytest.mark.slow
@pytest.mark.parametrize("process", ["contact_aligner", fab.Rules(3 * UM, 3 * UM), None])
def test_a_check_draws_itself(process):
    from matplotlib.figure import FigureBase

    level_map = level_map_from(np.random.default_rng(0).integers(0, 16, (30, 30)), aperture_m=30 * UM, name="quick")
    given = process or fab.STOCK["contact_aligner"].process(level_map.levels)
    report = fab.check(level_map, given)
    assert report.clean == (not report.headlines())
    assert isinstance(report.plot(), FigureBase)
    html = report._repr_html_()
    assert (_Sound(html).open, _Sound(html).pictures) == (0, 1)
    assert "mask 4" in html
    done = fab.repair(level_map, given)
    assert done.rules.printable
    assert fab.check(done.level_map, given).printable


def test_an_order_is_written_proved_and_shown(tmp_path):
    level_map = level_map_from(np.random.default_rng(0).integers(0, 16, (30, 30)), aperture_m=30 * UM, name="quick")
    order = fab.write_order(tmp_path / "quick", level_map, process="stepper", one_to_one=True)
    assert order.order.process.name == "stepper"
    assert order.manifest.name == "quick"
    assert "1:1; the reticle is the cell of a die, 5 times as large" in named(order.folder, "ORDER.csv").read_text()
    for report in (fab.verify(order), fab.verify(tmp_path / "quick"), fab.verify(str(order.folder))):
        assert report.passed
        report.require()
        assert report.checks == order.report.checks
    assert _Sound(order.report._repr_html_()).open == 0
    assert named(order.folder, "ALL.oas").name in order._repr_html_()
    named(order.folder, "CHROME.gds.gz").unlink()
    with pytest.raises(fab.CheckFailed, match="the file is missing"):
        fab.verify(order).require()
