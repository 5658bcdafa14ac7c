"""PSFs with the light of walls, against sums over cells and walls written out, and against coupled waves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.material import refractive_index
from sim.psf_bank import psf
from sim.rigorous import compare_row, edge_widths
from sim.rigorous.edge_optic import line_taps, oblique_waves, with_edges

PITCH, STEP, WAVELENGTH = 1.85e-6, 75e-9, 0.552e-6
INDEX = refractive_index("fused_silica", WAVELENGTH)


def camera(cells: int, window: int, focal_m: float) -> Camera:
    green = Colour("green", (WAVELENGTH,), (1.0,))
    grid = Grid((cells, cells), PITCH)
    return Camera(grid, cells * PITCH, "fused_silica", (green,), focal_m, PITCH, window)


def levels(cells: int, seed: int = 0) -> np.ndarray:
    return STEP * np.random.default_rng(seed).integers(0, 16, (cells, cells))


def written_out(height: np.ndarray, camera: Camera, depth: float, ways: dict[str, str], points: int = 4) -> np.ndarray:
    """Pixel energies as the plain sum over cells and walls, in double precision, `points` per pixel and axis."""
    n, d = len(height), camera.sensor_distance_m
    wave = 2 * np.pi / WAVELENGTH
    pitch = camera.grid.pitch_m
    x = (np.arange(n) - (n - 1) / 2) * pitch
    side = (np.arange(camera.window * points) - (camera.window * points - 1) / 2) * camera.pixel_m / points
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
    tables = {axis: edge_widths(tuple(STEP * np.arange(16)), WAVELENGTH, INDEX, way) for axis, way in ways.items()}
    border = (x[:-1] + x[1:]) / 2
    line = lit(border) * np.exp(-2j * np.pi * u[:, None] * border)
    for axis, width in tables.items():
        turned = (lambda a: a.T) if axis == "y" else (lambda a: a)
        h, open_, t = turned(height), turned(coverage), turned(light)
        rise = np.rint((h[:, 1:] - h[:, :-1]) / STEP).astype(int)
        low = np.where(rise > 0, t[:, :-1], t[:, 1:])
        shade = (open_[:, 1:] + open_[:, :-1]) / 2
        wall = width[np.abs(rise)] * np.exp(-1j * wave * np.abs(rise) * STEP) * low * shade
        field = field + turned(cell @ wall @ line.T)
    energy = np.abs(field / (WAVELENGTH * d)) ** 2 / (np.pi * camera.aperture_m**2 / 4)
    per_point = (camera.pixel_m / points) ** 2
    return per_point * energy.reshape(camera.window, points, camera.window, points).sum((1, 3))


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(("polarisation", "ways"), [("x", {"x": "TM", "y": "TE"}), ("y", {"x": "TE", "y": "TM"})])
@pytest.mark.parametrize("depth", [np.inf, 2e-3, 0.7e-3])
def test_light_of_walls_is_that_of_the_sum_over_walls(polarisation: str, ways: dict[str, str], depth: float):
    """0.5 %: half from the weights of the lines, half from the interpolated transform; without walls 8 %."""
    lens = camera(64, 96, 1e-3)
    height = levels(64)
    optic = with_edges(height, lens, polarisation, nearest_m=depth)
    waves = {np.inf: 0.304, 2e-3: 0.403, 0.7e-3: 0.588}
    assert sum(oblique_waves(lens, WAVELENGTH, depth)) == pytest.approx(waves[depth], abs=2e-3)
    assert optic.camera.grid.shape == ((128, 128) if depth == 0.7e-3 else (64, 64))
    found = np.asarray(psf(optic, depths=depth).energy[0, 0])
    cells = np.kron(height, np.ones((len(optic.coverage) // 64,) * 2))
    expected = lens.transmission(WAVELENGTH) * written_out(cells, optic.camera, depth, ways)
    thin = np.asarray(psf(height, lens, depth).energy[0, 0])
    assert off(found, expected) < 0.006
    assert off(thin, expected) > 0.05


def test_unpolarised_light_is_the_mean_of_both():
    lens, height = camera(64, 64, 1e-3), levels(64, 1)
    both = [psf(with_edges(height, lens, way)).energy[0, 0] for way in ("x", "y")]
    found = psf(with_edges(height, lens)).energy[0, 0]
    assert off(np.asarray(found), np.mean(both, axis=0)) < 1e-3


def test_a_grating_sends_light_where_maxwell_does():
    """Orders of a blazed grating of four cells, as shares of the light through a bare face, per polarisation."""
    lens = camera(128, 256, 2.4e-3)
    blazed = STEP * np.array([0, 4, 8, 12])
    height = np.tile(blazed, (128, 32))
    expected = compare_row(blazed, PITCH, WAVELENGTH, INDEX)
    apart = WAVELENGTH * lens.focal_length_m / (4 * PITCH) / lens.pixel_m  # pixels from order to order
    bare = np.asarray(psf(np.zeros((128, 128)), lens).energy[0, 0])
    for row, polarisation in enumerate(("y", "x")):  # walls across x: TE, then TM
        found = np.asarray(psf(with_edges(height, lens, polarisation)).energy[0, 0])
        pixels = np.arange(256) - 127.5

        def near(energy: np.ndarray, number: int, pixels: np.ndarray = pixels) -> float:
            inside = np.hypot(pixels[:, None], pixels - number * apart) < apart / 3
            return float(energy[inside].sum())

        orders = [near(found, number) / near(bare, 0) for number in (0, 1)]
        middle = int(-expected.number[0])
        # The first order loses four points to the walls; what is left is light between the orders of a finite grating.
        assert orders == pytest.approx(expected.rigorous[row, middle : middle + 2], abs=0.006)
        assert abs(orders[1] - expected.scalar[middle + 1]) > 0.02


def test_gradients_are_those_of_finite_differences():
    lens = camera(32, 32, 1e-3)
    height, way = levels(32) + 10e-9, levels(32, 3)

    def spot(amount: float) -> jax.Array:
        return jnp.asarray(psf(with_edges(height + amount * way, lens)).energy)[0, 0, 14:18, 14:18].sum()

    slope = jax.grad(spot)(0.0)
    # Single precision of a sum of a thousand cells limits the difference to a percent.
    assert float(slope) == pytest.approx(float(spot(2e-3) - spot(-2e-3)) / 4e-3, rel=0.02)


def test_a_flat_doe_is_as_it_was():
    lens = camera(32, 32, 1e-3)
    flat = np.zeros((32, 32))
    assert off(np.asarray(psf(with_edges(flat, lens)).energy), np.asarray(psf(flat, lens).energy)) < 1e-6


@pytest.mark.parametrize("seen", [0.1, 0.25, 0.4])
def test_weights_of_a_line_have_its_far_field(seen: float):
    taps, error = line_taps(seen, 0.0)
    waves = np.linspace(0, seen, 77)
    found = 2 * np.cos(2 * np.pi * waves[:, None] * (np.arange(len(taps)) + 0.5)) @ np.array(taps) * np.sinc(waves)
    # Half a percent on average, some times that at the end of the band.
    assert np.sqrt(np.mean((found - 1) ** 2)) < 0.0055
    assert np.abs(found - 1).max() < 0.03
    assert error < 0.005
    assert 2 * sum(taps) == pytest.approx(1, abs=1e-12)


def test_what_cannot_be_is_refused():
    lens = camera(32, 32, 1e-3)
    with pytest.raises(InputError, match='polarisation: must be "unpolarised", "x" or "y", but got \'round\''):
        with_edges(levels(32), lens, "round")
    with pytest.raises(ValueError, match=r"`height_m` must have the grid's shape \(32, 32\)"):
        with_edges(levels(16), lens)
