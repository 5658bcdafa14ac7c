"""From measured numbers to the plate: what is filled in comes back as the errors it was made from."""

import json
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.design.design import Design
from doedesign.lab.as_built import as_built, as_built_doe, compare_gratings, compare_with_sheet
from doedesign.lab.predictions import predicted_metrics
from doedesign.prediction import predict
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_variation
from fab.errors import InputError
from fab.layout.structures import PAD_SIDES_UM
from fab.levels import Levels
from fab.process import Normal, Process, Variation
from fab.runsheet.as_built import AsBuilt, ChromeMeasured, MaskMeasured
from fab.runsheet.write import record
from fab.units import NM, UM
from sim.store import read_bank
from tests.doedesign.small_runs import finished_run
from tests.fab.sheets import predictions, sheet, spreads_of

LEVELS = Levels(4, 300 * NM)
IDEAL = Process(LEVELS)
NOTHING, BARE = MaskMeasured(), ChromeMeasured()
PADS_M = [side * UM for side in PAD_SIDES_UM]

SPEC = """
name = "small"

[optics]
focal_length = "0.4 mm"
wavelengths = ["550 nm"]
design_wavelength = "550 nm"

[doe]
samples = 64
pitch = "1.85 um"
aperture = "118.4 um"
material = "fused_silica"

[process]
levels = 4
level_step = "300 nm"

[scene]
near = ["3 mm"]
far = ["inf"]

[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 40

[optimize]
start = "random"
steps = 0

[[objective]]
name = "far_spot"
"""


def measured(*masks: MaskMeasured, chrome: ChromeMeasured = BARE, **rest: Any) -> AsBuilt:
    blank = dict.fromkeys(("corner_radius_m", "sidewall_rad", "grating_binary", "grating_blazed", "predicted"))
    given: dict[str, Any] = {"notes": {}, **blank, **rest}
    return AsBuilt(level_map_sha256="", masks=masks or (NOTHING, NOTHING), chrome=chrome, **given)


def pads(depth_m: float, lag: float) -> tuple[tuple[float, float], ...]:
    return tuple((side, depth_m * (1 - lag * depth_m / side)) for side in PADS_M)


# Everything that a lab can measure, of a plate of two masks.
PLATE = Variation(
    depth_scale=(0.03, -0.02),
    overlay_y_m=(0.2 * UM, -0.4 * UM),
    overlay_x_m=(0.0, 0.5 * UM),
    cd_bias_m=(0.08 * UM, -0.05 * UM),
    corner_radius_m=0.3 * UM,
    sidewall_rad=math.radians(4),
    etch_lag=0.06,
    chrome_y_m=1 * UM,
    chrome_x_m=-2 * UM,
    chrome_diameter_m=-3 * UM,
)


def numbers_of(plate: Variation, levels: Levels) -> dict[str, Any]:
    """What a lab would write down for a plate, by the keys of the sheet."""
    out: dict[str, Any] = {}
    for bit in range(levels.bits):
        depth_m = levels.etch_depth_m(bit) * (1 + plate.depth_scale[bit])
        bias_um = plate.cd_bias_m[bit] / UM
        out[f"mask {bit + 1}"] = {
            "depth_by_pad_nm": {f"{side / UM:g} um": depth / NM for side, depth in pads(depth_m, plate.etch_lag)},
            "cd_um": {"2 um line": 2 + 2 * bias_um, "3 um gap": 3 - 2 * bias_um, "5 um line": 5 + 2 * bias_um},
            "overlay_x_um": plate.overlay_x_m[bit] / UM,
            "overlay_y_um": plate.overlay_y_m[bit] / UM,
            "times_etched": 1,
        }
    out["chrome"] = {
        "overlay_x_um": plate.chrome_x_m / UM,
        "overlay_y_um": plate.chrome_y_m / UM,
        "opening_diameter_um": 4430 + plate.chrome_diameter_m / UM,
    }
    corners = {"corner_radius_um": plate.corner_radius_m / UM, "sidewall_deg": math.degrees(plate.sidewall_rad)}
    return {**out, "plate": {**corners, "grating_binary": 0.5, "grating_blazed": 0.25}, "notes": {"wafer": "W1"}}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished run of 64 x 64 cells; pictures, which take most of the time, are left out."""
    folder = tmp_path_factory.mktemp("asbuilt")
    return finished_run(folder, SPEC)


@pytest.fixture(scope="module")
def design(run: Path) -> Design:
    return open_design(open_run(run))


def write_sheet(path: Path, design: Design, numbers: dict[str, Any], predicted: Any = None) -> Path:
    data = record(sheet(LEVELS, zero_layer=True, level_map=design.level_map, predictions=predictions()))
    if predicted is not None:
        data["predicted"] |= predicted
    path.write_text(json.dumps(data | ({"measured": numbers} if numbers else {})))
    return path


def test_what_was_measured_comes_back_as_the_errors_of_the_plate():
    masks = [
        MaskMeasured(x, y, cd, 0.0, None, pads(LEVELS.etch_depth_m(bit) * (1 + scale), PLATE.etch_lag))
        for bit, (x, y, cd, scale) in enumerate(
            zip(PLATE.overlay_x_m, PLATE.overlay_y_m, PLATE.cd_bias_m, PLATE.depth_scale, strict=True)
        )
    ]
    chrome = ChromeMeasured(PLATE.chrome_x_m, PLATE.chrome_y_m, PLATE.chrome_diameter_m)
    found = as_built_doe(
        measured(*masks, chrome=chrome, corner_radius_m=PLATE.corner_radius_m, sidewall_rad=PLATE.sidewall_rad), IDEAL
    )
    for name in ("depth_scale", "overlay_x_m", "overlay_y_m", "cd_bias_m"):
        assert getattr(found.variation, name) == pytest.approx(getattr(PLATE, name), abs=1e-12), name
    # The fit goes round until nothing changes; the depths of the pads differ by parts in 1e4 only.
    assert found.variation.etch_lag == pytest.approx(PLATE.etch_lag, rel=1e-6)
    for name in ("corner_radius_m", "sidewall_rad", "chrome_x_m", "chrome_y_m", "chrome_diameter_m"):
        assert getattr(found.variation, name) == getattr(PLATE, name), name
    sources = {one.error: one.source for one in found.taken}
    assert sources["depth_scale[1]"] == sources["etch_lag"] == sources["chrome_diameter_m"] == "measured"
    assert sources["roughness_m"] == sources["rotation_rad[0]"] == "not measured, taken as 0"


def test_nothing_measured_is_the_plate_of_the_means():
    assert as_built_doe(measured(), IDEAL).variation == Variation()
    means = spreads_of(
        LEVELS, common_depth_scale=(0.02, 0.01), depth_scale=(0.01, 0.0), common_cd_bias_m=(50 * NM, 0.0),
        cd_bias_m=(-20 * NM, 0.0), etch_lag=(0.05, 0.02), chrome_x_m=(1 * UM, 0.0), rotation_rad=(1e-5, 0.0),
    )  # fmt: skip
    process = Process(LEVELS, spreads=means)
    found = as_built_doe(measured(), process).variation
    # The common parts count with each mask's own; everything else is the mean as it is.
    assert found.depth_scale == pytest.approx((1.02 * 1.01 - 1,) * 2)
    assert found.cd_bias_m == pytest.approx((30 * NM,) * 2)
    rest = {"common_depth_scale": 0.0, "depth_scale": (), "common_cd_bias_m": 0.0, "cd_bias_m": ()}
    assert replace(found, **rest) == replace(process.expected(), **rest)


def test_a_measured_mask_has_no_common_part_left_and_the_others_keep_it():
    process = Process(LEVELS, spreads=spreads_of(LEVELS, common_depth_scale=(0.04, 0.0), common_cd_bias_m=(50 * NM, 0)))
    found = as_built_doe(measured(MaskMeasured(depths_m=((math.inf, 303 * NM),), edges_m=10 * NM), NOTHING), process)
    assert found.variation.common_depth_scale == found.variation.common_cd_bias_m == 0
    assert found.variation.depth_scale == pytest.approx((0.01, 0.04))
    assert found.variation.cd_bias_m == pytest.approx((10 * NM, 50 * NM))
    assert {t.error: t.source for t in found.taken}["depth_scale[1]"] == "process mean"


def test_edges_moved_on_the_mask_count_with_the_line_width():
    process = Process(LEVELS, spreads=spreads_of(LEVELS, cd_bias_m=(50 * NM, 0.0)))
    moved = MaskMeasured(edge_move_m=-50 * NM)
    assert as_built_doe(measured(moved, moved), process).variation.nominal
    found = as_built_doe(measured(moved._replace(edges_m=60 * NM), moved), process).variation
    assert found.cd_bias_m == pytest.approx((10 * NM, 0))


def test_depths_of_pads_with_scatter_are_a_least_squares_fit(rng):
    deep = [LEVELS.etch_depth_m(bit) for bit in range(2)]
    scatter = [[depth + rng.normal(0, 1 * NM) for _, depth in pads(d, 0.3)] for d in deep]
    masks = [MaskMeasured(depths_m=tuple(zip(PADS_M, depths, strict=True))) for depths in scatter]
    found = as_built_doe(measured(*masks), IDEAL)

    def squares(lag: float, *depths: float) -> float:
        return sum(
            (d - lag * d * d / w - got) ** 2
            for d, of in zip(depths, scatter, strict=True)
            for w, got in zip(PADS_M, of, strict=True)
        )

    best = [found.variation.etch_lag, *(n * (1 + s) for n, s in zip(deep, found.variation.depth_scale, strict=True))]
    least = squares(*best)
    for i, step in ((0, 0.02), (1, 0.3 * NM), (2, 0.3 * NM)):
        for sign in (-1, 1):
            assert squares(*[value + sign * step * (i == j) for j, value in enumerate(best)]) > least
    # 1 nm in one depth moves the lag by about as much as the scatter of 1 nm did.
    assert found.lag_per_nm is not None
    assert abs(best[0] - 0.3) < 4 * found.lag_per_nm


def test_lag_is_never_negative_and_one_pad_alone_takes_the_mean():
    rising = tuple(zip(PADS_M, (305 * NM, 302 * NM, 302 * NM), strict=True))
    found = as_built_doe(measured(MaskMeasured(depths_m=rising), NOTHING), IDEAL)
    assert found.variation.etch_lag == 0
    assert found.variation.depth_scale == pytest.approx((0.01, 0.0))
    process = Process(LEVELS, spreads={"etch_lag": Normal(0.5, 0.1)})
    one = as_built_doe(measured(MaskMeasured(depths_m=pads(306 * NM, 0.5)[:1]), NOTHING), process)
    assert one.variation.etch_lag == 0.5
    assert one.variation.depth_scale == pytest.approx((0.02, 0.0), abs=1e-6)
    assert one.lag_per_nm is None


def test_missed_and_doubled_etches():
    doubled = MaskMeasured(times_etched=2, depths_m=((math.inf, 1224 * NM),))
    found = as_built_doe(measured(MaskMeasured(times_etched=0, depths_m=((math.inf, 0.0),)), doubled), IDEAL).variation
    assert found.repeats == (-1, 1)
    assert found.depth_scale == pytest.approx((0.0, 0.02))
    assert as_built_doe(measured(NOTHING, NOTHING._replace(times_etched=1)), IDEAL).variation.repeats == ()


def test_verniers_and_pads_tell_of_the_place_of_the_die():
    """Turned and stretched masks, and a bowl, are part of what is measured at a die off the middle."""
    spreads = spreads_of(LEVELS, rotation_rad=(2e-5, 0.0), magnification=(1e-5, 0.0), radial_nonuniformity=(0.04, 0.0))
    process = Process(LEVELS, spreads=spreads, die_m=(20e-3, 10e-3))
    # At (y, x) = (20, 10) mm: toward +x 10e-3 * 1e-5 - 20e-3 * 2e-5, toward +y 20e-3 * 1e-5 + 10e-3 * 2e-5.
    there = MaskMeasured(-0.3 * UM, 0.4 * UM, depths_m=((math.inf, 300 * NM * (1 + 0.04 * 0.2)),))
    found = as_built_doe(measured(there, NOTHING), process).variation
    assert found.nominal is False
    assert found.value("overlay_x_m[0]") == pytest.approx(0, abs=1e-15)
    assert found.value("overlay_y_m[0]") == pytest.approx(0, abs=1e-15)
    assert found.value("depth_scale[0]") == pytest.approx(0, abs=1e-12)


def test_overlay_is_measured_against_the_marks_of_a_mask_that_lies_off_itself():
    """Mask 1 by 0.5 um, as the process says, and the second by 0.1 um more at the die, where the first is turned."""
    spreads = spreads_of(LEVELS, overlay_x_m=(0.0, 0.0), rotation_rad=(0.0, 0.0))
    spreads |= {"overlay_x_m[0]": Normal(0.5 * UM), "rotation_rad[0]": Normal(1e-5)}
    process = Process(LEVELS, spreads=spreads, die_m=(20e-3, 0.0))
    chrome = BARE._replace(overlay_x_m=0.2 * UM)
    asked = measured(NOTHING, NOTHING._replace(overlay_x_m=0.1 * UM), chrome=chrome, reference=0)
    found = as_built_doe(asked, process).variation
    assert found.value("overlay_x_m[0]") == pytest.approx(0.5 * UM)
    assert found.value("overlay_x_m[1]") == pytest.approx((0.5 + 0.1 - 0.2) * UM)
    assert found.chrome_x_m == pytest.approx((0.5 + 0.2 - 0.2) * UM)
    # Those of a zero layer lie where they should.
    zero = as_built_doe(asked.__class__(**{**vars(asked), "reference": None}), process).variation
    assert zero.value("overlay_x_m[1]") == pytest.approx(0.1 * UM)


@pytest.mark.parametrize(
    ("mean_m", "moved_m", "source"), [(0.0, -80 * NM, "not measured, taken as 0"), (80 * NM, -80 * NM, "process mean")]
)
def test_sources_are_those_of_errors_and_not_of_what_was_moved_on_the_mask(mean_m: float, moved_m: float, source: str):
    process = Process(LEVELS, spreads=spreads_of(LEVELS, cd_bias_m=(mean_m, 0.0)))
    taken = as_built_doe(measured(NOTHING._replace(edge_move_m=moved_m), NOTHING), process).taken
    assert next(one.source for one in taken if one.error == "cd_bias_m[0]") == source


def test_gratings_are_as_deep_as_the_pads_beside_them():
    """Pads of the drawn depths are gratings as drawn, also where the process is known to etch deeper at the die."""
    process = Process(LEVELS, spreads=spreads_of(LEVELS, radial_nonuniformity=(0.04, 0.0)), die_m=(40e-3, 0.0))
    as_drawn = (MaskMeasured(depths_m=((math.inf, depth_m),)) for depth_m in LEVELS.depths_m)
    shown = measured(*as_drawn, predicted={"probe_wavelength_nm": 633})
    variation = as_built_doe(shown, process).variation
    for row in compare_gratings(shown, process, variation, "fused_silica"):
        assert row["as_built"] == pytest.approx(row["as_drawn"], rel=1e-9)


@pytest.mark.slow
def test_a_filled_sheet_gives_the_prediction_of_the_plate_it_was_filled_from(run, design, tmp_path, caplog):
    wanted = predict(design, IDEAL, PLATE)
    before = [seen._asdict() for seen in predicted_metrics(predict(design, IDEAL, Variation()).rows)]
    file = write_sheet(tmp_path / "s.json", design, numbers_of(PLATE, LEVELS), {"as_drawn": before, "expected": before})
    caplog.set_level(logging.INFO)
    folder = run / "as-built"
    as_built(run, file, out=folder)
    assert folder == run / "as-built"
    bank = read_bank(folder / "as-built.exr")
    # The lag comes out of differences of pads good to 1e-7, and all is float32.
    np.testing.assert_allclose(bank.energy, wanted.bank.energy, rtol=0, atol=1e-5 * wanted.bank.energy.max())
    found = json.loads((folder / "as-built.json").read_text())
    rows = {(row["colour"], row["depth_m"], row["quantity"]): row for row in found["comparison"]}
    for row, old in zip(wanted.rows, before, strict=True):
        for quantity in ("strehl", "zeroth_order", "throughput"):
            told = rows[row["colour"], row["depth_m"], quantity]
            assert told["as_built"] == pytest.approx(row[quantity], rel=1e-4)
            assert told["as_drawn"] == told["expected"] == old[quantity]
    assert [row["measured"] for row in found["gratings"]] == [0.5, 0.25]
    assert found["notes"] == {"wafer": "W1"}
    assert any("ring:disc" in line and "as drawn" in line for line in caplog.messages)
    # What it wrote is what `psf --fabricated --variation` reads.
    variation = load_variation(folder / "variation.toml")
    assert variation.depth_scale == pytest.approx(PLATE.depth_scale)
    again = predict(design, IDEAL, variation)
    np.testing.assert_array_equal(again.bank.energy.astype(np.float32), bank.energy)
    content = {path.name: path.read_bytes() for path in folder.iterdir()}
    as_built(run, file, out=folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == content


def test_an_unfilled_sheet_gives_the_plate_as_drawn(run, design, tmp_path):
    folder = run / "as-built"
    as_built(run, write_sheet(tmp_path / "s.json", design, {}), out=folder)
    nominal = predict(design, IDEAL, Variation())
    np.testing.assert_array_equal(read_bank(folder / "as-built.exr").energy, nominal.bank.energy.astype(np.float32))
    assert load_variation(folder / "variation.toml") == Variation()


def test_another_designs_sheet_and_errors_beyond_the_model_are_refused(run, design, tmp_path):
    other = replace(design, level_map=design.level_map.with_level(np.roll(design.level_map.level, 1, axis=0)))
    with pytest.raises(InputError, match="this design"):
        as_built(run, write_sheet(tmp_path / "s.json", other, {}))
    far = {"mask 1": {"overlay_x_um": 40.0}}
    with pytest.raises(InputError, match="overlay") as caught:
        as_built(run, write_sheet(tmp_path / "t.json", design, far))
    assert "t.json" in str(caught.value)


def test_rows_that_the_sheet_does_not_have_are_compared_with_nothing(design):
    rows = predict(design, IDEAL, Variation()).rows
    assert all(row["as_drawn"] is row["expected"] is None for row in compare_with_sheet(rows, None))
    odd = {"as_drawn": [{"colour": rows[0]["colour"], "depth_m": 9.0, "strehl": 0.5}, 3], "expected": "nothing"}
    assert all(row["as_drawn"] is row["expected"] is None for row in compare_with_sheet(rows, odd))


def test_gratings_follow_the_measured_depths():
    predicted = {"probe_wavelength_nm": 550.0}
    shown = measured(predicted=predicted, grating_binary=0.1)
    drawn_row, _ = compare_gratings(shown, IDEAL, Variation(), "fused_silica")
    assert drawn_row["as_drawn"] == drawn_row["as_built"]
    assert drawn_row["measured"] == 0.1
    missed, blazed = compare_gratings(shown, IDEAL, Variation(repeats=(0, -1)), "fused_silica")
    # Without the deepest etch there is no binary grating: all light goes straight on.
    assert missed["as_built"] == pytest.approx(1.0)
    assert blazed["as_built"] > 0.3
    assert compare_gratings(measured(), IDEAL, Variation(), "fused_silica") == []
