"""Lamps read from weak copies: the plate's closed form, the solver where the answer is known, the scores."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from doedesign.capture.images import Pictures, picture_files
from doedesign.hdr.capture import LampCamera, LampCapture, LinePsfs, PlateSeries
from doedesign.hdr.scenes import Lamps, LampScenes
from doedesign.hdr.scores import compressed, judged_light
from doedesign.hdr.solver import LampSolver
from doedesign.hdr.study import LampCase, LampStudy, with_strength
from doedesign.spec import load_spec
from fab.aperture import aperture_from
from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.imaging.glare import Glare
from sim.light import srgb_from_linear
from sim.material import fresnel_transmission, refractive_index
from sim.psf_bank import psf
from sim.sensor import Sensor

ROOT = Path(__file__).parents[2]
GREEN = 540e-9
SILENT = Sensor(full_well_e=20000, exposure=0.8, quantum_efficiency=(1.0,), noise="none", bits=None)


def small_camera(*lines: float, window: int = 81) -> Camera:
    """256 x 256 cells of 5 um on a square aperture before a lens of 8 mm."""
    colours = tuple(Colour(f"c{n}", (line,), (1.0,)) for n, line in enumerate(lines))
    side = 256 * 5e-6
    return Camera(Grid((256, 256), 5e-6), aperture_from((side, side)), "fused_silica", colours, 8e-3, 3.7e-6, window)


@pytest.mark.parametrize(("duty", "step_m"), [(2, 80e-9), (4, 80e-9), (2, 150e-9)])
def test_orders_of_a_weak_binary_grating(duty: int, step_m: float):
    """0th order |1 - q + q exp(i phi)|^2, first ones (sin(pi q) / pi)^2 |exp(i phi) - 1|^2, q = 1 / duty."""
    cells, camera = 8, small_camera(GREEN)
    row = (np.arange(256) % cells < cells // duty) * step_m
    energy, bare = (np.asarray(psf(np.tile(one, (256, 1)), camera, np.inf).energy)[0, 0] for one in (row, 0 * row))
    index = float(refractive_index("fused_silica", GREEN))
    q, phase, passed = 1 / duty, 2 * np.pi * (index - 1) * step_m / GREEN, fresnel_transmission(index)
    jump = abs(np.exp(1j * phase) - 1) ** 2
    # The order of a grating drawn in cells is that of the continuous one: edges lie on cells.
    place = 8e-3 * GREEN / (cells * 5e-6) / 3.7e-6
    axis = np.arange(81) - 40
    near = [np.abs(axis - at) < 8 for at in (0, place, -place)]
    straight = abs(1 - q + q * np.exp(1j * phase)) ** 2
    # A spot of a square aperture leaves a hundredth of its light outside 16 pixels.
    assert energy[:, near[0]].sum() / passed == pytest.approx(straight, rel=0.02)
    # The 0th order's foot, a fiftieth of the order's amplitude there, adds to it or takes from it.
    for columns in near[1:]:
        order = (energy - straight * bare)[:, columns].sum() / passed
        assert order == pytest.approx((np.sin(np.pi * q) / np.pi) ** 2 * jump, rel=0.07)


def test_the_example_says_what_it_is():
    spec = load_spec(ROOT / "examples" / "snapshot_hdr.toml")
    assert spec.process.levels == 2
    assert [colour.name for colour in spec.optics.colours] == ["red", "green", "blue"]
    assert spec.sensor.window % 2 == 1


def copies(strength: float = 0.004, colours: int = 3) -> np.ndarray:
    """PSFs `[c, y, x]` of a sharp spot and four copies, which lie farther out in every next colour."""
    found = np.zeros((colours, 61, 61), np.float32)
    for c in range(colours):
        found[c, 30, 30] = 1 - 4 * strength
        for y, x in ((17, 5), (-17, -5), (-6, 19), (6, -19)):
            found[c, 30 + y + c * np.sign(y), 30 + x + c * np.sign(x)] = strength
    return found


def photographed(light: np.ndarray, kernel: np.ndarray, full: float = 1.25) -> LampCapture:
    """The frame of a scene that is dark beyond it, without noise."""
    n, half = light.shape[-1], kernel.shape[-1] // 2
    size = (n + 2 * half, n + 2 * half)
    found = np.fft.irfft2(np.fft.rfft2(light, size) * np.fft.rfft2(kernel, size), size)[
        :, half : half + n, half : half + n
    ]
    return LampCapture(np.minimum(found, full).astype(np.float32), found >= full)


def lamp_before_grey(radiance: tuple[float, float, float]) -> np.ndarray:
    """A round lamp of radius 5 in the middle of an even grey frame of 64 x 64."""
    y, x = np.ogrid[-32:32, -32:32]
    light = np.full((3, 64, 64), 0.0)
    light[:, np.hypot(y, x) < 5] = np.array(radiance)[:, None]
    return light


def test_a_lamp_before_nothing_is_found_exactly():
    light, kernel = lamp_before_grey((100.0, 60.0, 20.0)), copies()
    found = LampSolver(rounds=15, iterations=40, prior=1e-9).solve(photographed(light, kernel), kernel).light
    # Light that is black beyond the lamp has no edges but those of copies.
    assert found == pytest.approx(light, rel=5e-3, abs=5e-3)


def test_without_copies_lamps_are_as_usual():
    light = lamp_before_grey((100.0, 60.0, 20.0))
    kernel = np.zeros((3, 61, 61), np.float32)
    kernel[:, 30, 30] = 1
    found = LampSolver(usual=33.0).solve(photographed(light, kernel), kernel).light
    assert found[light > 0] == pytest.approx(33.0)
    assert found[light == 0] == pytest.approx(0, abs=1e-5)


def test_without_lamps_a_picture_stays_what_it_is():
    light = np.random.default_rng(1).uniform(0.1, 0.9, (3, 64, 64))
    kernel = np.zeros((3, 61, 61), np.float32)
    kernel[:, 30, 30] = 1
    assert LampSolver().solve(photographed(light, kernel), kernel).light == pytest.approx(light, abs=1e-6)


@pytest.mark.parametrize("wrong", [{"edge": 0.0}, {"rounds": 0}, {"usual": -1.0}])
def test_a_solver_of_no_use_is_refused(wrong: dict[str, float]):
    with pytest.raises(InputError):
        LampSolver(**wrong)  # pyright: ignore[reportArgumentType]


def test_scores_are_those_of_scikit_image():
    rng = np.random.default_rng(2)
    truth = rng.uniform(0, 100, (3, 20, 20))
    found, bright = truth * rng.uniform(0.5, 1.5, truth.shape), truth > 50
    score = judged_light(found, truth, bright)
    a, b = (compressed(one, truth.max())[bright] for one in (truth, found))
    assert score.lamps == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), rel=1e-9)
    a, b = (srgb_from_linear(np.clip(one, 0, 1))[~bright] for one in (truth, found))
    assert score.elsewhere == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), rel=1e-9)


def test_the_scale_of_scores():
    assert compressed(np.array([[[0.0, 7.0, -1.0]]]), 7.0)[0, 0] == pytest.approx([0, 1, 0])
    right = np.ones((3, 4, 4))
    assert judged_light(right, right, right > 0.5).lamps == np.inf
    assert np.isnan(judged_light(right, right, right < 0.5).lamps)


def scenes(**options: object) -> LampScenes:
    pictures = Pictures(picture_files(None)[:2], most_px=200)
    return LampScenes(pictures, Lamps(radius_px=(3.0, 6.0)), frame_px=64, margin_px=40, **options)  # pyright: ignore


WEIGHTS = np.tile([0.25, 0.5, 0.25], (3, 1))


def test_a_scene_is_a_function_of_its_number():
    one, again, other = (scenes(seed=s).scene(3, WEIGHTS) for s in (1, 1, 2))
    assert np.array_equal(one.light(), again.light())
    assert not np.array_equal(one.light(), other.light())
    assert one.light().shape == (3, 64, 64)
    assert one.radiance.max(axis=1).min() >= 50
    assert one.radiance.max() <= 200


def test_lines_add_up_to_the_light_of_a_scene():
    for spectrum in ("white", "narrow"):
        source = scenes()
        scene = source.with_lamps(replace(source.lamps, spectrum=spectrum)).scene(1, WEIGHTS)
        assert scene.lines(WEIGHTS).sum(axis=1)[:, 40:-40, 40:-40] == pytest.approx(scene.light(), rel=1e-5)


def test_lamps_of_narrow_spectra_stand_where_white_ones_do():
    source = scenes()
    white, narrow = (source.with_lamps(Lamps(spectrum=one)).scene(2, WEIGHTS) for one in ("white", "narrow"))
    assert np.array_equal(white.light(), narrow.light())
    assert not np.allclose(white.lines(WEIGHTS), narrow.lines(WEIGHTS))


def lamp_camera() -> LampCamera:
    """Three colours of three lines, pixels that see a small plate of 48 cells."""
    colours = tuple(
        Colour(name, (nm * 1e-9, (nm + 12) * 1e-9, (nm - 12) * 1e-9), (0.5, 0.25, 0.25))
        for name, nm in (("red", 620), ("green", 540), ("blue", 465))
    )
    camera = Camera(Grid((48, 48), 10e-6), 0.48e-3, "fused_silica", colours, 4e-3, 12e-6, 31)
    return LampCamera(camera, SILENT)


def test_a_bare_scene_comes_out_as_it_is():
    camera = lamp_camera()
    energy = np.zeros((3, 3, 31, 31), np.float32)
    energy[:, :, 15, 15] = 1
    scene = scenes().scene(0, camera.weights)
    light = camera.light_of(scene, LinePsfs(energy, camera.weights))
    # Single precision of transforms of light up to 200.
    assert light == pytest.approx(scene.light(), abs=1e-3)
    capture = camera.capture(scene, LinePsfs(energy, camera.weights), 0)
    saturated = camera.saturated(scene)
    # A pixel counts as full a little before it is.
    clear = np.abs(scene.light() - 1.25) > 0.03
    assert np.array_equal(capture.full[clear], saturated[clear])
    assert capture.light.max() == pytest.approx(1.25, rel=1e-5)


@pytest.mark.parametrize(
    ("sensor", "most"),
    [
        # White fills 0.8 of the well, and heat a tenth of it: 0.9 / 0.8.
        (replace(SILENT, dark_e=2000.0), 1.125),
        (Sensor(noise="release"), 1.0),  # white is full scale
        (Sensor(noise="tseng", bits=None), 1.0),
    ],
)
def test_a_pixel_is_full_where_its_raw_numbers_end(sensor: Sensor, most: float):
    camera = replace(lamp_camera(), sensor=sensor)
    energy = np.zeros((3, 3, 31, 31), np.float32)
    energy[:, :, 15, 15] = 1
    scene = scenes().scene(0, camera.weights)
    assert np.array_equal(camera.saturated(scene), scene.light() > most)
    for spilled in (0.0, 0.5):
        found = replace(camera, spilled=spilled).capture(scene, LinePsfs(energy, camera.weights), 0)
        assert found.light.max() == pytest.approx(most, rel=1e-3)  # a step of twelve bits
        # Wherever lamps are; a margin for noise and for what counts as full a little before.
        assert found.full[scene.light() > 1.03 * most].all()
    assert not camera.capture(scene, LinePsfs(energy, camera.weights), 0).full[scene.light() < 0.95 * most].any()


def test_a_frame_without_a_place_for_lamps_is_refused():
    with pytest.raises(InputError, match="frame_px"):
        replace(scenes(), frame_px=19)
    assert replace(scenes(), frame_px=20).scene(0, WEIGHTS).light().shape == (3, 20, 20)


def test_psfs_that_reach_beyond_a_scene_are_refused():
    camera = lamp_camera()
    far = LinePsfs(np.zeros((3, 3, 91, 91), np.float32), camera.weights)
    with pytest.raises(InputError, match="margin"):
        camera.light_of(scenes().scene(0, camera.weights), far)


def test_cameras_that_cannot_be_are_refused():
    camera = lamp_camera()
    with pytest.raises(InputError, match="window"):
        LampCamera(replace(camera.camera, window=30), camera.sensor)
    unlike = (*camera.camera.colours[:2], Colour("blue", (465e-9,), (1.0,)))
    with pytest.raises(InputError, match="lines"):
        LampCamera(replace(camera.camera, colours=unlike), camera.sensor)


@pytest.mark.slow
def test_a_study_of_a_small_plate():
    """Same scenes for both; the plate's copies say more of the lamps than the lens's halo does."""
    camera = lamp_camera()
    rows = np.arange(48)
    heights = 100e-9 * (((rows // 3) % 2)[:, None] ^ ((rows // 3) % 2))
    series, plain = PlateSeries.of(camera, heights), camera.psf(np.zeros((48, 48)))
    deeper = 1.02 * heights
    # The series finds a plate that is not the drawn one as well as a computation of its own.
    assert series.psf(deeper).energy == pytest.approx(camera.psf(deeper).energy, abs=2e-5)
    study = LampStudy(camera, series, plain, lambda _: deeper, scenes(), Glare(window=31), LampSolver(rounds=6))
    rows = {row.camera: row for row in study.rows(LampCase("fabricated"), 0)}
    assert set(rows) == {"clipped", "plain lens", "plate"}
    assert rows["plate"].lamps > rows["clipped"].lamps + 3
    weaker = with_strength(series.exact, 0.5)
    assert weaker.energy[:, :, 15, 15] == pytest.approx(series.exact.energy[:, :, 15, 15])
