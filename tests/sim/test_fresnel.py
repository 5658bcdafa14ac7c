import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from fab.errors import InputError
from sim.propagation.fresnel import nyquist_focal_length_m, plan_direct


def test_equation_six_at_the_papers_size():
    assert nyquist_focal_length_m(2400, 1.85e-6, YELLOW_M) == pytest.approx(2400 * 1.85e-6**2 / YELLOW_M)
    with pytest.raises(InputError, match=r"eq\. 6.*13\.9\d mm at 589 nm with N = 2400 and 1\.85 um.*far_field.*N = 41"):
        plan_direct(make_camera(2400, 4.44e-3, 8e-3, 3.7e-6, 512), YELLOW_M)


def test_a_grid_that_just_samples_the_lens_is_accepted():
    cells, aperture = 100, 0.1e-3
    camera = make_camera(cells, aperture, nyquist_focal_length_m(cells, aperture / cells, YELLOW_M), 2e-6, 16)
    plan = plan_direct(camera, YELLOW_M)
    assert plan.kernel.shape == (300, 300)


def test_a_window_wider_than_the_padded_grid_is_refused():
    with pytest.raises(InputError, match=r"camera\.window.*three apertures"):
        plan_direct(make_camera(100, 0.1e-3, 8e-3, 2e-6, 200), YELLOW_M)


@pytest.mark.parametrize("kernel", ["fresnel", "angular_spectrum"])
def test_operators_pass_or_stop_but_never_amplify(kernel: str):
    plan = plan_direct(make_camera(120, 0.12e-3, 1e-3, 1e-6, 40), YELLOW_M, kernel)  # pyright: ignore[reportArgumentType]
    assert np.abs(np.abs(plan.lens) - 1).max() < 1e-5  # the accuracy of `cis`
    modulus = np.abs(plan.kernel)
    assert modulus.max() < 1 + 1e-5
    assert modulus[0, 0] == pytest.approx(1, abs=1e-5)
    # Band-limited: the highest frequencies would leave the padded grid.
    assert modulus[180].max() < 1e-12
    assert modulus[:, 180].max() < 1e-12
