"""Fields of one symmetry between two half-spaces, in cosines and sines, and a layer's equations for them.

Lengths are in vacuum wavelengths. A field is h = (Hx, Hy), then e = (-Ey, Ex), both in the order of the sectors.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from jaxtyping import Complex, Float, Int

from sim.rigorous.mirrored.sectors import Product, Sector

_GRAZING = 1e-12  # squared wave number across the layer, over that of light; at 2e-10 orders are right to 1e-6


class Media(NamedTuple):
    """A layer in orders.

    Attributes:
        g: matrix of h' = i g e.
        b: matrix of e' = i b h.
        across: matrix of 1 / permittivity for the field along the light.
        inverse: inverses of the matrices of 1 / permittivity, of either sector.
        walls: matrix of the products of directions.
    """

    g: Float[np.ndarray, "field field"]
    b: Float[np.ndarray, "field field"]
    across: Float[np.ndarray, "along along"]
    inverse: tuple[Float[np.ndarray, "first first"], Float[np.ndarray, "second second"]]
    walls: Float[np.ndarray, "field field"]

    def single(self) -> "Media":
        """The same in single precision."""
        g, b, across, one, other, walls = (
            each.astype(np.float32) for each in (self.g, self.b, self.across, *self.inverse, self.walls)
        )
        return Media(g, b, across, (one, other), walls)


class Basis:
    """Cosines and sines of a field with a mirror, or with two, that light at normal incidence excites.

    Where an order `is_grazing`, there are none.

    Args:
        pixels: of a raster along either axis; more than four times the number of the highest order.
        period: of the square cell.
        indices: refractive indices before and behind the layers.
        terms: orders that are kept, about: those in a circle.
        along_x: light whose electric field is along x, instead of along y.
        also_along_y: the layers are alike under y -> -y as well as under x -> -x.

    Attributes:
        omega: wave number of light in vacuum.
        k2: squared transverse wave number of every function.
        cut: functions of the first component; those of the second follow.
        curl: matrix from h to i omega times the displacement along the light.
        divergences: matrix of the second derivatives that the magnetic field along the light brings.
        admittance: e over h of light that goes on behind the layers.
        impedance: h over e of light that comes from before them.
        light: h of the incident light, of unit power.
        electric: e of the same.
        numbers: (m, n) along x and y of all orders that are kept.
        products: matrices of multiplication between the sectors of both components.
        of_along: the same for the electric field along the light.
    """

    def __init__(
        self,
        pixels: int,
        period: float,
        indices: tuple[float, float],
        terms: int,
        *,
        along_x: bool,
        also_along_y: bool = False,
    ) -> None:
        self.omega, self._step = 2 * np.pi, 2 * np.pi / period
        self.numbers = m, n = numbers_of(terms)

        def sector(even: bool, even_y: bool) -> Sector:
            kept = m >= 0 if even else m > 0
            if also_along_y:
                kept &= n >= 0 if even_y else n < 0
            return Sector(m[kept], n[kept], even)

        # E along x and H along y are even under both mirrors, E along y and H along x odd, where light is along x.
        even = not along_x
        first, second = sector(even, even), sector(not even, not even)
        along, magnetic = sector(even, not even), sector(not even, even)  # of the fields along the light
        self.cut, self._sectors = len(first.m), (first, second)
        shape = (pixels, pixels)
        self.products = [[Product(row, column, shape) for column in (first, second)] for row in (first, second)]
        self.of_along = Product(along, along, shape) if also_along_y else self.products[0][0]
        self.curl = sparse.hstack([self._slope(along, first), -self._slope_x(along, second)]).tocsr()
        divergence = sparse.hstack([self._slope_x(magnetic, first), self._slope(magnetic, second)])
        self.divergences = (divergence.T @ divergence).tocsr()
        self.k2 = self._step**2 * np.concatenate([each.m**2 + each.n**2 for each in (first, second)])
        before, behind = (np.sqrt((index * self.omega) ** 2 - self.k2 + 0j) for index in indices)
        one, curls = sparse.eye_array(len(self.k2)), self.curl.T @ self.curl
        self.admittance = (sparse.diags_array(1 / behind) @ (self.omega**2 * one - curls / indices[1] ** 2)).tocsr()
        long = self.divergences / self.omega**2
        self.impedance = (sparse.diags_array(1 / before) @ (indices[0] ** 2 * one - long)).tocsr()
        lit = 1 if along_x else 0
        at = np.flatnonzero((self._sectors[lit].m == 0) & (self._sectors[lit].n == 0))[0] + lit * self.cut
        self.light: Complex[np.ndarray, " field"] = np.zeros(len(self.k2), complex)
        self.light[at] = 1 / np.sqrt((1 / before[at] * self.omega**2).real)
        self.electric = np.divide(self.light, self.impedance.diagonal(), where=self.light != 0, out=0 * self.light)

    def _slope(self, rows: Sector, columns: Sector) -> sparse.csr_array:
        """Derivative along y."""
        return _joined(rows, columns, -1, -self._step * columns.n)

    def _slope_x(self, rows: Sector, columns: Sector) -> sparse.csr_array:
        """Derivative along x, which makes odd functions of even ones."""
        return _joined(rows, columns, 1, (-1 if columns.even else 1) * self._step * columns.m)

    def media(
        self,
        permittivity: Float[np.ndarray, "y x"],
        inverse_permittivity: Float[np.ndarray, "y x"],
        walls: Float[np.ndarray, "3 y x"],
    ) -> Media:
        """A layer.

        Args:
            permittivity: of every pixel; as all of these, the values of a function whose waves are told.
            inverse_permittivity: 1 / permittivity.
            walls: products xx, yy and xy of directions along the walls.
        """
        (first, beside), (below, second) = self.products
        own = first, second
        inverse = tuple(scipy.linalg.inv(each.matrix(inverse_permittivity)) for each in own)
        laurent = [each.matrix(permittivity) for each in own]
        across = scipy.linalg.inv(self.of_along.matrix(permittivity))
        xx, yy, xy = walls
        product = np.block([[first.matrix(xx), beside.matrix(xy)], [below.matrix(xy), second.matrix(yy)]])
        parts = slice(None, self.cut), slice(self.cut, None)
        g = np.concatenate(
            [(one - other) @ product[part] for one, other, part in zip(inverse, laurent, parts, strict=True)]
        )
        for matrix, part in zip(laurent, parts, strict=True):
            g[part, part] += matrix
        g -= self.divergences.toarray() / self.omega**2
        b = -(self.curl.T @ (self.curl.T @ across.T).T)
        b[np.diag_indices_from(b)] += self.omega**2
        return Media(g, b, across, inverse, product)

    def to_orders(self, reach: int) -> sparse.csr_array:
        """Matrix to the orders (component, n from -reach to reach, m from 0) in exponentials.

        Args:
            reach: highest number of an order.
        """
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

    def orders(
        self, h: Complex[np.ndarray, " field"], e: Complex[np.ndarray, " field"], reach: int
    ) -> Float[np.ndarray, "y x"]:
        """Power of the orders from -reach to reach in light that goes on.

        Args:
            h: magnetic field.
            e: electric field.
            reach: highest number of an order that is told.
        """
        matrix = self.to_orders(reach)
        power = (np.conj(matrix @ e) * (matrix @ h)).real.reshape(2, 2 * reach + 1, reach + 1).sum(0)
        return np.concatenate([power[:, :0:-1], power], 1)


def is_grazing(period: float, indices: tuple[float, float], terms: int) -> bool:
    """Whether one of the orders travels along a face, for which the equations have no solution.

    Args:
        period: of the square cell, in vacuum wavelengths.
        indices: refractive indices before and behind the layers.
        terms: orders that are kept.
    """
    m, n = numbers_of(terms)
    squares = (m**2 + n**2) / period**2
    return any(bool(np.abs(index**2 - squares).min() <= _GRAZING) for index in indices)


def numbers_of(terms: int) -> tuple[Int[np.ndarray, " order"], Int[np.ndarray, " order"]]:
    """Numbers (m, n) along x and y of the orders in a circle.

    Args:
        terms: area of the circle: about as many orders.
    """
    reach = int(np.ceil(np.sqrt(terms / np.pi)))
    n, m = (each.ravel() for each in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    inside = m**2 + n**2 < terms / np.pi
    return m[inside], n[inside]


def _joined(rows: Sector, columns: Sector, turn: int, value: np.ndarray) -> sparse.csr_array:
    place = rows.places()
    found = [place.get(key, -1) for key in zip(columns.m.tolist(), (turn * columns.n).tolist(), strict=True)]
    row, kept = np.array(found), np.array(found) >= 0
    column = np.arange(len(columns.m))[kept]
    return sparse.csr_array((value[kept], (row[kept], column)), (len(rows.m), len(columns.m)))
