"""Foci on the axis: lenses, several foci, colours, an extended depth of focus; refused mistakes, resumed runs."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0

import doedesign
import doedesign.optimization as optimization
from doedesign.build import camera_from_spec
from doedesign.focus.depth import FocusTable, focus_of_design, focus_table
from doedesign.focus.design import FocusTask
from doedesign.focus.foci import Foci
from doedesign.focus.problem import BESIDE, ring_count, ring_numbers
from doedesign.prediction import on_target
from doedesign.runs.level_maps import open_design
from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.process import Process, Variation
from sim.camera import Colour
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import as_fabricated
from tests.pictures import leave_out_pictures

SMALL = """
name = "small"
[optics]
wavelengths = ["532 nm"]
design_wavelength = "532 nm"
[doe]
samples = 160
pitch = "2 um"
aperture = "320 um"
material = "fused_silica"
[process]
levels = 16
level_step = "72 nm"
[scene]
far = ["inf"]
[sensor]
distance = "4 mm"
pitch = "1 um"
resolution = [640, 480]
window = 64
[focus]
distances = ["4 mm"]
[optimize]
steps = 120
"""
BIFOCAL = ['focus.distances=["3 mm","6 mm"]']
BEAM = ["illumination.kind=gaussian", 'illumination.diameter="200 um"']
COLOURS = ['optics.wavelengths=["640 nm","532 nm","450 nm"]']


@pytest.fixture
def spec_file(tmp_path: Path) -> Path:
    file = tmp_path / "small.toml"
    file.write_text(SMALL)
    return file


def designed(file: Path, *overrides: str):
    spec = doedesign.load_spec(file, list(overrides))
    design = doedesign.optimize(spec)
    table = on_target(design, HeightOptic.of(design.camera, design.nominal_height_m))
    assert table is not None
    assert table.name == "focus"
    return design, focus_of_design(design, HeightOptic.of(design.camera, design.nominal_height_m))


@pytest.mark.slow
def test_one_focus_is_a_lens(spec_file: Path):
    """Sixteen levels leave 98.7 % of an ideal lens's light, cells of 0.15 waves at the rim 96.3 % of that."""
    design, table = designed(spec_file)
    assert table.strength[0] == pytest.approx(0.987 * 0.963, abs=0.01)
    # Cells take light from the rim, which makes an Airy disc a little wider.
    airy = 1.029 * 532e-9 * 4e-3 / 320e-6
    assert (table.width_m[0] > airy).all()
    assert table.width_m[0] == pytest.approx([airy] * 2, rel=0.05)
    # Half of an Airy disc's light lies within its full width at half maximum, 0.476; a little more within 1.15 of it.
    assert table.share[0] == pytest.approx(0.55, abs=0.06)
    lens = doedesign.load_spec(spec_file, [])
    waves = -(np.hypot(_radius(design), 4e-3) - 4e-3) / 532e-9
    ideal = HeightOptic.of(design.camera, np.float32(np.mod(waves, 1) / design.camera.waves_per_metre(532e-9)))
    assert lens.focus is not None
    other = doedesign.focus_table(ideal, Foci.shown(lens.focus, design.camera))
    assert table.strength[0] == pytest.approx(other.strength[0] * 0.987, abs=0.01)
    assert table.width_m[0] == pytest.approx(other.width_m[0], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("levels", [3, 6])
def test_a_lens_of_any_number_of_levels(spec_file: Path, levels: int):
    """Of an ideal lens's light levels leave sinc²(1/L), and cells 96.3 % of that."""
    step = f"process.level_step={1154.8 / levels:.2f} nm"  # one wave at 532 nm
    design, table = designed(spec_file, f"process.levels={levels}", step)
    assert np.unique(design.level_map.level).tolist() == list(range(levels))
    assert table.strength[0] == pytest.approx(np.sinc(1 / levels) ** 2 * 0.963, abs=0.005)


def _radius(design: doedesign.Design) -> np.ndarray:
    grid = design.camera.grid
    return np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x"))


@pytest.mark.slow
def test_the_image_on_the_sensor_agrees(spec_file: Path):
    """The angular spectrum, which shares nothing with the sum along the axis, finds as much light in the focus."""
    design, table = designed(spec_file)
    bank = psf(HeightOptic.of(design.camera, design.nominal_height_m))
    wanted = table.foci.width_m[0] / 2
    own = bank.encircled_energy([wanted])[0, 0, 0]
    # PSFs have the Fresnel loss; a pixel of 1 um in a circle of 7.9 um is coarse.
    assert own == pytest.approx(table.share[0] * table.fresnel, rel=0.05)


def test_a_gaussian_beam_is_brought_to_its_focus(spec_file: Path):
    """Against the integral over a round opening: wider than the aperture's Airy disc, and than an uncut Gaussian."""
    # Left out, the width would be that of light that fills the aperture, which is less.
    _, table = designed(spec_file, *BEAM, 'focus.widths=["10 um"]')
    radius = np.linspace(0, 160e-6, 2001)
    beam, sines = np.exp(-((radius / 100e-6) ** 2)) * radius, radius / np.hypot(radius, 4e-3)
    places = np.linspace(0, 6e-6, 1201)
    light = [np.trapezoid(beam * j0(2 * np.pi / 532e-9 * sines * place), radius) ** 2 for place in places]
    wanted = 2 * places[np.argmax(np.array(light) < light[0] / 2)]
    # Cells take light from the rim, half a per cent of the width; levels and rings do the rest.
    assert table.width_m[0] == pytest.approx([wanted] * 2, rel=0.02)
    assert table.strength[0] > 0.93


@pytest.mark.slow
def test_two_foci_share_the_light(spec_file: Path):
    _, even = designed(spec_file, *BIFOCAL)
    # A splitter of two, the ceiling of 1 x 2 spots, has 0.405 in each with any phase.
    assert even.strength.min() > 0.33
    assert even.strength.max() < 0.45
    assert even.worst < 1
    _, uneven = designed(spec_file, *BIFOCAL, "focus.weights=[3.0,1.0]")
    assert uneven.strength[0] > 2 * uneven.strength[1]


@pytest.mark.slow
def test_every_colour_has_its_own_focus(spec_file: Path):
    own = ['focus.distances=["4 mm","5 mm","6 mm"]', 'focus.colours=["640nm","532nm","450nm"]']
    _, table = designed(spec_file, *COLOURS, *own, "optimize.steps=200")
    assert [table.camera.colours[k].name for k in table.foci.colour] == ["640nm", "532nm", "450nm"]
    # A lens of 4 mm for red has its blue focus at 5.7 mm, and that of green at 4.8: it is not far from there.
    assert table.strength.min() > 0.25
    assert table.worst < 1.05


@pytest.mark.slow
def test_one_distance_for_all_colours(spec_file: Path):
    design, table = designed(spec_file, *COLOURS, "optimize.steps=200")
    assert len(table.strength) == 3
    assert table.strength.min() > 0.25
    red = HeightOptic.of(design.camera, np.float32(np.mod(-(_radius(design) ** 2) / 8e-3 / 532e-9, 1) * 1.15e-6))
    assert focus_of_design(design, red).strength.min() < 0.1  # as a Fresnel lens has it


@pytest.mark.slow
def test_light_stays_in_focus_all_the_way(spec_file: Path):
    way = ['focus.distances=["2 mm","40 mm"]', "focus.through=true", 'focus.widths=["6 um","70 um"]']
    _, table = designed(spec_file, *way, "optimize.steps=600")
    assert len(table.strength) == 60
    assert table.worst < 1.0
    assert table.width_m[0].max() <= 6e-6
    assert table.width_m[-1].max() <= 70e-6


def test_more_planes_where_foci_are_short(spec_file: Path):
    way = ['focus.distances=["2 mm","40 mm"]', "focus.through=true", 'focus.widths=["6 um","70 um"]']
    spec = doedesign.load_spec(spec_file, way)
    assert spec.focus is not None
    foci = Foci.wanted(spec.focus, doedesign.camera_from_spec(spec))
    steps = np.diff(foci.distance_m)
    assert (steps <= 0.26 * foci.width_m[1:] ** 2 / 532e-9).all()
    assert foci.width_m[[0, -1]] == pytest.approx([6e-6, 70e-6])
    assert foci.weight.sum() == pytest.approx(1)


def test_too_many_planes_are_refused(spec_file: Path):
    large = ["doe.samples=4000", 'doe.aperture="8 mm"', 'focus.distances=["20 mm","100 mm"]', "focus.through=true"]
    spec = doedesign.load_spec(spec_file, [*large, 'focus.widths=["4.2 um","4.8 um"]'])
    assert spec.focus is not None
    with pytest.raises(InputError, match="at most 4000 planes can be designed for at once, but got 8"):
        Foci.wanted(spec.focus, doedesign.camera_from_spec(spec))


@pytest.mark.slow
def test_a_stopped_design_goes_on_to_the_same_bytes(spec_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    leave_out_pictures(monkeypatch, optimization)
    few = [*BIFOCAL, "optimize.steps=40", "optimize.checkpoint_every=10"]
    whole = doedesign.optimize(spec_file, tmp_path / "whole", overrides=few)
    stops = [15, 36]

    class Stopped(Exception):
        pass

    from doedesign.focus.design import FocusTask

    original = FocusTask.steps

    def until(self: FocusTask, state):
        for found in original(self, state):
            yield found
            if stops and found[0].step >= stops[0]:
                stops.pop(0)
                raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FocusTask, "steps", until)
        for _ in range(2):
            with pytest.raises(Stopped):
                doedesign.optimize(spec_file, tmp_path / "parts", overrides=few)
    parts = doedesign.optimize(spec_file, tmp_path / "parts", overrides=few)
    np.testing.assert_array_equal(parts.level_map.level, whole.level_map.level)
    assert parts.history == whole.history


@pytest.mark.slow
def test_a_run_holds_table_and_picture(spec_file: Path, tmp_path: Path):
    doedesign.optimize(spec_file, tmp_path / "run", overrides=[*BIFOCAL, "optimize.steps=20"])
    lines = (tmp_path / "run" / "focus.csv").read_text().splitlines()
    assert lines[0] == "distance_mm,colour,wanted_um,width_y_um,width_x_um,strength,share"
    assert [line.split(",")[0] for line in lines[1:]] == ["3", "6"]
    assert (tmp_path / "run" / "focus.png").stat().st_size > 10_000
    assert open_design(tmp_path / "run", False).spec is not None


@pytest.mark.slow
def test_a_plate_with_errors_is_followed(spec_file: Path):
    """Etches 5 % too deep take light from the foci and leave it in the 0th order."""
    design, _ = designed(spec_file, *BIFOCAL)
    deep = Variation(common_depth_scale=0.05)
    found = [
        on_target(design, as_fabricated(design.level_map.level, design.camera, Process(design.levels), v))
        for v in (Variation(), deep)
    ]
    assert all(table is not None for table in found)
    drawn, made = (table.measures() for table in found if table is not None)
    assert made["on_target"] < drawn["on_target"]
    assert made["focus_width"] == pytest.approx(drawn["focus_width"], abs=0.05)


def test_one_distance_for_several_colours_is_no_focus_twice(spec_file: Path):
    distances, colours = 'focus.distances=["4 mm","4 mm"]', 'focus.colours=["640nm","532nm"]'
    spec = doedesign.load_spec(spec_file, [*COLOURS, distances, colours])
    assert spec.focus is not None
    assert spec.focus.distances_m == (4e-3, 4e-3)


@pytest.mark.parametrize(
    ("overrides", "key", "rule"),
    [
        (['focus.widths=["5 um","6 um"]'], "focus.widths", "one for each of the 1 distances"),
        (["focus.through=true"], "focus.distances", "two distances, the nearer first"),
        (['focus.distances=["5 mm","2 mm"]', "focus.through=true"], "focus.distances", "the nearer first"),
        (
            [*BIFOCAL, "focus.through=true", "focus.weights=[1.0,2.0]"],
            "focus.weights",
            "all distances and colours alike",
        ),
        (['focus.colours=["pink"]'], "focus.colours[0]", "a colour of the spec"),
        (['focus.widths=["3 um"]'], "focus.widths[0]", "rings of 2 um focus light to 4.12 um at least"),
        (
            ['focus.distances=["40 mm"]', 'focus.widths=["20 um"]'],
            "focus.widths[0]",
            "focuses light to 47.9 um at least",
        ),
        (['focus.distances=["4 mm","3 mm","4 mm"]'], "focus.distances[2]", "must differ"),
        (
            [*COLOURS, 'focus.distances=["4 mm","4 mm"]', 'focus.colours=["640nm","640nm"]'],
            "focus.distances[1]",
            "foci of one colour must differ",
        ),
        (['scene.far=["1 m"]'], "scene.far", "collimated"),
        ([*BEAM, "illumination.m_squared=1.4"], "illumination.m_squared", "a single mode"),
        ([*BEAM, 'illumination.angle=["1 deg", "0 deg"]'], "illumination.angle", "on the axis of the beam"),
        ([*BEAM, 'illumination.centre=["5 um", "0 um"]'], "illumination.centre", "on the axis of the beam"),
        (["optimize.start=random"], "optimize.start", "starts, steps and levels of their own"),
        (["optimize.start_options.charge=2"], "optimize.start_options", "levels of their own, but got charge"),
    ],
)
def test_what_cannot_be_is_refused(spec_file: Path, overrides: list[str], key: str, rule: str):
    with pytest.raises(InputError) as error:
        doedesign.load_spec(spec_file, overrides)
    assert key in str(error.value)
    assert rule in str(error.value)


@pytest.mark.parametrize("colours", [[], ['optics.wavelengths=["640 nm","532 nm"]']])
def test_the_strength_of_a_search_is_that_of_the_report(spec_file: Path, colours: list[str]):
    """Both are over the light of an ideal lens, which loses none to the width of cells."""
    task = FocusTask.from_spec(doedesign.load_spec(spec_file, [*BIFOCAL, *colours, "optimize.steps=10"]))
    *_, (state, _) = task.steps(task.initial_state())
    design = task.finished(state, [])
    light = task.problem.judge(task.problem.field(jnp.asarray(task.levels.heights_m(), jnp.float32)[state.level]))
    table = focus_of_design(design, HeightOptic.of(design.camera, design.nominal_height_m))
    mean = np.exp(table.foci.weight @ np.log(table.strength))
    assert float(light.strength) == pytest.approx(mean, rel=1e-3)


def test_a_loss_that_is_not_finite_is_refused(spec_file: Path):
    task = FocusTask.from_spec(doedesign.load_spec(spec_file))
    state = task.initial_state()
    with pytest.raises(InputError, match="optimize, step 0: the loss must stay finite"):
        next(task.steps(state._replace(radians=state.radians * np.nan)))


def test_foci_need_no_lens(spec_file: Path):
    text = SMALL.replace("[optics]", '[optics]\nfocal_length = "4 mm"').replace('distance = "4 mm"\n', "")
    spec_file.write_text(text)
    with pytest.raises(InputError, match="behind a DOE without a lens"):
        doedesign.load_spec(spec_file)


def test_the_phase_of_a_lens_falls_toward_its_rim(spec_file: Path, tmp_path: Path):
    """The file for optics programs, unwrapped: as a lens of 4 mm has it."""
    design, _ = designed(spec_file)
    design.write_phase(tmp_path / "lens.DAT", "532 nm")
    rows = np.loadtxt(tmp_path / "lens.DAT", skiprows=1)[:, 0].reshape(160, 160)
    along = np.unwrap(rows[79, 80:150])
    radius = (np.arange(70) + 0.5) * 2e-6
    wanted = -2 * np.pi * (np.hypot(radius, 4e-3) - 4e-3) / 532e-9
    # Levels are a sixteenth of a wave apart, rings of a third of a cell beside the middles of these.
    assert np.abs(along - along.mean() - wanted + wanted.mean()).max() < 0.8


def test_light_beside_a_focus_counts_in_its_loss(spec_file: Path):
    """A quarter of an ideal lens's light on the axis, and as much on three of the four sides."""
    spec = doedesign.load_spec(spec_file, [])
    assert spec.focus is not None
    camera = camera_from_spec(spec)
    table = focus_table(HeightOptic.of(camera), Foci.shown(spec.focus, camera))
    narrow = np.exp(-((3 * table.places) ** 2))  # 0.11 of the axis at half the width
    one_sided = np.where(table.places < 0, narrow, 1.0)
    table = replace(table, strength=np.array([0.25]), light=np.stack([narrow, narrow])[None])
    # As much as 0.42 of the axis does no harm.
    assert table.loss == pytest.approx(np.log(4), abs=0.01)  # 1e-12 of blur, which keeps a root smooth
    table = replace(table, light=np.stack([np.ones_like(narrow), one_sided])[None])
    assert table.loss == pytest.approx(np.log(4) + 5000 * 0.75 * 0.58**2, rel=1e-5)  # single precision


def table_of_a_slit(spec_file: Path) -> FocusTable:
    """Light of a parabola of 40 mm at 532 nm behind a slit, in a colour of two lines of which it is made for one."""
    camera = camera_from_spec(doedesign.load_spec(spec_file, ['sensor.distance="40 mm"', 'focus.distances=["40 mm"]']))
    colour = Colour("two", (532e-9, 640e-9), (0.7, 0.3))
    camera = replace(camera, colours=(colour,), aperture=RectangularAperture((160e-6, 240e-6)))
    square = camera.grid.axis_m("y")[:, None] ** 2 + camera.grid.axis_m("x") ** 2
    height = -square / (2 * 40e-3 * 532e-9 * camera.waves_per_metre(532e-9))
    foci = Foci(np.array([40e-3, 39e-3]), np.array([100e-6, 120e-6]), np.array([0.75, 0.25]), np.array([0, 0]))
    return focus_table(HeightOptic.of(camera, np.float32(height)), foci)


def test_the_table_of_a_slit_is_that_of_integrals_along_its_sides(spec_file: Path):
    """Fresnel's integral is a product of one along each side; the rim sends light off by 0.2 degrees at most."""
    table = table_of_a_slit(spec_file)
    camera, sides = table.camera, (160e-6, 240e-6)
    factor = np.array([weight * camera.transmission(wave) for weight, wave in ((0.7, 532e-9), (0.3, 640e-9))])
    for k, (distance, width) in enumerate(zip((40e-3, 39e-3), (100e-6, 120e-6), strict=True)):
        light, axis, ideal = np.zeros((2, 129)), 0.0, 0.0
        for wave, share in zip((532e-9, 640e-9), factor / factor.sum(), strict=True):
            lens = camera.waves_per_metre(wave) / camera.waves_per_metre(532e-9) / 532e-9 / 40e-3
            fields = []
            for side in sides:
                at = (np.arange(2000) + 0.5) / 2000 * side - side / 2
                bend = np.exp(1j * np.pi * at**2 * (1 / wave / distance - lens))
                turns = np.outer(table.places * width / wave / distance, at)
                fields.append(np.exp(-2j * np.pi * turns) @ bend * (side / 2000))
            over = share / (wave * distance) ** 2 / np.prod(sides)
            light += over * np.abs([fields[0] * fields[1][64], fields[1] * fields[0][64]]) ** 2
            axis += over * abs(fields[0][64] * fields[1][64]) ** 2
            ideal += over * np.prod(sides) ** 2
        # The sinc of a cell at the rim: 0.011 waves across it, 4e-4 of its light, and of obliquity less.
        np.testing.assert_allclose(table.light[k], light / axis, rtol=0, atol=1e-3)
        assert table.strength[k] == pytest.approx(axis / ideal, rel=1e-3)
        places, both = table.places[64:81] * width, light[:, 64:81].mean(0)
        inside = np.sum((2 * np.pi * places * both)[:-1] + (2 * np.pi * places * both)[1:]) * width / 64
        assert table.share[k] == pytest.approx(inside, rel=1e-3)
        widths = [np.interp(-0.5, -along[64:] / axis, table.places[64:]) * 2 * width for along in light]
        assert table.width_m[k] == pytest.approx(widths, rel=2e-3)
    assert table.worst == pytest.approx((table.width_m / np.array([[100e-6], [120e-6]])).max())
    at = (np.arange(2000) + 0.5) / 2000 - 0.5
    straight_on = [np.mean(np.exp(-1j * np.pi * (at * side) ** 2 / 532e-9 / 40e-3)) for side in sides]
    assert table.zeroth_order == pytest.approx(np.prod(np.abs(straight_on)) ** 2, rel=1e-3)
    assert table.measures()["on_target"] == pytest.approx(0.75 * table.share[0] + 0.25 * table.share[1])


def test_words_and_rows_of_foci(spec_file: Path):
    table = table_of_a_slit(spec_file)
    lost = np.stack([table.light[0], np.ones((2, 129))])  # as bright as the axis all along
    told = replace(table, light=lost, strength=np.array([0.5, 0.25]), share=np.array([0.4, 0.2]), zeroth_order=0.0125)
    told = replace(told, fresnel=0.9)
    wide_y, wide_x = table.width_m[0] * 1e6
    assert told.width_m[0] == pytest.approx(table.width_m[0])
    assert np.isinf(told.width_m[1]).all()
    assert told.describe() == (
        f"focus {max(wide_y, wide_x):.4g} um at 40 mm, ? um at 39 mm wide; at worst ? times the width wanted, of 2 "
        "looked at; 25 to 50 % of an ideal lens's light on the axis (ceiling: none known), 0th order 1.25 %; Fresnel "
        "loss of 10.0 % apart"
    )
    assert told.to_csv().splitlines()[1:] == [
        f"40,two,100,{wide_y:.6g},{wide_x:.6g},0.5,0.4",
        "39,two,120,inf,inf,0.25,0.2",
    ]
    assert told.measures() == {"on_target": pytest.approx(0.35), "focus_width": 10.0}
    rows = told.summary()["foci"]
    assert rows[0]["width_y_m"] == pytest.approx(wide_y * 1e-6)
    assert (rows[1]["width_y_m"], rows[1]["width_x_m"], rows[1]["strength"]) == (None, None, 0.25)
    assert told.summary()["focus_width"] is None


def test_usual_widths_are_those_of_an_ideal_lens_or_of_rings(spec_file: Path):
    """1.15 times 1.029 lambda z / D, z the way to the rim; no finer than cells make it, 1.029 times two of them."""
    spec = doedesign.load_spec(spec_file, [])
    camera = camera_from_spec(spec)
    assert spec.focus is not None
    foci = Foci.shown(spec.focus.model_copy(update={"distances_m": (4e-3, 1e-4)}), camera)
    lens = 1.029 * 532e-9 * np.hypot(4e-3, camera.aperture_m / 2) / camera.aperture_m
    assert foci.width_m == pytest.approx([1.15 * lens, 1.15 * 1.029 * 2 * 2e-6], rel=1e-3)
    assert foci.weight == pytest.approx([0.5, 0.5])
    way = {"distances_m": (2e-3, 40e-3), "through": True, "widths_m": (6e-6, 70e-6)}
    foci = Foci.shown(spec.focus.model_copy(update=way), camera)
    power = np.log(70 / 6) / np.log(20)  # so that both ends have their widths
    assert foci.width_m == pytest.approx(6e-6 * (foci.distance_m / 2e-3) ** power, rel=1e-9)
    assert foci.weight[1:-1] == pytest.approx(1 / 60, rel=1e-9)  # distances in equal ratios


def test_rings_reach_a_cell_beyond_the_rim(spec_file: Path):
    camera = camera_from_spec(doedesign.load_spec(spec_file, []))
    count = ring_count(camera)
    assert (count - 1) / 3 < camera.aperture_m / 2 / 2e-6 + 1 <= count / 3  # three to a cell
    numbers = ring_numbers(camera)
    radius = np.hypot(camera.grid.axis_m("y")[:, None], camera.grid.axis_m("x")) / 2e-6 * 3
    near = numbers < count - 1
    assert np.all((numbers <= radius) & ((radius < numbers + 1) | ~near))
    assert numbers.max() == count - 1
    # The loss of a report looks where the search does, beyond half the width wanted.
    table = table_of_a_slit(spec_file)
    assert np.isin(BESIDE, table.places).all()
    assert (min(BESIDE), max(BESIDE)) == (0.5, 1.0)
