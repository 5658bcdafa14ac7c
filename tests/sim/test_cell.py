"""Pieces and moments of a cell, against the definitions they stand for: pixels that reach a point, and integrals."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss, legval
from scipy.integrate import quad_vec

from sim.surface.cell import (
    DEGREE,
    DEGREES,
    DIPOLE,
    LINE_DEGREE,
    REACH,
    Cuts,
    axis_moments,
    axis_values,
    cuts,
    moment_weights,
    plane_moments,
    point_moments,
    whole_cell,
)

LEGENDRE = np.eye(DEGREE + 1)  # coefficients of P0, P1, ...
# Multiples of 1/64 are exact in float32, so a point is never on the other side of a line by rounding.
shifts = st.integers(-200, 200).map(lambda n: n / 64)
biases = st.integers(-31, 31).map(lambda n: n / 64)


def legendre(degree: int, x: np.ndarray) -> np.ndarray:
    return legval(x, LEGENDRE[degree])


def cut(shift: list[float], bias: list[float]) -> Cuts:
    return cuts(jnp.asarray(shift, jnp.float32), jnp.asarray(bias, jnp.float32))


# --- where the masks' edges lie ---------------------------------------------------------------------------------------


def is_open(pixels: np.ndarray, x: float, shift: float, bias: float) -> bool:
    """Whether the point x lies in the printed opening: any pixel within the bias is open, or all are."""
    numbers = np.arange(len(pixels)) - len(pixels) // 2
    reached = pixels[(numbers + shift - abs(bias) < x) & (x < numbers + 1 + shift + abs(bias))]
    return bool(reached.any() if bias >= 0 else reached.all())


@pytest.mark.slow
@given(st.lists(st.tuples(shifts, biases), min_size=1, max_size=3), st.integers(0, 2**20 - 1))
def test_pieces_are_open_where_a_pixel_within_the_bias_is(errors: list[tuple[float, float]], bits: int):
    """Random masks of 20 pixels around the cell, looked at a point at a time."""
    pixels = np.array([bits >> n & 1 for n in range(20)])
    shift, bias = zip(*errors, strict=True)
    found = cut(list(shift), list(bias))
    edges = np.asarray(found.edges)
    assert edges[0] == 0
    assert edges[-1] == 1
    assert (np.diff(edges) >= 0).all()
    for segment, (start, end) in enumerate(pairwise(edges)):
        if start == end:
            continue
        for mask in range(len(shift)):
            state = int(found.state[mask, segment])
            low, high = (10 + int(a[mask, state]) for a in (found.low, found.high))
            seen = pixels[low : high + 1]
            expected = is_open(pixels, (start + end) / 2, shift[mask], bias[mask])
            assert bool(seen.any() if bias[mask] >= 0 else seen.all()) == expected


@pytest.mark.slow
@given(st.lists(st.tuples(shifts, biases), min_size=1, max_size=4))
def test_the_lines_are_the_masks_edges(errors: list[tuple[float, float]]):
    shift, bias = (np.array(part) for part in zip(*errors, strict=True))
    found = cut(list(shift), list(bias))
    lines = np.asarray(found.edges)[1 + np.asarray(found.line)]
    wanted = np.mod(np.stack([shift - np.abs(bias), shift + np.abs(bias)], axis=1), 1.0)
    np.testing.assert_array_equal(np.sort(lines, axis=1), np.sort(wanted, axis=1))
    # Between its two lines a mask is in the middle state, and no two masks share a line of their own.
    assert sorted(np.asarray(found.line).ravel()) == list(range(2 * len(shift)))


def test_a_line_just_below_a_whole_number_stays_in_its_cell():
    """Rounded to float32 its fraction is 1: an empty last segment, not one of negative width."""
    for shift in (-1e-9, 1 - 1e-9, 3 * 1.85e-6 / float(np.float32(1.85e-6))):
        edges = np.asarray(cut([shift], [0.0]).edges)  # pyright: ignore[reportArgumentType]
        assert (np.diff(edges) >= 0).all()
        assert edges[-1] == 1


def test_masks_as_drawn_need_no_cuts():
    found = whole_cell(3)
    assert np.asarray(found.edges).tolist() == [0.0, 1.0]
    assert not np.asarray(found.low).any()
    assert not np.asarray(found.high).any()


# --- moments ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_moments_of_segments_are_integrals_of_legendre_polynomials(parts: int, rng: np.random.Generator):
    edges = np.concatenate([[0.0], np.sort(rng.random(7)), [1.0]])
    got = np.asarray(axis_moments(jnp.asarray(edges, jnp.float32), parts))
    nodes, weights = leggauss(8)
    for part in range(parts):
        for segment, (start, end) in enumerate(pairwise(edges)):
            # The piece of the segment within the part, in the part's own coordinate from -1 to 1.
            low, high = (np.clip(2 * (x * parts - part) - 1, -1, 1) for x in (start, end))
            at = (low + high) / 2 + (high - low) / 2 * nodes
            for degree in range(DEGREE + 1):
                # Half of it: the part's length counts as 1.
                exact = (high - low) / 4 * np.sum(weights * legendre(degree, at))
                assert got[part, degree, segment] == pytest.approx(exact, abs=1e-6)  # float32
    np.testing.assert_allclose(got.sum(axis=2), np.tile([1.0, 0.0, 0.0, 0.0], (parts, 1)), atol=1e-6)


@pytest.mark.parametrize("parts", [1, 2])
def test_a_point_has_the_moments_of_a_short_segment(parts: int):
    width = 1e-3
    for at in (0.0, 0.1, 0.25, 0.48, 0.7, 1.0):
        edges = jnp.clip(jnp.array([at - width, at + width]), 0.0, 1.0)
        length = float(edges[1] - edges[0])
        short = np.asarray(axis_moments(edges, parts))[:, :, 0] / length
        # To first order in the width: P2 has slopes up to 6 per part of the cell.
        np.testing.assert_allclose(
            np.asarray(axis_values(jnp.array([at]), parts))[:, :, 0], short, atol=20 * width * parts**2
        )


def test_a_point_belongs_to_one_part():
    points = jnp.array([0.0, 0.3, 0.5, 0.9, 1.0])
    shares = np.asarray(axis_values(points, 2))[:, 0] / 2
    assert shares.tolist() == [[1, 1, 0, 0, 0], [0, 0, 1, 1, 1]]


def test_moments_of_the_plane_are_products():
    y, x = (axis_moments(jnp.array(edges), 2) for edges in ([0.0, 0.2, 1.0], [0.0, 0.6, 0.7, 1.0]))
    got = np.asarray(plane_moments(y, x)).reshape(2, 2, len(DEGREES), 2, 3)
    for d, (qy, qx) in enumerate(DEGREES):
        wanted = np.einsum("pa,rb->prab", np.asarray(y)[:, qy], np.asarray(x)[:, qx])
        np.testing.assert_allclose(got[:, :, d], wanted, atol=1e-7)
    ay, ax = (axis_values(jnp.array(points), 2) for points in ([0.1, 0.8], [0.3, 0.9]))
    at = np.asarray(point_moments(ay, ax)).reshape(2, 2, len(DEGREES), 2)
    for d, (qy, qx) in enumerate(DEGREES):
        wanted = np.einsum("pq,rq->prq", np.asarray(ay)[:, qy], np.asarray(ax)[:, qx])
        np.testing.assert_allclose(at[:, :, d], wanted, atol=1e-6)


# --- what moments look like from afar ---------------------------------------------------------------------------------


def seen_from(u: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Far field of the weights as values of neighbouring cells."""
    return np.exp(-2j * np.pi * u[:, None] * np.arange(-REACH, REACH + 1)) @ weights * np.sinc(u)


def of_a_cell(u: np.ndarray, degree: int) -> np.ndarray:
    """Far field of (2q+1) P_q over a cell: an integral, no Bessel functions."""

    def integrand(x: float) -> np.ndarray:
        return legendre(degree, np.array(2 * x)) * np.exp(-2j * np.pi * u * x)

    return (2 * degree + 1) * quad_vec(integrand, -0.5, 0.5)[0]


def weights_of(low: float, high: float) -> np.ndarray:
    """Weights of one band for moments of cells, `[degree, tap]`."""
    return moment_weights(np.array([low]), np.array([high]))[0, :DEGREE]


@pytest.mark.parametrize(("low", "high", "limit"), [(-0.1, 0.1, 1e-4), (-0.4, 0.4, 1e-3), (-0.6, 0.2, 2e-3)])
def test_weights_of_lines_look_like_lines_near_the_lower_border(low: float, high: float, limit: float):
    """A line a little off the border is the sum over powers of its place; the third, left out, is 0.3 % here."""
    u, place = np.linspace(low, high, 201), 0.04
    weights = moment_weights(np.array([low]), np.array([high]))[0, DEGREE : DEGREE + DIPOLE]
    assert len(weights) == LINE_DEGREE + 1
    found = sum(place**q * seen_from(u, row) for q, row in enumerate(weights))
    error = np.abs(found - np.exp(-2j * np.pi * u * (place - 0.5)))
    assert np.sqrt(np.mean(error**2)) < limit + np.mean((2 * np.pi * np.abs(u) * place) ** 3) / 6
    # Light on the axis is that of the line wherever it lies.
    np.testing.assert_allclose(weights.sum(1), [1, 0, 0], atol=1e-5)


@pytest.mark.parametrize(("low", "high", "limit"), [(-0.1, 0.1, 1e-3), (-0.4, 0.4, 5e-3), (-0.6, 0.2, 1e-2)])
def test_weights_of_dipoles_look_like_dipoles_on_the_lower_border(low: float, high: float, limit: float):
    """Where light onto the cell comes from a side, at minus the middle of the band, it counts twice."""
    u, onto = np.linspace(low, high, 201), -(low + high) / 2
    weights = moment_weights(np.array([low]), np.array([high]))[0, DEGREE + DIPOLE]
    error = np.abs(seen_from(u, weights) - 2j * np.pi * (u + 2 * onto) * np.exp(1j * np.pi * u))
    assert np.sqrt(np.mean(error**2)) < limit  # of 0.4 to 3
    assert weights.sum() == pytest.approx(4j * np.pi * onto, abs=1e-4)


@pytest.mark.parametrize(
    ("low", "high", "limit"),
    # Fourteen weights to either side leave next to nothing of narrow bands, wherever they lie. Weights repeat after a
    # wave per cell: in bands almost as wide they have to come back to where they began, and miss the last of it.
    [(-0.1, 0.1, 1e-4), (-0.4, 0.4, 2e-4), (-0.6, 0.2, 5e-4), (-0.46, 0.46, 0.01), (-0.6, 0.32, 0.012)],
)
def test_weights_look_like_the_moments_within_the_band(low: float, high: float, limit: float):
    u = np.linspace(low, high, 201)
    for degree, weights in enumerate(weights_of(low, high), start=1):
        error = np.abs(seen_from(u, weights) - of_a_cell(u, degree))
        assert np.sqrt(np.mean(error**2)) < limit  # of a cell's 1


@pytest.mark.parametrize("slope", [3e-3, -3e-3])
@pytest.mark.parametrize(("low", "high"), [(-0.3, 0.3), (-0.5, 0.1)])
def test_weights_look_like_the_moments_where_each_cell_is_lit_more_obliquely_than_the_last(
    low: float, high: float, slope: float
):
    """Cells in a wave exp(pi i slope x²), the light from every point of them added up."""
    u, (nodes, shares) = np.linspace(low, high, 101), leggauss(8)
    places = np.arange(-REACH, REACH + 1)[:, None] + nodes / 2
    waves = np.exp(1j * np.pi * slope * places**2 - 2j * np.pi * u[:, None, None] * places) * shares / 2
    weights = moment_weights(np.array([low]), np.array([high]), slope)[0]
    # Within a cell the wave is taken as straight. Of its parabola moment 2 lacks 5 pi slope times the integral of
    # x² P2, 1/30, which is 0.0016; the others, which lack it off the axis alone, less than half of that.
    for degree, limit in ((1, 7e-4), (2, 1.6e-3), (3, 7e-4)):
        wanted = waves[:, REACH] @ ((2 * degree + 1) * legendre(degree, nodes))
        assert np.sqrt(np.mean(np.abs(waves.sum(2) @ weights[degree - 1] - wanted) ** 2)) < limit


@pytest.mark.parametrize(("low", "high"), [(-0.1, 0.1), (-0.46, 0.46), (-0.6, 0.32)])
def test_weights_leave_the_mean_alone_and_are_those_of_the_other_side_mirrored(low: float, high: float):
    weights, others = weights_of(low, high), weights_of(-high, -low)
    np.testing.assert_allclose(weights.sum(1), 0, atol=1e-5)
    # Seen from the other side, a cell's upper half is its lower one.
    parity = np.array([-1, 1, -1])[:, None]
    # To what the least squares are conditioned to, 1e-8 of weights to 1e-3 of them.
    np.testing.assert_allclose(others, parity * weights[:, ::-1], atol=1e-5)
    np.testing.assert_allclose(others, weights.conj(), atol=1e-5)
    # Cells are numbered upward: light from the upper half of a cell looks like more light in the cell above.
    assert weights[0, REACH + 1].real > 0
    # Bounded: large weights would amplify rounding, and light beyond the band.
    assert np.abs(weights).sum(1).max() < 5


@pytest.mark.parametrize("parts", [1, 2])
def test_a_row_of_cut_cells_looks_the_same_as_its_filtered_values(parts: int, rng: np.random.Generator):
    """Cells of four random pieces each, the plane wave from every piece added exactly."""
    count, band = 48, 0.4
    edges = np.array([0.0, 0.15, 0.4, 0.83, 1.0])
    light = np.exp(2j * np.pi * rng.random((count, 4)))
    light[:12] = light[-12:] = 1  # what is filtered must not spill over the ends
    u = np.linspace(-band * parts, band * parts, 101)
    # Integral of exp(-2 pi i u x) over every piece.
    start, end = edges[:-1], edges[1:]
    middle, width = (start + end) / 2, end - start
    piece = width * np.sinc(u[:, None] * width) * np.exp(-2j * np.pi * u[:, None] * middle)
    exact = np.einsum("us,un,ns->u", piece, np.exp(-2j * np.pi * u[:, None] * np.arange(count)), light)
    moments = np.einsum("pqs,ns->qnp", np.asarray(axis_moments(jnp.asarray(edges, jnp.float32), parts)), light)
    moments = moments.reshape(DEGREE + 1, count * parts)
    weights = weights_of(-band, band)
    filtered = moments[0] + sum(np.convolve(moments[q], weights[q - 1], "same") for q in range(1, DEGREE + 1))
    places = (np.arange(count * parts) + 0.5) / parts

    def seen(values: np.ndarray) -> np.ndarray:
        return np.sinc(u / parts) / parts * (np.exp(-2j * np.pi * u[:, None] * places) @ values)

    error = np.linalg.norm(seen(filtered) - exact) / np.linalg.norm(exact)
    # What is left out begins with the third moment, (pi u)^3 / 15 of its share of the light: 0.13 at 0.4 waves, a
    # third of it in the mean over the band, and a tenth of the light of such pieces is in their third moment.
    assert error < 0.008
    # The cells' means alone are off by a seventh.
    assert np.linalg.norm(seen(moments[0]) - exact) / np.linalg.norm(exact) > 0.1
