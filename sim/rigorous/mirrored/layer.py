"""A layer that is its own mirror image, between two half-spaces: its orders, and how they change with the layer.

Matrices are in single precision, and fields of the highest orders grow through a layer: orders are right to 1e-5 of the
incident light where they grow by less than exp(12), and to 1e-4 at the limits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from fab.errors import InputError
from sim.rigorous.mirrored.directions import products_of_directions
from sim.rigorous.mirrored.sectors import Product, Sector
from sim.rigorous.mirrored.waves import cosine_and_sine, fields_before, real_columns, times_columns, times_sparse

_NODES = 24  # of the depth, for the integral of the gradient
_MARGIN = 0.3  # for eigenvalues of G B beyond those of an even layer, over its highest
# Largest exponents to which fields may grow or turn through the layer. Measured against fmmax and the closed form of a
# plate: orders and their sum are off by less than 1e-4 there on all processors tried, by 1e-3 at 18 or 38, and nonsense
# at 21 or 50.
_MOST_GROWTH, _MOST_TURN = 14.0, 30.0
# The largest growth with the margin, for gradients: the derivative by the depth is off by up to 5 % there.
_MOST_ADJOINT = 12.0
_GRAZING = 1e-12  # squared wave number across the layer, over that of light; at 2e-10 orders are right to 1e-6


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

    How deep a layer may be: with k the highest transverse wave number of an order, g² = k² - (2 pi / wavelength)² times
    the least permittivity and p² = (2 pi / wavelength)² times the highest, a depth d must have g d <= 15 and p d <= 30,
    and for gradients sqrt(g² + 0.3 p²) d <= 12.

    Args:
        pixels: of a raster, along either axis; odd or even, and more than four times the number of the highest order.
        period_m: of the cell.
        wavelength_m: vacuum wavelength.
        indices: refractive indices before and behind the layer.
        terms: orders that are kept, about, as in `crossed_orders`.
        along_x: light whose electric field is along x, instead of along y.

    Raises:
        InputError: too few pixels for the terms, or an order at grazing in one of the half-spaces.
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
        self._all, highest = (m[inside], n[inside]), int(m[inside].max())
        if pixels <= 4 * highest:
            rule = f"{terms} terms have orders to {highest}, and so ask for more than {4 * highest} pixels"
            raise InputError("pixels", rule, pixels, "Draw a finer raster, or keep fewer terms.")
        sectors = [Sector(m[k], n[k], even) for even, k in ((True, inside & (m >= 0)), (False, inside & (m > 0)))]
        first, second = sectors[::-1] if along_x else sectors
        self._first, self._sectors = len(first.m), (first, second)
        self._products = [[Product(row, column, self._shape) for column in (first, second)] for row in (first, second)]
        self._curl = sparse.hstack([self._slope(first, first), -self._slope_x(first, second)]).tocsr()
        divergence = sparse.hstack([self._slope_x(second, first), self._slope(second, second)])
        self._divergences = (divergence.T @ divergence).tocsr()
        self._k2 = self._step**2 * np.concatenate([each.m**2 + each.n**2 for each in (first, second)])
        # e = admittance h of light that goes on, h = impedance e.
        before, behind = (np.sqrt((index * self._omega) ** 2 - self._k2 + 0j) for index in indices)
        if min(abs(before).min(), abs(behind).min()) ** 2 <= _GRAZING * self._omega**2:
            rule, got = "no order may leave at grazing", f"a period of {period_m / wavelength_m:.12g} wavelengths"
            raise InputError("period_m", rule, got, "Change the period or the wavelength by a millionth.")
        one, curls = sparse.eye_array(len(self._k2)), self._curl.T @ self._curl
        self._admittance = (sparse.diags_array(1 / behind) @ (self._omega**2 * one - curls / indices[1] ** 2)).tocsr()
        long = self._divergences / self._omega**2
        self._impedance = (sparse.diags_array(1 / before) @ (indices[0] ** 2 * one - long)).tocsr()
        lit = 1 if along_x else 0
        at = np.flatnonzero((self._sectors[lit].m == 0) & (self._sectors[lit].n == 0))[0] + lit * self._first
        self._light = np.zeros(len(self._k2), complex)
        self._light[at] = 1 / np.sqrt((1 / before[at] * self._omega**2).real)

    def _slope(self, rows: Sector, columns: Sector) -> sparse.csr_array:
        """Derivative along y."""
        return self._joined(rows, columns, -1, -self._step * columns.n)

    def _slope_x(self, rows: Sector, columns: Sector) -> sparse.csr_array:
        """Derivative along x, which makes odd functions of even ones."""
        return self._joined(rows, columns, 1, (-1 if columns.even else 1) * self._step * columns.m)

    @staticmethod
    def _joined(rows: Sector, columns: Sector, turn: int, value: np.ndarray) -> sparse.csr_array:
        place = rows.places()
        found = [place.get(key, -1) for key in zip(columns.m.tolist(), (turn * columns.n).tolist(), strict=True)]
        row, kept = np.array(found), np.array(found) >= 0
        column = np.arange(len(columns.m))[kept]
        return sparse.csr_array((value[kept], (row[kept], column)), (len(rows.m), len(columns.m)))

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
            InputError: the permittivity has another size, is not positive or not its own mirror image, or the layer is
                too deep.
        """
        self._require(permittivity, depth_m)
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
        self._require(permittivity, depth_m)
        self._require_shallow(depth_m, -self._bounds(permittivity)[0], _MOST_ADJOINT)
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

    def _bounds(self, permittivity: np.ndarray, margin: float = _MARGIN) -> tuple[float, float]:
        """The least and the largest eigenvalue that G B may have."""
        highest = self._omega**2 * permittivity.max()
        least = self._omega**2 * permittivity.min() - self._k2.max()
        return least - margin * highest, (1 + margin) * highest

    def _require(self, permittivity: np.ndarray, depth_m: float) -> None:
        fits = permittivity.shape == self._shape and permittivity.min() > 0
        if not fits or not np.allclose(permittivity, np.roll(permittivity[:, ::-1], 1, 1), rtol=1e-6, atol=0):
            rule = f"a layer has {self._shape[0]} x {self._shape[1]} positive permittivities, and a mirror at column 0"
            raise InputError("permittivity", rule, f"shape {permittivity.shape}", "Give such an array.")
        least, most = self._bounds(permittivity, 0.0)
        self._require_shallow(depth_m, -least, _MOST_GROWTH)
        self._require_shallow(depth_m, most, _MOST_TURN)

    def _require_shallow(self, depth_m: float, square: float, most: float) -> None:
        """Refuse a layer through which a wave number of that square grows or turns too much."""
        exponent = depth_m / self._unit_m * np.sqrt(max(square, 0.0))
        if not 0 <= exponent <= most:
            rule = f"in single precision, fields may change through a layer by an exponent of at most {most:g}"
            raise InputError("depth_m", rule, f"{exponent:.3g}", "Keep fewer terms, or give a shallower layer.")

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
        cosine, sine, both = cosine_and_sine(g @ b, depth)
        matrix = cosine.astype(np.complex64)
        matrix -= 1j * times_sparse(sine @ g, self._admittance)
        electric = -1j * (b @ sine) - times_sparse(b @ (both @ g), self._admittance)
        matrix += self._impedance @ (electric + self._admittance.toarray())
        factors = scipy.linalg.lu_factor(matrix.astype(np.complex64), overwrite_a=True, check_finite=False)
        return factors, scipy.linalg.lu_solve(factors, 2 * self._light.astype(np.complex64))

    def _selection(self, reach: int) -> sparse.csr_array:
        """Matrix to the orders (component, n from -reach to reach, m from 0) in exponentials."""
        blocks = []
        for sector in self._sectors:
            place = sector.places()
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
        bounds = self._bounds(permittivity)
        before = adjoint, self._impedance.T @ adjoint
        squared = media.g @ media.b
        h, e = fields_before(media.g, media.b, squared, behind, np.append(depth - place, depth), bounds)
        h, e, h0, e0 = h[:, :-1], e[:, :-1], h[:, -1], e[:, -1]
        first, second = fields_before(media.b.T, media.g.T, squared.T, before, place, bounds)
        # d(number) = Re(i sum(share (first . dG e + second . dB h))): products of few real columns.
        left, right = real_columns(1j * first * share, e)
        cut = self._first
        walled = media.walls @ right
        total = np.zeros(self._shape)
        inner = np.zeros(self._shape)
        for k, own in enumerate((slice(None, cut), slice(cut, None))):
            product = self._products[k][k]
            total += product.adjoint(left[own] @ (right[own] - walled[own]).T)
            inner += product.adjoint(-(media.inverse[k].T @ left[own]) @ (media.inverse[k] @ walled[own]).T)
        left, right = real_columns(1j * second * share, h)
        left, right = media.across.T @ (self._curl @ left), media.across @ (self._curl @ right)
        total += self._products[0][0].adjoint(left @ right.T)
        slope = (1j * (adjoint @ times_columns(media.g, e0) + before[1] @ times_columns(media.b, h0))).real
        return MirroredGradient(total - inner / permittivity**2, inner, float(slope / self._unit_m))

    def products_of_directions(self, permittivity: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "3 y x"]:
        """Products xx, yy and xy of directions along the walls, made of the layer's orders.

        Args:
            permittivity: of every pixel.
        """
        return products_of_directions(permittivity, self._all)
