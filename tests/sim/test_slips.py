"""Slips of those who call `sim` from Python: what is no beam, no camera, no bank is told in words."""

# What is given here is of other types than annotations say, on purpose.
# pyright: reportArgumentType=false

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.illumination import EvenBeam, GaussianBeam, MeasuredBeam
from sim.imaging.formation import Optics, capture
from sim.imaging.glare import Glare
from sim.imaging.scene import Scene
from sim.material import fresnel_transmission, full_wave_height_m, refractive_index
from sim.metrics import encircled_energy, energy_budget, ring_to_disc
from sim.optic import HeightOptic
from sim.psf_bank import PsfBank
from sim.rigorous.edge_optic import with_edges
from sim.store import read_bank, write_bank, write_height
from sim.surface import as_fabricated
from sim.surface.leakage import split_psf
from sim.transfer import mtf
from tests.pictures import require_place_of_axes, require_whole

COLOURS = (Colour("green", (550e-9,), (1.0,)),)
CAMERA = Camera(Grid((32, 32), 2e-6), 60e-6, "fused_silica", COLOURS, 1e-3, 2e-6, 32)
EVEN = np.ones((8, 8))
BANK = PsfBank(np.ones((1, 2, 8, 8)), ("green",), (0.05, np.inf), 2e-6)
BARE = HeightOptic.of(CAMERA)
SCENE = Scene(np.ones((1, 8, 8), np.float32), 5.0)
OPTICS = Optics(np.ones((1, 1, 3, 3), np.float32), 60e-6, 1e-3, 2e-6)
FLAT = np.zeros((32, 32), np.uint8)
IDEAL = Process(Levels(4, 300e-9))


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
        (lambda: replace(CAMERA, colours=()), r"colours: must be colour channels, but got \(\)"),
        (lambda: encircled_energy([1.0], 2e-6, [1e-6]), r"psfs: must be energies \[\.\.\., y, x\], but got list of"),
        (lambda: encircled_energy(EVEN, "2 um", [1e-6]), "pixel_m: must be a positive number .*'2 um'"),
        (lambda: BANK.at("2 cm"), "depth: must lie within the depths of the PSF bank, 0.05 to inf m, but got 0.02 m"),
        (lambda: BANK.at(None), "depth: must be metres or text"),
        (lambda: BANK.plot("x.png"), "ax: must be an Axes, but got a str"),
        (lambda: BANK.with_camera("lens"), r"camera: must be a Camera, but got a str\. A design has one"),
        (lambda: ring_to_disc(EVEN, None, 0.05), "camera: must be a Camera, but got a NoneType"),
        (lambda: ring_to_disc(EVEN, CAMERA, -0.05), r"depth_m: must be a positive distance, but got -50 mm\."),
        (lambda: energy_budget(EVEN, EVEN, 0.05, COLOURS[0]), "optic: must be a DOE of cells, but got a ndarray"),
        (lambda: energy_budget(BARE, EVEN, np.nan, COLOURS[0]), "depth_m: must be metres"),
        (lambda: energy_budget(BARE, EVEN, 0.05, "green"), "colour: must be a Colour, but got a str"),
        (lambda: split_psf(BARE, np.inf, COLOURS[0]), "doe: must be a FabricatedDoe, but got a HeightOptic"),
        (lambda: HeightOptic.of(None), "camera: must be a Camera"),
        (lambda: with_edges(np.zeros((32, 32)), "lens"), "camera: must be a Camera"),
        (lambda: with_edges(np.zeros((32, 32)), CAMERA, depths_m=0.05), "depths_m: must be several distances"),
        (
            lambda: as_fabricated(None, CAMERA, IDEAL, Variation()),
            "level_map: must be a ndarray, but got a NoneType",
        ),
        (lambda: as_fabricated(FLAT, CAMERA, IDEAL, Variation(), depths_m=(np.nan,)), "depths_m: must be several"),
        (
            lambda: as_fabricated(FLAT, CAMERA, IDEAL, Variation(common_depth_scale=-2.0)),
            r"variation\.common_depth_scale: no etch is shallower than nothing: .* but got -2\.0",
        ),
        (lambda: as_fabricated(FLAT, CAMERA, IDEAL, Variation(depth_scale=(0.0, -1.1))), r"variation\.depth_scale: no"),
        (lambda: fresnel_transmission("1.5"), "index: must be a number of 1 or more, but got '1.5'"),
        (lambda: fresnel_transmission(-1), "index: must be a number of 1 or more"),
        (lambda: Glare("2 %"), r"glare\.share: must lie from 0 to below 1, but got '2 %'"),
        (lambda: Glare(window=2.5), r"glare\.window: must be a whole, odd number"),
        (lambda: Glare(core_px=None), r"glare\.core_px: must be a positive number"),
        (lambda: capture(EVEN, OPTICS, "paper"), r"scene: must be a Scene, but got a ndarray\. For example sim\.Scene"),
        (lambda: capture(SCENE, BANK, "paper"), "optics: must be an Optics, but got a PsfBank"),
        (lambda: capture(SCENE, replace(OPTICS, aperture_m=-1e-3), "paper"), "optics: aperture_m: must be a positive"),
        (lambda: capture(SCENE, replace(OPTICS, pixel_m="2 um"), "paper"), "optics: pixel_m: .* but got '2 um'"),
        (lambda: mtf(BARE, count=0), "count: must be a whole number of frequencies, 2 or more, but got 0"),
        (lambda: write_bank(BANK, "b.exr"), "bank: must be a PsfBank, but got a str"),
        (lambda: write_bank(3, BANK), "path: must be the path of a file or a folder, but got an int"),
        (lambda: read_bank("b.exr", 2e-6, "5 cm"), "depth_m: must be a positive number of metres, but got '5 cm'"),
        (lambda: read_bank("b.exr", 2e-6, np.nan), "depth_m: must be a positive number"),
        (lambda: write_height("h.exr", EVEN, 0, 8e-6), "pitch_m: must be a positive number of metres, but got 0"),
        (lambda: write_height("h.exr", EVEN, 1e-6, -8e-6), "aperture: must be positive, but got -8 um"),
        (lambda: write_height("h.exr", EVEN[0], 1e-6, 8e-6), r"height_m: must be a map \[y, x\], but got the shape"),
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


def test_a_bank_is_asked_for_depths_with_a_unit():
    np.testing.assert_array_equal(BANK.at("5 cm"), BANK.at(0.05))
    np.testing.assert_array_equal(BANK.at("inf"), BANK.energy[:, 1])
