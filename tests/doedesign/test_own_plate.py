"""A plate of one's own, from an array of heights and without a spec: what takes it, and what is said of slips."""

# What is given here is of other types than annotations say, on purpose.
# pyright: reportArgumentType=false

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import doedesign as dd
import fab
import sim
from doedesign.templates import template_text
from fab.errors import InputError
from tests.pictures import require_place_of_axes, require_whole

PITCH_M, SIDE = 2e-6, 32
GRID = fab.Grid((SIDE, SIDE), PITCH_M)
CAMERA = sim.Camera(GRID, 60e-6, "fused_silica", (sim.Colour("green", (550e-9,), (1.0,)),), 1e-3, 2e-6, 32)
STEP_M = sim.full_wave_height_m("fused_silica", 550e-9) / 4
LEVELS = fab.Levels(4, STEP_M)
AZIMUTH = np.arctan2(GRID.axis_m("y")[:, None], GRID.axis_m("x"))
HEIGHT = fab.HeightMap((AZIMUTH / (2 * np.pi) % 1.0) * 4 * STEP_M, GRID, 60e-6)  # a vortex
PLATE = fab.LevelMap.from_height(HEIGHT, LEVELS, "vortex", wrapped=True)
DESIGN = dd.Design(PLATE, CAMERA, (), (np.inf,))
SPOT = dd.Spots(np.array([[0.0, 1e4]]), np.ones(1))


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("variation", "told"),
    [
        (fab.Variation(overlay_x_m=1e-6), r"overlay_x_m: must have one value per mask, 2, but got 1e-06\. "),
        (fab.Variation(overlay_x_m="1 um"), r"must have one value per mask.*For example \(1e-6, 0\.0\)"),
        (fab.Variation(overlay_x_m=("1 um", 0.0)), "overlay_x_m: must be a number, metres, but got '1 um'"),
        (fab.Variation(common_depth_scale="3 %"), "must be a number, a share, 0.03 for 3 %, but got '3 %'"),
        ({"overlay_x_m": (1e-6, 0.0)}, r"variation: must be a fab\.Variation or a TOML file, but got \{"),
    ],
)
def test_errors_of_a_plate_are_numbers_in_si_units(variation, told):
    with pytest.raises(InputError, match=told):
        DESIGN.fabricated(variation=variation)


@pytest.mark.usefixtures("annotations_unchecked")
def test_a_process_and_a_draw_of_another_kind_are_told():
    wrong = {"stock": "contact_aligner"}
    with pytest.raises(InputError, match=r"process: must be a process or the name of one, but got \{"):
        DESIGN.fabricated(wrong)
    with pytest.raises(InputError, match=r"process: must be a process or the name of one, but got \{"):
        fab.check(PLATE, wrong)
    with pytest.raises(InputError, match='draw: must be the key of a plate of this study, but got "3"'):
        DESIGN.fabricated("contact_aligner", seed=0, draw=3)
    with pytest.raises(InputError, match=r"process: must be a Process, but got a str\. For example fab\.process_from"):
        sim.as_fabricated(PLATE, CAMERA, "contact_aligner", fab.Variation())
    with pytest.raises(InputError, match="process: levels: must be a Levels, but got an int"):
        fab.Process(4)
    with pytest.raises(InputError, match="minimum_line_m: must be finite and not negative, in metres, but got '1 um'"):
        fab.Process(LEVELS, minimum_line_m="1 um")
    for spread in ((0.0, 1e-6), 1e-6):
        with pytest.raises(InputError, match=r"must be a mean and a sigma in SI units, .*fab\.Normal"):
            fab.Process(LEVELS, spreads={"overlay_x_m[0]": spread})
    with pytest.raises(InputError, match="mean and sigma must be finite numbers"):
        fab.Process(LEVELS, spreads={"overlay_x_m[0]": fab.Normal("1 um", 0.0)})


def test_a_level_map_is_fabricated_as_its_numbers_are():
    errors = fab.Variation(overlay_x_m=[0.2e-6, 0.0], cd_bias_m=np.array([1e-7, 0.0]))
    assert errors.overlay_x_m == (0.2e-6, 0.0)
    assert hash(errors) == hash(fab.Variation(overlay_x_m=(0.2e-6, 0.0), cd_bias_m=(1e-7, 0.0)))
    made, same = (sim.as_fabricated(one, CAMERA, fab.Process(LEVELS), errors) for one in (PLATE, PLATE.level))
    np.testing.assert_array_equal(made.transmission, same.transmission)


def test_maps_serve_as_heights_do():
    drawn = sim.psf(PLATE.height_m, CAMERA)
    for plate in (PLATE, dd.Design(PLATE, CAMERA)):
        found = sim.psf(plate, CAMERA, depths="inf")
        np.testing.assert_array_equal(found.energy, drawn.energy)
    np.testing.assert_array_equal(sim.psf(HEIGHT, CAMERA).energy, sim.psf(HEIGHT.height_m, CAMERA).energy)
    np.testing.assert_array_equal(sim.mtf(PLATE, CAMERA).transfer, sim.mtf(PLATE.height_m, CAMERA).transfer)
    design = dd.Design(PLATE, CAMERA)
    assert (design.near_m, design.far_m) == ((), (np.inf,))
    assert sim.zeroth_order(design) == sim.zeroth_order(sim.HeightOptic.of(CAMERA, PLATE))
    made = design.fabricated(variation=fab.Variation(common_depth_scale=0.1))
    assert 0.9 < sim.strehl(made, design)[0] < 0.99


OTHER = fab.Grid((SIDE, SIDE), 3e-6)


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: sim.psf(PLATE), r"camera: a height map needs a `camera`, but got LevelMap alone\. Give lens, sensor"),
        (
            lambda: sim.psf(fab.HeightMap(HEIGHT.height_m, OTHER, 60e-6), CAMERA),
            "camera: must have the grid of the plate, 32 x 32 cells of 3 um, but got 32 x 32 cells of 2 um",
        ),
        (
            lambda: dd.Design(PLATE, CAMERA, (), np.inf),
            "far_m: must be several distances, positive metres, but got inf",
        ),
        (lambda: dd.Design(PLATE, CAMERA, ("5 cm",)), r"near_m: must be several distances.*For example \(0\.05,\)"),
        (lambda: dd.Design(HEIGHT, CAMERA), r"level_map: must be a LevelMap, but got a HeightMap\. Quantise heights"),
        (lambda: dd.Design(PLATE, None), "camera: must be a Camera, but got a NoneType"),
        (
            lambda: dd.tolerance(PLATE),
            r"design: must be a design, a run or its folder, but got a LevelMap\. .*dd\.Design",
        ),
        (lambda: dd.write_masks(PLATE), r"source: must be a design, a run or its folder, but got a LevelMap\."),
        (lambda: dd.write_masks(HEIGHT.height_m), "source: must be a design, a run or its folder, but got a ndarray"),
        (lambda: sim.zeroth_order(PLATE), r"doe: must be a DOE of cells, but got a LevelMap\. Give a design"),
        (lambda: sim.strehl(sim.HeightOptic.of(CAMERA), None), "nominal: must be a DOE of cells, but got a NoneType"),
    ],
)
def test_slips_with_a_plate_of_ones_own_are_told(call, told):
    with pytest.raises(InputError, match=told):
        call()


def test_the_run_sheet_of_ones_own_plate_says_what_it_is_made_of_and_what_light_does(tmp_path):
    """It had the recipe of fused silica whatever the plate is made of, and nothing of its light."""
    camera = replace(CAMERA, material="pmma")
    order = dd.write_masks(dd.Design(PLATE, camera), tmp_path / "order")
    assert order.order.material == "PMMA"
    sheet = json.loads(next((tmp_path / "order").glob("*RUNSHEET.json")).read_text())
    assert sheet["predicted"]["as_drawn"][0]["colour"] == "green"
    assert sheet["predicted"]["design_wavelength_nm"] == 550


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: dd.optimize({}), r"spec: must be a spec or its TOML file, but got a dict\. For example dd\.load_spec"),
        (lambda: dd.load_spec(None), "spec: must be a spec or its TOML file, but got a NoneType"),
        (lambda: dd.psfs(DESIGN), 'run: must be a run or its folder, but got a Design. .* out="runs/NAME"'),
        (lambda: dd.precompensate(PLATE), "run: must be a run or its folder, but got a LevelMap"),
        (
            lambda: dd.tolerance(DESIGN, process="stepper", draws="4"),
            "draws: must be at least 1, a whole number, .*'4'",
        ),
        (lambda: dd.tolerance(DESIGN, process="stepper", draws=2.5), "draws: must be at least 1, a whole number"),
        (lambda: dd.study(DESIGN, process="stepper").monte_carlo("4"), "draws: must be at least 1, a whole number"),
        (
            lambda: dd.tolerance(DESIGN, process="stepper", errors=["overlay_x"]),
            "errors: must be a Mapping, but got a list",
        ),
        (lambda: dd.write_masks(DESIGN, "order", wafer=3), "wafer: must be a wafer or its TOML file, but got 3"),
        (lambda: dd.write_masks(DESIGN, "order", patch=3), "patch: must be a Patch, but got an int"),
        (lambda: fab.write_order("order", HEIGHT.height_m), r"level_map: must be a LevelMap, but got a ndarray\."),
        (lambda: fab.write_level_map("map.npz", HEIGHT), "level_map: must be a LevelMap, but got a HeightMap"),
        (lambda: fab.verify(PLATE), "order: must be a folder, or what write_order returned, but got a LevelMap"),
        (lambda: dd.write_masks(DESIGN, "order", stp_m=3), r"stp_m: must be an argument that there is, .*are step_m, "),
        (lambda: dd.write_masks(DESIGN, DESIGN), "out: must be the path of a file or a folder, but got a Design"),
        (lambda: dd.train("x.toml"), r"design: must be a Design, but got a str\. Of a run: dd\.open_design"),
        (lambda: dd.finetune("model", "pairs"), r"model: must be a Model, but got a str\. .*dd\.Model\.open"),
        (lambda: dd.predict("x", None, None), r"design: must be a Design, but got a str\. .*dd\.open_design"),
        (lambda: dd.camera_from_spec({}), r"spec: must be a Spec, but got a dict\. Read it by dd\.load_spec"),
        (lambda: dd.process_from_spec("stepper"), r"spec: must be a Spec, but got a str\. .*fab\.process_from"),
        (lambda: dd.order_table(DESIGN, [0, 1]), r"spots: must be a Spots, but got a list\. For example dd\.Spots"),
        (lambda: dd.order_table("x", SPOT), "optic: must be a DOE of cells, but got a str"),
        (
            lambda: dd.order_table(DESIGN, SPOT, colour=1),
            r"colour: must be the number of a colour, 0 to 0, but got 1\.",
        ),
        (lambda: dd.area_table(DESIGN, "square"), "target: must be an AreaTarget, but got a str"),
        (lambda: dd.focus_table(DESIGN, 5e-3), "foci: must be a Foci, but got a float"),
        (lambda: dd.simulate_files(DESIGN, "out"), r"design: must have a spec, .* but got none\. Of one picture: dd"),
        (
            lambda: dd.simulate(np.ones((16, 16)), DESIGN, obstruction=3, occlusion="paper"),
            "obstruction: must be a kind of .* but got 3",
        ),
        (lambda: dd.write_report(3), "run: must be a design, a run or its folder, but got a int"),
        (
            lambda: dd.explain_ratio(DESIGN, dd.Targets("550 nm", 0.01, 1.0), process="stepper"),
            "probe: must be positive, but got '550 nm'",
        ),
        (lambda: dd.simulate_files("run", "out"), "design: must be a Design, but got a str"),
        (lambda: dd.reconstruct_files("model", [], "out"), "model: must be a Model, but got a str"),
        (lambda: dd.import_objectives("x.toml"), r"spec: must be a Spec, but got a str\. Read it"),
        (lambda: dd.tolerance(DESIGN, process="stepper", limits=3), r"limits: must be .*, as text, but got \[3\]"),
        (lambda: dd.tolerance(DESIGN, process="stepper", limits=[3]), r"limits: must be .* but got \[3\]"),
        (lambda: dd.tolerance(DESIGN, process="stepper", seed="0"), "seed: must not be negative, a whole .*'0'"),
    ],
)
def test_other_slips_of_a_notebook_are_told(call, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=told):
        call()
    assert not list(tmp_path.iterdir())


def shown_in(figure: Any) -> list[Any]:
    """The arrays of its three panels."""
    return [axes.images[0].get_array() for axes in figure.axes[:3]]


@pytest.mark.parametrize("light", ["scalar", "edges"])
def test_a_plate_as_fabricated_draws_itself(light):
    """A notebook showed the names of its arrays."""
    design = dd.Design(PLATE, replace(CAMERA, light=light))
    drawn, deep = (design.fabricated(variation=fab.Variation(common_depth_scale=scale)) for scale in (0.0, 0.04))
    for plate in (drawn, deep):
        figure = plate.plot()
        require_whole(figure)
        text = plate._repr_html_()
        assert "DOE as fabricated" in text
        assert "0th order at 550 nm" in text
        assert "data:image/png" in text
    whole, before, after = shown_in(deep.plot())
    # The vortex has up to 3/4 of a wave, the etch 4 % too deep: floors lie lower, and phases are counted from the face.
    assert before.shape == after.shape == (SIDE, SIDE)
    assert np.abs(whole).max() == pytest.approx(0.03, abs=0.001 if light == "scalar" else 0.02)
    assert np.abs(shown_in(drawn.plot())[0]).max() < (1e-3 if light == "scalar" else 0.05)
    require_place_of_axes(deep.plot)


def test_a_bank_is_shown_with_the_numbers_that_are_meant_for_its_depths():
    """Of a star and of light without a lens the ring:disc ratio was shown, and of near light the far spot."""
    star, near = (sim.psf(PLATE, CAMERA, depths=depth)._repr_html_() for depth in ("inf", "1 mm"))
    free = replace(CAMERA, focal_length_m=np.inf, distance_m=5e-3)
    for shown in (star, sim.psf(PLATE, free)._repr_html_()):
        assert "far spot" in shown
        assert "ring:disc" not in shown
    assert "ring:disc" in near
    assert "far spot" not in near


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("fan_out", {"spots__count": [3, 3]}, "9 spots: "),
        ("fan_out", {"spots__count": [3, 3], "spots__colours": ["638nm", "520nm"]}, "<th>520nm</th><td>9 spots: "),
        ("diffuser", {"doe__samples": 256, "doe__aperture": "0.512 mm"}, "<th>area</th>"),
        ("bifocal", {"doe__samples": 200, "doe__aperture": "0.4 mm"}, "<th>foci</th>"),
    ],
)
def test_what_a_design_aims_at_is_shown_by_a_notebook(name, changes, words, tmp_path):
    """Its table was an array of numbers."""
    path = tmp_path / f"{name}.toml"
    path.write_text(template_text(name))
    if "spots__colours" in changes:
        changes = {**changes, "optics__wavelengths": ["638 nm", "520 nm"], "optics__design_wavelength": "520 nm"}
    design = dd.optimize(dd.load_spec(path, steps=2, **changes))
    shown = [one for table in dd.fabricated(design).aimed.values() for one in [table._repr_html_()]]
    assert shown
    for text in shown:
        assert words in text
        assert "data:image/png" in text


def test_tables_of_spots_and_foci_look_at_a_design():
    optic = DESIGN.as_optic()
    assert dd.order_table(DESIGN, SPOT).efficiency == dd.order_table(optic, SPOT).efficiency
    bare = replace(CAMERA, focal_length_m=np.inf, distance_m=5e-3)
    foci = dd.Foci(np.array([5e-3]), np.array([5e-5]), np.ones(1), np.zeros(1, int))
    assert (
        dd.focus_table(dd.Design(PLATE, bare), foci).strength == dd.focus_table(optic.with_camera(bare), foci).strength
    )


def test_a_repair_of_ones_own_plate_knows_which_levels_are_near_each_other(monkeypatch):
    """Levels of a relief that is not one wave high were taken for those of one that is."""

    class Planned(Exception):
        pass

    def plan(*given: Any, **asked: Any):
        raise Planned(asked["waves_per_metre"])

    monkeypatch.setattr("doedesign.lab.order.plan_order", plan)
    lower = fab.LevelMap(PLATE.level, fab.Levels(4, STEP_M / 2), GRID, 60e-6)
    with pytest.raises(Planned) as planned:
        dd.write_masks(dd.Design(lower, CAMERA), "order", on_violation="fix")
    assert planned.value.args == pytest.approx([1 / (4 * STEP_M)], rel=1e-6)
