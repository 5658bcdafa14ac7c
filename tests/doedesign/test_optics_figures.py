"""Figures 4 and 8: modulation transfer, zeroth order and concentric energy against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import fresnel

from doedesign.design.design import Design
from doedesign.design.starts import StartSetup, balanced_ridge, ring, zeroth_orders
from doedesign.evaluation.optics.depth_study import depth_study
from doedesign.evaluation.optics.plate_comparison import (
    FRESNEL,
    PROPOSED,
    RANDOM,
    RING,
    THIN_LENS,
    compare_optics,
    comparison_plates,
)
from doedesign.optimization import optimize
from doedesign.spec import load_spec
from fab.errors import InputError
from fab.figure import png_bytes
from fab.process import Process
from sim.illumination import GaussianBeam
from sim.metrics import zeroth_order
from sim.optic import HeightOptic
from sim.transfer import directional_mtf, mtf
from tests.doedesign.calibration_fakes import plate_drawn
from tests.doedesign.small_runs import SPREAD


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Design:
    """A ring of 48 cells with objectives."""
    path = tmp_path_factory.mktemp("spec") / "small.toml"
    path.write_text(SPREAD)
    return optimize(load_spec(path))


def test_mtf_of_the_thin_lens_is_that_of_a_disc_and_a_pixel():
    design = plate_drawn(200)
    camera = design.camera
    (colour,) = camera.colours
    frequencies = np.linspace(0, 0.5 / camera.pixel_m, 40)
    radial, along_x, along_y = directional_mtf(HeightOptic.of(camera), np.inf, frequencies)[0]
    reduced = np.minimum(frequencies * colour.wavelengths_m[0] * camera.focal_length_m / camera.aperture_m, 1)
    disc = 2 / np.pi * (np.arccos(reduced) - reduced * np.sqrt(1 - reduced**2))
    turns = np.linspace(0, np.pi, 721)[:-1]
    pixel = [np.sinc(camera.pixel_m * np.outer(frequencies, way)) for way in (np.sin(turns), np.cos(turns))]
    # Cells at the rim have the mean amplitude of their open part, and so a little less power than that part.
    np.testing.assert_allclose(along_x, disc * np.sinc(camera.pixel_m * frequencies), atol=4e-3)
    np.testing.assert_allclose(along_y, along_x, atol=1e-6)
    np.testing.assert_allclose(radial, disc * (pixel[0] * pixel[1]).mean(axis=1), atol=4e-3)


def test_mtf_along_x_is_that_of_sim_and_along_y_that_of_the_turned_plate():
    design = plate_drawn(64, window=32)
    camera, height = design.camera, design.height_m
    known = mtf(HeightOptic.of(camera, height), depths=6e-3, count=20)
    _, along_x, along_y = directional_mtf(HeightOptic.of(camera, height), 6e-3, known.frequencies_per_m)[0]
    turned = directional_mtf(HeightOptic.of(camera, height.T), 6e-3, known.frequencies_per_m)[0]
    np.testing.assert_allclose(along_x, known.transfer[0, 0], atol=2e-6)  # float32
    np.testing.assert_allclose(turned[1], along_y, atol=2e-6)


def test_modes_of_a_beam_add_up_before_their_mtf_is_normalised():
    """A beam of several modes whose aperture cuts the higher ones more: each by itself would count alike."""
    design = plate_drawn(64, window=32)
    radius = design.camera.aperture_m / 2
    camera = replace(design.camera, beam=GaussianBeam((radius, radius), m_squared=(1.0, 4.0)))
    doe = HeightOptic.of(camera, design.height_m)
    known = mtf(doe, depths=6e-3, count=20)
    _, along_x, _ = directional_mtf(doe, 6e-3, known.frequencies_per_m)[0]
    np.testing.assert_allclose(along_x, known.transfer[0, 0], atol=2e-6)  # float32


def test_ring_keeps_the_zeroth_order_of_its_closed_form():
    camera = plate_drawn(200).camera
    setup = StartSetup(camera, False, 550e-9)
    for wanted in (0.25, 0.5):
        ridge = balanced_ridge(setup, wanted)
        plate = ring(setup, {"far_energy": wanted, "roughness": 0.0})
        (expected,) = zeroth_orders(setup, ridge)
        assert expected == pytest.approx(wanted, abs=1e-6)
        # Cells round a period of three to whole cells: the duty of 1/2 comes out a few hundredths off.
        assert zeroth_order(HeightOptic.of(camera, plate))[0] == pytest.approx(expected, abs=0.03)


@pytest.mark.slow
def test_plates_stand_beside_each_other(small: Design):
    plates = comparison_plates(small, evaluations=6)
    found = compare_optics(small, plates)
    assert [plate.name for plate in found.plates] == [THIN_LENS, FRESNEL, RANDOM, RING, PROPOSED]
    rows = {row.plate: row for row in found.rows}
    lens = rows[THIN_LENS]
    assert lens.concentration == 1
    assert lens.far_spot > 0.75
    # The design is its start, a ring with a little noise.
    assert rows[RING].far_spot == pytest.approx(rows[PROPOSED].far_spot, abs=0.05)
    assert rows[RANDOM].far_spot < rows[RING].far_spot < lens.far_spot
    assert all(row.throughput_near < 0.94 for row in found.rows)  # both faces take 7 %
    assert all(0 <= row.mtf_far_nyquist <= row.mtf_far_quarter + 0.2 for row in found.rows)
    assert png_bytes(found.plot()).startswith(b"\x89PNG")


def test_what_cannot_be_compared_is_said(small: Design):
    with pytest.raises(InputError, match="needs the design's objectives"):
        comparison_plates(small.bare())
    assert set(comparison_plates(small.bare(), fresnel_m=5e-3)) == {THIN_LENS, FRESNEL, RANDOM, RING}
    with pytest.raises(InputError, match="a depth is needed"):
        compare_optics(replace(small, near_m=()), {})


def test_plates_are_compared_at_the_nearest_and_the_farthest_depth(small: Design):
    """In whichever order a spec lists them."""
    turned = replace(small, near_m=(9e-3, 6e-3, 8e-3), far_m=(math.inf, 0.5))
    found = compare_optics(turned, {})
    assert (found.near_m, found.far_m) == (6e-3, math.inf)


def test_light_of_a_flat_plate_lies_in_the_disc_and_is_even():
    design = plate_drawn(200, 16, relief=0.0)  # the top level everywhere
    found = depth_study(design, Process(design.levels), depths=("inf", 3e-3), draws=1)
    camera = found.camera
    drawn, made = found.of("as drawn"), found.of("draw 0")
    assert [row.depth_m for row in drawn] == [np.inf, 3e-3]
    assert drawn[1].zeroth_order == pytest.approx(1, abs=1e-5)
    faces = camera.lines[0].factor
    # Past a straight rim half a plane's light goes by Fresnel's integrals; the disc reaches a pixel beyond the rim.
    radius, edge = camera.defocus_radius_m(3e-3), camera.aperture_m / 2
    unit = np.sqrt(520e-9 * 3e-3 / 2)
    beyond = np.linspace(camera.pixel_m / radius * edge / unit, 60, 200_001)
    sine, cosine = fresnel(beyond)
    past = np.trapezoid(((0.5 - cosine) ** 2 + (0.5 - sine) ** 2) / 2, beyond) * unit
    assert drawn[1].inside == pytest.approx(faces * (1 - 2 * past / edge), abs=5e-3)
    assert drawn[1].ring_to_disc < 0.05
    assert made[1].inside == pytest.approx(drawn[1].inside, rel=1e-4)
    even = faces * camera.pixel_m**2 / (np.pi * radius**2)
    within = found.radii_m < 0.7 * radius
    areas = found.radii_m[within]
    # Fresnel's rings average out over the disc.
    assert np.average(found.cuts[0, 1, within], weights=areas) == pytest.approx(even, rel=0.05)


@pytest.mark.slow
def test_depths_are_followed_and_drawn(small: Design):
    found = depth_study(small, "contact_aligner", count=4, draws=2)
    assert found.plates == ("as drawn", "draw 0", "draw 1")
    assert found.depths_m[0] == np.inf
    assert found.depths_m[-1] == pytest.approx(6e-3)
    assert len(found.rows) == 12
    # Inverse depths are evenly spaced.
    np.testing.assert_allclose(np.diff([1 / z for z in found.depths_m]), 1 / 6e-3 / 3, rtol=1e-9)
    assert png_bytes(found.plot()).startswith(b"\x89PNG")
    with pytest.raises(InputError, match="at least 1"):
        depth_study(small, draws=0)
