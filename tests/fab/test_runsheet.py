"""The run sheet as values, as JSON and as a page."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from fab.errors import InputError
from fab.files import canonical_json
from fab.levels import Levels
from fab.process import Normal
from fab.runsheet.recipe import depths_m, least_resist, next_target_m
from fab.runsheet.tables import CertifiedOrder
from fab.runsheet.write import BARS, PADS, record, run_sheet_page
from fab.units import NM, UM
from tests.fab.sheets import DIGEST, STEM, predictions, sheet, spreads_of

VOID = {"meta", "img", "br"}
PICTURES = {name: b"\x89PNG not really" for name in ("wafer", "marks", "psfs")}


class Page(HTMLParser):
    """Reads a page, and notes every tag that is closed in the wrong place or not at all."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(f"{tag} at {self.getpos()}")

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def page_of(content, pictures=PICTURES) -> Page:
    return Page(run_sheet_page(content, f"{STEM}_RUNSHEET.json", pictures).decode())


@pytest.mark.parametrize("count", [2, 4, 6, 16, 64])
@pytest.mark.parametrize(("chrome", "zero_layer", "tone"), [("liftoff", False, "clear"), ("etch", True, "dark")])
def test_the_page_is_sound_and_names_every_mask_depth_and_file(count, chrome, zero_layer, tone):
    levels = Levels(count, 75 * NM)
    made = sheet(levels, tuple(reversed(range(levels.bits))), tone, chrome, zero_layer)
    page = page_of(record(made))
    assert (page.wrong, page.open) == ([], [])
    for number, plate in enumerate(made.photomasks, start=1):
        assert f"{number}. {plate.name.capitalize()}: " in page.text
        assert made.files[plate.name].file in page.text
        assert made.files[plate.name].sha256 in page.text
        if plate.bit is not None:
            assert f"Target depth {plate.depth}" in page.text
    for depth in depths_m(levels):
        assert re.search(rf"\b{depth / NM:.10g}\b", page.text)
    assert made.level_map.digest in page.text
    assert "None" not in page.text
    assert "right-reading chrome down" in page.text


def test_the_page_needs_nothing_else_and_repeats_job_and_digest_on_every_printed_page():
    text = run_sheet_page(record(sheet(predictions=predictions())), "x.json", PICTURES).decode()
    page = Page(text)
    assert not [tag for tag, _ in page.tags if tag in ("script", "link", "iframe")]
    sources = [attrs["src"] or "" for _, attrs in page.tags if "src" in attrs]
    assert len(sources) == 3
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in text
    style = text[text.index("<style>") : text.index("</style>")]
    assert f'content: "Run sheet {STEM}"' in style
    assert f'content: "level map {DIGEST[:12]}"' in style
    assert "size: A4" in style
    assert "table, dl, .warning, .sign, figure, .keep { break-inside: avoid; }" in style


def test_words_from_outside_stay_words():
    page = page_of(record(sheet()))
    assert 'edges of <all> masks "+50 nm"' in page.text
    assert "all" not in {tag for tag, _ in page.tags}


def test_without_predictions_the_page_promises_none():
    assert "Strehl" not in page_of(record(sheet()), {}).text
    seen = page_of(record(sheet(predictions=predictions()))).text
    for words in ("0.810 / 0.810", "3.21 / 3.21", "0.654", "infinity", "50 mm", "552.1 nm", "6.45 % over-etched"):
        assert words in seen, words
    assert "one measurement only: overlay of mask 4" in seen
    assert "For the 0th order it is line width (CD bars) of every mask" in seen


def test_certified_orders_stand_on_the_sheet_where_there_are_some():
    row = CertifiedOrder("red", 656 * NM, 0.1234, 0.1357, 0.2, 0.2222, 0.2219)
    seen = replace(predictions(), certified=(row,))
    content = record(sheet(predictions=seen))
    assert content["predicted"]["certified"] == [row._asdict()]
    text = page_of(content).text
    for words in ("656 nm", "12.34 %", "13.57 %", "20.00 %", "22.22 %", "22.19 %"):
        assert words in text
    without = record(sheet(predictions=predictions()))
    assert "certified" not in without["predicted"]
    assert "Maxwell" not in page_of(without).text


def test_the_same_sheet_gives_the_same_bytes_and_is_json():
    contents = [record(sheet(predictions=predictions())) for _ in range(2)]
    assert canonical_json(contents[0]) == canonical_json(contents[1])
    pages = [run_sheet_page(content, f"{STEM}_RUNSHEET.json", PICTURES) for content in contents]
    assert pages[0] == pages[1]


def test_steps_come_in_the_order_of_use_and_say_how_to_align():
    steps = record(sheet(order=(3, 1, 2, 0), chrome="etch", zero_layer=True))["steps"]
    assert [step["code"] for step in steps] == ["Z0", "M4", "M2", "M3", "M1", "CR"]
    # The plates after the first are aligned to its marks, in their own slot.
    for step in steps[1:]:
        align = next(action["how"] for action in step["before"] if action["task"] == "Align")
        assert f"aligned to the Z0 marks in slot {step['code']}" in align
        assert {(row["axis"], row["where"]) for row in step["overlay"]} == {
            (axis, where) for axis in "xy" for where in ("left site", "right site", "middle die")
        }
        assert step["marks"]
    assert steps[0]["overlay"] == steps[0]["marks"] == []
    # 600, 150, 300 and 75 nm one after the other.
    assert [step["etch"]["deepest_floor_nm"] for step in steps[1:5]] == [600, 750, 1050, 1125]
    # Blanket chrome comes before the resist of a chrome etch, and after it in a lift-off.
    assert [a["task"] for a in steps[-1]["before"]][:3] == ["Clean", "Deposit", "Prime"]
    lifted = record(sheet())["steps"][-1]
    assert "Deposit" not in [a["task"] for a in lifted["before"]]
    assert [a["task"] for a in lifted["after"]] == ["Descum", "Deposit", "Lift off"]


def test_resist_is_thick_enough():
    plates = {plate.name: plate for plate in sheet(Levels(64, 75 * NM)).photomasks}
    # A published rule: five times evaporated metal, ten times sputtered.
    assert least_resist(plates["chrome"], 100 * NM, "evaporated")[0] == pytest.approx(0.5 * UM)
    assert least_resist(plates["chrome"], 100 * NM, "sputtered")[0] == pytest.approx(1.0 * UM)
    assert least_resist(plates["mask 1"], 100 * NM, "evaporated")[0] == pytest.approx(1.0 * UM)
    assert least_resist(plates["mask 6"], 100 * NM, "evaporated")[0] == pytest.approx(1.6 * UM)


def test_times_are_depth_over_rate():
    times = record(sheet())["steps"][3]["etch"]["times"]
    assert [(row["rate_nm_per_min"], row["time_s"]) for row in times] == [(10, 3600), (20, 1800), (30, 1200)]
    assert "30:00 min" in page_of(record(sheet())).text


def test_what_holds_for_silica_alone_is_left_out_for_another_material():
    silica, other = record(sheet()), record(sheet(material="N-BK7"))
    assert "CHF3" in page_of(silica).text
    assert "has to be the lab's own recipe" not in page_of(silica).text
    page = page_of(other).text
    for words in ("16 levels in N-BK7", "This wafer is not fused silica", "Into the N-BK7, by the lab's recipe for it"):
        assert words in page
    for words in ("CHF3", "Acetone", "selectivity of 3", "nm/min it is", "HMDS", "xygen plasma", "Remover"):
        assert words not in page, words
        assert words in page_of(silica).text, words
    # Depths are the design's, whatever they are etched into.
    for one, same in zip(silica["steps"], other["steps"], strict=True):
        if one["etch"]:
            assert {**one["etch"], "times": []} == same["etch"]


def test_the_index_stands_beside_the_material():
    known = replace(predictions(), index=1.4599)
    content = record(sheet(predictions=known))
    assert content["predicted"]["index"] == 1.4599
    assert content["predicted"]["wave_height_nm"] == round(550 / 0.4599, 2)
    assert (
        "n = 1.4599 at the design wavelength of 550 nm: one wave is 1195.9 nm of fused silica" in page_of(content).text
    )
    assert "index" not in record(sheet(predictions=predictions()))["predicted"]


def test_the_correction_keeps_the_sum_of_all_etches():
    next_m = next_target_m(75 * NM, 80 * NM, 150 * NM)
    assert next_m == pytest.approx(145 * NM)
    assert 80 * NM + next_m == pytest.approx(75 * NM + 150 * NM)
    etch = record(sheet(order=(3, 0, 1, 2)))["steps"][0]["etch"]
    assert etch["next"] == "mask 1"
    assert {row["off_by_nm"]: row["next_target_nm"] for row in etch["corrections"]} == {-10: 85, -5: 80, 5: 70, 10: 65}
    assert record(sheet())["steps"][3]["etch"]["next"] is None


def test_the_deepest_floor_of_six_levels_is_not_made_by_all_masks():
    content = record(sheet(Levels(6, 75 * NM), (1, 0, 2)))
    assert content["staircase_nm"] == [0, 75, 150, 225, 300, 375]
    etches = [step["etch"] for step in content["steps"] if step.get("etch")]
    # After 150 nm; after 150 + 75 nm; 300 + 75 nm, since no level has all three.
    assert [etch["deepest_floor_nm"] for etch in etches] == [150, 225, 375]
    # So no single other depth keeps the full one right.
    assert [(etch["next"], etch["corrections"]) for etch in etches] == [(None, [])] * 3
    assert "best single correction" not in page_of(content).text
    assert "best single correction" in page_of(record(sheet())).text


def test_line_widths_are_those_at_which_the_doe_comes_out_as_designed():
    """A mask whose edges were drawn 50 nm inward is right where the process moves them 50 nm outward."""
    levels = Levels(4, 75 * NM)
    spreads = spreads_of(levels, common_cd_bias_m=(0.05 * UM, 0.03 * UM), cd_bias_m=(0.0, 0.04 * UM))
    made = sheet(levels, spreads=spreads, moves_m=(-0.05 * UM, 0.0))
    first, second = (record(made)["steps"][step]["widths"] for step in (0, 1))
    assert [row["bar"] for row in first] == list(BARS)
    assert {row["bar"]: row["target_um"] for row in first if "2 um" in row["bar"]} == {
        "2 um line": pytest.approx(2.1),
        "2 um gap": pytest.approx(1.9),
    }
    assert all(row["target_um"] == row["drawn_um"] for row in second)
    # Two standard deviations of 50 nm (30 and 40 in quadrature) at each of two edges.
    assert {row["tolerance_um"] for row in first} == {0.2}
    # The process prints lines of 1.2 um and says nothing of gaps.
    assert [row["bar"] for row in first if row["below_process"]] == ["1 um line"]
    assert all(row["x_mm"] is not None for row in (*first, *second))


@pytest.mark.parametrize("tone", ["clear", "dark"])
@pytest.mark.parametrize("chrome", ["liftoff", "etch"])
@pytest.mark.parametrize("zero_layer", [False, True])
def test_the_resist_is_that_which_makes_of_polygons_what_they_mean(tone, chrome, zero_layer):
    """Light falls through what is no chrome of a photomask; it opens a positive resist, and a negative one stays."""
    made = sheet(tone=tone, chrome=chrome, zero_layer=zero_layer)
    for plate, step in zip(made.photomasks, record(made)["steps"], strict=True):
        (resist,) = (row["how"] for row in step["before"] if row["task"] == "Resist")
        (plate_words,) = (row["how"] for row in step["before"] if row["task"] == "Load the mask")
        lit = "polygons are CLEAR" in plate_words
        assert lit != ("polygons are DARK" in plate_words)
        assert ("POSITIVE" in resist) != ("NEGATIVE" in resist)
        opened = lit == ("POSITIVE" in resist)  # in the polygons
        tasks = [row["task"] for row in (*step["before"], *step["after"])]
        if plate.bit is not None:
            assert opened, "etched in its polygons"
        else:  # chrome stays in its polygons: it is laid down where the resist is open, or etched away there
            assert ("Lift off" in tasks) == opened
            assert ("Etch the chrome" in tasks) != opened


def test_what_the_process_is_known_to_do_to_depths_is_expected_and_not_undone():
    """Told 71.4 nm, a process that etches 5.04 % too deep makes 75 nm, and 75 nm is what is to be measured."""
    levels = Levels(4, 75 * NM, (71.4 * NM, 140 * NM))
    spreads = {"common_depth_scale": Normal(0.04, 0.01), "depth_scale[0]": Normal(0.01, 0.0)}
    content = record(sheet(levels, spreads=spreads))
    first, second = (content["steps"][step]["etch"] for step in (0, 1))
    assert (first["target_nm"], first["expected_nm"]) == (71.4, pytest.approx(71.4 * 1.04 * 1.01))
    assert second["expected_nm"] == pytest.approx(140 * 1.04)
    assert [row["expected_nm"] for row in first["pads"]] == [round(71.4 * 1.04 * 1.01, 2)] * 3
    assert content["staircase_nm"] == pytest.approx([0, 75, 145.6, 220.6], abs=2e-3)
    assert second["deepest_floor_nm"] == content["staircase_nm"][-1]
    # 10 nm too deep: 10 nm less are etched next, for which 10 / 1.04 less are asked.
    assert {row["off_by_nm"]: row["next_target_nm"] for row in first["corrections"]}[10] == pytest.approx(
        140 - 10 / 1.04, abs=1e-6
    )
    text = page_of(content).text
    assert "Target depth 71.4 nm (expected: 74.999 nm)" in text
    assert "true rate = rate × measured depth / expected depth; next time = next target / true rate" in text
    # So an etch that is 10 nm too deep, by the tool's rate of that day, is made up for by the next one.
    rate, too_fast = 20.0, (first["expected_nm"] + 10) / first["expected_nm"]
    asked = {row["off_by_nm"]: row["next_target_nm"] for row in first["corrections"]}[10]
    next_depth = asked / (rate * too_fast) * rate * too_fast * 1.04
    assert first["expected_nm"] + 10 + next_depth == pytest.approx(first["expected_nm"] + second["expected_nm"])
    assert "(expected:" not in page_of(record(sheet())).text


def test_pads_are_measured_near_the_doe_and_expected_as_deep_as_it():
    """A mean bowl of 4 % at 25 of 50 mm: 1 % more than in the middle, which `masks --as-built` takes off again."""
    levels = Levels(4, 75 * NM)
    spreads, at = {"radial_nonuniformity": Normal(0.04)}, {"die_m": (25e-3, 0.0), "wafer_radius_m": 50e-3}
    made = sheet(levels, spreads=spreads)
    own = {name: place for name, place in made.places.items() if ": " not in name}  # of a monitor
    monitors = {"centre": (0.0, 20e-3), "upper": (0.0, 40e-3), "right": (25e-3, 20e-3)}  # from that of `sheet`
    moved = {f"{where} monitor: {name}": (x + dx, y + dy)
             for where, (dx, dy) in monitors.items() for name, (x, y) in own.items()}  # fmt: skip
    made = replace(made, places=moved)
    middle, there = (
        record(replace(made, process=process))["steps"][0]
        for process in (made.process, replace(made.process, **at))
    )  # fmt: skip
    for step, deep, where in ((middle, 75.0, "centre monitor"), (there, 75.75, "upper monitor")):
        assert step["etch"]["expected_nm"] == deep
        assert [(row["expected_nm"], row["where"]) for row in step["etch"]["pads"]] == [(deep, where)] * 3
        assert {row["where"] for row in step["widths"]} == {where}


def test_depth_pads_say_what_etch_lag_does():
    levels = Levels(16, 75 * NM)
    pads = record(sheet(levels, spreads=spreads_of(levels, etch_lag=(0.1, 0.0))))["steps"][3]["etch"]["pads"]
    assert [row["pad"] for row in pads] == list(PADS)
    # 600 nm x (1 - 0.1 x 0.6 um / 20 um) and so on.
    assert [row["expected_nm"] for row in pads] == [598.2, 599.64, 599.93]
    assert {row["target_nm"] for row in pads} == {600}


def test_nothing_is_measured_yet():
    def values(table):
        for value in table.values():
            yield from values(value) if isinstance(value, dict) else [value]

    measured = record(sheet())["measured"]
    assert set(values(measured)) == {None}
    # The first mask that is etched makes the marks, and there is no overlay of it.
    assert [name for name, table in measured.items() if "overlay_x_um" in table] == [
        "mask 2",
        "mask 3",
        "mask 4",
        "chrome",
    ]
    assert "overlay_x_um" in record(sheet(zero_layer=True))["measured"]["mask 1"]
    assert list(measured) == ["mask 1", "mask 2", "mask 3", "mask 4", "chrome", "plate", "notes"]


def test_a_sheet_without_its_files_or_in_another_order_is_refused():
    made, other = sheet(order=(0, 1, 2, 3)), sheet(order=(3, 2, 1, 0))
    with pytest.raises(InputError, match="file"):
        replace(made, files={})
    with pytest.raises(InputError, match="order of the process"):
        replace(made, photomasks=other.photomasks)


def test_the_depths_of_the_staircase_come_as_it_is_scanned():
    """Also where an etch is expected to miss its target by more than a step."""
    short = sheet(spreads={"depth_scale[3]": Normal(-0.25)})
    content = record(short)
    assert content["staircase_nm"][6:10] == pytest.approx([450, 525, 450, 525])
    assert content["steps"][-2]["etch"]["deepest_floor_nm"] == pytest.approx(max(content["staircase_nm"]))
    six = record(sheet(Levels(6, 200e-9), spreads={"depth_scale[2]": Normal(-0.5)}))
    assert six["staircase_nm"] == pytest.approx([0, 200, 400, 600, 400, 600])
    lag = record(sheet(Levels(5, 200e-9), spreads={"depth_scale[2]": Normal(-0.5)}))
    assert lag["staircase_nm"] == pytest.approx([0, 200, 400, 600, 400])
    assert "deepest floor 600 nm below" in run_sheet_page(lag, "a.json").decode()
