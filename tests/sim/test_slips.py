"""Slips of those who call `sim` from Python: what is no beam, no camera, no bank is told in words."""

# What is given here is of other types than annotations say, on purpose.
# pyright: reportArgumentType=false

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.illumination import EvenBeam, GaussianBeam, MeasuredBeam
from sim.material import full_wave_height_m, refractive_index
from sim.metrics import encircled_energy
from sim.psf_bank import PsfBank
from tests.pictures import require_place_of_axes, require_whole

COLOURS = (Colour("green", (550e-9,), (1.0,)),)
CAMERA = Camera(Grid((32, 32), 2e-6), 60e-6, "fused_silica", COLOURS, 1e-3, 2e-6, 32)
EVEN = np.ones((8, 8))


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("call", "told"),
    [
        (
            lambda: MeasuredBeam(EVEN, 0),
            r"beam: pixel_m: must be a positive number of metres, but got 0\. For example 5e-6",
        ),
        (lambda: MeasuredBeam(EVEN, "2 um"), "beam: pixel_m: must be a positive number of metres, but got '2 um'"),
        (lambda: MeasuredBeam(EVEN, np.nan), "beam: pixel_m: .*nan"),
        (lambda: MeasuredBeam(EVEN[0], 2e-6), r"beam: intensity: must be an array of numbers \[y, x\].* shape \(8,\)"),
        (lambda: MeasuredBeam(EVEN[:0], 2e-6), r"beam: intensity: .* shape \(0, 8\)"),
        (lambda: MeasuredBeam("beam.png", 2e-6), "beam: intensity: must be an array of numbers"),
        (lambda: MeasuredBeam(EVEN - 2, 2e-6), r"somewhere positive, but got -1\.0 to -1\.0"),
        (lambda: MeasuredBeam(EVEN, 2e-6, centre_m=0.0), r"beam: centre_m: must be two numbers \(y, x\), but got 0\.0"),
        (lambda: GaussianBeam(1e-3), r"beam: radius_m: must be two positive lengths .*got 0\.001\. .*\(1e-3, 1e-3\)"),
        (lambda: GaussianBeam(("1 mm", "1 mm")), "beam: radius_m: must be two positive lengths"),
        (lambda: GaussianBeam((1e-3, 1e-3), m_squared=1), "beam: m_squared: must be two numbers"),
        (lambda: GaussianBeam((1e-3, 1e-3), waist_distance_m="1 m"), "beam: waist_distance_m: must be a finite number"),
        (lambda: GaussianBeam((1e-3, 1e-3), angle_rad=(np.nan, 0.0)), "beam: angle_rad: must be two numbers"),
        (lambda: EvenBeam("1 m"), "beam: distance_m: must be positive, a number of metres, but got '1 m'"),
        (lambda: EvenBeam(angle_rad=0.1), "beam: angle_rad: must be two numbers"),
        (lambda: replace(CAMERA, beam="gauss"), r"beam: must be a beam of sim, but got 'gauss'\. .*GaussianBeam"),
        (lambda: replace(CAMERA, fill="1"), "fill: must lie above 0, up to 1, but got '1'"),
        (lambda: replace(CAMERA, distortion=1), "distortion: must be two finite numbers, k1 and k2, but got 1"),
        (
            lambda: full_wave_height_m("fused_silica", "550 nm"),
            r"the wavelength must be a number of metres, .*'550 nm'",
        ),
        (lambda: refractive_index("fused_silica", None), "the wavelength must be a number of metres, but got None"),
        (lambda: encircled_energy(EVEN, 2e-6, 1e-6), "radii_m: must be several radii, .* but got 1e-06"),
        (lambda: encircled_energy(EVEN, 2e-6, ["1 um"]), "radii_m: must be several radii"),
        (lambda: encircled_energy(EVEN, 2e-6, []), "radii_m: must be several radii"),
        (lambda: encircled_energy(EVEN, 2e-6, [-1e-6]), "radii_m: must be several radii"),
        (lambda: PsfBank(EVEN[None, None], "g", (np.inf,), 2e-6), "colours: must be one for each PSF, but got 'g'"),
        (lambda: PsfBank(EVEN[None, None], ("g",), np.inf, 2e-6), "depths_m: must be one for each PSF, but got inf"),
        (lambda: PsfBank(EVEN[None, None], ("g",), (np.inf,), 0), "pixel_m: must be a positive number of metres"),
        (lambda: PsfBank(EVEN[None, None], ("g",), (np.inf,), "2 um"), "pixel_m: must be a positive number .*'2 um'"),
    ],
)
def test_slips_are_told_in_words(call, told):
    with pytest.raises(InputError, match=told):
        call()


@pytest.mark.usefixtures("annotations_unchecked")
def test_lists_of_a_beam_are_taken():
    beam = GaussianBeam([1e-3, 2e-3])
    assert beam == GaussianBeam((1e-3, 2e-3))
    assert replace(CAMERA, beam=beam) == replace(CAMERA, beam=GaussianBeam((1e-3, 2e-3)))


@pytest.mark.parametrize("sines", [False, True], ids=["on_a_sensor", "in_angles"])
def test_psfs_without_a_camera_are_drawn_and_summed(sines, rng):
    """As a notebook shows measured ones: it ended in an error."""
    energy = rng.normal(1e-3, 1e-4, (2, 3, 33, 33)).astype(np.float32)
    energy[..., 16, 16] = 0.5
    bank = PsfBank(energy, ("red", "green"), (0.05, 0.1, np.inf), 1e-3 if sines else 2e-6, sines=sines)
    np.testing.assert_allclose(bank.throughput(), energy.sum((2, 3), dtype=np.float64), rtol=1e-6)
    assert "light in the window" in bank._repr_html_()
    figure: Any = bank.plot()
    require_whole(figure)
    require_place_of_axes(bank.plot)
    panes = [axes for axes in figure.axes if axes.images]
    assert [axes.get_title(loc="left") for axes in panes[:3]] == ["50 mm", "100 mm", "∞"]
    assert panes[0].get_ylabel().startswith("red\ny (°" if sines else "red\ny (µm)")
    with pytest.raises(InputError, match=r"must be known for metrics, but got None\. Give it by bank\.with_camera"):
        bank.ring_to_disc()
