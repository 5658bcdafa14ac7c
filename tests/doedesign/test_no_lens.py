"""Specs without a lens: which way light takes, what belongs to a lens only, and a run from the spec to the masks."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import doedesign.optimization as optimization
import doedesign.runs.fabricated
from doedesign.build import camera_from_spec
from doedesign.design.problem import problem_of, view_of
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.prediction import on_target
from doedesign.runs.fabricated import fabricated
from doedesign.spec import Spec, load_spec, spec_to_toml
from fab.errors import InputError
from fab.order.verify import verify
from sim.optic import HeightOptic
from sim.psf_bank import psf
from tests.pictures import leave_out_pictures, leave_out_pictures_of_orders

SPEC = """
name = "bare"

[optics]
wavelengths = ["850 nm"]
design_wavelength = "850 nm"

[doe]
samples = 100
pitch = "4 um"
aperture = "400 um"
material = "fused_silica"

[process]
levels = 8
level_step = "234.6 nm"

[scene]
far = ["inf"]

[sensor]
distance = "5 mm"
pitch = "2 um"
resolution = [1440, 1080]
window = 64

[optimize]
start = "fresnel"
start_options = { focal_length = "5 mm" }
steps = 0
"""


def spec_of(tmp_path: Path, *overrides: str) -> Spec:
    """The spec with changes; `sensor.distance=` takes that line out."""
    path, none = tmp_path / "bare.toml", "sensor.distance="
    path.write_text(SPEC.replace('distance = "5 mm"\n', "") if none in overrides else SPEC)
    return load_spec(path, [change for change in overrides if change != none])


def test_the_way_of_light_follows_from_the_distance(tmp_path: Path):
    near, far = (camera_from_spec(spec_of(tmp_path, f'sensor.distance="{d}"')) for d in ("1.5 mm", "50 mm"))
    assert (near.propagation, far.propagation) == ("angular_spectrum", "far_field")
    assert near.focal_length_m == np.inf
    assert "no lens, sensor 1.5 mm behind" in near.lens_text
    # The shadow of the aperture.
    assert near.defocus_radius_m(np.inf) == pytest.approx(near.aperture_m / 2)
    assert spec_of(tmp_path).image_distance_m == 5e-3


def test_light_from_beside_the_axis_has_images_of_its_own(tmp_path: Path):
    """Astigmatism and coma of 20 degrees, 0.8 waves at this rim, are not computed; of a tilt the sensor stays."""
    with pytest.raises(InputError, match=r"robust\.field: without a lens, light from beside the axis"):
        spec_of(tmp_path, 'robust={ draws = 4, field = "random" }')
    beam = "illumination={ kind = 'plane', WAY = ['0 deg', '20 deg'] }"
    with pytest.raises(
        InputError, match=r"illumination\.angle: without a lens, light must arrive within 4\.\d degrees"
    ):
        camera_from_spec(spec_of(tmp_path, beam.replace("WAY", "angle")))
    assert camera_from_spec(spec_of(tmp_path, beam.replace("WAY", "tilt"))).is_tilted


def test_a_spec_is_written_as_it_was_read(tmp_path: Path):
    spec = spec_of(tmp_path)
    path = tmp_path / "again.toml"
    path.write_text(spec_to_toml(spec))
    assert load_spec(path) == spec


@pytest.mark.slow
@pytest.mark.parametrize(("distance", "least"), [pytest.param("5 mm", 0.6, marks=pytest.mark.slow), ("1.5 mm", 0.05)])
def test_a_run_leads_to_a_verified_order_and_to_a_plate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, distance: str, least: float
):
    leave_out_pictures(monkeypatch, optimization, doedesign.runs.fabricated)
    leave_out_pictures_of_orders(monkeypatch)
    spec = spec_of(tmp_path, f'sensor.distance="{distance}"', f"optimize.start_options.focal_length='{distance}'")
    optimize(spec, tmp_path / "run")
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    row = metrics["psf"][0]
    assert row["far_spot"] > least
    assert sum(row["budget"].values()) == pytest.approx(1, abs=1e-5)
    assert all(one["lens_mapping"] is None for one in metrics.get("accuracy", []))
    made = fabricated(tmp_path / "run")
    assert made.rows["fabricated"][0]["far_spot"] == pytest.approx(row["far_spot"], rel=1e-3)
    write_masks(tmp_path / "run", tmp_path / "order")
    assert verify(tmp_path / "order").passed


@pytest.mark.slow
def test_a_design_is_optimised_for_a_sensor_near_by(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """From a flat start, at a distance for which the angular spectrum is needed."""
    leave_out_pictures(monkeypatch, optimization)
    text = ("optimize.start='flat'", "optimize.start_options={}", "optimize.steps=30", 'sensor.distance="1.5 mm"')
    target = 'objective=[{ name = "target_pattern", options = { pattern = "disc", diameter = "40 um" } }]'
    design = optimize(spec_of(tmp_path, *text, target))
    losses = [record["loss"] for record in design.history]
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.slow
@pytest.mark.parametrize("distance", [pytest.param("3 mm", marks=pytest.mark.slow), "20 mm"])
def test_steps_see_the_light_of_a_near_point_as_it_is_reported(tmp_path: Path, distance: str):
    """By the direct path and in the far field; steps as for a star were off by 0.07 and 0.28."""
    spec = spec_of(tmp_path, f"sensor.distance={distance}", 'scene.far=["2.5 mm", "1 m"]', "optimize.sampling=exact")
    problem, scene = problem_of(spec, {})
    height = 234.6e-9 * np.random.default_rng(2).integers(0, 8, problem.camera.grid.shape)
    seen = np.asarray(view_of(problem, jnp.asarray(height, jnp.float32), scene.first_look()).far[0, 0])
    told = psf(HeightOptic.of(problem.camera, height), depths=[2.5e-3]).energy[0, 0]
    assert np.linalg.norm(seen - told) < 1e-5 * np.linalg.norm(told)  # of float32


def test_orders_of_a_unit_cell_need_no_lens(tmp_path: Path):
    plain = ("optimize.start='flat'", "optimize.start_options={}", "optimize.steps=20")
    spots = 'spots={ count = [3, 3], period = "80 um", starts = 8 }'
    lensed, bare = (
        optimize(spec_of(tmp_path, *plain, spots, *more))
        for more in (("optics.focal_length='5 mm'", "sensor.distance="), ())
    )
    assert lensed.level_map.digest == bare.level_map.digest
    tables = [on_target(each, each.as_optic()) for each in (lensed, bare)]
    assert tables[0] is not None
    assert tables[1] is not None
    assert tables[0].measures() == pytest.approx(tables[1].measures(), abs=1e-5)
    with pytest.raises(InputError, match="in the focus of a lens"):
        spec_of(tmp_path, *plain, 'spots={ count = [3, 3], spacing = "80 um" }')


@pytest.mark.slow
def test_an_area_is_lit_without_a_lens(tmp_path: Path):
    plain = ("optimize.start='flat'", "optimize.start_options={}", "optimize.steps=60", 'sensor.distance="50 mm"')
    area = 'area={ shape = "ellipse", width = "1.5 mm" }'
    design = optimize(spec_of(tmp_path, *plain, area, 'sensor.pitch="20 um"', "sensor.window=128"))
    table = on_target(design, design.as_optic())
    assert table is not None
    assert table.measures()["on_target"] > 0.65  # of an area seven times as wide as what light can draw
    with pytest.raises(InputError, match=r"needs a sensor at least 3\.66 mm away"):
        optimize(spec_of(tmp_path, *plain, 'area={ shape = "ellipse", width = "40 um" }', 'sensor.distance="1.5 mm"'))


@pytest.mark.parametrize(
    ("changes", "where", "words"),
    [
        (['optics.focal_length="8 mm"'], "sensor.distance", "without a lens"),
        (['optics.mapping="tangent"'], "optics.mapping", "belongs to a lens"),
        (['sensor.defocus="1 mm"'], "sensor.defocus", "belongs to a lens"),
        (['optics.propagation="fresnel"'], "optics.propagation", "belongs to a lens"),
        (['scene.near=["5 mm"]', 'scene.far=["1 m"]'], "scene.near", "through a lens"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, changes: list[str], where: str, words: str):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *changes)
    assert where in str(refused.value)
    assert words in str(refused.value)


def test_neither_lens_nor_distance_is_refused(tmp_path: Path):
    path = tmp_path / "bare.toml"
    text = SPEC.replace('distance = "5 mm"\n', "")
    # A start that is a lens has its focus in a distance.
    path.write_text(text)
    assert load_spec(path).sensor.distance_m == 5e-3
    path.write_text(text.replace('start = "fresnel"\nstart_options = { focal_length = "5 mm" }\n', ""))
    with pytest.raises(InputError, match="a camera has a lens, or a sensor at a distance"):
        load_spec(path)
