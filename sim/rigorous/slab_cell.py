"""A relief of square cells in slabs of given thickness that repeats: its orders, and how they change with every cell.

Each slab of a cell is filled with glass, with air, or with a share of glass, which has the mean permittivity; so light
changes smoothly from one level of a staircase to the next, and is exact where every slab is full or empty. fmmax (MIT;
the extra `rigorous`) finds the modes and differentiates through them. Directions of walls are those of `crossed` and
are taken as constant. A row of cells that is alike along y keeps orders along x alone.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from threadpoolctl import threadpool_limits

from sim.rigorous.crossed import directions_of_walls, require_fmmax, travelling_terms
from sim.tracing import compiled_quickly

# Of a period and axis, in the raster that the permittivity is transformed from.
_SAMPLES, _ROW_SAMPLES = 256, 1024
# Highest wave number that is kept, over that which travels in the glass.
_WAVES, _ROW_WAVES = 1.1, 2.0
_GRAZING = 1e-7  # of a sine
_MATRICES = 90  # of twice the terms squared that a gradient keeps per slab; 85 were measured


def usual_terms(shape: tuple[int, int], cell_m: float, wavelength_m: float, index: float) -> int:
    """Number of orders that a cell is solved with unless another one is asked for.

    Args:
        shape: cells along y and x; one where all are alike.
        cell_m: width of a cell.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
    """
    if 1 in shape:
        return 2 * int(np.ceil(_ROW_WAVES * index * max(shape) * cell_m / wavelength_m)) + 1
    return travelling_terms(shape, cell_m, wavelength_m, index, _WAVES)


def gradient_bytes(terms: int, slabs: int) -> int:
    """Memory that a gradient of a cell takes, about."""
    return _MATRICES * slabs * (2 * terms) ** 2 * np.dtype(np.complex128).itemsize


def _in_order() -> dict[str, Any]:
    """Options of `jax.jit`: one after another, since matrices that LAPACK solves at once may wait for each other."""
    if jax.default_backend() != "cpu":
        return {}
    return {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED", **compiled_quickly()}


class SlabCell:
    """Cells of glass between air and glass, lit from the air at normal incidence.

    Args:
        shape: cells along y and x; one where all are alike.
        cell_m: width of a cell.
        thickness_m: of every slab, the one nearest to the air first.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        terms: orders that are kept, about; those nearest to the 0th. Compare two numbers to be sure.

    Raises:
        InputError: fmmax is missing.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        cell_m: float,
        thickness_m: Float[np.ndarray, " slab"],
        wavelength_m: float,
        index: float,
        terms: int,
    ) -> None:
        self._fmmax: Any = require_fmmax()
        self._index, self._shape = index, shape
        self._thickness = np.asarray(thickness_m, np.float64) / wavelength_m
        # What is alike along an axis may have any period there.
        self._period = tuple((count if count > 1 else max(shape)) * cell_m / wavelength_m for count in shape)
        self._samples = tuple(
            max(2, -(-(_ROW_SAMPLES if 1 in shape else _SAMPLES) // count)) if count > 1 else 1 for count in shape
        )
        with jax.enable_x64(True):
            self._number = self._kept(terms)
        # A wave that travels along the faces has no modes to be told apart by.
        sines = np.hypot(*(self._number / self._period[::-1]).T)
        if any(np.abs(sines - each).min() < _GRAZING for each in (1.0, index)):
            self._period = tuple(period * (1 + 2 * _GRAZING) for period in self._period)
        self._transmit = jax.jit(self._transmitted, compiler_options=_in_order())
        self._judged: dict[Callable[[Any], Any], Any] = {}

    def _kept(self, terms: int) -> np.ndarray:
        """Orders `[order, x and y]`."""
        if 1 in self._shape:
            reach = terms // 2
            line, none = np.arange(-reach, reach + 1), np.zeros(2 * reach + 1, int)
            return np.stack([line, none] if self._shape[0] == 1 else [none, line], 1)
        expansion = self._fmmax.generate_expansion(self._lattice(), terms, self._fmmax.Truncation.CIRCULAR)
        return np.asarray(expansion.basis_coefficients)

    @property
    def number(self) -> Int[np.ndarray, "order 2"]:
        """`[order, y and x]` of every order that is kept."""
        return self._number[:, ::-1]

    @property
    def terms(self) -> int:
        """Number of orders that are kept."""
        return len(self._number)

    def transmitted(self, filled: Float[np.ndarray, "slab y x"]) -> Float[np.ndarray, "2 order"]:
        """Share of the power incident with its electric field along x or y that every transmitted order takes.

        Args:
            filled: share of glass of every cell in every slab, the one nearest to the air first.
        """
        with jax.enable_x64(True), threadpool_limits(1):
            return np.asarray(self._transmit(*self._media(filled)))

    def gradient(
        self, filled: Float[np.ndarray, "slab y x"], judge: Callable[[Any], Any]
    ) -> tuple[float, Float[np.ndarray, "2 order"], Float[np.ndarray, "slab y x"]]:
        """A number that depends on the transmitted orders, those orders, and its derivative by every share of glass.

        Args:
            filled: as in `transmitted`.
            judge: makes a jax scalar of what `transmitted` returns; compiled once for every function.
        """
        if judge not in self._judged:

            def judged(permittivity: Any, walls: Any) -> tuple[Any, Any]:
                orders = self._transmitted(permittivity, walls)
                return judge(orders), orders

            valued = jax.value_and_grad(judged, has_aux=True)
            self._judged[judge] = jax.jit(valued, compiler_options=_in_order())
        with jax.enable_x64(True), threadpool_limits(1):
            (value, orders), change = self._judged[judge](*self._media(filled))
            ny, nx = self._shape
            of_cells = np.asarray(change).reshape(len(filled), nx, self._samples[1], ny, self._samples[0]).sum((2, 4))
        return float(value), np.asarray(orders), of_cells.transpose(0, 2, 1) * (self._index**2 - 1)

    def _lattice(self) -> Any:
        y, x = self._period
        return self._fmmax.LatticeVectors(u=jnp.array([x, 0.0]), v=jnp.array([0.0, y]))

    def _media(self, filled: np.ndarray) -> tuple[Any, Any]:
        """Rasters `[slab, x, y]` of the permittivity, and directions of walls in them `[slab, x and y, x, y]`."""
        block = np.ones(self._samples[::-1])
        rasters = np.stack([np.kron(1 + (self._index**2 - 1) * each.T, block) for each in np.asarray(filled)])
        walls = np.stack([np.stack(directions_of_walls(each, max(self._samples))) for each in rasters])
        return jnp.asarray(rasters), jnp.asarray(walls, complex)

    def _transmitted(self, permittivity: Any, walls: Any) -> Array:
        fmmax, lattice = self._fmmax, self._lattice()

        def solved(permittivity: Any, formulation: Any) -> Any:
            return fmmax.eigensolve_isotropic_media(
                wavelength=jnp.asarray(1.0),
                in_plane_wavevector=jnp.zeros(2),
                primitive_lattice_vectors=lattice,
                permittivity=permittivity,
                expansion=fmmax.Expansion(self._number),
                formulation=formulation,
            )

        air, glass = (solved(jnp.array([[value]]), fmmax.Formulation.FFT) for value in (1.0, self._index**2))
        slabs = jax.vmap(lambda raster, along: solved(raster, lambda *_: (along[0], along[1])))(permittivity, walls)
        first, rest = (jax.tree.map(lambda leaf, part=part: leaf[part], slabs) for part in (0, slice(1, None)))
        thickness, none = jnp.asarray(self._thickness), jnp.asarray(0.0)
        matrix = fmmax.append_layer(fmmax.stack_s_matrix([air], [none]), first, thickness[0])
        if len(self._thickness) > 1:
            matrix, _ = jax.lax.scan(
                lambda above, layer: (fmmax.append_layer(above, *layer), None), matrix, (rest, thickness[1:])
            )
        matrix = fmmax.append_layer(matrix, glass, none)
        # Amplitudes are those of the magnetic field along x, then along y.
        count, zeroth = self.terms, int(np.flatnonzero((self._number == 0).all(1))[0])
        light = jnp.zeros((2 * count, 2), complex).at[[count + zeroth, zeroth], [0, 1]].set(1.0)
        dark = jnp.zeros_like(light)
        incident, _ = fmmax.amplitude_poynting_flux(light, dark, air)
        behind, _ = fmmax.amplitude_poynting_flux(matrix.s11 @ light, dark, glass)
        return (behind / incident.sum(0)).reshape(2, count, 2).sum(0).T
