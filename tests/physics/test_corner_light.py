"""Light of corners against light that is propagated through them, step by step."""

from itertools import pairwise

import numpy as np
import pytest

from sim.rigorous.corner_light import CornerCell, Four, corner_light, corner_slopes

HIGHEST = 7.5  # radians; 16 levels of 75 nm in fused silica delay light by 7.3 at 450 nm


def cells(phase: np.ndarray) -> Four:
    """Corners of an array `[..., y, x]` of phases."""
    a, b, c, d = (CornerCell(one, np.cos(one), np.sin(one)) for one in (phase[..., y, x] for y, x in np.ndindex(2, 2)))
    return a, b, c, d


def light_through(phase: np.ndarray, side: float = 16.0, samples: int = 64) -> complex:
    """Mean light of a square of 2 x 2 cells, or of a row, that repeats: paraxial steps between layers of glass.

    Lengths along the face are in 1 / sqrt(k q), depths in 1 / q. Diffraction of the highest corners spreads over some 3
    of these lengths, and cells are 16 wide.
    """
    fine = np.kron(phase, np.ones([samples if n > 1 else 1 for n in phase.shape]))
    waves = [2 * np.pi * np.fft.fftfreq(n, side / samples) if n > 1 else np.zeros(1) for n in fine.shape]
    square = waves[0][:, None] ** 2 + waves[1] ** 2
    field = np.ones(fine.shape, complex)
    layers = np.unique(np.append(phase, 0.0))[::-1]
    for top, bottom in pairwise(layers):
        count = int(np.ceil((top - bottom) / 0.1))
        depth = (top - bottom) / count
        half, glass = np.exp(-0.25j * square * depth), np.exp(1j * depth * (fine > bottom + 1e-9))
        for _ in range(count):
            field = np.fft.ifft2(half * np.fft.fft2(glass * np.fft.ifft2(half * np.fft.fft2(field))))
    return complex(field.mean())


def beyond_thin(phase: np.ndarray) -> complex:
    return light_through(phase) - complex(np.exp(1j * phase).mean())


def propagated(phase: np.ndarray, side: float = 16.0) -> complex:
    """Light of one of the four corners of a square that repeats, which are alike but for mirroring."""
    found = beyond_thin(phase)
    for axis in (0, 1):
        for row in np.split(phase, 2, axis):
            found -= beyond_thin(row) / 2
    return found * side**2


@pytest.mark.parametrize(("lowest", "highest", "missed"), [(0.0, 3.0, 0.4), (3.0, 5.0, 0.25), (5.0, HIGHEST, 0.3)])
def test_light_of_corners_is_that_of_wave_propagation(lowest: float, highest: float, missed: float):
    """Of 24 random corners: 35, 16 and 24 % are left; of low ones, a tenth as bright as high ones, the most."""
    rng = np.random.default_rng(11)
    phase = rng.uniform(0, 1, (24, 2, 2))
    phase -= phase.min((1, 2), keepdims=True)
    phase *= rng.uniform(lowest, highest, (24, 1, 1)) / phase.max((1, 2), keepdims=True)
    expected = np.array([propagated(one) for one in phase])
    real, imag = corner_light(cells(phase))
    assert np.linalg.norm(real + 1j * imag - expected) < missed * np.linalg.norm(expected)


def test_walls_that_go_straight_on_have_no_corners():
    low, high = np.random.default_rng(0).uniform(0, 20, (2, 50))
    for cell in (np.array([[low, high], [low, high]]), np.array([[low, low], [high, high]])):
        for part in corner_light(cells(np.moveaxis(cell, -1, 0))):
            np.testing.assert_allclose(part, 0, atol=1e-12)


def test_corners_do_not_tell_mirrored_and_turned_ones_apart():
    """Nor where the light is told: a phase more of all four cells is a phase more of the light."""
    phase = np.random.default_rng(1).uniform(0, 9, (20, 2, 2))
    real, imag = corner_light(cells(phase))
    for other in (phase[:, ::-1], phase[:, :, ::-1], phase.swapaxes(1, 2)):
        np.testing.assert_allclose(corner_light(cells(other)), (real, imag), atol=1e-12)
    later = corner_light(cells(phase + 1.0))
    np.testing.assert_allclose(later[0] + 1j * later[1], (real + 1j * imag) * np.exp(1j), atol=1e-12)


def test_slopes_are_those_of_differences():
    """Below and beyond what phases are held at."""
    phase, seen, step = np.random.default_rng(2).uniform(0, 12, (200, 2, 2)), (0.7, -0.4), 1e-5

    def amount(phase: np.ndarray) -> np.ndarray:
        real, imag = corner_light(cells(phase))
        return seen[0] * real - seen[1] * imag

    for slope, (y, x) in zip(corner_slopes(cells(phase), seen), np.ndindex(2, 2), strict=True):
        more, less = phase.copy(), phase.copy()
        more[:, y, x] += step
        less[:, y, x] -= step
        np.testing.assert_allclose(slope, (amount(more) - amount(less)) / (2 * step), atol=1e-6)
