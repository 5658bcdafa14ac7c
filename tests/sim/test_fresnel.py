import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera, relative_error
from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera
from sim.propagation.fresnel import Kernel, nyquist_focal_length_m, plan_direct
from sim.psf_bank import psf


def test_equation_six_at_the_papers_size():
    assert nyquist_focal_length_m(2400, 1.85e-6, YELLOW_M) == pytest.approx(2400 * 1.85e-6**2 / YELLOW_M)
    with pytest.raises(
        InputError,
        match=r"eq\. 6.* focal length, 8 mm.*13\.9\d mm at 589 nm with N = 2400 and 1\.85 um.*far_field.*N = 41",
    ):
        plan_direct(make_camera(2400, 4.44e-3, 8e-3, 3.7e-6, 512), YELLOW_M)


def summed(camera: Camera, height_m: np.ndarray, depth_m: float) -> np.ndarray:
    """Pixel energies by Fresnel's integral over eight parts of every cell, 16 places of a pixel, along either axis.

    Behind a lens in its focal plane the quadratic phases of lens and propagation cancel: what is left is the source's.
    """
    assert camera.defocus_m == 0
    parts, places, scale = 8, 16, YELLOW_M * camera.focal_length_m
    small, step = camera.grid.pitch_m / parts, camera.pixel_m / places
    x = (np.arange(parts * camera.grid.shape[1]) - (parts * camera.grid.shape[1] - 1) / 2) * small
    seen = (np.arange(places * camera.window) - (places * camera.window - 1) / 2) * step
    waves = np.kron(height_m, np.ones((parts, parts))) * camera.waves_per_metre(YELLOW_M)
    waves = waves + (x[:, None] ** 2 + x**2) / (2 * depth_m * YELLOW_M)
    turns = np.exp(-2j * np.pi / scale * np.outer(seen, x)) * np.sinc(small / scale * seen)[:, None]
    field = turns @ np.exp(2j * np.pi * waves) @ turns.T * small**2 / scale
    energy = (np.abs(field) ** 2 * step**2).reshape(camera.window, places, camera.window, places).sum(axis=(1, 3))
    return energy / camera.opening.area_m2 * camera.transmission(YELLOW_M)


@pytest.mark.parametrize(("spare", "depth"), [(1.0, np.inf), (1.0, 20.0), (1.2, np.inf), (4.0, 3.0)])
def test_a_rough_plate_on_a_grid_that_just_samples_the_lens(spare: float, depth: float):
    """Its light fills the window and meets half a wave of the lens per cell at the rim, and squares weaken it aside.

    With a sample per cell 33 % off at `spare` = 1, and with points in place of squares 17 % at 4.
    """
    cells, side = 61, 61 * 1.6e-6
    focal = spare * nyquist_focal_length_m(cells, 1.6e-6, YELLOW_M)
    speck = YELLOW_M * focal / side
    camera = Camera(
        Grid((cells, cells), 1.6e-6),
        RectangularAperture((side, side)),
        "fused_silica",
        make_camera(8, 1, 1, 1, 8).colours,
        focal,
        1.3 * speck,
        24,
    )
    height = np.random.default_rng(0).uniform(0, 1, (cells, cells)) / camera.waves_per_metre(YELLOW_M)
    got = psf(height, camera, [depth * focal], propagation="fresnel").energy[0, 0]
    # The rules over pixels differ by 1e-3; parts of cells lit evenly by the near source leave 2e-3.
    assert relative_error(got, summed(camera, height, depth * focal)) < 3e-3


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


@pytest.mark.parametrize("kernel", ["fresnel", "angular_spectrum"])
def test_plane_waves_are_delayed_by_their_path(kernel: Kernel):
    """d sqrt(1 - (wavelength nu)²) for each, less d, and its parabola: 0.9 % of d apart at a sine of 1/2."""
    camera = make_camera(100, 40e-6, nyquist_focal_length_m(100, 0.4e-6, YELLOW_M), 0.4e-6, 16)
    plan = plan_direct(camera, YELLOW_M, kernel)
    count, distance = plan.kernel.shape[0], camera.focal_length_m
    nu = np.arange(-(count // 2), count - count // 2) / (count * 0.4e-6 / plan.parts)
    across = (YELLOW_M * nu[:, None]) ** 2 + (YELLOW_M * nu) ** 2
    path = -across / 2 if kernel == "fresnel" else np.sqrt(np.maximum(1 - across, 0)) - 1
    # In units of the wave that goes straight on.
    found = np.fft.fftshift(np.asarray(plan.kernel, np.complex128)) * np.exp(-2j * np.pi * distance / YELLOW_M * path)
    passed = np.abs(found) > 1e-3
    assert np.sqrt(across[passed].max()) > 0.5
    # The accuracy of `cis`.
    np.testing.assert_allclose(found[passed], np.abs(found[passed]), atol=1e-5)


def test_an_odd_and_an_even_number_of_cells_have_their_image_in_the_middle():
    """A plate of 40 rows and 61 columns, whose middles lie between cells and on one."""
    side = 61 * 1.6e-6
    focal = 4 * nyquist_focal_length_m(61, 1.6e-6, YELLOW_M)  # four samples to a wavelength x distance / side
    colours = make_camera(8, 1, 1, 1, 8).colours
    camera = Camera(
        Grid((40, 61), 1.6e-6), RectangularAperture((40 * 1.6e-6, side)), "fused_silica", colours, focal, 3e-6, 24
    )
    got = psf(np.zeros((40, 61)), camera, [np.inf], propagation="fresnel").energy[0, 0]
    for mirrored in (got[::-1], got[:, ::-1]):
        # Rules of pixels beside other samples promise 0.2 %.
        assert relative_error(mirrored, got) < 4e-3
    points = ((np.arange(50) + 0.5) / 50 - 0.5) * camera.pixel_m
    places = camera.axis_m()[:, None] + points
    y, x = (
        np.mean(extent / (YELLOW_M * focal) * np.sinc(extent / (YELLOW_M * focal) * places) ** 2, axis=1)
        for extent in (40 * 1.6e-6, side)
    )
    # What leaves the padded grid is missing, a per cent of the light at an edge.
    assert relative_error(got / got.sum(), np.outer(y, x) / np.outer(y, x).sum()) < 0.01
