"""Glare and blooming: energy, closed forms, what is refused."""

import jax
import numpy as np
import pytest

from fab.errors import InputError
from sim.imaging.glare import Glare
from sim.sensor.blooming import bloomed


@pytest.mark.parametrize("fall", [1.5, 2.0, 3.0])
def test_glare_keeps_all_light(fall: float):
    kernel = Glare(share=0.03, fall=fall, window=101).kernel()
    assert kernel.sum() == pytest.approx(1, rel=1e-12)
    assert kernel.min() > 0
    assert np.array_equal(kernel, kernel[::-1, ::-1])
    assert np.array_equal(kernel, kernel.T)


def test_glare_falls_by_its_power():
    kernel = Glare(share=0.02, fall=2.0, core_px=1.0, window=201).kernel()
    middle = kernel[100, 100:]
    # (20^2 + 1) / (80^2 + 1)
    assert middle[80] / middle[20] == pytest.approx(401 / 6401, rel=1e-12)


def test_a_psf_with_glare_is_the_convolution():
    rng = np.random.default_rng(1)
    psf, glare = rng.uniform(size=(2, 9, 9)), Glare(share=0.1, window=21)
    found = glare.scattered(psf)
    assert found.shape == (2, 21, 21)
    kernel, want = glare.kernel(), np.zeros((2, 29, 29))
    for v in range(9):
        for u in range(9):
            want[:, v : v + 21, u : u + 21] += psf[:, v, u, None, None] * kernel
    assert found == pytest.approx(want[:, 4:25, 4:25], rel=1e-5)


def test_transforms_leave_no_negative_light():
    psf = np.zeros((65, 65))
    psf[32, 32] = 1.0
    assert Glare(share=0.0, window=31).scattered(psf).min() == 0.0


def test_the_usual_glare_is_a_fiftieth_of_the_light_that_falls_with_the_square():
    glare = Glare()
    kernel = glare.kernel()
    assert (glare.share, kernel.shape) == (0.02, (255, 255))
    # Of 1 / (r² + 1.5²) less than a tenth lies on the middle pixel.
    assert 0.98 < kernel.max() < 0.982
    assert kernel[127, 127 + 100] / kernel[127, 127 + 10] == pytest.approx(102.25 / 10002.25, rel=1e-9)


@pytest.mark.parametrize("shape", [(9, 11), (8, 8), (2, 9, 7)])
def test_a_psf_without_a_middle_or_not_square_has_no_glare(shape: tuple[int, ...]):
    with pytest.raises(ValueError, match="odd square window"):
        Glare(window=5).scattered(np.ones(shape))


def test_no_glare_changes_nothing():
    psf = np.random.default_rng(2).uniform(size=(31, 31)).astype(np.float32)
    assert Glare(share=0.0, window=11).scattered(psf) == pytest.approx(psf, abs=1e-6)


def test_a_lens_of_a_kind_has_another_glare():
    shares = [Glare(share=0.02).drawn(np.random.default_rng(seed), 0.3).share for seed in range(400)]
    # The standard deviation of 400 draws is known to 3.5 %; four times that.
    assert np.std(np.log(shares)) == pytest.approx(0.3, rel=0.14)
    hazy = [Glare(share=0.8).drawn(np.random.default_rng(seed), 0.3).share for seed in range(40)]
    assert max(hazy) == 0.8
    assert min(hazy) < 0.7
    assert max(Glare(share=0.4).drawn(np.random.default_rng(seed), 0.3).share for seed in range(40)) == 0.5


@pytest.mark.parametrize(
    "wrong", [{"share": 1.0}, {"share": 1.5}, {"share": -0.1}, {"fall": 0.0}, {"core_px": -1.0}, {"window": 10}]
)
def test_a_glare_that_cannot_be_is_refused(wrong: dict[str, float]):
    with pytest.raises(InputError):
        Glare(**wrong)  # pyright: ignore[reportArgumentType]


def test_a_full_pixel_fills_its_column():
    signal = np.zeros((11, 3))
    signal[5, 1] = 6.0  # 5 too many: two and a half pixels to either side
    found = np.asarray(bloomed(signal, 1.0, 1.0))
    want = np.zeros((11, 3))
    want[3:8, 1], want[[2, 8], 1] = 1, 0.5
    assert found == pytest.approx(want, abs=1e-6)


def test_drains_take_their_share():
    signal = np.zeros((21, 1))
    signal[10] = 9.0
    assert np.asarray(bloomed(signal, 1.0, 0.25)).sum() == pytest.approx(1 + 0.25 * 8, rel=1e-6)
    traced = jax.jit(lambda full: bloomed(signal, full, 0.25).sum())(np.ones((1, 1), np.float32))
    assert float(traced) == pytest.approx(1 + 0.25 * 8, rel=1e-6)
    assert np.asarray(bloomed(signal, 1.0, 0.0)).sum() == pytest.approx(1)


def test_blooming_keeps_charge_until_columns_end():
    signal = np.random.default_rng(3).uniform(0, 0.9, (60, 30))
    signal[25:30, 8:12] = 3.0
    found = np.asarray(bloomed(signal, 1.0, 1.0))
    assert found.max() <= 1 + 1e-6
    # No charge moves along rows; single precision of 60 sums.
    assert found.sum(axis=0) == pytest.approx(signal.sum(axis=0), rel=1e-5)


def test_blooming_knows_what_every_pixel_holds():
    """Colours with full wells of their own are as each for itself; a column fills by what its pixels hold."""
    signal = np.random.default_rng(2).uniform(0, 3, (3, 20, 4)).astype(np.float32)
    full = np.array([0.5, 1.0, 2.0], np.float32)
    found = np.asarray(bloomed(signal, full[:, None, None], 1.0))
    alone = [np.asarray(bloomed(one, well, 1.0)) for one, well in zip(signal, full.tolist(), strict=True)]
    np.testing.assert_array_equal(found, alone)
    wells = np.array([[1.0], [3.0], [2.0], [1.0]])
    found = bloomed(np.array([[0.0], [0.0], [8.0], [0.0]]), wells, 1.0)
    # Of six too many three go up, where one fills and the rest runs out, and three down.
    np.testing.assert_array_equal(found, [[0.0], [3.0], [2.0], [1.0]])


def test_blooming_can_be_differentiated():
    signal = np.full((5, 1), 0.5, np.float32)
    signal[2] = 1.6
    slope = jax.grad(lambda s: bloomed(s, 1.0, 1.0)[1, 0])(signal)
    assert slope[2, 0] == pytest.approx(0.5)


@pytest.mark.parametrize(("full", "spilled"), [(0.0, 0.5), (1.0, 1.5)])
def test_blooming_that_cannot_be_is_refused(full: float, spilled: float):
    with pytest.raises(InputError):
        bloomed(np.ones((2, 2)), full, spilled)
