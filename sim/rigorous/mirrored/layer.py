"""A layer that is its own mirror image, between two half-spaces: its orders, and how they change with the layer.

Matrices are in single precision, and fields of the highest orders grow through a layer: orders are right to 1e-5 of the
incident light where they grow by less than exp(12), and to 1e-4 at the limits.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from fab.errors import InputError
from sim.rigorous.mirrored.basis import Basis, Media, is_grazing, numbers_of
from sim.rigorous.mirrored.directions import products_of_directions
from sim.rigorous.mirrored.waves import cosine_and_sine, fields_before, real_columns, times_columns, times_sparse

_NODES = 24  # of the depth, for the integral of the gradient
_MARGIN = 0.3  # for eigenvalues of G B beyond those of an even layer, over its highest
# Largest exponents to which fields may grow or turn through the layer. Measured against fmmax and the closed form of a
# plate: orders and their sum are off by less than 1e-4 there on all processors tried, by 1e-3 at 18 or 38, and nonsense
# at 21 or 50.
_MOST_GROWTH, _MOST_TURN = 14.0, 30.0
# The largest growth with the margin, for gradients: the derivative by the depth is off by up to 5 % there.
_MOST_ADJOINT = 12.0


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
        highest = int(numbers_of(terms)[0].max())
        if pixels <= 4 * highest:
            rule = f"{terms} terms have orders to {highest}, and so ask for more than {4 * highest} pixels"
            raise InputError("pixels", rule, pixels, "Draw a finer raster, or keep fewer terms.")
        period = period_m / wavelength_m
        if is_grazing(period, indices, terms):
            rule, got = "no order may leave at grazing", f"a period of {period:.12g} wavelengths"
            raise InputError("period_m", rule, got, "Change the period or the wavelength by a millionth.")
        self._basis = Basis(pixels, period, indices, terms, along_x=along_x)

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
            solution = self._solve(self._basis.media(permittivity, 1 / permittivity, walls).single(), depth_m)
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
            media = self._basis.media(permittivity, 1 / permittivity, walls).single()
            factors, h = self._solve(media, depth_m)
            orders = self._orders(h, reach)
            e, selection = self._basis.admittance @ h, self._basis.to_orders(reach)
            found = []
            for each in weights(orders.orders):
                folded = each[:, reach:].copy()
                folded[:, 1:] += each[:, :reach][:, ::-1]
                weight = np.tile(folded.ravel(), 2)
                source = selection.T @ (weight * np.conj(selection @ e))
                source += self._basis.admittance.T @ (selection.T @ (weight * np.conj(selection @ h)))
                adjoint = scipy.linalg.lu_solve(factors, source, trans=1)
                found.append(self._gradient(media, permittivity, depth_m, (h, e), adjoint))
            return orders, found

    def _bounds(self, permittivity: np.ndarray, margin: float = _MARGIN) -> tuple[float, float]:
        """The least and the largest eigenvalue that G B may have."""
        highest = self._basis.omega**2 * permittivity.max()
        least = self._basis.omega**2 * permittivity.min() - self._basis.k2.max()
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

    def _solve(self, media: Media, depth_m: float) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Factors of the matrix that takes h behind the layer to twice the light before it, and h behind the layer."""
        g, b = media.g, media.b
        depth = depth_m / self._unit_m
        cosine, sine, both = cosine_and_sine(g @ b, depth)
        matrix = cosine.astype(np.complex64)
        matrix -= 1j * times_sparse(sine @ g, self._basis.admittance)
        electric = -1j * (b @ sine) - times_sparse(b @ (both @ g), self._basis.admittance)
        matrix += self._basis.impedance @ (electric + self._basis.admittance.toarray())
        factors = scipy.linalg.lu_factor(matrix.astype(np.complex64), overwrite_a=True, check_finite=False)
        return factors, scipy.linalg.lu_solve(factors, 2 * self._basis.light.astype(np.complex64))

    def _orders(self, h: np.ndarray, reach: int) -> MirroredOrders:
        e = self._basis.admittance @ h
        return MirroredOrders(self._basis.orders(h, e, reach), float(np.vdot(e, h).real))

    def _gradient(
        self,
        media: Media,
        permittivity: np.ndarray,
        depth_m: float,
        behind: tuple[np.ndarray, np.ndarray],
        adjoint: np.ndarray,
    ) -> MirroredGradient:
        depth = depth_m / self._unit_m
        nodes, share = np.polynomial.legendre.leggauss(_NODES)
        place, share = depth * (1 + nodes) / 2, depth * share / 2
        bounds = self._bounds(permittivity)
        before = adjoint, self._basis.impedance.T @ adjoint
        squared = media.g @ media.b
        h, e = fields_before(media.g, media.b, squared, behind, np.append(depth - place, depth), bounds)
        h, e, h0, e0 = h[:, :-1], e[:, :-1], h[:, -1], e[:, -1]
        first, second = fields_before(media.b.T, media.g.T, squared.T, before, place, bounds)
        # d(number) = Re(i sum(share (first . dG e + second . dB h))): products of few real columns.
        left, right = real_columns(1j * first * share, e)
        cut = self._basis.cut
        walled = media.walls @ right
        total = np.zeros(self._shape)
        inner = np.zeros(self._shape)
        for k, own in enumerate((slice(None, cut), slice(cut, None))):
            product = self._basis.products[k][k]
            total += product.adjoint(left[own] @ (right[own] - walled[own]).T)
            inner += product.adjoint(-(media.inverse[k].T @ left[own]) @ (media.inverse[k] @ walled[own]).T)
        left, right = real_columns(1j * second * share, h)
        left, right = media.across.T @ (self._basis.curl @ left), media.across @ (self._basis.curl @ right)
        total += self._basis.products[0][0].adjoint(left @ right.T)
        slope = (1j * (adjoint @ times_columns(media.g, e0) + before[1] @ times_columns(media.b, h0))).real
        return MirroredGradient(total - inner / permittivity**2, inner, float(slope / self._unit_m))

    def products_of_directions(self, permittivity: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "3 y x"]:
        """Products xx, yy and xy of directions along the walls, made of the layer's orders.

        Args:
            permittivity: of every pixel.
        """
        return products_of_directions(permittivity, self._basis.numbers)
