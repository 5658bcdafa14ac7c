"""Errors of linear filters in closed form against filters that work on random pictures."""

import numpy as np
import pytest

from sim.imaging.filtering import common_filter, filter_errors, photograph_spectrum, spectrum_weights, transfers

SIDE = 32
VARIANCE, NOISE = 0.04, 0.02


def discs() -> np.ndarray:
    """Blurs of three depths, `[depth, y, x]`."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    found = np.stack([(np.hypot(y, x) <= radius).astype(float) for radius in (1.0, 2.5, 4.0)])
    return found / found.sum(axis=(1, 2), keepdims=True)


def test_the_spectrum_has_the_variance_that_is_asked_for():
    power = photograph_spectrum(SIDE, VARIANCE)
    assert np.sum(power * spectrum_weights(SIDE)) == pytest.approx(VARIANCE)
    assert power[0, 0] == 0.0
    # Twice the frequency has a quarter of the power, in whatever direction.
    assert power[0, 4] == pytest.approx(4 * power[0, 8])
    assert [power[3, 4], power[-3, 4], power[5, 0], power[-5, 0]] == pytest.approx([power[0, 5]] * 4)
    for side, variance in ((1, 1.0), (8, 0.0), (8, np.inf)):
        with pytest.raises(ValueError, match="variance"):
            photograph_spectrum(side, variance)


def test_even_blurs_have_real_transfers_that_begin_with_their_light():
    transfer = np.asarray(transfers(discs()))
    assert np.abs(np.imag(transfer)).max() < 1e-5
    assert np.real(transfer[:, 0, 0]) == pytest.approx(np.ones(3), rel=1e-5)


def _measured(known: bool) -> np.ndarray:
    """Mean squared error of filtered pictures, by depth, as a share of the variance."""
    rng = np.random.default_rng(0)
    signal = photograph_spectrum(SIDE, VARIANCE)
    transfer = np.asarray(transfers(discs()), np.complex128)
    noise = NOISE**2 / SIDE**2
    together = np.asarray(common_filter(transfer, signal, noise))
    alone = [np.asarray(common_filter(one[None], signal, noise)) for one in transfer]
    errors = np.zeros((len(transfer), 400))
    for number in range(errors.shape[1]):
        white = np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
        scene = white * np.sqrt(signal) * SIDE
        seen = transfer * scene + np.fft.rfft2(NOISE * rng.normal(size=(len(transfer), SIDE, SIDE)))
        filters = alone if known else [together] * len(alone)
        for depth, found in enumerate(filters):
            missed = np.fft.irfft2(found * seen[depth] - scene, (SIDE, SIDE))
            # The mean is known.
            errors[depth, number] = np.mean((missed - missed.mean()) ** 2)
    return errors.mean(axis=1) / VARIANCE


@pytest.mark.parametrize("known", [False, True])
def test_errors_are_those_of_filters_that_work_on_pictures(known: bool):
    signal = photograph_spectrum(SIDE, VARIANCE)
    said = np.asarray(filter_errors(transfers(discs()), signal, NOISE**2 / SIDE**2, known))
    # 400 pictures, whose few slow waves hold most of the variance.
    assert said == pytest.approx(_measured(known), rel=0.05)


def test_no_other_filter_is_better_in_the_mean():
    signal, noise = photograph_spectrum(SIDE, VARIANCE), NOISE**2 / SIDE**2
    transfer = np.asarray(transfers(discs()))
    best = np.asarray(common_filter(transfer, signal, noise))
    rng = np.random.default_rng(2)

    def error(found: np.ndarray) -> float:
        return float(np.sum(np.mean(np.abs(1 - found * transfer) ** 2 * signal + np.abs(found) ** 2 * noise, axis=0)))

    for _ in range(20):
        moved = best + 0.05 * (rng.normal(size=best.shape) + 1j * rng.normal(size=best.shape))
        assert error(moved) > error(best)


def test_colours_are_filtered_each_by_itself():
    signal, noise = photograph_spectrum(SIDE, VARIANCE), NOISE**2 / SIDE**2
    colours = np.stack([discs()[:2], discs()[1:], discs()[::2]])
    together = np.asarray(filter_errors(transfers(colours), signal, noise, False))
    alone = [np.asarray(filter_errors(transfers(one), signal, noise, False)) for one in colours]
    np.testing.assert_allclose(together, alone, rtol=1e-5)  # single precision


def test_alike_blurs_leave_noise_alone_and_unlike_ones_their_difference():
    signal, noise = photograph_spectrum(SIDE, VARIANCE), NOISE**2 / SIDE**2
    transfer = np.asarray(transfers(discs()))
    alike = np.repeat(transfer[1:2], 3, axis=0)
    same = np.asarray(filter_errors(alike, signal, noise, False))
    assert same == pytest.approx(np.asarray(filter_errors(alike, signal, noise, True)), rel=1e-4)
    # s (n + s var H) / (s <|H|²> + n), summed over frequencies.
    power, mean = np.mean(np.abs(transfer) ** 2, axis=0), np.mean(transfer, axis=0)
    closed = signal * (noise + signal * (power - np.abs(mean) ** 2)) / (signal * power + noise)
    said = np.asarray(filter_errors(transfer, signal, noise, False)).mean()
    assert said == pytest.approx(np.sum(closed * spectrum_weights(SIDE)) / VARIANCE, rel=1e-4)
    assert said > same.mean()
    # A point without noise is perfect, and a camera that sees nothing shows the mean alone.
    for light, left in ((1.0, 0.0), (0.0, 1.0)):
        point = np.full((2, SIDE, SIDE // 2 + 1), light, np.complex64)
        assert np.asarray(filter_errors(point, signal, 1e-12, False)) == pytest.approx(left, abs=1e-6)
