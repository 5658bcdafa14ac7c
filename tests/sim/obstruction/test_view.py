import numpy as np
import pytest

from sim.obstruction import CameraView

DSLR = CameraView((512, 512), 12.9e-6, 50e-3)
AUTOMOTIVE = CameraView((512, 512), 3.7e-6, 8e-3)


def test_sizes_in_pixels_by_hand():
    # Eq. 11: a wire of 4 mm at 60 cm is 4 x 50 / 0.6 / 12.9 = 25.84 pixels wide.
    assert DSLR.pixels(4e-3, 0.6) == pytest.approx(25.84, abs=5e-3)
    # A drop of 2 mm at 5 cm: 2 x 8 / 0.05 / 3.7 = 86.49 pixels.
    assert AUTOMOTIVE.pixels(2e-3, 0.05) == pytest.approx(86.49, abs=5e-3)
    assert AUTOMOTIVE.pixels(2e-3, 0.10) == pytest.approx(86.49 / 2, abs=5e-3)
    assert AUTOMOTIVE.pixels(2e-3, float("inf")) == 0


def test_a_pixel_at_a_distance():
    # 3.7 um at 8 mm from the lens is 55.5 um at 12 cm.
    assert AUTOMOTIVE.pixel_at_m(0.12) == pytest.approx(55.5e-6)


def test_directions_are_centred_and_row_zero_is_the_lowest():
    y, x = CameraView((4, 3), 2e-6, 1e-3).slopes()
    np.testing.assert_allclose(y[:, 0], [-3e-3, -1e-3, 1e-3, 3e-3], rtol=1e-6)
    np.testing.assert_allclose(x[0], [-2e-3, 0, 2e-3], rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "pixel_m", "focal_m", "name"),
    [
        ((0, 5), 1e-6, 1e-3, "shape"),
        ((5, -5), 1e-6, 1e-3, "shape"),
        ((1, 5), 1e-6, 1e-3, "shape"),
        ((5, 5), 0.0, 1e-3, "pixel_m"),
        ((5, 5), float("nan"), 1e-3, "pixel_m"),
        ((5, 5), 1e-6, -1e-3, "focal_m"),
        ((5, 5), 1e-6, float("inf"), "focal_m"),
    ],
)
def test_nonsense_is_refused(shape: tuple[int, int], pixel_m: float, focal_m: float, name: str):
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        CameraView(shape, pixel_m, focal_m)


@pytest.mark.parametrize("depth_m", [0.0, -0.1, float("nan")])
def test_nothing_stands_behind_the_lens(depth_m: float):
    with pytest.raises(ValueError, match="`depth_m` must be positive"):
        DSLR.pixels(1e-3, depth_m)


def test_a_background_fills_the_frame_in_three_colours():
    CameraView((4, 6), 1e-6, 1e-3).require(np.zeros((3, 4, 6), np.float32))
    for shape in ((1, 4, 6), (3, 6, 4)):
        with pytest.raises(ValueError, match=r"`background` must have the shape \(3, 4, 6\)"):
            CameraView((4, 6), 1e-6, 1e-3).require(np.zeros(shape, np.float32))
