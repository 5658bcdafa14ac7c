import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import make_camera, relative_error, wrapped_map
from fab.errors import InputError
from sim.camera import Colour
from sim.optic import HeightOptic
from sim.propagation.farfield import FarField
from sim.propagation.fresnel import DirectPath
from sim.psf_bank import PsfBank, depths_from, field_from, psf

ONE = make_camera(128, 0.3e-3, 0.54e-3, 1.85e-6, 32)
HEIGHT = wrapped_map(128)


@pytest.mark.slow
def test_axes_are_wavelength_depth_y_x():
    camera = dataclasses.replace(ONE, colours=(Colour("a", (5e-7,), (1.0,)), Colour("b", (6e-7,), (1.0,))))
    calls = []
    bank = psf(HEIGHT, camera, [0.02, 0.5, np.inf], on_psf=lambda: calls.append(1))
    assert bank.energy.shape == (2, 3, 32, 32)
    assert bank.energy.dtype == np.float32
    assert (bank.colours, bank.depths_m, bank.pixel_m) == (("a", "b"), (0.02, 0.5, np.inf), 1.85e-6)
    assert len(calls) == 6
    for c, wavelength in enumerate((5e-7, 6e-7)):
        for d, depth in enumerate(bank.depths_m):
            single = dataclasses.replace(ONE, colours=(Colour("s", (wavelength,), (1.0,)),))
            np.testing.assert_array_equal(bank.energy[c, d], psf(HEIGHT, single, [depth]).energy[0, 0])


@pytest.mark.slow
def test_a_colour_is_the_weighted_sum_of_its_wavelengths():
    waves, weights = (5e-7, 5.5e-7, 6e-7), (0.2, 0.5, 0.3)
    mixed = dataclasses.replace(ONE, colours=(Colour("green", waves, weights),))
    pure = dataclasses.replace(ONE, colours=tuple(Colour(f"{w}", (w,), (1.0,)) for w in waves))
    parts = psf(HEIGHT, pure, [0.1]).energy[:, 0]
    whole = psf(HEIGHT, mixed, [0.1]).energy[0, 0]
    assert relative_error(whole, np.tensordot(weights, parts.astype(np.float64), 1)) < 1e-6  # float32 sums


def test_reflection_is_in_the_energy():
    flat = psf(np.zeros((128, 128)), ONE, [np.inf]).energy[0, 0]
    air = 2 * 0.0338 + 0.0012  # two faces of fused silica send back 6.8-7.0 %
    assert 0.85 < flat.sum() < 1 - air + 0.003


def test_the_field_behind_the_plate():
    field = np.asarray(HeightOptic.of(ONE, HEIGHT).field(ONE.lines[0], 0.05))
    y, x = (ONE.grid.axis_m(a) for a in ("y", "x"))
    path = np.sqrt(y[:, None] ** 2 + x[None, :] ** 2 + 0.05**2) - 0.05
    wanted = np.exp(2j * np.pi * (HEIGHT * ONE.waves_per_metre(589e-9) + path / 589e-9))
    inside = ONE.grid.inside_circle(ONE.aperture_m * 0.98)
    # A micrometre of glass is a wave, so float32 heights cost 1e-6 and `cis` 4e-6.
    assert np.abs(field - wanted)[inside].max() < 1e-5
    assert field[0, 0] == 0


def test_propagations_by_name():
    assert isinstance(HeightOptic.of(ONE).plan(ONE.lines[0], np.inf), FarField)
    fine = HeightOptic.of(make_camera(300, 0.15e-3, 1e-3, 1e-6, 16))
    assert isinstance(fine.plan(fine.lines[0], np.inf, "fresnel"), DirectPath)


@pytest.mark.parametrize("depths", [[], 0.0, [-0.1], [0.1, np.nan]])
def test_depths_are_positive(depths: list[float] | float):
    with pytest.raises(InputError, match="depth"):
        psf(HEIGHT, ONE, depths)


@pytest.mark.parametrize("field", [(0.0, 2.0), (0.0, np.nan), (0.1,), ("0.1", "0.2"), "12", 0.1])
def test_field_angles_are_two_numbers_within_what_a_lens_says(field: object):
    with pytest.raises(InputError, match=r"field_rad: must be two angles \(y, x\) within 1.047 radians"):
        field_from(field)
    assert field_from((0.0, np.pi / 3)) == (0.0, np.pi / 3)


def test_field_angles_of_psfs_are_checked_and_kept_as_floats(recwarn: pytest.WarningsRecorder):
    with pytest.raises(InputError, match="field_rad"):
        psf(HEIGHT, ONE, field_rad=(0.0, 2.0))
    bank = psf(HEIGHT, ONE, field_rad=(0.0, np.float64(0.1)))
    assert [type(angle) for angle in (*bank.field_rad, *field_from([0, np.float32(1)]))] == [float] * 4
    assert not [one for one in recwarn if "static" in str(one.message)]


def test_a_map_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="must have the grid's shape"):
        psf(np.zeros((127, 128)), ONE, [np.inf])


def test_an_oblique_field_is_the_same_lens_seen_under_an_angle():
    """On a star, obliquity only lengthens the way through the glass; a flat plate does not notice."""
    flat = np.zeros((128, 128))
    on, off = (psf(flat, ONE, [np.inf], field_rad=f).energy for f in ((0.0, 0.0), (0.2, 0.1)))
    np.testing.assert_array_equal(on, off)
    ruled = psf(HEIGHT, ONE, [np.inf], field_rad=(0.2, 0.0)).energy
    assert relative_error(ruled, psf(HEIGHT, ONE, [np.inf]).energy.astype(np.float64)) > 0.01


def test_psfs_of_a_bank_keep_its_field():
    field = (0.0, 0.1)
    bank = psf(HEIGHT, ONE, [0.02, np.inf], field_rad=field)
    again = psf(bank, depths=np.inf)
    assert again.field_rad == field
    np.testing.assert_array_equal(again.energy[:, 0], bank.energy[:, 1])
    with pytest.raises(ValueError, match="`field_rad` must be that of the bank"):
        psf(bank, field_rad=(0.0, 0.2))
    assert psf(dataclasses.replace(bank, camera=None, sines=True), depths=0.02).sines


def test_an_image_that_folds_over_off_the_axis_is_refused():
    """A barrel that ends at 1.2 times the angle of this chief ray's tangent."""
    lens = dataclasses.replace(ONE, mapping="tangent", distortion=(-0.4, 0.0))
    psf(HEIGHT, lens, field_rad=(0.0, 0.3))
    with pytest.raises(InputError, match="distortion: the image must not fold over"):
        psf(HEIGHT, lens, field_rad=(0.0, 0.8))


def test_a_colour_and_pixels_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="weights: must be one for each wavelength, together 1"):
        Colour("a", (5e-7, 6e-7), (1.0, 1.0))
    with pytest.raises(InputError, match="fill: must lie above 0, up to 1"):
        dataclasses.replace(ONE, fill=2.0)


@pytest.mark.parametrize(
    ("height", "message"),
    [
        (np.where(np.arange(128) == 3, np.nan, HEIGHT), "height_m: every height must be a finite number"),
        (1e9 * HEIGHT, "height_m: heights are metres, at most 1 mm"),
        (np.arange(128**2).reshape(128, 128), "height_m: heights are metres, at most 1 mm"),  # levels
        (HEIGHT + 0.1j * HEIGHT, "height_m: must be real numbers"),
        (HEIGHT > 0, "height_m: must be real numbers"),
        (np.ma.masked_less(HEIGHT, 1e-7), "height_m: every pixel must have a value"),
    ],
)
def test_heights_that_are_none_are_refused(height: np.ndarray, message: str):
    """They gave light: NaN everywhere, that of other heights, or that of what lay under a mask."""
    with pytest.raises(InputError) as error:
        psf(height, ONE)
    assert str(error.value).startswith(message)


def test_depths_may_be_arrays_of_jax_but_not_traced():
    assert depths_from(jnp.array([0.5, np.inf])) == depths_from(np.array([0.5, np.inf])) == (0.5, np.inf)
    assert depths_from(jnp.float32(0.5)) == (0.5,)
    with pytest.raises(InputError, match="depth: must be metres"):
        depths_from(np.ones((2, 2)))
    with pytest.raises(InputError, match="depths: must be known before a program is compiled"):
        jax.grad(lambda depth: depths_from(depth)[0])(0.1)


def test_a_bank_has_one_entry_for_each_colour_and_depth():
    """Beside measured PSFs, of which a depth too few would take those of another."""
    energy = np.ones((3, 2, 5, 5), np.float32)
    bank = PsfBank(energy, ("R", "G", "B"), (0.05, np.inf), 3e-6)
    with pytest.raises(InputError, match=r"energy: must be \[colour, depth, y, x\] for 3 colours and 1 depths"):
        PsfBank(energy, bank.colours, (0.05,), 3e-6)
    with pytest.raises(InputError, match=r"energy: must be .* for 2 colours and 2 depths"):
        PsfBank(energy, ("R", "G"), bank.depths_m, 3e-6)
    with pytest.raises(InputError, match="depths_m: must be positive"):
        PsfBank(energy, bank.colours, (0.0, np.inf), 3e-6)
    with pytest.raises(InputError, match="depth: must lie within the depths of the PSF bank"):
        bank.at(0.0)
    assert jax.tree.map(np.sum, bank).energy == 150  # what jax makes of one is not looked at
