"""Objectives against PSFs whose value is known."""

import inspect
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from doedesign.build import camera_from_spec
from doedesign.design.metrics import _spot_energies, drawn_patterns
from doedesign.design.objectives import (
    BUILT_IN,
    PsfSet,
    disc_radii_m,
    equal_colours,
    far_spot,
    filtered_error,
    handcrafted,
    import_objectives,
    near_spread,
    ring_to_disc,
    source_digests,
    spot_energy,
    spot_weights,
    terms_from_spec,
    window_loss,
    window_share,
)
from doedesign.design.patterns import target_image
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from doedesign.spec.values import NEAR_OBJECTIVES, OBJECTIVES
from fab.errors import InputError
from fab.files import sha256_file
from fab.grid import Grid
from fab.pictures import write_pixels
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.metrics import participation
from sim.psf_bank import PsfBank, psf

EXAMPLES = Path(__file__).parents[2] / "examples"
CAMERA = Camera(Grid((64, 64), 10e-6), 0.64e-3, "fused_silica", (Colour("green", (550e-9,), (1.0,)),), 5e-3, 4e-6, 64)
DISC, NO_DISC = jnp.full(1, 40e-6), jnp.zeros(0)  # ten pixels; of a scene without near depths


def view(near: np.ndarray, far: np.ndarray, lens: float = 1.0) -> PsfSet:
    return PsfSet(jnp.asarray(near)[None, None], jnp.asarray(far)[None, None], jnp.full((1, 1), lens), DISC, CAMERA)


def even() -> np.ndarray:
    return np.full((64, 64), 1 / 64**2, np.float32)


def point() -> np.ndarray:
    image = np.zeros((64, 64), np.float32)
    image[31:33, 31:33] = 0.25
    return image


def test_far_spot_is_the_light_that_misses() -> None:
    assert float(far_spot(view(even(), point()))) == pytest.approx(0.0, abs=1e-6)
    assert float(far_spot(view(even(), 0.3 * point()))) == pytest.approx(0.7, abs=1e-6)


def test_near_spread_is_one_for_the_plain_lens() -> None:
    bank = psf(np.zeros((64, 64)), CAMERA, [0.05])
    lens = float(participation(jnp.asarray(bank.energy[0, 0])))
    assert float(near_spread(view(bank.energy[0, 0], point(), lens))) == pytest.approx(1.0, rel=1e-6)
    assert float(near_spread(view(even(), point(), lens))) == pytest.approx(1 / 64**2 / lens, rel=1e-5)


def test_coherent_light_obeys_its_bound() -> None:
    # A fraction s of the field passes undiffracted; the near PSF keeps s times the lens's disc, hence s² of its square.
    bank = psf(np.zeros((64, 64)), CAMERA, [0.05]).energy[0, 0]
    lens = float(participation(jnp.asarray(bank)))
    s = 0.4
    assert float(near_spread(view(s * bank, point(), lens))) == pytest.approx(s**2, rel=1e-5)


def test_window_loss_counts_what_is_not_there() -> None:
    assert float(window_loss(view(0.5 * even(), point()))) == pytest.approx(0.25, abs=1e-6)


def of_spots(*spots: float, window: float = 1.0) -> PsfSet:
    """One PSF per colour with this light in the spot, and the rest of what falls into the window in its corner."""
    camera = replace(CAMERA, colours=tuple(Colour(str(i), (550e-9,), (1.0,)) for i in range(len(spots))))
    far = np.stack([spot * point() for spot in spots])[:, None]
    far[:, 0, 0, 0] += window - np.array(spots, np.float32)
    return PsfSet(jnp.asarray(far), jnp.asarray(far), jnp.ones((len(spots), 1)), DISC, camera)


def test_a_stated_spot_and_equal_colours_by_hand() -> None:
    spots = of_spots(0.2, 0.3, 0.4)
    assert float(spot_energy(spots, energy=0.3)) == pytest.approx(0.02 / 3, rel=1e-4)
    assert float(spot_energy(replace(spots, worst=True), energy=0.25)) == pytest.approx(0.15**2, rel=1e-4)
    assert float(equal_colours(spots)) == pytest.approx(0.02 / 3 / 0.3**2, rel=1e-4)
    assert float(equal_colours(of_spots(0.3, 0.3))) == pytest.approx(0.0, abs=1e-9)


def test_the_window_costs_nothing_where_it_holds_enough() -> None:
    assert float(window_share(of_spots(0.3, window=0.7), least=0.8)) == pytest.approx(0.01, rel=1e-4)
    assert float(window_share(of_spots(0.3, window=0.85), least=0.8)) == 0.0


def test_ring_to_disc_costs_nothing_where_it_is_held() -> None:
    """An even window: pi 10^2 pixels of 64^2 in the disc, less by 1e-3, for squares at its edge are cut by a line."""
    disc = np.pi * 100 / 64**2
    ratio = (1 - disc) / disc
    psfs = view(even(), point())
    assert float(ring_to_disc(psfs, least=ratio + 2)) == pytest.approx(4.0, rel=0.02)
    assert float(ring_to_disc(psfs, least=0.9 * ratio)) == 0.0
    assert float(ring_to_disc(view(point(), point()), least=1.5)) == pytest.approx(1.5**2, rel=1e-5)
    for least in (0, -1.0, True):
        with pytest.raises(InputError, match="ring_to_disc: least: must be a ratio above 0"):
            ring_to_disc(psfs, least=least)


def test_ring_to_disc_is_that_of_the_metrics() -> None:
    """Of every colour and depth; the metric cuts the edge's squares into strips."""
    (term,), psfs, near, _ = three_colours("{ name = 'ring_to_disc', options = { least = 30.0 } }")
    pixel_m, side = psfs.camera.pixel_m, psfs.camera.window
    lacks = []
    for depth, radius_m in enumerate(np.asarray(psfs.disc_radius_m)):
        assert radius_m == pytest.approx(psfs.camera.defocus_radius_m((5e-3, 10e-3)[depth]) + pixel_m, rel=1e-6)
        disc = (near[:, depth] * circle_coverage(Grid((side, side), pixel_m), 2 * float(radius_m))).sum((1, 2))
        lacks.append(np.maximum(30 - (near[:, depth].sum((1, 2)) - disc) / disc, 0) ** 2)
    assert float(term.value(psfs)) == pytest.approx(np.mean(lacks), rel=1e-3)


@pytest.mark.parametrize("window", [64, 65])
def test_the_disc_of_ring_to_disc_lies_on_the_axis(window: int) -> None:
    """Of an even window between the four middle pixels: light on one side counts as that on the other."""
    camera = replace(CAMERA, window=window)
    disc = circle_coverage(Grid((window, window), camera.pixel_m), 2 * 10 * camera.pixel_m)
    weights = np.random.default_rng(0).uniform(0.5, 1, disc.shape)
    light = weights * disc + 0.1 * (1 - disc)
    found = []
    for way in (light, light[::-1], light[:, ::-1]):
        near = jnp.asarray(way / way.sum(), jnp.float32)[None, None]
        found.append(float(ring_to_disc(PsfSet(near, near[:, :0], jnp.ones((1, 1)), DISC, camera), least=30.0)))
    # Sums of single precision.
    assert found[1:] == pytest.approx([found[0]] * 2, rel=1e-5)
    ring = light.sum() - (light * disc).sum()
    # Squares at the edge are cut by a line here and into strips there.
    assert found[0] == pytest.approx((30.0 - ring / (light * disc).sum()) ** 2, rel=1e-3)


@pytest.mark.parametrize("share", [-0.1, 1.5, True])
def test_shares_are_shares(share: Any) -> None:
    for call in (lambda: spot_energy(of_spots(0.3), energy=share), lambda: window_share(of_spots(0.3), least=share)):
        with pytest.raises(InputError, match="must be a share of the light from 0 to 1"):
            call()


def test_handcrafted_is_zero_at_its_targets() -> None:
    spots = spot_weights(CAMERA)[0]
    assert float(handcrafted(view(even(), spots / spots.sum()))) == pytest.approx(0.0, abs=1e-5)
    assert float(handcrafted(view(point(), even()))) > 1.0


def test_handcrafted_off_its_targets_by_hand() -> None:
    """Light scaled by a is (1 - a)^2 of its target's square away, in every colour; a point is 4 of N^2 pixels."""
    colours = tuple(Colour(name, (wave,), (1.0,)) for name, wave in (("blue", 450e-9), ("red", 650e-9)))
    camera = replace(CAMERA, colours=colours, focal_length_m=20e-3)
    spots = spot_weights(camera)
    assert spots[0].sum() < 0.7 * spots[1].sum()
    targets = spots / spots.sum(axis=(1, 2), keepdims=True)
    far = np.stack([0.5 * targets[0], 0.8 * targets[1]])[:, None]
    near = np.broadcast_to(point(), (2, 1, 64, 64))
    psfs = PsfSet(jnp.asarray(near), jnp.asarray(far), jnp.ones((2, 1)), DISC, camera)
    missed, spread = (0.5**2 + 0.2**2) / 2, np.log(1 + (64**2 / 4 - 1))
    assert float(handcrafted(psfs)) == pytest.approx(missed + spread, rel=1e-5)
    assert float(handcrafted(psfs, near_weight=3.0)) == pytest.approx(missed + 3 * spread, rel=1e-5)
    assert float(handcrafted(view(1.5 * even(), targets[0]))) > np.log(1.25)


def test_target_pattern_off_its_target_by_hand() -> None:
    """Light scaled by a is (1 - a)^2 away, and light on two other pixels than the target's two is 2 away."""
    target = np.zeros((64, 64), np.float32)
    target[3, 4:6] = 0.5
    other = np.roll(target, 9, axis=0)
    for image, wanted in ((0.4 * target, 0.36), (1.5 * target, 0.25), (0 * target, 1.0), (other, 2.0)):
        assert float(BUILT_IN["target_pattern"](view(even(), image), target=target)) == pytest.approx(wanted, rel=1e-6)
    both = PsfSet(jnp.zeros((1, 0, 64, 64)), jnp.stack([0.4 * target, other])[None], jnp.zeros((1, 0)), NO_DISC, CAMERA)
    assert float(BUILT_IN["target_pattern"](both, target=target)) == pytest.approx((0.36 + 2) / 2, rel=1e-6)


def test_spots_are_airy_patterns_at_the_points_of_a_grid() -> None:
    """Against (2 J1(v) / v)^2 with v = pi D r / (lambda f), columns along x."""
    options = {"pattern": "spots", "count": (3, 2), "spacing": "60 um"}
    found = target_image(CAMERA, options, None, "objective")
    axis = (np.arange(64) - 31.5) * 4e-6
    wanted = np.zeros((64, 64))
    for x in (-60e-6, 0.0, 60e-6):
        for y in (-30e-6, 30e-6):
            v = np.pi * 0.64e-3 * np.hypot(axis[:, None] - y, axis - x) / (550e-9 * 5e-3)
            wanted += (2 * special.j1(v) / v) ** 2
    # The zero is taken at 1.2197 lambda f / D and 3.8317, both to five digits.
    np.testing.assert_allclose(found, wanted / wanted.sum(), rtol=1e-3, atol=1e-7)
    single = target_image(replace(CAMERA, window=65), options | {"count": (1, 1)}, None, "objective")
    assert single[32, 32] == single.max()
    with pytest.raises(InputError, match=r"window, 0\.252 mm, but got 0\.36 mm"):
        target_image(CAMERA, options | {"count": (7, 2)}, None, "objective")
    # Those in the middle of the outermost pixels are still within.
    assert target_image(CAMERA, options | {"count": (2, 1), "spacing": "252 um"}, None, "objective").sum() > 0


@pytest.mark.parametrize("count", [None, [3, 3], (3,), (3, 3, 3), (0, 3), (3, -1), (3, 2.0), (True, 3)])
def test_a_grid_of_spots_needs_two_numbers(count: Any) -> None:
    options = {"pattern": "spots", "count": count, "spacing": "60 um"}
    with pytest.raises(InputError, match="count: must be two positive whole numbers"):
        target_image(CAMERA, options, None, "objective")


def test_squares_and_discs_are_as_large_as_they_say() -> None:
    axis = np.abs((np.arange(64) - 31.5) * 4e-6)
    square = target_image(CAMERA, {"pattern": "square", "width": "50 um"}, None, "objective")
    # Pixels of 4 um about the middle: six wholly, and a quarter of the one beyond, on either side.
    line = np.where(axis < 23e-6, 1.0, np.where(axis < 27e-6, 0.25, 0.0)) / 12.5
    np.testing.assert_allclose(square, np.outer(line, line), atol=1e-8)
    disc = target_image(CAMERA, {"pattern": "disc", "diameter": "160 um"}, None, "objective")
    r = np.hypot(axis[:, None], axis)
    # Wholly within by half a pixel's diagonal, every pixel holds its share of pi r^2; without, nothing.
    np.testing.assert_allclose(disc[r < 77e-6], 16 / (np.pi * 80**2), rtol=2e-3)
    assert not disc[r > 83e-6].any()


def test_patterns_are_moved_by_their_offset() -> None:
    """By whole pixels, nothing but the place changes; x before y, as everywhere in a spec."""
    for options in (
        {"pattern": "square", "width": "50 um"},
        {"pattern": "disc", "diameter": "60 um"},
        {"pattern": "spots", "count": (2, 1), "spacing": "40 um"},
    ):
        centred = target_image(CAMERA, options, None, "objective")
        moved = target_image(CAMERA, options | {"offset": ("40 um", "-20 um")}, None, "objective")
        # Far rings of spots that fall over the window's edge are a few thousandths of their peak.
        np.testing.assert_allclose(moved[5:40, 15:], centred[10:45, 5:-10], atol=3e-3 * centred.max())
    for offset in ("40 um", ("40 um",), ("40", "3 um"), (1, 2)):
        with pytest.raises(InputError, match=r"offset: must be two lengths, \[x, y\]"):
            target_image(CAMERA, {"pattern": "disc", "diameter": "60 um", "offset": offset}, None, "objective")


@pytest.mark.parametrize("width", ["0 um", "-3 um", "3", "wide"])
def test_a_length_that_is_none(width: str) -> None:
    with pytest.raises(InputError, match='For example width = "250 um"') as caught:
        target_image(CAMERA, {"pattern": "square", "width": width}, None, "objective[0] target_pattern")
    assert "objective[0] target_pattern: width: must be" in str(caught.value)


def test_a_picture_keeps_its_proportions(tmp_path: Path) -> None:
    """Four times as wide as tall: dark above and below; a square in it stays one."""
    wide = np.zeros((16, 64), np.uint8)
    wide[4:12, 28:36] = 255
    write_pixels(tmp_path / "wide.png", wide)
    found = target_image(CAMERA, {"image": "wide.png"}, tmp_path / "wide.png", "objective")
    rows, columns = (np.flatnonzero(found.sum(axis) > 1e-6) for axis in (1, 0))
    assert rows.tolist() == columns.tolist() == [*range(28, 36)]
    with pytest.raises(InputError, match="an image has no other options, but got width"):
        target_image(CAMERA, {"image": "wide.png", "width": "1 mm"}, tmp_path / "wide.png", "objective")


def test_light_between_two_spots_counts_once() -> None:
    """Of a pattern whose discs overlap: all light is on target, once."""
    options = {"pattern": "spots", "count": (3, 3), "spacing": "12 um"}
    light = target_image(CAMERA, options, None, "objective")
    assert 0.9 < _spot_energies(CAMERA, light, options).sum() < 1.0001


def test_pictures_of_other_kinds_hold_the_same_light(tmp_path: Path) -> None:
    """Alpha is left out, grey with one channel is grey, and colours count by their luminance."""
    grey = np.zeros((64, 64), np.uint8)
    grey[:, :32] = 255
    cases = {
        "grey": grey,
        "alpha": np.stack([grey, grey, grey, np.full_like(grey, 255)], axis=-1),
        "grey and alpha": np.stack([grey, np.full_like(grey, 255)], axis=-1),
        "unlike": np.stack([grey, 0 * grey, grey[:, ::-1]], axis=-1),
    }
    for name, values in cases.items():
        write_pixels(tmp_path / f"{name}.png", values)
        found = target_image(CAMERA, {}, tmp_path / f"{name}.png", "objective")
        left = found[:, :32].sum(dtype=np.float64)
        # Red on the left and blue on the right, by the weights of Rec. 709.
        assert left == pytest.approx(0.2125 / (0.2125 + 0.0721) if name == "unlike" else 1.0, abs=1e-4)


def test_target_pattern_is_zero_when_all_light_is_on_target() -> None:
    spec = load_spec(EXAMPLES / "beam_splitter.toml")
    camera = camera_from_spec(spec)
    (term,) = terms_from_spec(spec, camera, {})
    target = target_image(camera, dict(spec.objectives[0].options), None, "objective")
    assert target.sum() == pytest.approx(1.0, abs=1e-5)
    images = PsfSet(
        jnp.zeros((1, 0, *target.shape)), jnp.asarray(target)[None, None], jnp.zeros((1, 0)), NO_DISC, camera
    )
    assert float(term.value(images)) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_array_equal(np.asarray(term.target), target)
    assert terms_from_spec(load_spec(EXAMPLES / "quick.toml"), CAMERA, {})[0].target is None


@pytest.mark.parametrize(
    "options",
    [{"pattern": "spots", "count": [3, 3], "spacing": "60 um"}, {"pattern": "square", "width": "50 um"}],
)
def test_light_on_a_pattern_leaves_out_what_the_faces_reflect(options: dict[str, Any]) -> None:
    """As for spots, areas and foci: glass that reflects more leaves the number as it is."""
    wanted = ["sensor.window=128", f"objective.0.options={json.dumps(options).replace(':', '=')}"]
    found, passed = [], []
    for material in ("fused_silica", "su8"):
        spec = load_spec(EXAMPLES / "beam_splitter.toml", [*wanted, f"doe.material={material}"])
        camera = camera_from_spec(spec)
        terms = terms_from_spec(spec, camera, {})
        target = terms[0].target
        assert target is not None
        energy = camera.lines[0].factor * target[None, None]  # all that passes is as the target has it
        bank = PsfBank(energy, (camera.colours[0].name,), spec.scene.far_m, camera.pixel_m, camera=camera)
        (drawn,) = drawn_patterns(spec, camera, bank, terms)
        found.append(drawn.efficiency)
        passed.append(camera.lines[0].factor)
    assert passed[0] > passed[1] + 0.03
    # The target's own tails and rim lie beside it. Sums of single precision.
    assert 0.5 < found[0] < 1
    assert found[1] == pytest.approx(found[0], rel=1e-5)


def test_a_picture_is_a_target_with_its_top_at_the_highest_y(tmp_path: Path) -> None:
    display = np.zeros((128, 128), np.uint8)
    display[96:, :64] = 188  # top left; half of the linear light of 255 in sRGB
    write_pixels(tmp_path / "grey.png", display)
    write_pixels(tmp_path / "colour.tif", np.repeat(display[..., None].astype(np.uint16) * 257, 3, axis=2))
    for name in ("grey.png", "colour.tif"):
        target = target_image(CAMERA, {}, tmp_path / name, "objective")
        assert target.sum() == pytest.approx(1.0, abs=1e-5)
        # Anti-aliasing blurs by about a pixel of the target; energies are shares of the total, 16 x 32 pixels.
        np.testing.assert_allclose(target[52:, :28], 1 / (16 * 32), rtol=0.01)
        assert target[:44].max() < 1e-6
    write_pixels(tmp_path / "black.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match="some light"):
        target_image(CAMERA, {}, tmp_path / "black.png", "objective")


def test_the_objectives_are_those_of_the_spec() -> None:
    """And each says by itself whether it looks at near depths, as the spec's table does."""
    assert BUILT_IN.keys() == set(OBJECTIVES)
    given = {
        "target_pattern": {"target": even()},
        "spot_energy": {"energy": 0.3},
        "window_share": {"least": 0.5},
        "ring_to_disc": {"least": 1.5},
    }
    for name in OBJECTIVES:
        without = PsfSet(
            jnp.zeros((1, 0, 64, 64)), jnp.asarray(point())[None, None], jnp.zeros((1, 0)), NO_DISC, CAMERA
        )
        value = float(BUILT_IN[name](without, **given.get(name, {})))
        assert np.isnan(value) == (name in NEAR_OBJECTIVES), name


def test_one_filter_for_all_depths_wants_psfs_that_are_alike() -> None:
    """A point and a blur of 4 pixels, alone and together; light that is lost is lost in the picture's mean, too."""
    blur = np.zeros((64, 64), np.float32)
    blur[30:34, 30:34] = 1 / 16

    def both(*far: np.ndarray) -> PsfSet:
        return PsfSet(jnp.zeros((1, 0, 64, 64)), jnp.asarray(np.stack(far))[None], jnp.zeros((1, 0)), NO_DISC, CAMERA)

    alike = [float(filtered_error(both(one, one))) for one in (point(), blur)]
    apart, known = (float(filtered_error(both(point(), blur), known=way)) for way in (False, True))
    assert alike[0] < alike[1] < apart
    assert known == pytest.approx(np.mean(alike), rel=1e-4)
    # The worst of both, under the filter that is best for their mean.
    assert float(filtered_error(replace(both(point(), blur), worst=True))) > apart
    # More noise, or less contrast, leaves more.
    assert float(filtered_error(both(point(), point()), noise=0.02)) == pytest.approx(
        float(filtered_error(both(point(), point()), contrast=0.125)), rel=1e-4
    )
    for options in ({"noise": 0.0}, {"contrast": -0.1}, {"noise": True}):
        with pytest.raises(InputError, match="must be above 0"):
            filtered_error(both(point()), **options)  # pyright: ignore


def test_an_objective_of_all_depths_has_them_in_every_step() -> None:
    """Its spec says so by itself."""
    spec = load_spec(EXAMPLES / "wide_aperture.toml", ["objective=[{ name = 'filtered_error' }]"])
    assert spec.objectives[0].compares
    assert not load_spec(EXAMPLES / "quick.toml").objectives[0].compares


THREE = [
    "optics.wavelengths=['656 nm', '589 nm', '486 nm']",
    "scene.near=['5 mm', '10 mm']",
    "scene.far=['1 m', 'inf']",
]


def three_colours(*objectives: str) -> tuple[tuple[Any, ...], PsfSet, np.ndarray, np.ndarray]:
    """Terms of a spec of three colours and two depths on either side, and PSFs that hold random light."""
    spec = load_spec(
        EXAMPLES / "quick.toml", [*THREE, "optimize.colours=together", f"objective=[{', '.join(objectives)}]"]
    )
    camera, rng = camera_from_spec(spec), np.random.default_rng(3)
    near, far = rng.uniform(0, 1, (2, 3, 2, camera.window, camera.window)).astype(np.float32) / camera.window**2
    disc_radius_m = jnp.asarray(disc_radii_m(camera, spec.scene.near_m))
    psfs = PsfSet(jnp.asarray(near), jnp.asarray(far), jnp.full((3, 2), 1e-6), disc_radius_m, camera)
    return terms_from_spec(spec, camera, {}), psfs, near, far


def test_terms_of_some_colours_and_depths_and_of_the_worst_of_them() -> None:
    """Each against the sums over light that it should look at."""
    terms, psfs, near, far = three_colours(
        "{ name = 'window_loss', over = 'worst' }",
        "{ name = 'window_loss', colours = ['486nm'] }",
        "{ name = 'window_loss', depths = ['10 mm', 'inf'], over = 'worst' }",
        "{ name = 'near_spread', colours = ['656nm', '486nm'], depths = ['10 mm'] }",
        "{ name = 'near_spread', over = 'worst' }",
        "{ name = 'far_spot', depths = ['1 m'], over = 'worst' }",
        "{ name = 'far_spot', colours = ['589nm'] }",
    )
    light = np.concatenate([near, far], 1, dtype=np.float64).sum((2, 3))
    squares = (near.astype(np.float64) ** 2).sum((2, 3)) / 1e-6
    spots = np.einsum("wfyx,wyx->wf", far.astype(np.float64), spot_weights(psfs.camera))
    wanted = [
        1 - light.min(),
        1 - light[2].mean(),
        1 - light[:, [1, 3]].min(),
        squares[[0, 2], 1].mean(),
        squares.max(),
        1 - spots[:, 0].min(),
        1 - spots[1].mean(),
    ]
    for term, value in zip(terms, wanted, strict=True):
        assert float(term.value(psfs)) == pytest.approx(value, rel=1e-5), term.name


@pytest.mark.parametrize(
    ("objective", "words"),
    [
        ("{ name = 'far_spot', colours = ['green'] }", r"objective\[0\].colours: must be colour channels of the spec"),
        ("{ name = 'far_spot', depths = ['5 mm'] }", 'depths that "far_spot" looks at in this scene are: 1 m, inf'),
        ("{ name = 'near_spread', depths = ['7 mm'] }", "looks at in this scene are: 5 mm, 10 mm, but got 7 mm"),
        ("{ name = 'handcrafted', depths = ['5 mm'] }", '"handcrafted" needs a far depth'),
        ("{ name = 'far_spot', over = 'best' }", r"objective\[0\].over"),
        ("{ name = 'far_spot', depths = ['1'] }", r"objective\[0\].depths\[0\]"),
    ],
)
def test_colours_and_depths_that_are_not_there(objective: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        three_colours(objective)


def test_users_objective(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("users_objectives")
    module.dark_centre = lambda view, *, power=1.0: jnp.mean(view.near) ** power  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "users_objectives", module)
    overrides = ["objective.0.name=users_objectives:dark_centre", "objective.0.options.power=2.0"]
    spec = load_spec(EXAMPLES / "quick.toml", overrides)
    with pytest.raises(InputError, match="a spec runs no code by itself"):
        terms_from_spec(spec, CAMERA, {})
    term = terms_from_spec(spec, CAMERA, {}, import_objectives(spec))[0]
    assert float(term.value(view(even(), point()))) == pytest.approx(1 / 64**4, rel=1e-5)
    # An option of that name is no picture.
    module.near_to = lambda view, *, target: jnp.mean(view.near) - target  # type: ignore[attr-defined]
    spec = load_spec(
        EXAMPLES / "quick.toml", ["objective.0={ name = 'users_objectives:near_to', options.target = 0.3 }"]
    )
    assert terms_from_spec(spec, CAMERA, {}, import_objectives(spec))[0].target is None


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["objective.0.name=no_such_module:f"], "importable module:function"),
        (["objective.0.name=math:no_such_function"], "importable module:function"),
        (["objective.0.name=math:pi"], "must be a function"),
        (
            ["objective.0.name=builtins:max"],
            "builtins:max: must be a function that tells its arguments",
        ),
        (["objective.0.options.radius=3"], "must be options of far_spot"),
        (["objective.0.name=target_pattern", "objective.0.options.pattern=hexagon"], "must be one of spots"),
        (["objective.0.name=target_pattern", "objective.0.options.pattern=square"], "must be a length"),
        (["objective.0.name=target_pattern", "objective.0.options={pattern='disc', bogus=1}"], "are: diameter"),
    ],
)
def test_wrong_objectives_are_named(overrides: list[str], words: str) -> None:
    spec = load_spec(EXAMPLES / "quick.toml", overrides)
    with pytest.raises(InputError, match=words):
        terms_from_spec(spec, CAMERA, {}, import_objectives(spec))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def dark(psfs:", r"module of a user's objective must run, but got \"broken_own:dark\" \(SyntaxError"),
        ("dark = bright", r"\(NameError: name 'bright' is not defined\). Correct broken_own."),
        ("def dark(psfs):\n    return psfs.far", r"broken_own:dark: must return one real number, .* \(1, 1, 64, 64\)"),
        ("def dark(psfs):\n    return None", "broken_own:dark: must return one real number, but got NoneType"),
        ("def dark(psfs):\n    return 1j * psfs.far.max()", "one real number, but got complex64"),
    ],
)
def test_an_objective_with_a_fault_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, words: str
) -> None:
    (tmp_path / "broken_own.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "broken_own", raising=False)
    spec = load_spec(EXAMPLES / "quick.toml", ["objective.0.name=broken_own:dark"])
    with pytest.raises(InputError, match=words):
        terms_from_spec(spec, CAMERA, {}, import_objectives(spec))[0].value(view(even(), point()))


def test_a_flag_is_no_number_and_no_word() -> None:
    """They are refused: "false" would be true, and true would be 1."""
    psfs = view(even(), point())
    for known in ("false", 1, None):
        with pytest.raises(InputError, match="filtered_error: known: must be true or false"):
            inspect.unwrap(filtered_error)(psfs, known=cast("Any", known))  # past the checks of types that tests have
    with pytest.raises(InputError, match="handcrafted: near_weight: must be a number, but got True"):
        handcrafted(psfs, near_weight=True)


def test_a_spec_alone_runs_no_code() -> None:
    """Neither is the function called nor its module imported."""
    spec = load_spec(EXAMPLES / "quick.toml", ["objective.0.name=this:d", "objective.0.options={mode=0}"])
    with pytest.raises(InputError, match=r"objective\[0\] this:d: a spec runs no code by itself"):
        optimize(spec)
    assert "this" not in sys.modules


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Spec]:
    """A module with an objective, and a spec that names it."""
    file = tmp_path / "own_objective.py"
    file.write_text("def dark(psfs):\n    return psfs.far.max()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_objective", raising=False)
    return file, load_spec(EXAMPLES / "quick.toml", ["objective.0.name=own_objective:dark", "optimize.steps=0"])


def test_the_file_of_an_objective_is_known_by_its_digest(own: tuple[Path, Spec]) -> None:
    file, spec = own
    assert source_digests(spec, import_objectives(spec)) == {"objective[0].name": sha256_file(file)}
    with pytest.raises(InputError, match="must be in a file"):
        source_digests(spec, {"own_objective:dark": cast("Any", len)})


@pytest.mark.slow
def test_a_run_records_the_file_of_an_objective(own: tuple[Path, Spec], tmp_path: Path) -> None:
    file, spec = own
    functions = import_objectives(spec)
    optimize(spec, tmp_path / "run", objectives=functions)
    recorded = json.loads((tmp_path / "run" / "manifest.json").read_text())["inputs_sha256"]
    assert recorded == {"objective[0].name": sha256_file(file)}
    file.write_text("def dark(psfs):\n    return psfs.far.min()\n")
    with pytest.raises(InputError, match="other input files"):
        optimize(spec, tmp_path / "run", objectives=functions)
