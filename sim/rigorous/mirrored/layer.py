"""A layer that is its own mirror image, between two half-spaces: its orders, and how they change with the layer.

Matrices are in single precision: 1e-6 of the incident light.
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
        sectors = [Sector(m[k], n[k], even) for even, k in ((True, inside & (m >= 0)), (False, inside & (m > 0)))]
        first, second = sectors[::-1] if along_x else sectors
        self._first, self._sectors = len(first.m), (first, second)
        self._products = [[Product(row, column, self._shape) for column in (first, second)] for row in (first, second)]
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

    def _slope(self, rows: Sector, columns: Sector) -> sparse.csr_array:
        """Derivative along y."""
        return self._joined(rows, columns, -1, -self._step * columns.n)

    def _slope_x(self, columns: Sector, rows: Sector) -> sparse.csr_array:
        """Derivative along x, which makes odd functions of even ones."""
        return self._joined(rows, columns, 1, (-1 if columns.even else 1) * self._step * columns.m)

    @staticmethod
    def _joined(rows: Sector, columns: Sector, turn: int, value: np.ndarray) -> sparse.csr_array:
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
