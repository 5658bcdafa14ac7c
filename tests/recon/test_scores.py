"""Scores against scikit-image, regions, and intervals of paired differences."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from doedesign.training import scores as scoring
from doedesign.training.distance.backbones import weight_shapes
from doedesign.training.distance.perceptual import Lpips, read_lpips
from doedesign.training.scores import mean_and_interval, paired_difference, scores

psnr, ssim = eqx.filter_jit(scoring.psnr), eqx.filter_jit(scoring.ssim)


@pytest.fixture
def pair(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A picture with bright and dark parts and one like it that leaves 0..1 in places."""
    y, x = np.mgrid[:48, :61] / 10
    waves = 0.5 + 0.5 * np.sin(y + np.array([[[0]], [[1]], [[2]]])) * np.cos(x)
    a = np.stack([waves, waves**2])
    return a.astype(np.float32), (a + 0.1 * rng.standard_normal(a.shape)).astype(np.float32)


@pytest.fixture
def mask() -> np.ndarray:
    """A soft disc, another one that touches the frame."""
    y, x = np.mgrid[:48, :61]
    distance = [np.hypot(y - 20, x - 30), np.hypot(y - 4, x - 8)]
    return np.clip((12 - np.stack(distance)) / 8 + 0.5, 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Lpips:
    """A backbone with random weights: the one with the fewest layers to compile."""
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("weights") / "w.npz"
    shapes = weight_shapes("alex")
    np.savez(
        path,
        allow_pickle=False,
        **{key: rng.uniform(-0.1, 0.15, shape).astype(np.float32) for key, shape in shapes.items()},
    )
    return read_lpips([path])


def expected_ssim(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    settings: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    found: Any = structural_similarity(
        a.astype(np.float64), b.clip(0, 1).astype(np.float64), channel_axis=0, data_range=1, full=True, **settings
    )
    return found[0], found[1].mean(0)


def test_full_image(pair):
    a, b = pair
    expected = [peak_signal_noise_ratio(p, q.clip(0, 1), data_range=1) for p, q in zip(a, b, strict=True)]
    np.testing.assert_allclose(psnr(b, a), expected, rtol=1e-5)
    expected = [expected_ssim(p, q)[0] for p, q in zip(a, b, strict=True)]
    np.testing.assert_allclose(ssim(b, a), expected, atol=1e-4)  # variances are small differences in float32
    assert not np.allclose(ssim(a, b), 1, atol=0.1)


def test_region(pair, mask):
    a, b = pair
    where = mask >= 0.5
    for k in range(2):
        error = (a[k].astype(np.float64) - b[k].clip(0, 1)) ** 2
        assert float(psnr(b, a, mask)[k]) == pytest.approx(-10 * np.log10(error[:, where[k]].mean()), rel=1e-5)
        inner = np.zeros_like(where[k])
        inner[5:-5, 5:-5] = where[k, 5:-5, 5:-5]
        assert inner.sum() < where[k].sum() or k == 0
        assert float(ssim(b, a, mask)[k]) == pytest.approx(expected_ssim(a[k], b[k])[1][inner].mean(), abs=1e-4)


def test_what_lies_outside_the_region_does_not_count(pair, mask):
    a, b = pair
    far = np.asarray(mask < 0.5)[:, None]
    # SSIM looks 5 pixels far, so that its region is shrunk by as much.
    other = np.where(far, 1 - b, b)
    np.testing.assert_array_equal(psnr(b, a, mask), psnr(other, a, mask))
    core = np.zeros_like(mask)
    core[0, 17:24, 27:34] = 1
    assert float(ssim(b, a, core)[0]) == pytest.approx(float(ssim(other, a, core)[0]), abs=1e-5)
    assert np.abs(np.asarray(ssim(b, a) - ssim(other, a))).min() > 0.01


def test_a_mask_everywhere_is_the_full_image(pair, model):
    a, b = pair
    found = scores(b, a, np.full((2, 48, 61), 0.5, np.float32), model)
    assert found.occluded.closeness is not None
    assert found.full.closeness is not None
    np.testing.assert_allclose(found.occluded.psnr, found.full.psnr, rtol=1e-6)
    np.testing.assert_allclose(found.occluded.ssim, found.full.ssim, rtol=1e-6)
    # The map enlarges what the whole score averages: not the same at the edges.
    np.testing.assert_allclose(1 - found.occluded.closeness, 1 - found.full.closeness, rtol=0.1)


def test_scores_are_the_single_scores(pair, mask, model):
    a, b = pair
    found = scores(b, a, mask, model)
    assert found.occluded.closeness is not None
    assert found.full.closeness is not None
    np.testing.assert_allclose(found.full.psnr, psnr(b, a), rtol=1e-6)
    np.testing.assert_allclose(found.full.ssim, ssim(b, a), rtol=1e-6)
    np.testing.assert_allclose(found.occluded.psnr, psnr(b, a, mask), rtol=1e-6)
    np.testing.assert_allclose(found.occluded.ssim, ssim(b, a, mask), rtol=1e-6)
    shown = jnp.clip(b, 0, 1)
    np.testing.assert_allclose(found.full.closeness, 1 - eqx.filter_jit(model)(shown, a), rtol=1e-5)
    each = np.asarray(eqx.filter_jit(Lpips.map)(model, shown, a))
    expected = [1 - each[k][mask[k] >= 0.5].mean() for k in range(2)]
    np.testing.assert_allclose(found.occluded.closeness, expected, rtol=1e-5)
    without = scores(b, a, mask)
    assert without.full.closeness is None
    assert without.occluded.closeness is None


def test_equal_pictures_and_empty_regions(pair, mask):
    a, _ = pair
    mask[1] = 0.49
    found = scores(a, a, mask)
    assert np.isposinf(found.full.psnr).all()
    np.testing.assert_allclose(found.full.ssim, 1, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(found.occluded.ssim), [False, True])
    np.testing.assert_array_equal(np.isnan(found.occluded.psnr), [False, True])


def test_better_pictures_score_higher(pair, mask, model):
    a, b = pair
    near, far = scores(a + 0.3 * (b - a), a, mask, model), scores(b, a, mask, model)
    for better, worse in zip((*near.full, *near.occluded), (*far.full, *far.occluded), strict=True):
        assert (np.asarray(better) > np.asarray(worse)).all()


def test_bad_shapes_are_refused(pair):
    a, b = pair
    with pytest.raises(ValueError, match="at least 11 x 11"):
        ssim(a[..., :10], b[..., :10])
    with pytest.raises(ValueError, match="one shape"):
        ssim(a, b[..., :-1])


def test_mean_and_interval():
    # t(0.975, 2) = 4.30265; the standard error of 1, 2, 3 is 1 / sqrt(3).
    found = mean_and_interval([1.0, np.nan, 2.0, 3.0])
    assert found == pytest.approx((2, 2 - 4.30265 / 3**0.5, 2 + 4.30265 / 3**0.5, 3), rel=1e-5)
    assert mean_and_interval([4.0]) == (4, -np.inf, np.inf, 1)
    wide, narrow = (mean_and_interval([1.0, 2.0, 3.0], c) for c in (0.99, 0.5))
    assert wide.low < found.low < narrow.low < 2 < narrow.high < found.high < wide.high
    for values in ([], [np.nan], [1.0, np.inf]):
        with pytest.raises(ValueError, match="at least one number"):
            mean_and_interval(values)
    with pytest.raises(ValueError, match="between 0 and 1"):
        mean_and_interval([1.0, 2.0], 95)


def test_seeds_and_pictures_are_both_draws(rng):
    """Both spreads count, so that the interval holds as often as it says, which that over pictures alone does not."""
    seeds, pictures, turns = 3, 40, 1000
    shared = [0.3 * rng.standard_normal((turns, seeds, 1)), rng.standard_normal((turns, 1, pictures))]
    drawn = sum(shared) + 0.2 * rng.standard_normal((turns, seeds, pictures))
    both, one = ([mean_and_interval(values) for values in given] for given in (drawn, drawn.mean(axis=1)))
    assert [found.mean for found in both] == pytest.approx([found.mean for found in one])
    share, share_of_one = (np.mean([found.low < 0 < found.high for found in each]) for each in (both, one))
    assert share > 0.94  # 0.95, less 1.5 standard errors of a share of 1000
    assert share_of_one < 0.9
    np.testing.assert_allclose(mean_and_interval(drawn[0, :1]), mean_and_interval(drawn[0, 0]))
    assert mean_and_interval(np.ones((2, 5))) == (1, 1, 1, 5)
    gap = drawn[0].copy()
    gap[1, 7] = np.nan
    assert mean_and_interval(gap) == mean_and_interval(np.delete(drawn[0], 7, axis=1))


def test_pairs_tell_more_than_the_spread_of_pictures(rng):
    easy = rng.normal(22, 4, 40)
    a, b = easy + rng.normal(0.5, 0.2, 40), easy
    found = paired_difference(a, b)
    expected = scipy.stats.ttest_rel(a, b).confidence_interval(0.95)
    np.testing.assert_allclose(found[:3], [np.mean(a - b), expected.low, expected.high])
    assert 0 < found.low < 0.5 < found.high < 0.8
    apart = mean_and_interval(a).low - mean_and_interval(b).high
    assert apart < 0  # unpaired, nothing could be said
    with pytest.raises(ValueError, match="one score per picture"):
        paired_difference(a, b[:-1])
