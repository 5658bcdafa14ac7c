"""PSFs with the light of walls, against sums over cells, walls and corners written out, and against coupled waves."""

import inspect
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.aperture import Aperture, RectangularAperture, RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.material import refractive_index
from sim.optic import CellOptic, HeightOptic
from sim.psf_bank import psf
from sim.rigorous import cells_and_walls, compare_row, edge_widths
from sim.rigorous.cells_and_walls import light_of_cells_and_walls
from sim.rigorous.corner_light import corner_unit
from sim.rigorous.edge_optic import dipole_weights, line_weights, optic_as_drawn, with_edges
from sim.rigorous.edge_widths import edge_dipoles, series_at
from sim.rigorous.rows import Polarisation, orders_of, row_slabs
from sim.rigorous.walls import Corners, Walls
from sim.rigorous.width_tables import edge_table

PITCH, STEP, WAVELENGTH = 1.85e-6, 75e-9, 0.552e-6
INDEX = refractive_index("fused_silica", WAVELENGTH)


def camera(cells: int, window: int, focal_m: float) -> Camera:
    green = Colour("green", (WAVELENGTH,), (1.0,))
    grid = Grid((cells, cells), PITCH)
    return Camera(grid, cells * PITCH, "fused_silica", (green,), focal_m, PITCH, window)


def levels(cells: int, seed: int = 0) -> np.ndarray:
    return STEP * np.random.default_rng(seed).integers(0, 16, (cells, cells))


def of_corners(phase: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Light of all corners of a map over that of `corner_unit`: its formula, cell by cell of the four."""
    found = np.zeros(np.subtract(phase.shape, 1), complex)
    for y in (0, 1):
        for x in (0, 1):

            def at(of: np.ndarray, y: int, x: int) -> np.ndarray:
                return of[y : y + len(of) - 1, x : x + of.shape[1] - 1]

            u, v, w = (at(phase, *place) - at(phase, y, x) for place in ((y, 1 - x), (1 - y, x), (1 - y, 1 - x)))
            second = 2 * (np.sign(u) + np.sign(v) - np.sign(w)) + 1j * (np.abs(u) + np.abs(v) - np.abs(w))
            found += at(light, y, x) * (second / (2 * np.pi) + u * v * (0.0018 * w * np.abs(w) - 0.021j))
    return found


def written_out(
    height: np.ndarray, camera: Camera, depth: float, ways: dict[str, Polarisation], samples: int = 4
) -> np.ndarray:
    """Pixel energies as the plain sum over cells, walls and corners, double precision, `samples` along a pixel."""
    n, d = len(height), camera.sensor_distance_m
    wave = 2 * np.pi / WAVELENGTH
    pitch = camera.grid.pitch_m
    x = (np.arange(n) - (n - 1) / 2) * pitch
    side = (np.arange(camera.window * samples) - (camera.window * samples - 1) / 2) * camera.pixel_m / samples
    u = side / (WAVELENGTH * d)
    coverage = circle_coverage(camera.grid, camera.aperture_m)
    square = x[:, None] ** 2 + x**2
    # A sphere's part beyond the parabola, a hundredth of a wave at the nearest depth.
    beyond = 0 * square if np.isinf(depth) else np.hypot(np.sqrt(square), depth) - depth - square / (2 * depth)
    light = np.exp(1j * wave * ((INDEX - 1) * height + beyond))

    def lit(a: np.ndarray) -> np.ndarray:
        return np.exp(1j * wave * a**2 / (2 * depth))

    def along(a: np.ndarray, length: float) -> np.ndarray:
        """Far field of lengths centred at points, lit obliquely: `[u, a]`."""
        oblique = u[:, None] - a / (depth * WAVELENGTH)
        return lit(a) * length * np.sinc(length * oblique) * np.exp(-2j * np.pi * u[:, None] * a)

    cell = along(x, pitch)
    field = cell @ (coverage * light) @ cell.T
    solved = tuple(STEP * np.arange(16)), WAVELENGTH, INDEX
    border = (x[:-1] + x[1:]) / 2
    line = lit(border) * np.exp(-2j * np.pi * u[:, None] * border)
    # Seen from a side, what stands high is to the side: light onto the wall counts as that from it does.
    dipole = line * 2j * np.pi * (u[:, None] + border / (depth * WAVELENGTH))
    for axis, way in ways.items():
        width, own = edge_widths(*solved, way), edge_dipoles(*solved, way)
        turned = (lambda a: a.T) if axis == "y" else (lambda a: a)
        h, open_, t = turned(height), turned(coverage), turned(light)
        rise = np.rint((h[:, 1:] - h[:, :-1]) / STEP).astype(int)
        low = np.where(rise > 0, t[:, :-1], t[:, 1:])
        shade = (open_[:, 1:] + open_[:, :-1]) / 2
        air = np.exp(-1j * wave * np.abs(rise) * STEP)
        field = field + turned(cell @ (width[np.abs(rise)] * air * low * shade) @ line.T)
        foot = np.minimum(h[:, :-1], h[:, 1:]) - h.mean()
        stands = 1j / (2 * wave * INDEX) * foot * (t[:, 1:] - t[:, :-1])
        field = field + turned(cell @ ((stands + np.sign(rise) * own[np.abs(rise)] * air * low) * shade) @ dipole.T)
    if ways:
        shade = (coverage[1:, 1:] + coverage[1:, :-1] + coverage[:-1, 1:] + coverage[:-1, :-1]) / 4
        points = corner_unit(WAVELENGTH, INDEX) * of_corners(wave * (INDEX - 1) * height, light)
        field = field + line @ (points * shade) @ line.T
    energy = np.abs(field / (WAVELENGTH * d)) ** 2 / (np.pi * camera.aperture_m**2 / 4)
    per_sample = (camera.pixel_m / samples) ** 2
    return per_sample * energy.reshape(camera.window, samples, camera.window, samples).sum((1, 3))


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(("polarisation", "ways"), [("x", {"x": "TM", "y": "TE"}), ("y", {"x": "TE", "y": "TM"})])
@pytest.mark.parametrize("depths", [(np.inf,), (2e-3,), (0.7e-3,), (0.7e-3, 2e-3, np.inf)])
def test_light_of_walls_is_that_of_the_sum_over_walls(
    polarisation: str, ways: dict[str, Polarisation], depths: tuple[float, ...]
):
    """As well as a thin element is that of the sum over cells; without walls it is off by 20 to 36 %.

    The nearest source lights the rim with 0.28 waves per cell, and the window ends at 0.3.
    """
    lens = camera(64, 96, 1e-3)
    height = levels(64)
    optic = with_edges(height, replace(lens, polarisation=polarisation), depths_m=depths)
    assert optic.camera.grid == lens.grid
    for depth in depths:
        found = np.asarray(psf(optic, depths=depth).energy[0, 0])
        passed = lens.transmission(WAVELENGTH)
        expected, without = (passed * written_out(height, lens, depth, some) for some in (ways, {}))
        thin = np.asarray(psf(height, lens, depth).energy[0, 0])
        own = off(thin, without)  # of the interpolated transform, and of parabolic light on a cell
        assert own < 0.009
        # Walls are up to a third of the light of a pixel, and 0.3 % of them is missed on average, 2 % at the rim.
        assert off(found, expected) < own + 0.003
        assert off(thin, expected) > 0.15


@pytest.mark.slow
def test_a_doe_has_views_where_near_and_far_light_are_too_different():
    """The window ends at 0.41 waves per cell, and the nearest source lights the rim with 0.28: 1.1 from end to end."""
    lens, height, depths = camera(64, 130, 1e-3), levels(64), (0.7e-3, 2e-3, np.inf)
    optic = with_edges(height, replace(lens, polarisation="x"), depths_m=depths)
    assert optic.camera.grid == lens.grid
    assert [(view.nearest_m, view.farthest_m) for view in optic.views] == [(1.4e-3, np.inf), (0.7e-3, 1.4e-3)]
    for depth in depths:
        found = np.asarray(psf(optic, depths=depth).energy[0, 0])
        passed = lens.transmission(WAVELENGTH)
        expected = passed * written_out(height, lens, depth, {"x": "TM", "y": "TE"})
        thin = passed * written_out(height, lens, depth, {})
        assert off(found, expected) < 0.012
        assert off(thin, expected) > 0.15
    slope = jax.grad(lambda h: jnp.sum(psf(with_edges(h, lens, depths_m=depths), depths=2e-3).energy ** 2))
    own = jax.grad(lambda h: jnp.sum(psf(with_edges(h, lens, depths_m=(2e-3,)), depths=2e-3).energy ** 2))
    plate = jnp.asarray(height, jnp.float32)
    assert off(np.asarray(slope(plate)), np.asarray(own(plate))) < 0.02


@pytest.mark.slow
def test_cells_are_split_where_light_is_too_oblique_for_them():
    """The window ends at half a wave per cell, and the nearest source lights the rim with 0.28."""
    lens, height, depths = camera(64, 160, 1e-3), levels(64), (0.7e-3, np.inf)
    optic = with_edges(height, replace(lens, polarisation="x"), depths_m=depths)
    assert optic.camera.grid == Grid((128, 128), PITCH / 2)
    for depth in depths:
        found = np.asarray(psf(optic, depths=depth).energy[0, 0])
        expected = written_out(np.kron(height, np.ones((2, 2))), optic.camera, depth, {"x": "TM", "y": "TE"})
        assert off(found, lens.transmission(WAVELENGTH) * expected) < 0.006


def test_unpolarised_light_is_the_mean_of_both():
    lens, height = camera(64, 64, 1e-3), levels(64, 1)
    both = [psf(with_edges(height, replace(lens, polarisation=way))).energy[0, 0] for way in ("x", "y")]
    found = psf(with_edges(height, lens)).energy[0, 0]
    assert off(np.asarray(found), np.mean(both, axis=0)) < 1e-3


@pytest.mark.slow
def test_a_grating_sends_light_where_maxwell_does():
    """Orders of a blazed grating of four cells, as shares of the light through a bare face, per polarisation."""
    lens = camera(128, 256, 2.4e-3)
    blazed = STEP * np.array([0, 4, 8, 12])
    height = np.tile(blazed, (128, 32))
    expected = compare_row(blazed, PITCH, WAVELENGTH, INDEX)
    apart = WAVELENGTH * lens.focal_length_m / (4 * PITCH) / lens.pixel_m  # pixels from order to order
    bare = np.asarray(psf(np.zeros((128, 128)), lens).energy[0, 0])
    for row, polarisation in enumerate(("y", "x")):  # walls across x: TE, then TM
        found = np.asarray(psf(with_edges(height, replace(lens, polarisation=polarisation))).energy[0, 0])
        pixels = np.arange(256) - 127.5

        def near(energy: np.ndarray, number: int, pixels: np.ndarray = pixels) -> float:
            inside = np.hypot(pixels[:, None], pixels - number * apart) < apart / 3
            return float(energy[inside].sum())

        orders = [near(found, number) / near(bare, 0) for number in (0, 1)]
        middle = int(-expected.number[0])
        # The first order loses four points to the walls; what is left is light between the orders of a finite grating.
        assert orders == pytest.approx(expected.rigorous[row, middle : middle + 2], abs=0.006)
        assert abs(orders[1] - expected.scalar[middle + 1]) > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("polarisation", ["TE", "TM"])
def test_a_grating_lit_aslant_sends_light_where_maxwell_does(polarisation: Polarisation):
    """0th order of a binary grating of four cells: at 20 degrees glass delays light by a twentieth more."""
    lens, binary = camera(128, 256, 2.4e-3), STEP * np.array([0, 0, 7, 7])
    lens = replace(lens, polarisation="y" if polarisation == "TE" else "x")  # walls across x
    field = 0.0, np.radians(20)
    apart = WAVELENGTH * lens.focal_length_m / (4 * PITCH) / lens.pixel_m  # pixels from order to order
    pixels = np.arange(256) - 127.5
    inside = np.hypot(pixels[:, None], pixels) < apart / 3

    def zeroth(optic: CellOptic) -> float:
        return float(np.asarray(psf(optic, field_rad=field).energy[0, 0])[inside].sum())

    def rigorous(height: np.ndarray) -> float:
        found = orders_of(row_slabs(height, PITCH, INDEX), WAVELENGTH, INDEX, polarisation, 60, sine=np.sin(field[1]))
        return float(found.transmitted[found.at(0)])

    height, flat = np.tile(binary, (128, 32)), np.zeros((128, 128))
    expected = rigorous(binary) / rigorous(np.array([0, 0, 0, 1e-12]))  # 2.7 and 3.2 %; 4.7 and 5.3 along the axis
    found = zeroth(with_edges(height, lens)) / zeroth(HeightOptic.of(lens, flat))
    # Widths of walls are those along the axis; what is left without them at this angle is three times as much.
    assert found == pytest.approx(expected, abs=0.003)
    thin = zeroth(HeightOptic.of(lens, height)) / zeroth(HeightOptic.of(lens, flat))
    assert abs(thin - expected) > 0.007


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences():
    lens = camera(32, 32, 1e-3)
    height, way = levels(32) + 10e-9, levels(32, 3)

    def spot(amount: float) -> jax.Array:
        return jnp.asarray(psf(with_edges(height + amount * way, lens)).energy)[0, 0, 14:18, 14:18].sum()

    slope = jax.grad(spot)(0.0)
    # Single precision of a sum of a thousand cells limits the difference to a percent.
    assert float(slope) == pytest.approx(float(spot(2e-3) - spot(-2e-3)) / 4e-3, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("oblique", [False, True])
def test_slopes_of_the_light_of_walls_are_those_of_differences(oblique: bool):
    """Cell by cell, at the rim too, where the weights of a line lie partly beyond the cells."""
    weights, _ = line_weights(0.3, 0.0, 0.28 * oblique, RoundAperture(1.0))
    assert np.iscomplexobj(weights) == oblique
    of_dipoles = dipole_weights(0.3, 0.0, 0.28 * oblique, RoundAperture(1.0))
    some = weights[4:32:4].T, of_dipoles[4:32:4].T  # at seven borders, each with its own if light is oblique
    tables = [edge_table(1.2e-6, WAVELENGTH, INDEX, "x", axis) for axis in ("y", "x")]
    walls = [Walls.of(one, 1.2e-6, INDEX / WAVELENGTH, some, PITCH) for one in tables]
    rng = np.random.default_rng(0)
    height, rate = jnp.asarray(rng.uniform(0, 1.1e-6, (8, 8)), jnp.float32), (INDEX - 1) / WAVELENGTH
    points, _ = line_weights(0.3, 0.0, 0.28 * oblique, RoundAperture(1.0), 0.05)
    corners = Corners.of(corner_unit(WAVELENGTH, INDEX) / PITCH**2, points[4:32:4].T)
    seen = jnp.asarray(rng.normal(size=(8, 8)) + 1j * rng.normal(size=(8, 8)), jnp.complex64)

    def amount(height: jax.Array) -> jax.Array:
        return jnp.sum(seen * light_of_cells_and_walls(height, rate, corners, *walls)).real

    slopes = np.asarray(jax.grad(amount)(height)) * 1e-9
    steps = 1e-9 * np.eye(64, dtype=np.float32).reshape(64, 8, 8)
    differences = np.array([amount(height + step) - amount(height - step) for step in steps]).reshape(8, 8) / 2
    # Single precision of sums of 64 cells, over differences of a hundredth.
    np.testing.assert_allclose(slopes, differences, rtol=0, atol=2e-3 * np.abs(slopes).max())


@pytest.mark.parametrize("rows", [3, 4])
def test_a_plate_is_the_same_a_few_rows_at_a_time(rows: int, monkeypatch: pytest.MonkeyPatch):
    """Light and slopes, with weights that differ from border to border; the last of three rows lie in two strips."""
    of_lines = line_weights(0.3, 0.0, 0.28, RoundAperture(1.0))[0]
    of_dipoles = dipole_weights(0.3, 0.0, 0.28, RoundAperture(1.0))
    borders = [slice(4, 4 + 3 * count, 3) for count in (7, 5)]
    own = [(of_lines[at].T, of_dipoles[at].T) for at in borders]
    tables = [edge_table(1.125e-6, WAVELENGTH, INDEX, "x", axis) for axis in ("y", "x")]
    walls = [Walls.of(of, 1.125e-6, INDEX / WAVELENGTH, w, PITCH) for of, w in zip(tables, own, strict=True)]
    corners = Corners.of(0.01, line_weights(0.3, 0.0, 0.28, RoundAperture(1.0), 0.05)[0][borders[1]].T)
    rng, rate = np.random.default_rng(5), (INDEX - 1) / WAVELENGTH
    height = jnp.asarray(rng.uniform(0, 1.1e-6, (8, 6)), jnp.float32)
    seen = jnp.asarray(rng.normal(size=(8, 6)) + 1j * rng.normal(size=(8, 6)), jnp.complex64)

    def found() -> tuple[np.ndarray, np.ndarray]:
        # Not the compiled one, which remembers how many rows it took.
        uncompiled = inspect.unwrap(light_of_cells_and_walls)
        light, back = jax.vjp(jax.jit(lambda h: uncompiled(h, rate, corners, *walls)), height)
        return np.asarray(light), np.asarray(back(seen)[0])

    whole = found()
    monkeypatch.setattr(cells_and_walls, "_ROWS", rows)
    for few, all_ in zip(found(), whole, strict=True):
        np.testing.assert_allclose(few, all_, rtol=0, atol=1e-5 * np.abs(all_).max())


def test_widths_from_their_series_are_those_that_were_solved():
    """Between the heights it was fitted to."""
    height = np.random.default_rng(0).uniform(0, 1.125e-6, 50)
    series = edge_table(1.125e-6, WAVELENGTH, INDEX, "unpolarised", "x").width_m
    found = series_at(series, 2 * height / 1.125e-6 - 1) * height / 1.125e-6
    solved = np.mean([edge_widths(tuple(height.tolist()), WAVELENGTH, INDEX, way) for way in ("TE", "TM")], axis=0)
    wanted = solved * np.exp(-2j * np.pi * height / WAVELENGTH)
    assert np.abs(found - wanted).max() < 2.5e-9  # of 350; the series is good to 2 where it was fitted


def test_a_flat_doe_is_as_it_was():
    lens = camera(32, 32, 1e-3)
    flat = np.zeros((32, 32))
    assert off(np.asarray(psf(with_edges(flat, lens)).energy), np.asarray(psf(flat, lens).energy)) < 1e-6


@pytest.mark.parametrize(("seen", "low", "high"), [(0.1, 0, 0), (0.4, 0, 0), (0.3, 0.28, 0.28), (0.3, 0.0, 0.28)])
def test_weights_of_a_line_have_its_far_field(seen: float, low: float, high: float):
    weights, error = line_weights(seen, low, high, RoundAperture(1.0))
    assert error < 0.003
    for share, taps in zip((0.0, 0.5, 1.0), weights[[0, 16, 32]], strict=True):
        waves = np.linspace(-seen - share * high, seen - share * low, 77)
        places = np.arange(len(taps)) - (len(taps) - 1) / 2
        missed = np.abs(np.exp(-2j * np.pi * waves[:, None] * places) @ taps * np.sinc(waves) - 1)
        # 0.3 % on average over the DOE, some times that on its rim, and more at the ends of the band.
        assert np.sqrt(np.mean(missed**2)) < 0.03
        assert missed.max() < 0.15
        assert taps.sum() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("aperture", [RoundAperture(2.0), RectangularAperture((1.6, 2.0))])
def test_the_error_of_a_line_is_the_mean_over_all_lines(aperture: Aperture):
    """Random lines along both axes, each with the length of it that is open; the rim of a rectangle counts in full."""
    seen, low, high = 0.3, 0.0, 0.55
    weights, error = line_weights(seen, low, high, aperture)
    at = np.random.default_rng(0).uniform(-1, 1, 1500)
    along = (np.arange(800) + 0.5) / 400 - 1
    nodes = np.linspace(0, 1, len(weights))
    places = np.arange(weights.shape[1]) - (weights.shape[1] - 1) / 2
    missed = [
        np.mean(np.abs(np.exp(-2j * np.pi * waves[:, None] * places) @ taps * np.sinc(waves) - 1) ** 2)
        for waves, taps in zip(np.linspace(-seen - nodes * high, seen - nodes * low, 300, axis=1), weights, strict=True)
    ]
    squares = np.interp(np.abs(at), nodes, missed)
    lengths = aperture.contains(at[:, None], along).mean(1) + aperture.contains(along[:, None], at).mean(0)
    # The node at the rim, in full on one side of it, and as many lines as there are.
    assert error == pytest.approx(np.sqrt((squares * lengths).sum() / lengths.sum()), rel=0.1)


def test_a_camera_for_another_kind_of_light_is_refused():
    seen = camera(16, 16, 1e-3)
    edges = replace(seen, light="edges")
    for optic, other in ((HeightOptic.of(seen), edges), (with_edges(levels(16), edges), seen)):
        with pytest.raises(ValueError, match=r"substrate and light, .* (scalar|edges) light, but got"):
            psf(optic, other)


def test_what_cannot_be_is_refused():
    lens = camera(32, 32, 1e-3)
    for key, value in (("polarisation", "round"), ("light", "bright")):
        with pytest.raises(InputError, match=f"{key}: must be one of .*, but got '{value}'"):
            replace(lens, **{key: value})
    with pytest.raises(ValueError, match=r"`height_m` must have the grid's shape \(32, 32\)"):
        with_edges(levels(16), lens)
    with pytest.raises(InputError, match="height_m: every height must be a finite number, but got 1024 wrong pixels"):
        with_edges(np.full((32, 32), np.nan), lens)


def test_heights_that_are_no_numbers_give_no_light_and_no_slope():
    """One of them is enough, wherever it lies: an optimiser must see that it diverged."""
    lens = camera(32, 32, 1e-3)
    for place in ((0, 0), (31, 17)):
        height = levels(32)
        height[place] = np.nan

        def total(height: jax.Array) -> jax.Array:
            return jnp.sum(jnp.abs(with_edges(height, lens).transmission) ** 2)

        value, slope = jax.value_and_grad(total)(jnp.asarray(height))
        assert np.isnan(value)
        assert np.isnan(np.asarray(slope)).any()


def test_other_wavelengths_than_those_of_the_camera():
    lens, red = camera(32, 32, 1e-3), 656e-9
    own = replace(lens, colours=(Colour("red", (red,), (1.0,)),))
    found, expected = with_edges(levels(32), lens, wavelengths_m=(red,)), with_edges(levels(32), own)
    np.testing.assert_array_equal(found.transmission, expected.transmission)
    assert found.wavelengths_m == (red,)
    raised = levels(32) + STEP
    kept = found.with_heights(jnp.asarray(raised)).prepared_for((0.5, np.inf))
    assert kept.wavelengths_m == (red,)
    assert found.with_camera(own).wavelengths_m == (red,)


def test_other_depths_and_cameras_are_prepared_for():
    """A plate serves what it was not made for as well as one that was made for it."""
    lens, other = camera(32, 32, 1e-3), camera(32, 48, 1e-3)
    optic = with_edges(levels(32), lens, depths_m=(0.1, 1.0))
    for depth in (0.7e-3, np.inf):
        made_for = psf(with_edges(levels(32), lens, depths_m=(0.1, 1.0, depth)), depths=depth).energy
        np.testing.assert_array_equal(psf(optic, depths=depth).energy, made_for)
    found = psf(optic, other, depths=0.5)
    assert found.camera is not None
    assert found.camera.window == 48
    np.testing.assert_array_equal(
        found.energy, psf(with_edges(levels(32), other, depths_m=(0.1, 1.0)), depths=0.5).energy
    )
    assert optic.with_camera(lens) is optic
    with pytest.raises(ValueError, match="`camera` must have the DOE's aperture, substrate and light"):
        optic.with_camera(replace(lens, aperture=30e-6))


def test_heights_in_a_camera_whose_light_has_edges():
    lens = replace(camera(32, 32, 1e-3), light="edges")
    walls = psf(with_edges(levels(32), lens)).energy
    np.testing.assert_array_equal(psf(levels(32), lens).energy, walls)
    assert off(np.asarray(psf(levels(32), replace(lens, light="scalar")).energy), np.asarray(walls)) > 0.02
    assert isinstance(optic_as_drawn(lens), HeightOptic)  # a bare lens has no walls
    np.testing.assert_array_equal(
        psf(optic_as_drawn(lens, np.zeros((32, 32))).with_heights(jnp.asarray(levels(32)))).energy, walls
    )
