"""Classic designs by name, each against what its formula promises in the light of a lens."""

from dataclasses import replace

import numpy as np
import pytest

from doedesign.design.analytic import axilens, logarithmic_asphere
from doedesign.design.starts import StartSetup, start_heights
from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.metrics import zeroth_order
from sim.optic import HeightOptic
from sim.psf_bank import psf

GREEN = 550e-9
CAMERA = Camera(Grid((400, 400), 2e-6), 0.8e-3, "fused_silica", (Colour("green", (GREEN,), (1.0,)),), 4e-3, 2e-6, 255)
SETUP = StartSetup(CAMERA, False, GREEN, 3)
AT = CAMERA.axis_m()


def image_of(name: str, **options: object) -> np.ndarray:
    """PSF for a star over what passes the glass."""
    optic = HeightOptic.of(CAMERA, start_heights(name, options, SETUP))
    return np.asarray(psf(optic).energy[0, 0]) / CAMERA.transmission(GREEN)


@pytest.mark.parametrize(("azimuth", "place"), [("0 deg", (0.0, 1.0)), ("90 deg", (1.0, 0.0)), ("200 deg", None)])
def test_a_blazed_grating_sends_light_toward_its_azimuth(azimuth: str, place: tuple[float, float] | None):
    image = image_of("blazed", period="16 um", azimuth=azimuth)
    turn = np.deg2rad(float(azimuth.split()[0]))
    y, x = place or (np.sin(turn), np.cos(turn))
    radius = GREEN * 4e-3 / 16e-6  # 137.5 um
    near = np.hypot(AT[:, None] - radius * y, AT - radius * x) < 15e-6
    # The eight cells of a period send sinc²(1/8) = 95 % there, a few per cent of it beyond the first dark rings.
    assert image[near].sum() > 0.85


def test_an_axicon_draws_a_ring_of_its_angle():
    image = image_of("axicon", angle="2 deg")
    radius = np.hypot(AT[:, None], AT)
    bins = np.bincount((radius / 2e-6).astype(int).ravel(), image.ravel())
    # f sin(angle) = 139.6 um, less than a pixel and a bin off.
    assert 2e-6 * (int(np.argmax(bins)) + 0.5) == pytest.approx(4e-3 * np.sin(np.deg2rad(2)), abs=3e-6)


@pytest.mark.parametrize("charge", [1, -3])
def test_a_vortex_is_dark_in_its_middle(charge: int):
    optic = HeightOptic.of(CAMERA, start_heights("vortex", {"charge": charge}, SETUP))
    assert zeroth_order(optic)[0] < 1e-3
    image, ideal = image_of("vortex", charge=charge), image_of("flat")
    # A pixel of 2 um sees beyond the core of 2.75 um.
    assert image[127, 127] < 0.12 * ideal.max()
    assert image.sum() > 0.9 * ideal.sum()


def test_a_lens_array_makes_a_spot_behind_every_lens():
    """Behind a lens of its own each lenslet has the same focus: a pattern as wide as the lenslet's own angle."""
    image = image_of("lens_array", pitch="200 um", focal_length="8 mm")
    # Rays of a lenslet leave up to pitch / (2 f) = 12.5 mrad off: a square of 100 um behind 4 mm.
    inside = (np.abs(AT[:, None]) < 60e-6) & (np.abs(AT) < 60e-6)
    assert image[inside].sum() > 0.85
    # Periods of 200 um: orders 11 um apart, dark between.
    row = image[127 - 1 : 127 + 2].sum(0)
    step = GREEN * 4e-3 / 200e-6
    places = [row[np.argmin(np.abs(AT - k * step))] for k in range(-3, 4)]
    between = [row[np.argmin(np.abs(AT - (k + 0.5) * step))] for k in range(-3, 3)]
    assert np.mean(places) > 4 * np.mean(between)


def test_a_cubic_phase_hardly_changes_out_of_focus():
    """Correlation of the transfer functions' sizes at 3 waves of defocus, over that of the bare lens."""
    sharp, blurred = [], []
    for depth in (np.inf, 5e-2):
        for name, kept in (("cubic", sharp), ("flat", blurred)):
            optic = HeightOptic.of(CAMERA, start_heights(name, {"waves": 10} if name == "cubic" else {}, SETUP))
            kept.append(np.abs(np.fft.rfft2(np.asarray(psf(optic, depths=depth).energy[0, 0])))[:20, :20].ravel())
    alike = [np.corrcoef(*pair)[0, 1] for pair in (sharp, blurred)]
    assert alike[0] > 0.97
    assert alike[1] < 0.9


@pytest.mark.slow
def test_a_quartic_keeps_its_peak_over_as_many_waves_as_it_has():
    """Light on the axis over that of a lens in focus, for W waves of defocus: |∫ exp 2πi (w (t² - t) + W t) dt|².

    It is about 1 / (2 w) from -w to w, and gone beyond, where no zone is in focus any more.
    """
    waves, share = 5.0, (np.arange(4000) + 0.5) / 4000
    fine = replace(CAMERA, pixel_m=0.2e-6, window=1)  # an Airy disc is 3.4 um wide
    setup = StartSetup(fine, False, GREEN)
    ideal = float(psf(HeightOptic.of(fine)).energy[0, 0, 0, 0])
    optic, peaks = HeightOptic.of(fine, start_heights("quartic", {"waves": waves}, setup)), {}
    for defocus in (0.0, 3.0, -3.0, 9.0, -9.0):
        # D² / 8 of curvature; a sensor before the focus takes curvature away.
        curvature = 8 * GREEN * defocus / fine.aperture_m**2
        moved = -curvature * fine.focal_length_m**2 / (1 + curvature * fine.focal_length_m)
        own = optic.with_camera(replace(fine, defocus_m=moved))
        phase = waves * (share**2 - share) + defocus * share
        closed = np.abs(np.mean(np.exp(2j * np.pi * phase))) ** 2
        # A cell's height is that of its middle, at most a tenth of a wave off.
        # A nearer sensor has a smaller picture.
        nearer = (1 + moved / fine.focal_length_m) ** 2
        peaks[defocus] = float(psf(own).energy[0, 0, 0, 0]) * nearer / ideal
        assert peaks[defocus] == pytest.approx(closed, abs=0.01)
    assert min(peaks[0.0], peaks[3.0], peaks[-3.0]) > 0.6 / (2 * waves)
    assert max(peaks[9.0], peaks[-9.0]) < 0.2 / (2 * waves)


@pytest.mark.parametrize("formula", [axilens, logarithmic_asphere])
def test_zones_of_an_extended_focus_point_to_their_distance(formula: object):
    radius = np.linspace(1e-6, 1e-3, 2001)
    slope = np.gradient(formula(radius, 10e-3, 20e-3, 1e-3, GREEN), radius) * GREEN  # pyright: ignore
    focus = -radius / slope
    assert focus[3] == pytest.approx(10e-3, rel=1e-3)
    assert np.all(np.diff(focus[1:-1]) > 0)
    if formula is logarithmic_asphere:
        np.testing.assert_allclose(focus[5:-1], 10e-3 + 10e-3 * (radius[5:-1] / 1e-3) ** 2, rtol=1e-3)
    else:  # Davidson's formula differs from its name: the slope has the derivative of the focal length, too
        assert focus[-2] > 20e-3


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("axicon", {}, "an angle with a unit"),
        ("axicon", {"angle": "2 mm"}, "an angle with a unit"),
        ("vortex", {"charge": 0.5}, "a whole number"),
        ("blazed", {}, "needs it"),
        ("lens_array", {"pitch": "20 um"}, "needs it"),
        ("axilens", {"near": "5 mm", "far": "5 mm"}, "must differ"),
        ("cubic", {"wave": 3}, "options of start"),
        ("quartic", {"waves": "5"}, "a number from"),
    ],
)
def test_bad_options_are_refused(name: str, options: dict[str, object], words: str):
    with pytest.raises(InputError, match=words):
        start_heights(name, options, SETUP)


def test_rings_take_only_profiles():
    with pytest.raises(InputError, match="profile over the radius"):
        start_heights("vortex", {}, SETUP._replace(radial=True))
    assert start_heights("axicon", {"angle": "1 deg"}, SETUP._replace(radial=True)).ndim == 1
