"""The error budget of PSFs."""

from dataclasses import replace

import numpy as np
import pytest

from doedesign.design.accuracy import Accuracy, accuracies, in_words, relative_difference, rim_error
from fab.aperture import RectangularAperture
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.optic import HeightOptic
from sim.propagation.farfield import plan_far_field
from sim.psf_bank import psf
from sim.rigorous.edge_optic import with_edges

GREEN = 552e-9


def camera(cells: int, **given: object) -> Camera:
    one = Camera(
        Grid((cells, cells), 2e-6), cells * 2e-6, "fused_silica", (Colour("g", (GREEN,), (1.0,)),), 1e-3, 2e-6, 64
    )
    return replace(one, **given)  # type: ignore[arg-type]


def levels(cells: int) -> np.ndarray:
    return 75e-9 * np.random.default_rng(0).integers(0, 16, (cells, cells))


def test_the_rim_is_off_by_as_much_as_on_a_raster():
    """Sixteen samples per cell and axis of a random plate, with a true circle and with grey cells, at other directions.

    Either is a mean over a few hundred speckles, good to a tenth.
    """
    lens, height = camera(48), levels(48)
    reach = lens.window * lens.pixel_m / 2 / lens.focal_length_m / GREEN
    waves = np.random.default_rng(5).uniform(-reach, reach, (2, 30))
    axis = (np.arange(48 * 16) - (48 * 16 - 1) / 2) * 2e-6 / 16
    kernels = [np.exp(-2j * np.pi * axis[:, None] * seen) for seen in waves]
    light = np.kron(np.exp(2j * np.pi * lens.waves_per_metre(GREEN) * height), np.ones((16, 16)))
    grey = np.kron(circle_coverage(lens.grid, lens.aperture_m).astype(float), np.ones((16, 16)))
    circle = np.hypot(axis[:, None], axis) <= lens.aperture_m / 2
    seen = [np.abs(kernels[0].T @ (light * open_) @ kernels[1]) ** 2 for open_ in (grey, circle)]
    expected = relative_difference(*seen)
    assert rim_error(HeightOptic.of(lens, height), lens.lines[0], np.inf) == pytest.approx(expected, rel=0.25)


def test_the_rim_of_a_random_plate_counts_less_the_larger_it_is():
    small, large = (
        rim_error(HeightOptic.of(camera(cells), levels(cells)), camera(cells).lines[0], 0.05) for cells in (32, 128)
    )
    assert 0.002 < small < 0.1
    # The rim's share of the light falls as one over the cells, its amplitude as the root of that.
    assert large == pytest.approx(small / 2, rel=0.3)


@pytest.mark.slow
def test_every_entry_is_what_it_says():
    lens, depths = camera(64), (0.01, np.inf)
    optic = HeightOptic.of(lens, levels(64))
    bank = psf(optic, depths=(0.01, 1.0, np.inf))
    found = accuracies(optic, bank, depths)
    assert [one.depth_m for one in found] == [0.01, np.inf]
    walls = psf(with_edges(levels(64), lens, depths_m=depths), depths=depths).energy[0]
    for one, image, depth in zip(found, walls, depths, strict=True):
        thin = np.asarray(psf(optic, depths=depth).energy[0, 0])
        assert one.numerics == plan_far_field(lens, GREEN, depth_m=depth).expected_error
        assert one.walls == pytest.approx(relative_difference(thin, image), rel=1e-3)
        assert one.walls is not None
        assert one.walls > 0.02
        bent = psf(optic, replace(lens, mapping="tangent"), depth).energy[0, 0]
        assert one.lens_mapping == pytest.approx(relative_difference(thin, np.asarray(bent)), rel=1e-3)
        assert one.rim == rim_error(optic, lens.lines[0], depth)
    lit = with_edges(levels(64), replace(lens, light="edges"), depths_m=depths)
    assert all(one.walls is None for one in accuracies(lit, psf(lit, depths=depths), depths))


def test_words_name_the_largest():
    found = [Accuracy("g", 0.05, 0.002, 0.0012, 0.043, 0.07), Accuracy("g", np.inf, 0.001, 0.0005, 0.021, 0.08)]
    head = "PSFs at 552 nm may be off by (relative RMS): numerics 0.2 %, square cells on"
    said, lens = f"{head} the round rim 0.12 %", "lens mapping (sine, not tangent) 8 %"
    assert in_words(found, camera(8)) == f"{said}, light of walls left out 4.3 %, {lens}"
    assert in_words([one._replace(walls=None) for one in found], camera(8)) == f"{said}, {lens}"
    slit = replace(camera(8), aperture=RectangularAperture((4e-6, 8e-6)), mapping="tangent")
    other = "lens mapping (tangent, not sine) 8 %"
    assert in_words(found, slit) == f"{head} the rim 0.12 %, light of walls left out 4.3 %, {other}"


def test_small_and_large_errors_are_told_without_powers_of_ten():
    said = in_words([Accuracy("g", np.inf, 0.0018, 6.1e-7, 0.011, 1.28)], camera(8))
    assert "numerics 0.18 %, square cells on the round rim below 0.01 %, light of walls left out 1.1 %" in said
    assert said.endswith("lens mapping (sine, not tangent) 130 %")
