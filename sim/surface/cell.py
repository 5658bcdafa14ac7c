"""One DOE cell with displaced masks: where within the cell what is etched, and what the cell does to light from afar.

A mask that lies off by a fraction of a cell, or prints its openings too wide, moves all its edges, so every cell is cut
along a few lines, the same ones in all cells of a small tile (`Cuts`). Between the lines the depth is constant. The
depth of every piece of every cell is one matrix product of the masks' states with what each etch takes away, and its
light needs one exponential.

A lens does not see the pieces. It sees how much light a cell passes and, to its first three moments, from where within
the cell: exp(-2 pi i u x) over a cell is a short series of Legendre polynomials, sum (2q+1) (-i)^q j_q(pi u) P_q(2x),
and of the plane waves that reach the sensor little more than half a turn fits into a cell. The cell's mean alone is off
by 15 % in the PSF of a plate with 0.5 um of overlay. `moment_weights` turns moments into values of the neighbouring
cells that have the same far field, so that the transform of one number per cell stays what it was.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int
from scipy.special import factorial, spherical_jn

DEGREE = 3  # of the highest moments
# Moments kept: degree along y and along x.
DEGREES = tuple((y, x) for y in range(DEGREE + 1) for x in range(DEGREE + 1 - y))
LINE_DEGREE = 2  # the same of lines along borders
DIPOLE = LINE_DEGREE + 1  # of a line, after its moments across it: its dipole
REACH = 20  # cells to either side of a moment's own
_RIDGE = 1e-8  # keeps weights small where the band leaves them free


class Cuts(NamedTuple):
    """Lines that cut every cell of a tile along one axis."""

    # Where they are, in cells from the cell's lower side, increasing, with 0 and 1 at the ends
    edges: Float[Array, " segment+1"]
    # `[mask, segment]` 0, 1 or 2: the segment lies before, between or behind the two lines of that mask
    state: Int[Array, "mask segment"]
    # `[mask, state]` offset in cells of the lowest mask pixel that a piece in that state sees
    low: Int[Array, "mask 3"]
    high: Int[Array, "mask 3"]  # the same for the highest
    # `[mask, 2]` which of the inner `edges` (0 = first) are the mask's lines shift - |bias| and shift + |bias|;
    # modulo one cell, either may come first
    line: Int[Array, "mask 2"]


def cuts(shift: Float[Array, " mask"], bias: Float[Array, " mask"]) -> Cuts:
    """Cut a cell where masks are shifted, and edges of their openings moved outward by `bias` (-1/2 to 1/2), in cells.

    A point of the wafer lies in the printed opening if any mask pixel within the bias of it (measured along x and along
    y) is open, or, for a negative bias, if all of them are: the square keeps the corners of rectangles square.
    """
    reach = jnp.abs(bias)
    lines = jnp.stack([shift - reach, shift + reach], axis=1)
    whole = jnp.floor(lines)
    # A line just below a whole number can round up to a fraction of 1, which belongs to the next cell.
    fraction = jnp.clip(lines - whole, 0.0, 1.0)
    number = whole.astype(jnp.int32)
    masks = shift.shape[0]
    flat = fraction.reshape(-1)
    order = jnp.argsort(flat)  # stable: equal lines keep their order, so an unbiased mask's lower line comes first
    rank = jnp.argsort(order).reshape(masks, 2)
    edges = jnp.concatenate([jnp.zeros(1), flat[order], jnp.ones(1)])
    segments = jnp.arange(2 * masks + 1)
    behind = segments[None, None, :] > rank[:, :, None]
    state = behind.sum(axis=1).astype(jnp.int32)
    # Behind the lower line a piece sees one more pixel above, behind the upper line one less below.
    lower_first = rank[:, 0] < rank[:, 1]
    high = -number[:, 0, None] - 1 + jnp.stack([0 * rank[:, 0], lower_first, 1 + 0 * rank[:, 0]], axis=1)
    low = -number[:, 1, None] - 1 + jnp.stack([0 * rank[:, 0], ~lower_first, 1 + 0 * rank[:, 0]], axis=1)
    return Cuts(edges, state, low.astype(jnp.int32), high.astype(jnp.int32), rank)


def whole_cell(masks: int) -> Cuts:
    """No cuts: every mask lies where it was drawn."""
    same = jnp.zeros((masks, 3), jnp.int32)
    none = jnp.zeros((masks, 2), jnp.int32)
    return Cuts(jnp.array([0.0, 1.0]), jnp.zeros((masks, 1), jnp.int32), same, same, none)


def axis_moments(edges: Float[Array, " edge"], parts: int) -> Float[Array, "part degree edge-1"]:
    """Integral of the Legendre polynomials P0 to P3 over every segment, for each of `parts` equal parts of the cell.

    Over its own part a whole cell gives (1, 0, 0, 0).
    """
    start = jnp.arange(parts)[:, None] / parts
    x = jnp.clip((edges[None, :] - start) * parts, 0.0, 1.0)
    odd = x * (x - 1)
    powers = jnp.stack([x, odd, odd * (2 * x - 1), odd * (5 * odd + 1)], axis=1)
    return jnp.diff(powers, axis=-1)


def axis_values(points: Float[Array, " point"], parts: int) -> Float[Array, "part degree point"]:
    """Legendre polynomials P0 to P3 at points of the cell, times the parts per length; zero outside each part."""
    start = jnp.arange(parts)[:, None] / parts
    x = (points[None, :] - start) * parts
    inside = (x >= 0) & ((x < 1) | ((x <= 1) & (start + 1 / parts >= 1)))
    z = 2 * x - 1
    values = jnp.stack([jnp.ones_like(x), z, (3 * z * z - 1) / 2, z * (5 * z * z - 3) / 2], axis=1)
    return parts * jnp.where(inside[:, None, :], values, 0.0)


def plane_moments(
    along_y: Float[Array, "part degree a"], along_x: Float[Array, "part degree b"]
) -> Float[Array, "moment a b"]:
    """Products of moments along both axes for `DEGREES`, one row per (part y, part x, degree)."""
    rows = [jnp.einsum("pa,rb->prab", along_y[:, degree_y], along_x[:, degree_x]) for degree_y, degree_x in DEGREES]
    stacked = jnp.stack(rows, axis=2)
    return stacked.reshape(-1, along_y.shape[-1], along_x.shape[-1])


def point_moments(at_y: Float[Array, "part degree q"], at_x: Float[Array, "part degree q"]) -> Float[Array, "moment q"]:
    """The same for points, one product per point."""
    rows = [at_y[:, None, degree_y] * at_x[None, :, degree_x] for degree_y, degree_x in DEGREES]
    return jnp.stack(rows, axis=2).reshape(-1, at_y.shape[-1])


def moment_weights(
    low: Float[np.ndarray, " band"],
    high: Float[np.ndarray, " band"],
    slope: float = 0.0,
    within: tuple[int, int] = (-REACH, REACH),
) -> Complex[np.ndarray, "band kind tap"]:
    """Weights on the cells -20 ... 20 from a moment's own whose far field is that of the moment.

    The first three kinds are moments of degree 1, 2 and 3 of a cell, the next those of degree 0, 1 and 2 of a line
    about the lower border of its cell, sum of light times place^q with places in cells, and the last is a dipole there.

    A cell's far field is sinc(u). The sum of weights times exp(-2 pi i u k) sinc(u) is fitted by least squares to
    (2q+1) (-i)^q j_q(pi u), the far field of moment q, to exp(i pi u) (-2 pi i u)^q / q!, that of a line's moment, and
    to 2 pi i (u + 2 v) exp(i pi u), that of a dipole (`sim.rigorous.edge_optic.dipole_weights`), for wave numbers u
    from `low` to `high`, waves per cell: those of light to a pixel less that of the light on the cell, v. Any band
    narrower than 1 can be fitted, wherever it lies. `slope` is how much more obliquely each cell is lit than the one
    before, waves per cell. Near the border of the grid only the cells `within` some places have weights.

    The weights of all kinds but a line's light itself, whose weights sum to 1, and of dipoles that are lit obliquely,
    have no effect on the axis, so that they leave the mean of a plate alone; they are real for a band that is symmetric
    about it.
    """
    waves = (low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 200))[:, :, None]  # [band, node, place]
    places = np.arange(within[0], within[1] + 1)
    seen = np.exp(-2j * np.pi * waves * places + 1j * np.pi * slope * places**2) * np.sinc(waves - slope * places)
    degrees, powers = np.arange(1, DEGREE + 1), np.arange(LINE_DEGREE + 1)
    cells = (2 * degrees + 1) * (-1j) ** degrees * spherical_jn(degrees, np.pi * waves)
    lines = np.exp(1j * np.pi * waves) * (-2j * np.pi * waves) ** powers / factorial(powers)
    onto = -(low + high)[:, None, None]  # twice the wave number of the light on the cell
    dipoles = 2j * np.pi * (waves + onto) * np.exp(1j * np.pi * waves)
    wanted = np.concatenate([cells, lines, dipoles], 2)
    on_axis = np.zeros((len(low), 1, wanted.shape[2]), complex)
    on_axis[..., DEGREE], on_axis[..., DEGREE + DIPOLE] = 1.0, 2j * np.pi * onto[..., 0]
    turned = seen.conj().swapaxes(1, 2) / waves.shape[1]
    # As good as exact on the axis, and then exact.
    matrix = turned @ seen + 1e3 * np.ones((len(places), len(places))) + _RIDGE * np.eye(len(places))
    weights = np.linalg.solve(matrix, turned @ wanted + 1e3 * on_axis).swapaxes(1, 2)
    weights = weights + ((on_axis[:, 0] - weights.sum(axis=2)) / len(places))[:, :, None]
    return np.pad(weights, ((0, 0), (0, 0), (REACH + within[0], REACH - within[1])))
