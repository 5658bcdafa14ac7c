"""The example that explains the paper's 1:1: a very small design, and whether what it finds is physics."""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest

import doedesign.optimization
from tests.pictures import leave_out_pictures

pytestmark = pytest.mark.study

EXAMPLES = Path(__file__).parents[2] / "examples"
LIFTS = (0, 8)


class Example(NamedTuple):
    """The example's modules, what it found, and what it wrote."""

    main: ModuleType
    plates: ModuleType
    answer: Any
    files: list[Path]


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Example]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        import explain_1to1  # pyright: ignore[reportMissingImports]
        import explain_plates  # pyright: ignore[reportMissingImports]

        leave_out_pictures(patch, doedesign.optimization)
        # Each of these compiles a program of its own for seconds; tests/sim looks at what they do.
        slow = ("rounded corners", "tilted walls", "etch lag", "roughness")
        quick = [plate for plate in explain_plates.singles() if plate.error not in slow]
        patch.setattr(explain_plates, "singles", lambda: iter(quick))
        # A twelfth of the paper's aperture.
        run = explain_1to1.design(12, runs=tmp_path_factory.mktemp("runs"))
        answer = explain_plates.explain(explain_plates.bench_of(run), LIFTS, count=2)
        files = explain_1to1.write(answer, run.folder / "explain")
        yield Example(explain_1to1, explain_plates, answer, files)
        for name in ("explain_1to1", "explain_plates", "explain_picture"):
            sys.modules.pop(name)


def test_table_and_verdict(example: Example):
    answer = example.answer
    singles = list(example.plates.singles())
    assert len(answer.of("drawn")) == len(LIFTS)
    assert len(answer.of("single")) == len(singles)
    assert len(answer.of("lifted")) == 8  # at the one other lift: width four times, depth twice, overlay, a missed etch
    assert len(answer.of("draw")) == len(answer.of("frail draw")) == 2
    table, found, picture = example.files
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == 2 * len(answer.seen)  # wavelengths
    assert {"group", "error", "size", "lift", "wavelength", "ring_to_disc", "throughput"} <= rows[0].keys()
    stored = json.loads(found.read_text())
    assert stored["verdict"] == example.main.verdict(answer)
    assert [str(row["ring_to_disc"]) for row in stored["plates"]] == [row["ring_to_disc"] for row in rows]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "line width, all masks" in example.main.table(answer)


def test_energy_is_kept(example: Example):
    # Roughness alone takes light to angles that no row has; everything else is either in the window or beside it.
    bench = example.answer.bench
    for seen in example.answer.seen:
        for colour in example.plates.LINES:
            row = seen.light[colour.name]
            passed = bench.camera.transmission(colour.wavelengths_m[0]) + row["chrome"]
            assert row["throughput"] + row["outside_window"] == pytest.approx(passed, abs=1e-6)
            assert 0 < row["throughput"] < passed


def test_all_lifts_draw_the_same_light_at_the_full_wave(example: Example):
    # Sixteen steps of 75 nm are one wave at 552.06 nm: 1e-4 of a wave more or less where a lift wraps.
    ratios = [seen.light["552 nm"]["ring_to_disc"] for seen in example.answer.of("drawn")]
    assert ratios == pytest.approx([ratios[0]] * len(LIFTS), rel=0.01)
    # At the probe they are 1.06 waves, and wrapped places are wrong by 0.06 waves.
    probe = [seen.ratio for seen in example.answer.of("drawn")]
    assert abs(probe[1] / probe[0] - 1) > 0.1


def test_depth_alone_never_explains_it(example: Example):
    plates = example.answer.alone("depth, all etches") + example.answer.alone("depth, one etch")
    assert not any(seen.reaches for seen in plates)
    # A few hundredths of a wave are hardly a change of what is drawn.
    assert min(seen.light["552 nm"]["strehl"] for seen in plates) > 0.97
    # The design makes its ring by height differences below half a wave: shallower etches leave more in the disc.
    drawn = example.answer.seen[0]
    common = [(s.plate.variation.common_depth_scale, s.ratio) for s in plates if s.plate.lift == 0]
    curve = sorted((depth, ratio) for depth, ratio in common if depth)
    assert np.all(np.diff([ratio for _, ratio in curve]) > 0)
    assert curve[0][1] < drawn.ratio < curve[-1][1]


def test_line_width_costs_light_and_its_sign_and_the_lift_decide(example: Example):
    by_lift = {}
    for lift in LIFTS:
        at_lift = [s for s in example.answer.alone("line width, all masks") if s.plate.lift == lift]
        widths = {round(1e6 * s.plate.variation.common_cd_bias_m, 2): s for s in at_lift}
        drawn = next(s for s in example.answer.of("drawn") if s.plate.lift == lift)
        for sign in (-1, 1):
            steps = [drawn, widths[0.25 * sign], widths[0.5 * sign]]
            # Wrong strips grow with the bias: less of the wanted field and less light in the window, either way.
            assert np.all(np.diff([s.light["552 nm"]["strehl"] for s in steps]) < -0.1)
            assert np.all(np.diff([s.throughput for s in steps]) < 0)
        by_lift[lift] = {width: seen.ratio / drawn.ratio for width, seen in widths.items()}
    # The same error raises the ratio of one lift and lowers that of another.
    assert by_lift[0][-0.5] > 1.5
    assert by_lift[8][-0.5] < 0.6


def test_what_reaches_it_loses_light(example: Example):
    drawn = example.answer.seen[0]
    reaching = [seen for seen in example.answer.seen if seen.reaches]
    assert reaching
    assert all(seen.throughput < drawn.throughput for seen in reaching)
    # What is said to be needed does what is said.
    for lift, family in example.answer.needed.items():
        for found in family.singles:
            assert found.ring_to_disc == pytest.approx(1.0, rel=0.02)
            variation = example.plates.Variation(**found.values)
            seen = example.plates.look_at(
                example.answer.bench, [example.plates.Plate("again", "", "", lift, variation)], "again"
            )
            assert seen[0].ratio == pytest.approx(found.ring_to_disc, rel=1e-4)
