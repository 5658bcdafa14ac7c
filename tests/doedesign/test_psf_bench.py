"""The PSF bench: closed forms of its parts, and a calibration that is told of the fibre alone."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doedesign.calibration.estimate import calibrate
from doedesign.calibration.forward_model import ForwardModel
from doedesign.calibration.measurement import load_measurement, read_measurement
from doedesign.calibration.unknowns import unknowns_of
from doedesign.evaluation.optics.bench_measurement import bench_measurement
from doedesign.evaluation.optics.psf_bench import PsfBench, bench_camera, bench_light, bench_throughput
from fab.errors import InputError
from fab.figure import png_bytes
from fab.process import Variation, variation_of
from sim.optic import HeightOptic
from sim.psf_bank import psf
from tests.doedesign.calibration_fakes import plate_drawn, usual_process

NEAR_M, DEPTHS = 2e-3, (2e-3, math.inf)
PAPER = PsfBench()


def test_a_perfect_bench_shows_the_psf_of_sim_and_noise():
    design = plate_drawn(64, 8, window=48)
    bench = PsfBench.exact(margin=0, bracket=(1.0,), background_e_per_s=0.0)
    found = bench_measurement(design, usual_process(design), Variation(), bench, DEPTHS)
    known = psf(replace(design, camera=bench_camera(design, bench)), depths=DEPTHS).energy[0]
    for image, energy in zip(found.images, known, strict=True):
        np.testing.assert_allclose(image.light, energy, atol=1e-6 * energy.max())
        electrons = energy[::-1, ::-1] * bench.source_e_per_s * image.exposures_s[0]
        counts = (image.frames[0].astype(float) - bench.black) * bench.gain
        variance = electrons + bench.read_noise**2 + bench.gain**2 / 12
        # 2304 pixels: a standard deviation of 3 %.
        assert np.mean((counts - electrons) ** 2 / variance) == pytest.approx(1, abs=0.12)


def test_exposures_that_would_fill_a_quarter_of_the_frame_are_left_out():
    design = plate_drawn(64, 8, window=48)
    process, errors = usual_process(design), Variation()
    bench = PsfBench.exact(margin=0, bracket=(1.0, 6.0, 60.0, 600.0), background_e_per_s=0.0)
    for image in bench_measurement(design, process, errors, bench, DEPTHS).images:
        electrons = image.light * bench.source_e_per_s * image.exposures_s[0]
        full = [np.mean(electrons * times > (bench.full - bench.black) * bench.gain) for times in bench.bracket]
        assert len(image.frames) == len(image.darks) == len(image.exposures_s) == sum(share < 0.25 for share in full)
        assert 1 < len(image.frames) < len(bench.bracket)
        assert (image.frames[-1] == bench.full).mean() < 0.26  # and noise
    # Light from elsewhere fills frames, too; one is always taken.
    lit = replace(bench, background_e_per_s=1e12)
    assert [len(image.frames) for image in bench_measurement(design, process, errors, lit, DEPTHS).images] == [1, 1]


def test_relay_passes_a_strip_of_a_small_aperture():
    # Where the aperture is small beside the lens its rims are straight: what is left is a strip of half width R - f s.
    bench = replace(PAPER, relay_m=1.0, relay_clear_m=2.0)
    radius = 1e-3
    half = np.linspace(0, 1, 21)
    strip = 2 / np.pi * (np.arcsin(half) + half * np.sqrt(1 - half**2))
    np.testing.assert_allclose(bench.passed_share(1 - half * radius, radius), strip, atol=2e-3)


def test_relay_passes_what_rays_do():
    radius = 2.2e-3
    y, x = np.meshgrid(*[np.linspace(-radius, radius, 801)] * 2, indexing="ij")
    inside = np.hypot(y, x) < radius
    clear, dark = (PAPER.relay_clear_m / 2 - radius) / PAPER.relay_m, PAPER.relay_clear_m / 2 / PAPER.relay_m
    sines = np.array([0.0, clear - 1e-4, 0.155, 0.165, 0.175, dark])
    counted = [(PAPER.passes(y, x, 0.6 * s, 0.8 * s) & inside).sum() / inside.sum() for s in sines]
    shares = PAPER.passed_share(sines, radius)
    np.testing.assert_allclose(shares, counted, atol=3e-3)
    assert shares[:2] == pytest.approx(1, abs=1e-6)
    assert shares[-1] == 0


def test_relay_leaves_what_it_passes_and_stops_the_rest():
    design = plate_drawn(64, 8, window=48)
    bench = PsfBench.exact(margin=0, relay_m=5e-3, relay_clear_m=1.2e-3)
    camera = bench_camera(design, bench)
    open_, light = bench_light(HeightOptic.of(camera, design.height_m), bench, NEAR_M)
    axis = camera.axis_m() / camera.focal_length_m
    sine, rim = np.hypot(axis[:, None], axis), 0.6e-3
    clear, dark = (rim - camera.aperture_m / 2) / bench.relay_m, rim / bench.relay_m
    assert 0 < (sine < clear).mean() < 1
    np.testing.assert_array_equal(light[sine <= clear], open_[sine <= clear])
    assert not light[sine >= dark].any()
    between = (sine > clear) & (sine < dark)
    assert 0.1 < light[between].sum() / open_[between].sum() < 0.9


def test_fibre_lights_the_rim_less_than_the_middle():
    design = plate_drawn(200, window=96)
    depth = 3e-3  # near enough that the light on the sensor is that on the aperture
    bench = PsfBench.exact(mode_field_m=3.5e-6, margin=0)
    camera = bench_camera(design, bench)
    plate = HeightOptic.of(camera)
    even, _ = bench_light(plate, replace(bench, mode_field_m=0.0), depth)
    lit, _ = bench_light(plate, bench, depth)
    faces = camera.transmission(bench.probe_m)
    place = np.hypot(*np.meshgrid(camera.axis_m(), camera.axis_m())) / camera.defocus_radius_m(depth)
    assert place.max() > 0.8
    waist = 520e-9 / np.pi / 1.75e-6 * depth
    edge = camera.aperture_m / 2
    gauss = np.exp(-2 * (place * edge / waist) ** 2)
    # On the aperture falls as much light as from a point, so the middle is brighter by the inverse of the mean.
    gauss /= waist**2 / 2 / edge**2 * -np.expm1(-2 * (edge / waist) ** 2)
    for low, high in ((0.0, 0.3), (0.3, 0.5), (0.5, 0.7)):
        ring = (place >= low) & (place < high)
        # Fresnel's rings average out; what the Gaussian changes in them is small.
        assert lit[ring].sum() / even[ring].sum() == pytest.approx(gauss[ring].mean(), rel=0.03)
    assert even.sum() <= faces


def test_a_fit_that_is_told_of_the_fibre_sees_its_light(tmp_path: Path):
    """Bench and calibration each have the Gaussian in their own words: a radius from the mode field, a power of 1."""
    design = plate_drawn(64, 8, window=48)
    bench = PsfBench.exact(mode_field_m=3.5e-6, margin=0, collimator_m=12.5e-3)
    camera = bench_camera(design, bench)
    told = f"""
    probe = "520 nm"
    pixel = "{camera.pixel_m * 1e6:.9g} um"
    gain = 2.0
    read_noise = 4.0
    mode_field = "3.5 um"
    collimator = "12.5 mm"
    [[image]]
    depth = "2 mm"
    files = ["near.tiff"]
    [[image]]
    depth = "inf"
    files = ["far.tiff"]
    """
    (tmp_path / "measurement.toml").write_text(told)
    spec = load_measurement(tmp_path / "measurement.toml")
    radii = tuple(spec.beam_radius_m(depth) for depth in DEPTHS)
    depth_alone = unknowns_of(usual_process(design), ["common_depth_scale"])
    model = ForwardModel(design.level_map.level, camera, depth_alone, DEPTHS, beam_radii_m=radii)
    plate = HeightOptic.of(camera, design.height_m)
    for index, depth in enumerate(DEPTHS):
        seen = model.plate(np.zeros(1)).image(index, np.zeros(7))
        lit, _ = bench_light(plate, bench, depth)
        np.testing.assert_allclose(seen, lit, atol=2e-4 * lit.max())
        even, _ = bench_light(plate, replace(bench, mode_field_m=0.0), depth)
        assert np.linalg.norm(even - lit) > (0.015 if depth == NEAR_M else 1e-4) * np.linalg.norm(lit)
    assert math.isinf(spec.model_copy(update={"collimator_m": None}).beam_radius_m(math.inf))
    assert math.isinf(spec.model_copy(update={"mode_field_m": None}).beam_radius_m(NEAR_M))


def test_throughput_of_a_flat_plate_is_that_of_its_faces():
    camera = bench_camera(plate_drawn(64, 8, window=48), PAPER)
    found = bench_throughput(HeightOptic.of(camera), PAPER)
    index = 1.46128  # of fused silica at 520 nm, by Malitson's formula
    assert found.throughput == pytest.approx((4 * index / (1 + index) ** 2) ** 2, rel=1e-4)
    assert found.needed == pytest.approx(0.9237, abs=1e-4)


@pytest.mark.study
def test_a_calibration_finds_the_plate_on_a_bench_it_is_not_told_of(tmp_path: Path):
    design = plate_drawn(64, 8, window=48)
    process = usual_process(design)
    hidden = {
        "common_depth_scale": 0.021,
        "common_cd_bias_m": 90e-9,
        "overlay_x_m[1]": 310e-9,
        "overlay_y_m[2]": -240e-9,
    }
    errors = variation_of(process.masks, hidden)
    # The relay cuts the corners of the frame, which are not compared; the fibre lights the rim 15 % less from near by.
    bench = replace(
        PAPER, relay_m=5e-3, relay_clear_m=1.5e-3, depth_sigma_m=4e-6, collimator_m=12.5e-3, within_relay=True
    )
    found = bench_measurement(design, process, errors, bench, DEPTHS, seed=3)
    near, far = found.rows
    assert near.rim == pytest.approx(0.85, abs=0.01)
    assert near.relay < 0.97
    assert found.window == 37  # sqrt(2) (R - a) / f_relay of the focal length, in pixels
    assert far.rim > 0.99
    path = found.write(tmp_path)
    assert (tmp_path / "hidden.toml").is_file()
    measurement = read_measurement(path, design.camera)
    assert [image.depth_m for image in measurement.images] == [pytest.approx(NEAR_M), math.inf]
    result = calibrate(design, measurement, process=process, evaluations=0)
    names = result.objective.unknowns.names
    missed = {n: float(v) - errors.value(n) for n, v in zip(names, result.posterior.values, strict=True)}
    # At least twice what was left when the fit was not told of the fibre: 0.02 %, 2 nm and 9 nm.
    limits = {"common_depth_scale": 0.001, "common_cd_bias_m": 8e-9}
    for name, error in missed.items():
        assert abs(error) < limits.get(name, 20e-9), (name, error)
    rotation, scale_y, scale_x, _ = result.posterior.geometry
    assert rotation == pytest.approx(bench.rotation_rad, abs=2e-4)
    assert (scale_y, scale_x) == pytest.approx((bench.scale_y, bench.scale_x), abs=1e-3)
    assert png_bytes(found.plot()).startswith(b"\x89PNG")


def test_a_bench_that_cannot_be_is_refused():
    design = plate_drawn(64, 8, window=48)
    with pytest.raises(InputError, match="must be positive"):
        PsfBench(relay_m=0.0)
    with pytest.raises(InputError, match="must be a share"):
        PsfBench(throughput=1.2)
    with pytest.raises(InputError, match="exposures over the shortest"):
        PsfBench(bracket=(0.5,))
    with pytest.raises(InputError, match="must be positive, at least one"):
        bench_measurement(design, usual_process(design), Variation(), PAPER, (-1.0,))
    narrow = replace(PAPER, relay_clear_m=1e-6, within_relay=True)
    with pytest.raises(InputError, match="relay_clear_m: the relay must leave 16 pixels"):
        bench_measurement(design, usual_process(design), Variation(), narrow, DEPTHS)
    half = PAPER.scaled(0.5)
    assert (half.relay_m, half.mode_field_m) == (PAPER.relay_m / 2, PAPER.mode_field_m)
