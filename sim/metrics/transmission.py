"""Numbers of the field behind a DOE: its mean transmission, 0th order, Strehl ratio and open share."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from fab.errors import InputError
from sim.camera import require_colour
from sim.optic import CellOptic
from sim.tracing import is_traced, stacked, total


def mean_transmission(doe: Any) -> Complex[np.ndarray, " w"] | Complex[Array, " w"]:
    """Mean transmission c0 for `doe.wavelengths_m`, weighted by open shares of cells and the irradiance on them.

    `doe` is an optic of cells, or what carries one, such as a design; an InputError for anything else.
    """
    cells = cell_optic_of("doe", doe)
    return _mean_over_aperture(cells, cells.means)


def cell_optic_of(name: str, doe: Any, colour: int = 0) -> CellOptic:
    """The optic of cells that a `doe` is or carries, the value of `name`, to be looked at in the light of a colour.

    An InputError for anything else, or for a colour that its camera does not have.
    """
    found = doe.as_optic() if hasattr(doe, "as_optic") else doe
    if not isinstance(found, CellOptic):
        cure = "Give a design, a DOE as fabricated, or sim.HeightOptic.of(camera, height_m)."
        raise InputError(name, "must be a DOE of cells", f"a {type(doe).__name__}", cure)
    require_colour(found.camera, colour)
    return found


def _mean_over_aperture(doe: CellOptic, values: Any) -> Any:
    if doe.camera.beam is not None:
        return stacked([_lit_mean(doe, *each) for each in zip(values, doe.wavelengths_m, strict=True)])
    if is_traced(values, doe.coverage):
        return jnp.einsum("wyx,yx->w", values, doe.coverage, precision="highest") / jnp.sum(doe.coverage)
    coverage = np.asarray(doe.coverage, np.float64)
    return np.einsum("wyx,yx->w", np.asarray(values), coverage, dtype=np.complex128) / coverage.sum()


def _lit_mean(doe: CellOptic, values: Any, wavelength_m: float) -> Any:
    xp = jnp if is_traced(values, doe.coverage) else np
    light = doe.camera.irradiance(wavelength_m)
    assert light is not None
    weights = xp.asarray(doe.coverage) * light
    return xp.sum(xp.asarray(values) * weights) / xp.sum(weights)


def opening(doe: CellOptic, wavelength_m: float) -> Any:
    """Power on the open parts of the cells, over that of the beam, or over that on the nominal aperture without one."""
    camera = doe.camera
    cells, light = camera.opening.area_in(camera.grid.pitch_m), camera.irradiance(wavelength_m)
    return total(doe.coverage if light is None else doe.coverage * light) / cells


def zeroth_order(doe: Any) -> Float[np.ndarray, " w"] | Float[Array, " w"]:
    """Fraction |c0|^2 of the light that passes as if the DOE were flat, for `doe.wavelengths_m`.

    `doe` is as in `mean_transmission`.
    """
    return abs(mean_transmission(doe)) ** 2


def strehl(doe: Any, nominal: Any) -> Float[np.ndarray, " w"] | Float[Array, " w"]:
    """Overlap |<t conj(t_nominal)>|^2 with the field of the DOE exactly as drawn, for `doe.wavelengths_m`.

    Each is an optic of cells, or what carries one, such as a design; an InputError for anything else. The cells of
    `doe` and those of `nominal` may be parts of those that were drawn.
    """
    doe, nominal = cell_optic_of("doe", doe), cell_optic_of("nominal", nominal)
    (ny, nx), other = doe.camera.grid.shape, nominal.camera.grid.shape[0]
    xp, common = jnp if is_traced(doe.means, nominal.means, doe.coverage) else np, math.lcm(ny, other)
    meant = in_parts(xp.conj(xp.asarray(nominal.means)), common // other)
    if (parts := common // ny) > 1:
        meant = meant.reshape(len(meant), ny, parts, nx, parts).mean((2, 4))
    return abs(_mean_over_aperture(doe, xp.asarray(doe.means) * meant)) ** 2


def in_parts(values: Any, parts: int) -> Any:
    """Values `[..., y, x]` of cells, numpy's or jax's, as those of `parts` by `parts` equal parts of every cell."""
    return values if parts == 1 else values.repeat(parts, axis=-2).repeat(parts, axis=-1)
