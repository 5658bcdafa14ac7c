"""Light of one relief layer that repeats and has a mirror, with the gradient of its orders: for refinement.

At normal incidence through a layer without loss that is its own mirror image along x, the field divides into two parts
that do not know of each other, and light along x or y excites one. In cosines and sines instead of exponentials its
equations are real. So this needs half of the unknowns of `crossed_orders` and real arithmetic, and no modes: with the
transverse fields h = (Hx, Hy) and e = (-Ey, Ex), Maxwell's equations in Fourier orders are h' = i G e, e' = i B h, and
cos(sqrt(G B) d) and sin(sqrt(G B) d) / sqrt(G B) of a layer d thick are found by doubling, in products of matrices.
The gradient is that of the adjoint field: one more solution of the same system, and an integral over the depth.

Walls: the directions along them are those of fmmax's JONES_DIRECT_FOURIER (after V. Liu and S. Fan, Comput. Phys.
Commun. 183, 2233 (2012)), of which this keeps the real part of their products. The imaginary part breaks the mirror,
and changes the orders in second order only: by 1e-5 to 3e-5 of the incident light in splitters of 49 orders of 0.016
(800 terms), by 4e-4 to 6e-4 in blobs of 2.4 um (100 terms). Matrices are in single precision: 1e-6 of that light.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from fab.errors import InputError

_HALVINGS = 3  # of the depth, before the power series
_NODES = 24  # of the depth, for the integral of the gradient
_DEGREE = 24  # of the polynomials that carry fields to those nodes
_JONES_WEIGHT = 0.05  # fmmax's, of the roughness of directions


class MirroredOrders(NamedTuple):
    """Light that a mirrored layer transmits.

    Attributes:
        orders: `[y, x]` shares of the incident power, of the orders from -y to y and -x to x that were asked for.
        transmitted: share of all orders together.
    """

    orders: Float[np.ndarray, "y x"]
    transmitted: float


class MirroredGradient(NamedTuple):
    """How a number changes that depends on the orders of a mirrored layer, walls held in their directions.

    Attributes:
        permittivity: `[y, x]` its derivative by the permittivity of every pixel.
        inverse: the part of it that comes by 1 / permittivity, as a derivative by that.
        depth: its derivative by the depth, 1/m.
    """

    permittivity: Float[np.ndarray, "y x"]
    inverse: Float[np.ndarray, "y x"]
    depth: float

    def exchanged(self, old: Float[np.ndarray, "y x"], new: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
        """Tell what every pixel adds to the number if it gets another permittivity altogether.

        First order in the matrices, which permittivity and its inverse enter for different fields: of glass in air, the
        derivative alone is wrong by the glass's permittivity for fields across a wall.

        Args:
            old: permittivity of every pixel that the gradient was taken at.
            new: another.
        """
        direct = self.permittivity + self.inverse / old**2
        return direct * (new - old) + self.inverse * (1 / new - 1 / old)


class _Sector(NamedTuple):
    """Functions cos(m x) or sin(m x) times cos(n y), or sin(|n| y) of a negative n; those in a circle."""

    m: Int[np.ndarray, " function"]
    n: Int[np.ndarray, " function"]
    even: bool


class _Product:
    """Matrix of multiplication by a raster, from functions of one sector to those of another."""

    def __init__(self, rows: _Sector, columns: _Sector, shape: tuple[int, int]) -> None:
        self.shape, self.odd = shape, rows.even != columns.even
        m, n, over, up = rows.m[:, None], abs(rows.n)[:, None], columns.m, abs(columns.n)
        near, far = {(True, True): (1, 1), (False, False): (1, -1), (True, False): (-1, 1), (False, True): (1, 1)}[
            rows.even, columns.even
        ]
        sine, other = rows.n[:, None] < 0, columns.n < 0
        scale = np.sqrt(2.0) ** (1.0 * (m > 0) + (over > 0) + (n > 0) + (up > 0)) / 4
        size = shape[0] * shape[1]
        places, signs = [], []
        # Re(s s' conj(Z(n + n'))) and Re(s conj(s') conj(Z(n - n'))) with s = 1 of a cosine, -i of a sine.
        for step, imaginary, sign in (
            (n + up, sine != other, np.where(sine & other, -1.0, np.where(sine != other, -1.0, 1.0))),
            (n - up, sine != other, np.where(~sine & other, 1.0, np.where(sine & ~other, -1.0, 1.0))),
        ):
            for along, weight in ((m - over, near), (m + over, far)):
                places.append(size * imaginary + (step % shape[0]) * shape[1] + along % shape[1])
                signs.append(scale * sign * weight)
        self._places, self._signs = np.array(places), np.array(signs)

    def matrix(self, raster: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "row column"]:
        """Return the matrix."""
        waves = np.fft.fft2(raster) / raster.size
        waves = 1j * waves if self.odd else waves
        return (np.concatenate([waves.real.ravel(), waves.imag.ravel()])[self._places] * self._signs).sum(0)

    def adjoint(self, matrix: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "y x"]:
        """Return the gradient by the raster (an even one) of a number whose gradient by the matrix is given."""
        size = self.shape[0] * self.shape[1]
        flat = np.bincount(self._places.ravel(), (self._signs * matrix).ravel(), 2 * size)
        real, imaginary = flat.reshape(2, *self.shape)
        return np.fft.ifft2(real + 1j * imaginary).real


class _Media(NamedTuple):
    """The layer in orders: h' = i G e, e' = i B h, and what the gradient asks for."""

    g: np.ndarray
    b: np.ndarray
    across: np.ndarray  # 1 / permittivity of the field along the light
    inverse: tuple[np.ndarray, np.ndarray]  # of the matrices of 1 / permittivity, of either sector
    walls: np.ndarray  # products of directions


class MirroredLayer:
    """One layer between two half-spaces, alike under x -> -x, that repeats in a square cell.

    Rasters are `[y, x]` and their mirror maps column i to column -i, modulo their number. Light comes through the first
    half-space at normal incidence.

    Args:
        pixels: of a raster, along either axis; odd or even.
        period_m: of the cell.
        wavelength_m: vacuum wavelength.
        indices: refractive indices before and behind the layer.
        terms: orders that are kept, about, as in `crossed_orders`.
        along_x: light whose electric field is along x, instead of along y.
    """

    def __init__(
        self,
        pixels: int,
        period_m: float,
        wavelength_m: float,
        indices: tuple[float, float],
        terms: int,
        along_x: bool = False,
    ) -> None:
        self._shape, self._unit_m = (pixels, pixels), wavelength_m
        self._step, self._omega = 2 * np.pi * wavelength_m / period_m, 2 * np.pi
        reach = int(np.ceil(np.sqrt(terms / np.pi)))
        n, m = (each.ravel() for each in np.mgrid[-reach : reach + 1, -reach : reach + 1])
        inside = m**2 + n**2 < terms / np.pi
        self._all = m[inside], n[inside]
        sectors = [_Sector(m[k], n[k], even) for even, k in ((True, inside & (m >= 0)), (False, inside & (m > 0)))]
        first, second = sectors[::-1] if along_x else sectors
        self._first, self._sectors = len(first.m), (first, second)
        self._products = [[_Product(row, column, self._shape) for column in (first, second)] for row in (first, second)]
        self._curl = sparse.hstack([self._slope(first, first), -self._slope_x(second, first)]).tocsr()
        divergence = sparse.hstack([self._slope_x(first, second), self._slope(second, second)])
        self._divergences = (divergence.T @ divergence).tocsr()
        self._k2 = self._step**2 * np.concatenate([each.m**2 + each.n**2 for each in (first, second)])
        # e = admittance h of light that goes on, h = impedance e.
        self._admittance = self._faces(indices[1])[0]
        face = self._faces(indices[0])
        self._impedance = face[1]
        lit = 1 if along_x else 0
        at = np.flatnonzero((self._sectors[lit].m == 0) & (self._sectors[lit].n == 0))[0] + lit * self._first
        self._light = np.zeros(len(self._k2), complex)
        self._light[at] = 1 / np.sqrt(face[0][at, at].real)

    def _slope(self, rows: _Sector, columns: _Sector) -> sparse.csr_array:
        """Derivative along y."""
        return self._joined(rows, columns, -1, -self._step * columns.n)

    def _slope_x(self, columns: _Sector, rows: _Sector) -> sparse.csr_array:
        """Derivative along x, which makes odd functions of even ones."""
        return self._joined(rows, columns, 1, (-1 if columns.even else 1) * self._step * columns.m)

    @staticmethod
    def _joined(rows: _Sector, columns: _Sector, turn: int, value: np.ndarray) -> sparse.csr_array:
        place = {key: i for i, key in enumerate(zip(rows.m.tolist(), rows.n.tolist(), strict=True))}
        found = [place.get(key, -1) for key in zip(columns.m.tolist(), (turn * columns.n).tolist(), strict=True)]
        row, kept = np.array(found), np.array(found) >= 0
        column = np.arange(len(columns.m))[kept]
        return sparse.csr_array((value[kept], (row[kept], column)), (len(rows.m), len(columns.m)))

    def _faces(self, index: float) -> tuple[sparse.csr_array, sparse.csr_array]:
        q = np.sqrt((index * self._omega) ** 2 - self._k2 + 0j)
        one = sparse.eye_array(len(q))
        admittance = sparse.diags_array(1 / q) @ (self._omega**2 * one - self._curl.T @ self._curl / index**2)
        impedance = sparse.diags_array(1 / q) @ (index**2 * one - self._divergences / self._omega**2)
        return admittance.tocsr(), impedance.tocsr()

    def solve(
        self, permittivity: Float[np.ndarray, "y x"], depth_m: float, walls: Float[np.ndarray, "3 y x"], reach: int
    ) -> MirroredOrders:
        """Transmit light.

        Args:
            permittivity: of every pixel of the layer; its own mirror image.
            depth_m: thickness of the layer.
            walls: of `products_of_directions`, of this permittivity or of one nearby.
            reach: orders from -reach to reach are told.

        Raises:
            InputError: the permittivity has another size, is not positive or not its own mirror image.
        """
        self._require(permittivity)
        with threadpool_limits(1):
            solution = self._solve(self._media(permittivity, walls), depth_m)
            return self._orders(solution[1], reach)

    def gradients(
        self,
        permittivity: Float[np.ndarray, "y x"],
        depth_m: float,
        walls: Float[np.ndarray, "3 y x"],
        reach: int,
        weights: Callable[[Float[np.ndarray, "y x"]], Float[np.ndarray, "number y x"]],
    ) -> tuple[MirroredOrders, list[MirroredGradient]]:
        """Transmit light, and tell how numbers that depend on its orders change with the layer.

        Args:
            permittivity: as in `solve`.
            depth_m: as in `solve`.
            walls: as in `solve`; they are taken as constant, as fmmax takes its directions.
            reach: as in `solve`.
            weights: makes the derivatives of the numbers by each order from the orders; those by m and -m are added.

        Returns:
            The orders, and a gradient per number. The first costs about a quarter more than the orders alone.

        Raises:
            InputError: as in `solve`.
        """
        self._require(permittivity)
        with threadpool_limits(1):
            media = self._media(permittivity, walls)
            factors, h = self._solve(media, depth_m)
            orders = self._orders(h, reach)
            e, selection = self._admittance @ h, self._selection(reach)
            found = []
            for each in weights(orders.orders):
                folded = each[:, reach:].copy()
                folded[:, 1:] += each[:, :reach][:, ::-1]
                weight = np.tile(folded.ravel(), 2)
                source = selection.T @ (weight * np.conj(selection @ e))
                source += self._admittance.T @ (selection.T @ (weight * np.conj(selection @ h)))
                adjoint = scipy.linalg.lu_solve(factors, source, trans=1)
                found.append(self._gradient(media, permittivity, depth_m, (h, e), adjoint))
            return orders, found

    def _require(self, permittivity: np.ndarray) -> None:
        fits = permittivity.shape == self._shape and permittivity.min() > 0
        if not fits or not np.allclose(permittivity, np.roll(permittivity[:, ::-1], 1, 1), rtol=1e-6, atol=0):
            rule = f"a layer has {self._shape[0]} x {self._shape[1]} positive permittivities, and a mirror at column 0"
            raise InputError("permittivity", rule, f"shape {permittivity.shape}", "Give such an array.")

    def _media(self, permittivity: np.ndarray, walls: np.ndarray) -> _Media:
        (first, _), (_, second) = self._products
        inverses = tuple(scipy.linalg.inv(each.matrix(1 / permittivity)) for each in (first, second))
        laurent = [each.matrix(permittivity) for each in (first, second)]
        across = scipy.linalg.inv(laurent[0])
        xx, yy, xy = walls
        (upper, beside), (below, lower) = self._products
        product = np.block([[upper.matrix(xx), beside.matrix(xy)], [below.matrix(xy), lower.matrix(yy)]])
        cut = self._first
        g = np.concatenate([(inverses[0] - laurent[0]) @ product[:cut], (inverses[1] - laurent[1]) @ product[cut:]])
        g[:cut, :cut] += laurent[0]
        g[cut:, cut:] += laurent[1]
        g -= self._divergences.toarray() / self._omega**2
        b = -(self._curl.T @ (self._curl.T @ across.T).T)
        b[np.diag_indices_from(b)] += self._omega**2
        single = [each.astype(np.float32) for each in (g, b, across, *inverses, product)]
        return _Media(single[0], single[1], single[2], (single[3], single[4]), single[5])

    def _solve(self, media: _Media, depth_m: float) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Factors of the matrix that takes h behind the layer to twice the light before it, and h behind the layer."""
        g, b = media.g, media.b
        depth = depth_m / self._unit_m
        cosine, sine, both = _waves(g @ b, depth)
        matrix = cosine.astype(np.complex64)
        matrix -= 1j * _right(sine @ g, self._admittance)
        electric = -1j * (b @ sine) - _right(b @ (both @ g), self._admittance)
        matrix += self._impedance @ (electric + self._admittance.toarray())
        factors = scipy.linalg.lu_factor(matrix.astype(np.complex64), overwrite_a=True, check_finite=False)
        return factors, scipy.linalg.lu_solve(factors, 2 * self._light.astype(np.complex64))

    def _selection(self, reach: int) -> sparse.csr_array:
        """Matrix to the orders (component, n from -reach to reach, m from 0) in exponentials."""
        blocks = []
        for sector in self._sectors:
            place = {key: i for i, key in enumerate(zip(sector.m.tolist(), sector.n.tolist(), strict=True))}
            rows, columns, values = [], [], []
            for at, (n, m) in enumerate((n, m) for n in range(-reach, reach + 1) for m in range(reach + 1)):
                half = np.sqrt(0.5) if m else 1.0
                for key, value in (((m, abs(n)), 1.0), ((m, -abs(n)), -1j * np.sign(n))):
                    if key in place and value:
                        rows.append(at)
                        columns.append(place[key])
                        values.append(half * (np.sqrt(0.5) if n else 1.0) * value)
            count = (2 * reach + 1) * (reach + 1)
            blocks.append(sparse.csr_array((values, (rows, columns)), (count, len(sector.m))))
        return sparse.block_diag(blocks).tocsr()

    def _orders(self, h: np.ndarray, reach: int) -> MirroredOrders:
        e, selection = self._admittance @ h, self._selection(reach)
        power = (np.conj(selection @ e) * (selection @ h)).real.reshape(2, 2 * reach + 1, reach + 1).sum(0)
        return MirroredOrders(np.concatenate([power[:, :0:-1], power], 1), float(np.vdot(e, h).real))

    def _gradient(
        self,
        media: _Media,
        permittivity: np.ndarray,
        depth_m: float,
        behind: tuple[np.ndarray, np.ndarray],
        adjoint: np.ndarray,
    ) -> MirroredGradient:
        depth = depth_m / self._unit_m
        nodes, share = np.polynomial.legendre.leggauss(_NODES)
        place, share = depth * (1 + nodes) / 2, depth * share / 2
        highest = self._omega**2 * permittivity.max()
        bounds = (self._omega**2 * permittivity.min() - self._k2.max()) - 0.3 * highest, 1.3 * highest
        before = adjoint, self._impedance.T @ adjoint
        squared = media.g @ media.b
        h, e = _fields(media.g, media.b, squared, behind, np.append(depth - place, depth), bounds)
        h, e, h0, e0 = h[:, :-1], e[:, :-1], h[:, -1], e[:, -1]
        first, second = _fields(media.b.T, media.g.T, squared.T, before, place, bounds)
        # d(number) = Re(i sum(share (first . dG e + second . dB h))): products of few real columns.
        left, right = _real(1j * first * share, e)
        cut = self._first
        walled = media.walls @ right
        total = np.zeros(self._shape)
        inner = np.zeros(self._shape)
        for k, own in enumerate((slice(None, cut), slice(cut, None))):
            product = self._products[k][k]
            total += product.adjoint(left[own] @ (right[own] - walled[own]).T)
            inner += product.adjoint(-(media.inverse[k].T @ left[own]) @ (media.inverse[k] @ walled[own]).T)
        left, right = _real(1j * second * share, h)
        left, right = media.across.T @ (self._curl @ left), media.across @ (self._curl @ right)
        total += self._products[0][0].adjoint(left @ right.T)
        slope = (1j * (adjoint @ _thin(media.g, e0) + before[1] @ _thin(media.b, h0))).real
        return MirroredGradient(total - inner / permittivity**2, inner, float(slope / self._unit_m))

    def products_of_directions(self, permittivity: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "3 y x"]:
        """Products xx, yy and xy of directions along the walls: fmmax's JONES_DIRECT_FOURIER, the real part of xy.

        Args:
            permittivity: of every pixel.
        """
        m, n = self._all
        gradient = [(np.roll(permittivity, -1, k) - np.roll(permittivity, 1, k)) / 2 for k in (1, 0)]
        size = 2 * (2 * int(abs(m).max()) + 1)

        def raster(waves: np.ndarray, count: int) -> np.ndarray:
            full = np.zeros((count, count), complex)
            full[n, m] = waves
            return np.fft.ifft2(full) * count**2

        across = np.stack([raster((np.fft.fft2(each) / each.size)[n, m], size) for each in gradient])
        weight = np.sqrt((abs(across) ** 2).sum(0))
        weight /= weight.max() or 1.0
        target = _jones(np.stack([across[1], -across[0]]))
        wave = np.fft.fft2(weight) / weight.size
        matrix = wave[n[:, None] - n, m[:, None] - m]
        matrix[np.diag_indices_from(matrix)] += _JONES_WEIGHT / len(m) * (2 * np.pi) ** 2 * (m**2 + n**2)
        given = np.stack([(np.fft.fft2(weight * each) / weight.size)[n, m] for each in target], 1)
        with threadpool_limits(1):
            found = scipy.linalg.solve(matrix, given, assume_a="her")
        x, y = (raster(each, self._shape[0]) for each in found.T)
        norm = abs(x) ** 2 + abs(y) ** 2
        norm = np.where(norm > 1e-8 * norm.max(), norm, np.inf)
        return np.stack([abs(x) ** 2, abs(y) ** 2, np.real(np.conj(x) * y)]) / norm


def _jones(field: np.ndarray) -> np.ndarray:
    """Directions of a field, made elliptic where walls are equally far and circular where there are none."""
    norm = np.sqrt((abs(field) ** 2).sum(0))
    near = norm <= 1e-8
    x, y = (np.where(near, np.sqrt(0.5), each.real / np.where(near, 1.0, norm)) for each in field)
    tilt = np.where(near, np.pi / 4, np.pi / 8 * (1 + np.cos(np.pi * np.where(near, 0.0, 1.0))))
    turn = x + 1j * y
    turn = turn / abs(turn)
    cosine, sine = np.cos(tilt), 1j * np.sin(tilt)
    return turn * np.stack([x * cosine - y * sine, y * cosine + x * sine])


def _waves(squared: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """cos(d q), sin(d q) / q and (1 - cos(d q)) / q² of the matrix q²."""
    step = depth / 2**_HALVINGS
    x = squared * step**2
    x2 = x @ x
    x3 = x2 @ x
    one = np.identity(len(x), x.dtype)

    def series(first: int) -> np.ndarray:
        c = [(-1) ** k / math.factorial(2 * k + first) for k in range(9)]
        found = c[6] * one + c[7] * x + c[8] * x2
        for k in (3, 0):
            found = found @ x3
            found += c[k] * one + c[k + 1] * x + c[k + 2] * x2
        return found

    cosine, sine = series(0), step * series(1)
    for _ in range(_HALVINGS - 1):
        cosine, sine = 2 * (cosine @ cosine) - one, 2 * (sine @ cosine)
    return 2 * (cosine @ cosine) - one, 2 * (sine @ cosine), 2 * (sine @ sine)


def _right(matrix: np.ndarray, thin: sparse.csr_array) -> np.ndarray:
    return (thin.T @ matrix.T).T


def _real(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Real columns whose product left @ right.T is the real part of that of complex ones."""
    pairs = ((np.real(left), -np.imag(left)), (np.real(right), np.imag(right)))
    first, second = (np.concatenate(pair, 1).astype(np.float32) for pair in pairs)
    return first, second


def _fields(
    g: np.ndarray,
    b: np.ndarray,
    squared: np.ndarray,
    known: tuple[np.ndarray, np.ndarray],
    way: np.ndarray,
    bounds: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Both fields at distances before a place where they are known: exp(-i A s), A = [[0, G], [B, 0]]; squared: G B."""
    h, e = known
    middle, half = (bounds[1] + bounds[0]) / 2, (bounds[1] - bounds[0]) / 2
    given = np.stack([h, _thin(g, e)], 1)
    given = np.concatenate([np.real(given), np.imag(given)], 1).astype(g.dtype)

    def times(columns: np.ndarray) -> np.ndarray:
        return (squared @ columns - np.float32(middle) * columns) / np.float32(half)

    chain = [given, times(given)]
    while len(chain) < _DEGREE:
        chain.append(2 * times(chain[-1]) - chain[-2])
    columns = np.stack(chain)
    columns = columns[..., :2] + 1j * columns[..., 2:]
    points = np.cos(np.pi * (np.arange(_DEGREE) + 0.5) / _DEGREE)
    q = np.sqrt(middle + half * points + 0j)[:, None]
    values = np.stack([np.cos(q * way), np.sin(q * way) / q, (1 - np.cos(q * way)) / q**2]).real
    weights = np.einsum("fps,kp->fks", values, np.cos(np.arange(_DEGREE)[:, None] * np.arccos(points))) * 2 / _DEGREE
    weights[:, 0] /= 2
    cosine, sine, both = np.einsum("fks,knv->fnvs", weights, columns)
    found = cosine[:, 0] - 1j * sine[:, 1]
    return found, e[:, None] - _thin(b, both[:, 1] + 1j * sine[:, 0])


def _thin(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Product of a real matrix with few complex columns, without a complex copy of the matrix."""
    found = matrix @ np.stack([np.real(columns), np.imag(columns)], -1).reshape(len(columns), -1).astype(matrix.dtype)
    return found[:, ::2].reshape(columns.shape) + 1j * found[:, 1::2].reshape(columns.shape)
