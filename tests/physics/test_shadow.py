"""Shadows of obstructions on the pupil: Fresnel's own cases, geometry, and a propagation on a raster."""

import dataclasses

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from sim.camera import Camera, Mapping
from sim.imaging.shadow import Border, shadow, shadowed_psf
from sim.psf_bank import psf

NEAR_M = 0.05
# Fresnel number D^2 / (lambda z) of 76, a tenth of the automotive camera's: fringes are wider, tests faster.
SMALL = make_camera(300, 1.5e-3, 8e-3, 3.7e-6, 127)


def strip(width: int, shape: tuple[int, int] = (101, 101)) -> np.ndarray:
    """A vertical bar in the middle of a view, an odd number of pixels wide."""
    mask = np.zeros(shape)
    middle = shape[1] // 2
    mask[:, middle - width // 2 : middle + width // 2 + 1] = 1
    return mask


def width_m(pixels: int) -> float:
    """Width of so many pixels in the plane of the obstruction (eq. 11)."""
    return pixels * 3.7e-6 * NEAR_M / 8e-3


def disc_overlap(share: float) -> float:
    """What a strip through the middle leaves open of a disc, its width over the diameter given."""
    a = min(share, 1.0)
    return 1 - 2 / np.pi * (np.arcsin(a) + a * np.sqrt(1 - a * a))


def pupil_shadow(
    camera: Camera,
    height_m: np.ndarray,
    mask: np.ndarray,
    depth_m: float,
    points: list[tuple[int, int]],
    radiance: np.ndarray,
    background_depth_m: float,
    border: Border = "edge",
) -> np.ndarray:
    """Picture `[colour, y, x]` of some scene points (light `[point, colour]`) behind an obstruction that sends none."""
    if camera.window % 2 == 0:
        raise ValueError(f"`camera.window` must be odd, but got {camera.window}")
    half = camera.window // 2
    height, width = mask.shape
    wide = np.zeros((len(camera.colours), height + 2 * half, width + 2 * half))
    for (row, column), light in zip(points, radiance, strict=True):
        image = shadowed_psf(camera, height_m, mask, depth_m, background_depth_m, (row, column), border)
        wide[:, row : row + camera.window, column : column + camera.window] += light[:, None, None] * image
    return wide[:, half : half + height, half : half + width].astype(np.float32)


def test_nothing_in_the_way_and_everything():
    empty, full = np.zeros((5, 5)), np.ones((5, 5))
    assert np.abs(shadow(SMALL, empty, NEAR_M, np.inf, YELLOW_M, (2, 2)) - 1).max() == 0
    # All strips of an axis together pass all there is: an exact sum of Fresnel integrals, so rounding is all.
    assert np.abs(shadow(SMALL, full, NEAR_M, np.inf, YELLOW_M, (2, 2))).max() < 1e-14


def test_half_a_plane_leaves_a_quarter_of_the_light_at_its_edge():
    mask = np.zeros((5, 80))
    mask[:, 40:] = 1
    # A point at -1/2 sees the edge through the middle of the aperture; a lens turns the view round, so the side
    # that is covered is the aperture's -x.
    light = np.abs(shadow(SMALL, mask, NEAR_M, np.inf, YELLOW_M, (2, 39.5))) ** 2
    middle = light[:, 149:151].mean()
    # Cells half a pitch beside the edge are 1 % brighter and darker in turn; their mean is the quarter but for a curve.
    assert middle == pytest.approx(0.25, abs=1e-3)
    assert light[:, 0].max() < 0.01
    # First bright fringe of a straight edge: 1.370 of the light (M. Born, E. Wolf, Principles of Optics, ch. 8.7).
    assert light[150].max() == pytest.approx(1.370, abs=0.003)


def test_against_a_propagation_on_a_raster():
    """The same bar by the angular spectrum on a raster wide and fine enough for its fringes."""
    mask, depth, point = strip(21), NEAR_M, (50, 58)
    found = shadow(SMALL, mask, depth, np.inf, YELLOW_M, point)[0]
    pitch, count = 1.25e-6, 1 << 15
    x = (np.arange(count) - count / 2 + 0.5) * pitch
    # The bar is 8 pixels to the left of the point in the picture, so to the right in its plane.
    scale = 3.7e-6 * depth / 8e-3
    bar = np.abs(x - 8 * scale) < 10.5 * scale
    wave = np.fft.fft(bar)
    spread = np.fft.ifft(wave * np.exp(-1j * np.pi * YELLOW_M * depth * np.fft.fftfreq(count, pitch) ** 2))
    wanted = (
        1 - np.interp(SMALL.grid.axis_m("x"), x, spread.real) - 1j * np.interp(SMALL.grid.axis_m("x"), x, spread.imag)
    )
    # The raster puts the bar's edges right to half of its pitch, 0.6 um of a fringe's 170 um.
    assert np.abs(found - wanted).max() < 6e-3


def test_a_point_that_is_not_at_infinity_sees_a_wider_shadow():
    """Rays from b to the aperture cross the obstruction nearer to each other, by 1 - z / b."""
    mask, wall = strip(25), 0.1
    far = np.abs(shadow(SMALL, mask, NEAR_M, np.inf, YELLOW_M, (50, 50))[0]) ** 2
    near = np.abs(shadow(SMALL, mask, NEAR_M, wall, YELLOW_M, (50, 50))[0]) ** 2
    dark = [int(np.count_nonzero(light < 0.25)) for light in (far, near)]
    # In shadow is what has less than the light at the edge, a quarter. The wave past the other edge, a tenth as strong
    # there, moves that line by a cell or two on either side.
    assert dark[0] == pytest.approx(width_m(25) / SMALL.grid.pitch_m, abs=4)
    assert dark[1] == pytest.approx(2 * dark[0], abs=8)


@pytest.mark.parametrize("pixels", [11, 21, 41])
def test_light_that_passes_is_what_geometry_leaves_open(pixels: int):
    flat = np.zeros(SMALL.grid.shape)
    camera = dataclasses.replace(SMALL, window=401)
    passed = shadowed_psf(camera, flat, strip(pixels), NEAR_M, np.inf, (50, 50)).sum()
    whole = psf(flat, camera, [np.inf]).energy.sum()
    # Fringes carry light across the edge of the shadow: lambda z / (pi D w) or so of it, 1 % at this Fresnel number.
    assert passed / whole == pytest.approx(disc_overlap(width_m(pixels) / SMALL.aperture_m), abs=0.012)


@pytest.mark.parametrize("mapping", ["sine", "tangent"])
def test_the_sensor_has_its_own_distance(mapping: Mapping):
    """Focused at 20 cm the sensor lies 4 % farther away, and pixels are so much narrower at the obstruction."""
    defocus_m = 8e-3**2 / (0.2 - 8e-3)
    focused = dataclasses.replace(SMALL, defocus_m=defocus_m, mapping=mapping)
    longer = dataclasses.replace(SMALL, focal_length_m=8e-3 + defocus_m)
    given = strip(21), NEAR_M, 0.2, YELLOW_M, (50, 50)
    found, wanted, other = (shadow(camera, *given) for camera in (focused, longer, SMALL))
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.mean(np.abs(found) ** 2) > np.mean(np.abs(other) ** 2) + 2e-3


def test_a_picture_is_the_sum_of_its_points():
    flat, mask = np.zeros(SMALL.grid.shape), strip(11, (41, 61))
    points, light = [(20, 30), (5, 2)], np.array([[2.0], [0.5]])
    picture = pupil_shadow(SMALL, flat, mask, NEAR_M, points, light, np.inf)
    alone = [shadowed_psf(SMALL, flat, mask, NEAR_M, np.inf, point)[0] for point in points]
    # Pixel (row, column) of the picture is the middle of the PSF shifted to the point.
    wanted = np.zeros((41, 61))
    for (row, column), weight, image in zip(points, light[:, 0], alone, strict=True):
        wanted += weight * image[63 - row : 104 - row, 63 - column : 124 - column]
    np.testing.assert_allclose(picture[0], wanted, atol=1e-7)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="depth_m"):
        shadow(SMALL, strip(3), 0.2, 0.1, YELLOW_M, (0, 0))
    with pytest.raises(ValueError, match="odd"):
        pupil_shadow(dataclasses.replace(SMALL, window=64), np.zeros((300, 300)), strip(3), 1, [], np.empty((0, 1)), 2)


@pytest.mark.slow
def test_an_even_light_behind_a_bar_is_what_the_bar_would_have_sent():
    """Reciprocity: a world of one radiance stays even whatever the plate does, so bar and background add up to it.

    The plate is a ring grating, whose zones send light outward along their own radius: here p_near is not the shadow
    disc blurred by p_far, and the models of `sim.imaging.formation` differ.
    """
    camera = dataclasses.replace(SMALL, window=255)
    y, x = np.meshgrid(camera.grid.axis_m("y"), camera.grid.axis_m("x"), indexing="ij")
    # First orders 53 pixels away, within the window together with the blur of 65; 3 % of the light beyond.
    height = 1.0 * (1 + np.sin(2 * np.pi * np.hypot(y, x) / 24e-6)) / (2 * np.pi * camera.waves_per_metre(YELLOW_M))
    half, bar = 127, strip(31, (1, 255))
    # Everything is alike on both sides of the middle, so one side tells what lands there.
    found = 0.0
    for point in range(half, 255):
        image = shadowed_psf(camera, height, bar, NEAR_M, np.inf, (0, point))[0]
        found += (2 - (point == half)) * float(image[:, 2 * half - point].sum())
    bank = psf(height, camera, [NEAR_M, np.inf]).energy[0].sum(axis=1)
    wanted = bank[1].sum() - bank[0, half - 15 : half + 16].sum()
    # What leaves the window differs for near and far light, and fringes carry a little over the bar's edge.
    assert found == pytest.approx(wanted, abs=0.01)
    blurred = np.convolve(bank[1], _shadow_line(camera), "same")
    radiometric = bank[1].sum() - blurred[half - 15 : half + 16].sum()
    assert abs(found - wanted) < 0.3 * abs(found - radiometric), (found, wanted, radiometric)


def _shadow_line(camera) -> np.ndarray:
    """The shadow disc summed over its columns."""
    half_px = camera.aperture_m / 2 * 8e-3 / NEAR_M / camera.pixel_m
    edges = np.clip((np.arange(256) - 127.5) / half_px, -1, 1)
    return np.diff(edges * np.sqrt(1 - edges**2) + np.arcsin(edges)) / np.pi
