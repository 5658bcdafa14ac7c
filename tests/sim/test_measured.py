"""From frames to one image: what is known about its values and their noise holds, and the light is found."""

import numpy as np
import pytest

from fab.errors import InputError
from sim.frames import CameraFrame
from sim.measured import (
    MeasuredPsf,
    Noise,
    binned,
    centre_of_light,
    cut_window,
    merge_exposures,
    parabola_vertex,
    without_background,
)

NOISE = Noise(gain_e=2.0, read_e=4.0)
BLACK = 100.0


def exposed(rate: np.ndarray, exposure: float, rng: np.random.Generator, top: float = 4095.0) -> CameraFrame:
    """A 12-bit frame of a known rate, counts per unit of exposure."""
    electrons = rng.poisson(rate * exposure * NOISE.gain_e) + rng.normal(0, NOISE.read_e, rate.shape)
    counts = np.clip(np.rint(electrons / NOISE.gain_e + BLACK), 0, top).astype(np.float32)
    return CameraFrame(counts, np.ones(rate.shape, bool), top, 0.0, 1.0)


def test_one_dark_frame_for_all_is_the_same_noise_in_all(rng: np.random.Generator):
    """Four equal exposures without light: with a dark frame for each the mean is twice as well known."""
    noise, sigma, shape = Noise(1.0, 5.0), 5.0, (150, 150)

    def frame() -> CameraFrame:
        return CameraFrame((100 + rng.normal(0, sigma, shape)).astype(np.float32), np.ones(shape, bool), 1e4, 0.0, 1e-3)

    frames, own = [frame() for _ in range(4)], [frame() for _ in range(4)]
    light = [replace_counts(each, each.counts + 50) for each in frames]
    for darks, variance in ((own, 2 * sigma**2 / 4), ([own[0]] * 4, sigma**2 / 4 + sigma**2)):
        merged = merge_exposures(light, [1.0] * 4, darks, noise)
        # 22500 pixels know a variance to 1 %; weights that follow the noise of dark frames cost some more.
        assert merged.rate.var() == pytest.approx(variance, rel=0.12)
        assert merged.floor.mean() == pytest.approx(variance, rel=0.12)


def replace_counts(frame: CameraFrame, counts: np.ndarray) -> CameraFrame:
    return frame._replace(counts=counts)


def test_a_bracket_has_the_true_rate_and_the_noise_it_claims(rng: np.random.Generator):
    """Four decades of light in three exposures; the brightest is full in two of them."""
    rate = np.geomspace(0.05, 500, 200 * 300).reshape(200, 300)
    exposures = (2.0, 20.0, 200.0)
    frames = [exposed(rate, t, rng) for t in exposures]
    merged = merge_exposures(frames, exposures, [BLACK] * 3, NOISE)
    assert merged.valid.all()
    pull = (merged.rate - rate) / np.sqrt(merged.variance(rate))
    # Of 60000 standard normals the mean and the variance are known to 0.004 and 0.006; four times that.
    assert abs(pull.mean()) < 0.016
    assert abs(pull.var() - 1) < 0.025
    # At every brightness, too: tenths of the pixels, each known to 0.02.
    tenths = pull.reshape(10, -1)
    assert np.abs(tenths.var(axis=1) - 1).max() < 0.08
    assert np.abs(tenths.mean(axis=1)).max() < 0.055
    # And no worse than the longest exposure alone where that is not full.
    alone = merge_exposures(frames[2:], exposures[2:], [BLACK], NOISE)
    both = alone.valid
    assert (merged.variance(rate)[both] <= alone.variance(rate)[both] * (1 + 1e-6)).all()


def test_a_noisy_dark_frame_counts_among_the_noise(rng: np.random.Generator):
    rate = np.full((200, 200), 3.0)
    dark = exposed(np.zeros_like(rate), 1.0, rng)
    merged = merge_exposures([exposed(rate, 50.0, rng)], [50.0], [dark], NOISE)
    pull = (merged.rate - rate) / np.sqrt(merged.variance(rate))
    assert abs(pull.var() - 1) < 0.03  # 40000 values: four times 0.007
    averaged = merge_exposures([exposed(rate, 50.0, rng)], [50.0], [dark], NOISE, dark_count=100)
    assert (averaged.floor < merged.floor).all()


@pytest.mark.parametrize("read_e", [1.5, 4.0])
def test_dark_frames_have_the_noise_they_claim_and_hot_pixels_theirs(read_e: float, rng: np.random.Generator):
    """A bracket of faint light with dark frames of its own; a fiftieth of the pixels is hot."""
    shape, gain_e, light_e, exposures = (400, 400), 2.0, 4.0, (1.0, 2.0, 4.0)
    heat_e = np.where(rng.random(shape) < 0.02, 60.0, 0.0)

    def frame(electrons: float) -> CameraFrame:
        counts = (rng.poisson(heat_e + electrons) + rng.normal(0, read_e, shape)) / gain_e + BLACK
        return CameraFrame(np.rint(counts).astype(np.float32), np.ones(shape, bool), 4095.0, 0.0, 1.0)

    frames, darks = [frame(light_e * t) for t in exposures], [frame(0.0) for _ in exposures]
    merged = merge_exposures(frames, exposures, darks, Noise(gain_e, read_e))
    rate = np.full(shape, light_e / gain_e)
    pull = (merged.rate - rate) / np.sqrt(merged.variance(rate))
    for hot in (False, True):
        count = np.count_nonzero((heat_e > 0) == hot)
        # Four standard deviations; weights follow the noise of hot pixels' dark frames and of a first estimate: 1 %.
        assert pull[(heat_e > 0) == hot].var() == pytest.approx(1, abs=4 * np.sqrt(2 / count) + 0.01)
    # Pixels whose dark frames were bright by chance seemed darker and counted less: 0.03 too bright.
    assert abs(pull[heat_e == 0].mean()) < 4 / np.sqrt(pull.size) + 0.008


def test_full_pixels_come_from_shorter_exposures_and_are_lost_without(rng: np.random.Generator):
    rate = np.full((50, 50), 10.0)
    rate[20:30, 20:30] = 5000.0
    long, short = exposed(rate, 10.0, rng), exposed(rate, 0.5, rng)
    both = merge_exposures([long, short], [10.0, 0.5], [BLACK] * 2, NOISE)
    assert both.valid.all()
    np.testing.assert_allclose(both.rate[20:30, 20:30].mean(), 5000, rtol=0.01)
    alone = merge_exposures([long], [10.0], [BLACK], NOISE)
    np.testing.assert_array_equal(alone.valid, rate < 1000)
    assert (alone.rate[~alone.valid] == 0).all()


def test_bad_brackets_are_refused_by_name(rng: np.random.Generator):
    rate = np.full((20, 20), 10.0)
    frame = exposed(rate, 1.0, rng)
    other = CameraFrame(frame.counts[:10], frame.valid[:10])
    bright = CameraFrame(frame.counts + 50, frame.valid)
    names = ["a.tiff", "b.tiff"]
    with pytest.raises(InputError, match=r"b\.tiff: all exposures of an image must have the same size"):
        merge_exposures([frame, other], [1.0, 2.0], [0.0, 0.0], NOISE, names=names)
    with pytest.raises(InputError, match=r"a\.tiff: an image must be brighter than its dark frame"):
        merge_exposures([frame], [1.0], [bright], NOISE, names=names[:1])
    with pytest.raises(InputError, match=r"a\.tiff: a dark frame must have its image's size"):
        merge_exposures([frame], [1.0], [other], NOISE, names=names[:1])
    with pytest.raises(InputError, match=r"a\.tiff: an exposure must be positive"):
        merge_exposures([frame], [0.0], [0.0], NOISE, names=names[:1])
    with pytest.raises(InputError, match=r"a\.tiff: some pixels must not be saturated"):
        merge_exposures([frame], [1.0], [0.0], NOISE, clipped_at=50.0, names=names[:1])


def spot_image(centre: tuple[float, float], shape: tuple[int, int], rng: np.random.Generator) -> MeasuredPsf:
    """A bright spot on a wide disc with speckle, on background, with noise."""
    y, x = np.indices(shape)
    radius = np.hypot(y - centre[0], x - centre[1])
    disc = np.where(radius < 40, rng.exponential(20.0, shape), 0.0)
    rate = 3000 * np.exp(-(radius**2) / 4) + disc + 30.0
    sigma = 2.0
    noisy = rate + rng.normal(0, sigma, shape)
    return MeasuredPsf(noisy, np.full(shape, sigma**2), np.zeros(shape), np.ones(shape, bool))


def test_the_background_is_that_of_the_border(rng: np.random.Generator):
    image, level = without_background(spot_image((120.0, 160.0), (240, 320), rng))
    # About 20000 border pixels of sigma 2 give 0.015; four times that.
    assert abs(level - 30) < 0.06
    assert abs(image.rate[:20].mean()) < 0.2


@pytest.mark.parametrize(("off", "counted"), [(4, True), (5, False), (-4, True), (-5, False)])
def test_a_border_pixel_beyond_three_spreads_is_not_of_the_background(off: int, counted: bool):
    """Among 99, 100 and 101 the middle deviation is 1, a spread of 1.48: 4 is 2.7 spreads, and 5 is 3.4."""
    rate = 99.0 + np.add.outer(np.arange(60), np.arange(60)) % 3
    rate[3:-3, 3:-3] = 5000.0
    spoilt = tuple(np.argwhere(rate == 100)[::12].T)  # 19 of the border's 684 pixels
    rate[spoilt] += off
    image = MeasuredPsf(rate, np.ones_like(rate), np.zeros_like(rate), np.ones(rate.shape, bool))
    _, level = without_background(image)
    assert level == pytest.approx(100 + (19 * off / 684 if counted else 0.0), rel=1e-12)


@pytest.mark.parametrize(("shape", "centre"), [((240, 320), (113.0, 151.0)), ((1300, 1500), (700.0, 640.0))])
def test_the_light_is_found(shape: tuple[int, int], centre: tuple[float, float], rng: np.random.Generator):
    image, _ = without_background(spot_image(centre, shape, rng))
    found = centre_of_light(image)
    # A pixel in a small frame, a bin of two in a large one; the fit compares with the model afterwards.
    limit = 1.0 if max(shape) < 1000 else 2.0
    assert np.hypot(found[0] - centre[0], found[1] - centre[1]) < limit


def test_the_light_is_found_among_full_pixels_and_in_a_mosaic(rng: np.random.Generator):
    image, _ = without_background(spot_image((113.0, 151.0), (240, 320), rng))
    full = image._replace(valid=image.rate < 500)
    mosaic = image._replace(valid=np.add.outer(np.arange(240), np.arange(320)) % 2 == 1)
    for cut in (full, mosaic):
        found = centre_of_light(cut)
        assert np.hypot(found[0] - 113, found[1] - 151) < 1.5
    with pytest.raises(InputError, match="light above the noise"):
        centre_of_light(image._replace(rate=0 * image.rate))


@pytest.mark.parametrize("window", [64, 65])
def test_a_window_moves_by_whole_pixels(window: int):
    values = np.arange(200.0 * 180).reshape(200, 180)
    image = MeasuredPsf(values, values, values, np.ones(values.shape, bool))
    cut, rest = cut_window(image, (90.3, 70.6), window)
    corner = np.argwhere(values == cut.rate[0, 0])[0]
    # Where the point lies, counted from the window's middle, and where the middle lies in the frame.
    np.testing.assert_allclose(corner + (window - 1) / 2 + rest, (90.3, 70.6), rtol=1e-12)
    assert max(map(abs, rest)) <= 0.5
    assert cut.valid.all()
    beyond, _ = cut_window(image, (90.0, 5.0), window)
    assert 0.5 < beyond.valid.mean() < 0.7  # half the window and five columns are there
    assert (beyond.rate[~beyond.valid] == 0).all()
    with pytest.raises(InputError, match="at least the window's 190 pixels per side"):
        cut_window(image, (90.0, 90.0), 190)


def test_binned_pixels_add_light_and_noise(rng: np.random.Generator):
    shape = (40, 60)
    signal = rng.uniform(0, 100, shape)
    valid = np.ones(shape, bool)
    valid[5, 7] = False
    image = MeasuredPsf(signal, rng.uniform(1, 2, shape), np.full(shape, 0.3), valid)
    small = binned(image, 2)
    np.testing.assert_allclose(small.rate[0, 0], signal[:2, :2].sum())
    np.testing.assert_allclose(small.variance(small.rate)[1, 1], image.variance(signal)[2:4, 2:4].sum())
    assert small.valid.sum() == small.valid.size - 1
    assert not small.valid[2, 3]
    with pytest.raises(ValueError, match="multiples of 7"):
        binned(image, 7)


@pytest.mark.parametrize("vertex", [3.0, 3.2, 2.7, 0.1, 6.8])
def test_a_parabola_has_its_vertex_where_it_is(vertex: float):
    """Seven samples of a period, so that the neighbours of the first and the last lie at the other end."""
    away = (np.arange(7) - vertex + 3.5) % 7 - 3.5
    at = int(np.argmax(-(away**2)))
    assert parabola_vertex(5 - 2 * away**2, at) == pytest.approx((vertex - at + 3.5) % 7 - 3.5, abs=1e-12)


def test_what_is_no_peak_has_its_vertex_on_itself():
    assert parabola_vertex(np.array([0.0, 1.0, 2.0, 3.0]), 1) == 0.0  # a line
    assert parabola_vertex(np.array([1.0, 0.0, 1.0, 0.0]), 1) == 0.0  # a dip


def test_light_without_any_noise_is_merged():
    """A clean simulation in an EXR file, dark around its spot."""
    rate = np.zeros((20, 20))
    rate[8:12, 8:12] = 100.0
    frames = [
        CameraFrame((rate * t).astype(np.float32), np.ones(rate.shape, bool), np.inf, 0.0, 0.0) for t in (1.0, 2.0)
    ]
    merged = merge_exposures(frames, (1.0, 2.0), [0.0] * 2, Noise(1.0, 0.0))
    np.testing.assert_allclose(merged.rate, rate, atol=1e-6)
    assert merged.valid.all()
