"""Specs with spots: from the file to a run that can be stopped, its table, and a mask order."""

import json
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization as optimization
import doedesign.runs.fabricated
from doedesign.design.design import Design
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.prediction import on_target
from doedesign.runs.fabricated import fabricated
from doedesign.spec import Spec, load_spec, spec_to_toml
from doedesign.spots.design import SpotTask, spots_from_spec
from doedesign.spots.orders import OrderTable, order_table
from fab.errors import InputError
from fab.order.verify import verify
from fab.process import Variation
from sim.optic import HeightOptic
from tests.pictures import leave_out_pictures, leave_out_pictures_of_orders

SPEC = """
name = "fan"

[optics]
focal_length = "20 mm"
wavelengths = ["532 nm"]
design_wavelength = "532 nm"

[doe]
samples = 96
pitch = "2 um"
aperture = "192 um"
material = "fused_silica"

[process]
levels = 8
level_step = "144 nm"

[scene]
far = ["inf"]

[sensor]
pitch = "3.45 um"
resolution = [1440, 1080]
window = 64

[spots]
count = [3, 3]
period = "48 um"
starts = 8

[optimize]
steps = 12
checkpoint_every = 5
"""


def spec_of(tmp_path: Path, *overrides: str) -> Spec:
    path = tmp_path / "fan.toml"
    path.write_text(SPEC)
    return load_spec(path, overrides)


LIST = ["spots.arrangement=list", 'spots.places=[["0.1 mm", "-0.2 mm"], ["0.3 mm", "0 mm"]]']


@pytest.fixture
def free(tmp_path: Path) -> Path:
    """The same spec without a unit cell."""
    path = tmp_path / "free.toml"
    path.write_text(SPEC.replace('period = "48 um"', 'spacing = "120 um"'))
    return path


@pytest.mark.parametrize("levels", [5, 6])
def test_orders_by_any_number_of_levels(tmp_path: Path, levels: int):
    """With any phase 3 x 3 equal orders take 93.9 % at best, and levels keep sinc²(1/L) of that."""
    step = f"process.level_step={1154.8 / levels:.2f} nm"  # one wave at 532 nm
    design = optimize(spec_of(tmp_path, f"process.levels={levels}", step))
    assert np.unique(design.level_map.level).tolist() == list(range(levels))
    table = on_target(design, HeightOptic.of(design.camera, design.nominal_height_m))
    assert isinstance(table, OrderTable)
    assert table.total == pytest.approx(0.939 * np.sinc(1 / levels) ** 2, abs=0.015)
    assert table.uniformity_error < 0.02


def test_a_design_of_orders_repeats_its_cell(tmp_path: Path):
    design = optimize(spec_of(tmp_path))
    level = design.level_map.level
    inner = level[24:72, 24:72]
    np.testing.assert_array_equal(inner[:24, :24], inner[24:, 24:])
    assert len(design.history) == 12
    assert design.history[-1]["names"] == ["efficiency", "uniformity_error"]
    # Of 0.940 x 0.950: nine beams of 24 cells.
    assert design.history[-1]["terms"][0] > 0.85


def waves_of(design: Design, waves_per_m: np.ndarray) -> np.ndarray:
    """Amplitudes of plane waves in the middle of a DOE, cell by cell in double precision, over its open area."""
    y, x = design.camera.grid.axis_m("y"), design.camera.grid.axis_m("x")
    rate = design.camera.waves_per_metre(532e-9)
    field = np.exp(2j * np.pi * rate * design.levels.heights_m()[design.level_map.level])
    field *= np.hypot(y[:, None], x) < 96e-6
    found = [np.sum(field * np.exp(-2j * np.pi * (v * y[:, None] + u * x))) for v, u in waves_per_m]
    return np.array(found) / np.count_nonzero(field)


# The aperture of 192 um is four periods of 48 um: a cell that begins elsewhere has other phases.
@pytest.mark.parametrize("cells", [24, 32])
def test_orders_have_the_phases_that_are_given(tmp_path: Path, cells: int):
    given = np.array([0, 90, 0, 180, 30, -60, 0, -120, 45.0])
    phases = f"spots.phases={[f'{one:g} deg' for one in given]}".replace("'", '"')
    spec = spec_of(tmp_path, phases, f"spots.period={2 * cells} um", "optimize.steps=60")
    design = optimize(spec)
    table = on_target(design, HeightOptic.of(design.camera, design.nominal_height_m))
    assert isinstance(table, OrderTable)
    # Levels of 45 degrees leave a few; orders of a round aperture of few periods reach over into each other.
    assert table.wave is not None
    assert np.degrees(table.wave.phase_rmse) < 3
    light = waves_of(design, table.spots.waves_per_m)
    off = np.angle(light * np.exp(-1j * np.radians(given)))
    off = np.degrees(np.angle(np.exp(1j * (off - np.angle(np.sum(np.exp(1j * off)))))))
    assert np.abs(off).max() < 8
    # These phases cost light: free ones take 93.9 % of it at best.
    assert table.wave is not None
    assert 0.55 < table.wave.share <= table.total * (1 + 1e-9) < 0.88
    assert table.uniformity_error < 0.06
    assert table.summary()["in_wave"] == table.wave.share
    assert 0.75 * table.wave.ceiling < table.wave.share < table.wave.ceiling
    assert "in the wave that is given" in table.describe()
    assert table.to_csv().splitlines()[0].endswith("over_wanted,phase_error_deg")


def test_spots_on_a_sensor_have_the_phases_that_are_given(free: Path):
    """Two spots draw fringes on the DOE; which of them its middle lies on is their difference of phases."""
    for shift in (0, 90, 180):
        one = load_spec(free, ["spots.count=[2, 1]", "spots.spacing=0.5 mm", f'spots.phases=["0 deg", "{shift} deg"]'])
        design = optimize(one)
        table = on_target(design, HeightOptic.of(design.camera, design.nominal_height_m))
        assert isinstance(table, OrderTable)
        light = waves_of(design, table.spots.waves_per_m)
        assert np.degrees(np.angle(light[1] / light[0] * np.exp(-1j * np.radians(shift)))) == pytest.approx(0, abs=2)
        assert table.wave is not None
        assert table.wave.share == pytest.approx(table.total, rel=2e-3)
        # A sum of two waves is real but for a phase: its sign alone sends 8 / pi^2 into both.
        assert table.total == pytest.approx(8 / np.pi**2, abs=0.02)


@pytest.mark.slow
def test_a_run_holds_its_table_and_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    leave_out_pictures(monkeypatch, optimization)
    spec = spec_of(tmp_path)
    whole = tmp_path / "whole"
    optimize(spec, whole)
    metrics = json.loads((whole / "metrics.json").read_text())["orders"]
    assert metrics["on_target"] > 0.85
    assert metrics["on_target"] == pytest.approx(sum(metrics["spots"]))
    assert metrics["on_target"] < metrics["ceiling"]
    assert metrics["uniformity_error"] < 0.03
    assert (whole / "orders.csv").read_text().count("\n") == 10

    saved = optimization.save_checkpoint

    def stop(run, arrays, step, history):
        saved(run, arrays, step, history)
        if step == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(optimization, "save_checkpoint", stop)
    with pytest.raises(KeyboardInterrupt):
        optimize(spec, tmp_path / "stopped")
    monkeypatch.setattr(optimization, "save_checkpoint", saved)
    optimize(spec, tmp_path / "stopped")
    for name in ("level_map.npz", "history.jsonl", "orders.csv", "metrics.json"):
        assert (tmp_path / "stopped" / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.slow
def test_a_plate_as_fabricated_has_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Etches 5 % too deep make beams unequal, by as much as a transform of the deeper cell says."""
    leave_out_pictures(monkeypatch, doedesign.runs.fabricated)
    design = optimize(spec_of(tmp_path, "spots.count=[3, 1]"))
    found = fabricated(design, variation=Variation(common_depth_scale=0.05), out=tmp_path / "made")
    rate, step = design.camera.waves_per_metre(532e-9), design.levels.step_m
    cell = design.level_map.level[36:37, 36:60].astype(float)
    light = np.exp(2j * np.pi * rate * step * (7 - 1.05 * (7 - cell)))
    waves = np.fft.fft(light[0], norm="forward")[[-1, 0, 1]] * np.sinc(np.array([-1, 0, 1]) / 24)
    made, drawn = found.aimed["fabricated"], found.aimed["nominal"]
    assert isinstance(made, OrderTable)
    assert isinstance(drawn, OrderTable)
    np.testing.assert_allclose(made.efficiency, np.abs(waves) ** 2, atol=1e-5)
    assert made.uniformity_error > 2 * drawn.uniformity_error
    metrics = json.loads((tmp_path / "made" / "metrics.json").read_text())
    assert metrics["orders"]["fabricated"]["spots"] == pytest.approx(list(made.efficiency))
    assert (tmp_path / "made" / "orders.csv").exists()


@pytest.mark.slow
def test_masks_of_a_run_are_proved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    leave_out_pictures(monkeypatch, optimization)
    leave_out_pictures_of_orders(monkeypatch)
    optimize(spec_of(tmp_path), tmp_path / "run")
    done = write_masks(tmp_path / "run", tmp_path / "order")
    assert done.report.passed
    assert verify(tmp_path / "order").passed


def test_free_spots_are_where_they_should_be(free: Path):
    """Three by three 120 um apart, behind an aperture of 192 cells."""
    spec = load_spec(free, ["doe.samples=192", "doe.aperture=0.384 mm", "optimize.steps=30"])
    design = optimize(spec)
    assert spec.spots is not None
    table = order_table(design.as_optic(), spots_from_spec(spec.spots, design.camera))
    assert table.total > 0.8
    assert table.uniformity_error < 0.02
    assert sorted(set(np.round(table.places_m[:, 0] * 1e6, 6))) == [-120, 0, 120]


def test_offset_hexagon_ring_and_list(free: Path):
    def places(*overrides: str) -> np.ndarray:
        text = free.read_text().replace("count = [3, 3]\n", "").replace('spacing = "120 um"\n', "")
        path = free.with_name("other.toml")
        path.write_text(text)
        spec = load_spec(path, ["doe.samples=256", "doe.aperture=0.512 mm", *overrides])
        task = SpotTask.from_spec(spec)
        sines = task.problem.spots.waves_per_m * 532e-9
        return np.stack(task.camera.image_m(*sines.T), axis=1) * 1e3

    np.testing.assert_allclose(places(*LIST), [[-0.2, 0.1], [0, 0.3]], atol=1e-9)
    moved = places("spots.count=[1,2]", "spots.spacing=0.2 mm", 'spots.offset=["0.1 mm", "0.3 mm"]')
    np.testing.assert_allclose(moved, [[0.2, 0.1], [0.4, 0.1]], atol=1e-9)
    assert len(places("spots.arrangement=hexagonal", "spots.rings=1", "spots.spacing=0.2 mm")) == 7
    ring = places("spots.arrangement=ring", "spots.number=4", "spots.radius=0.3 mm")
    np.testing.assert_allclose(ring, [[0, 0.3], [0.3, 0], [0, -0.3], [-0.3, 0]], atol=1e-9)


def test_a_lattice_of_even_counts_is_twice_as_fine(free: Path):
    spec = load_spec(free, ["spots.count=[2, 3]"])
    assert spec.spots is not None
    task = SpotTask.from_spec(spec)
    spots = task.problem.spots
    assert spots.orders is not None
    np.testing.assert_allclose(spots.orders * np.array(spots.lattice_per_m), spots.waves_per_m, rtol=1e-12)


def test_the_table_of_spots_is_written_as_it_was_read(tmp_path: Path):
    spec = spec_of(tmp_path)
    path = tmp_path / "again.toml"
    path.write_text(spec_to_toml(spec))
    assert load_spec(path) == spec


@pytest.mark.parametrize(
    ("overrides", "where", "rule"),
    [
        (["spots.period=0.5 um"], "spots.period", "must be a whole number of cells"),
        (["spots.period=47 um"], "spots.period", "must be a whole number of cells"),
        (["spots.count=[30, 1]"], "spots.period", "steer light to the order 12 at most"),
        (["spots.count=[1, 1]"], "spots.count", "2 to 10000 spots"),
        (["spots.weights=[1.0, 2.0]"], "spots.weights", "one per spot, 9"),
        (["spots.arrangement=ring"], "spots.number", 'arrangement "ring" needs it'),
        (["spots.rings=2"], "spots.rings", 'arrangement "grid" takes: count, period'),
        (['spots.offset=["1 um", "0 um"]'], "spots.offset", "cannot be moved"),
        (['spots.phases=["1 deg", "0 deg"]'], "spots.phases", "one per spot, 9"),
        (['scene.far=["5 m"]'], "scene.far", "collimated beam"),
        (["sensor.defocus=1 mm"], "sensor.defocus", "focal plane"),
        (["optimize.start=random"], "optimize.start", "starts, steps and levels of their own"),
        (["optimize.learning_rate=0.2"], "optimize.learning_rate", "starts, steps and levels of their own"),
        (["optimize.sampling=exact"], "optimize.sampling", "starts, steps and levels of their own"),
        (['objective=[{name = "far_spot"}]'], "spots", "takes the place of objectives"),
        (["process.etch_depths=optimize"], "process.etch_depths", "the depths must be known"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, overrides: list[str], where: str, rule: str):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *overrides)
    assert where in str(refused.value)
    assert rule in str(refused.value)


def test_spots_beyond_what_cells_steer_are_told_the_pitch_that_would_do(free: Path):
    with pytest.raises(InputError, match=r"steer light 2660 um far at most.*choose a pitch of at most 0\.\d+ um|pitch"):
        load_spec(free, ["spots.spacing=4 mm"])


def test_spots_too_far_from_a_tilted_beam_are_told_from_where_it_goes(free: Path):
    """The beam goes 20 mm x sin(20 degrees) = 6.84 mm aside, and the outer spots lie 0.12 mm on the other side."""
    tilted = ['illumination={ kind = "plane", tilt = ["20 deg", "0 deg"] }']
    with pytest.raises(InputError) as refused:
        load_spec(free, tilted)
    told = str(refused.value)
    assert "steer light 2660 um far at most, but got a spot 6960 um from where the tilted beam goes" in told
    assert "choose a pitch of at most 764 nm." in told  # 532 nm / 2 / 0.34802, rounded down


@pytest.mark.parametrize(
    ("overrides", "key", "words"),
    [
        # Chrome reaches 5 um over the rim of 192 um: 532 nm x 20 mm / 182 um is 58.5 um.
        (["spots.spacing=250 nm"], "spots.spacing", r"at least 117 um apart.*got 0\.25 um.*Check the unit"),
        (["spots.spacing=110 um"], "spots.spacing", "at least 117 um apart.*aperture.*got 110 um"),
        # A lens that images tangents gathers the outer spots.
        (["spots.count=[1, 21]", "spots.spacing=117 um", "optics.mapping=tangent"], "spots.spacing", "at least 118 um"),
        # The beam is smaller than the aperture.
        (['illumination={ diameter = "96 um" }'], "spots.spacing", "at least 222 um.*lit aperture.*got 120 um"),
    ],
)
def test_spots_that_share_their_light_are_refused(free: Path, overrides: list[str], key: str, words: str):
    with pytest.raises(InputError, match=f"{key}: .*{words}"):
        load_spec(free, overrides)


@pytest.mark.parametrize(
    ("table", "key", "words"),
    [
        ('arrangement = "hexagonal"\nrings = 2\nspacing = "110 um"', "spacing", "got 110 um"),
        ('arrangement = "ring"\nnumber = 12\nradius = "0.2 mm"', "radius", "got 103.5 um between neighbours"),
        (
            'arrangement = "list"\nplaces = [["0 mm", "0 mm"], ["0.5 mm", "0 mm"], ["0.1 mm", "0 mm"]]',
            "places",
            "at least 117 um.*got 100 um between the places 0 and 2",
        ),
        (
            'arrangement = "list"\nplaces = [["0 mm", "1 mm"], ["0.5 mm", "0 mm"], ["0.5 mm", "0 mm"]]',
            "places",
            "at least 117 um.*got 0 um between the places 1 and 2",
        ),
    ],
)
def test_every_arrangement_is_looked_at(free: Path, table: str, key: str, words: str):
    text = free.read_text().replace("count = [3, 3]\n", "").replace('spacing = "120 um"\n', table + "\n")
    free.write_text(text)
    with pytest.raises(InputError, match=rf"spots\.{key}: .*{words}"):
        load_spec(free)


def test_the_total_of_the_closest_spots_stays_a_share(free: Path):
    """Of spots one width apart the total passes all light, of such as the rule allows it does not."""
    totals = []
    for widths in (1.0, 2.0):
        spec = load_spec(free, ["optimize.steps=30"])
        assert spec.spots is not None
        close = spec.spots.model_copy(update={"spacing_m": widths * 532e-9 * 20e-3 / 182e-6})
        design = optimize(spec.model_copy(update={"spots": close}))
        table = on_target(design, design.as_optic())
        assert isinstance(table, OrderTable)
        totals.append(table.total)
    assert totals[0] > 1
    assert totals[1] < 1


@pytest.mark.parametrize(("period", "fits"), [("128 um", True), ("132 um", False)])
def test_a_whole_unit_cell_fits_into_the_light(tmp_path: Path, period: str, fits: bool):
    """The largest square in a disc of 182 um has sides of 128.7 um."""
    if fits:
        assert spec_of(tmp_path, f"spots.period={period}").spots is not None
        return
    with pytest.raises(InputError, match=r"spots\.period: one period at least.*128\.7 um.*got 132 um.*Check the unit"):
        spec_of(tmp_path, f"spots.period={period}")


def test_a_whole_unit_cell_fits_into_an_open_part_of_a_mask(tmp_path: Path):
    """A frame of 192 um whose bars are 40 um wide, 30 um without what the chrome covers."""
    frame = "doe.aperture={ rows = [[20, 0, 96], [56, 0, 20, 76, 96], [20, 0, 96]] }"
    assert spec_of(tmp_path, frame, "spots.period=28 um").spots is not None
    with pytest.raises(InputError, match=r"spots\.period: .*open over one whole period.*got 36 um.*Check the unit"):
        spec_of(tmp_path, frame, "spots.period=36 um")
    for period in ("2 mm", "0.1 um"):  # more than the DOE, and no cell
        with pytest.raises(InputError, match=r"spots\.period: "):
            spec_of(tmp_path, frame, f"spots.period={period}")


@pytest.mark.slow
def test_nine_by_nine_orders_begin_with_a_row_and_a_column(tmp_path: Path):
    """Rows of nine reach 99.28 % with any phase, and so nine by nine 98.56 %; 16 levels keep 98.7 % of that.

    Searches over the phases of all 81 orders end at 94 %.
    """
    asked = ["spots.count=[9, 9]", "spots.period=192 um", "process.levels=16", "process.level_step=72 nm"]
    spec = spec_of(tmp_path, *asked, "doe.samples=192", "doe.aperture=0.384 mm", "spots.starts=100")
    table = on_target(design := optimize(spec), design.as_optic())
    assert isinstance(table, OrderTable)
    # Cells of 1/96 of a period take 1.3 % of the outermost orders; the rest is rounding and equality.
    assert table.total > 0.955
    assert table.uniformity_error < 0.01


def test_rows_are_crossed_for_grids_of_equal_spots_alone(tmp_path: Path):
    rows = SpotTask.from_spec(spec_of(tmp_path))._crossed_rows()
    assert len(rows) == 4
    for waves in rows:
        phases = waves.phases.reshape(3, 3)
        np.testing.assert_allclose(phases - phases[0], (phases[:, :1] - phases[0, 0]) + np.zeros((3, 3)), atol=1e-12)
        assert np.linalg.norm(waves.weights) == pytest.approx(1)
    for asked in ("spots.count=[3, 1]", f"spots.weights={[1.0] * 8 + [2.0]}"):
        assert not SpotTask.from_spec(spec_of(tmp_path, asked))._crossed_rows()
