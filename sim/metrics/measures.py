"""Numbers of a PSF: energy within discs, far spot, ring:disc ratio, concentration, and the radii that they count to."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from fab.grid import Grid
from fab.units import distance_from, number_of, require_kind
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.tracing import is_traced, total

Psf = Float[np.ndarray, "y x"] | Float[Array, "y x"]
Number = float | Float[Array, ""]


def radius_map_m(shape: tuple[int, int], pixel_m: float) -> Float[np.ndarray, "y x"]:
    """Distance of every pixel centre from the centre of the window, metres."""
    y, x = (pixel_m * (np.arange(n) - (n - 1) / 2) for n in shape)
    return np.hypot(y[:, None], x[None, :])


@lru_cache(maxsize=32)
def disc_weights(shape: tuple[int, int], pixel_m: float, radius_m: float) -> Float[np.ndarray, "y x"]:
    """Share of every pixel's area inside a centred disc, float32; kept and read-only, for every draw asks for a few."""
    weights = circle_coverage(Grid(shape, pixel_m), 2 * radius_m)
    weights.setflags(write=False)
    return weights


def airy_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius of the first dark ring of the ideal lens, 1.22 lambda d / D; D of others: shorter side of their box."""
    return 1.2197 * wavelength_m * camera.sensor_distance_m / min(camera.opening.sizes_m)


def mean_wavelength_m(colour: Colour) -> float:
    """Weighted mean wavelength of a colour channel."""
    return float(np.dot(colour.wavelengths_m, colour.weights))


def spot_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius that counts as the far spot: the first dark ring, and one pixel to catch it anywhere on the pixel grid."""
    return airy_radius_m(camera, wavelength_m) + camera.pixel_m


def near_and_far(camera: Camera, depths_m: Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Depths whose defocus disc is wider than the far spot, and the others; without a lens all are others."""
    if camera.distance_m is not None:
        return (), tuple(depths_m)
    spot_m = spot_radius_m(camera, max(line.wavelength_m for line in camera.lines))
    near = tuple(z for z in depths_m if camera.defocus_radius_m(z) > spot_m)
    return near, tuple(z for z in depths_m if z not in near)


def encircled_energy(
    psfs: Float[np.ndarray, "*bank y x"] | Float[Array, "*bank y x"],
    pixel_m: float,
    radii_m: Sequence[float] | np.ndarray,
) -> Float[np.ndarray, "*bank r"] | Float[Array, "*bank r"]:
    """Energy `[..., radius]` of `psfs` `[..., y, x]` of pitch `pixel_m` inside centred discs of `radii_m`, metres.

    Not divided by the total; partly covered pixels count by area.

    Raises:
        InputError: no radii, radii that are not numbers of metres of 0 or more, no PSFs, or no pitch.
    """
    if not is_traced(psfs) and (np.ndim(psfs) < 2 or np.asarray(psfs).dtype.kind not in "fiu"):
        got = f"{type(psfs).__name__} of shape {np.shape(psfs)}"
        raise InputError("psfs", "must be energies [..., y, x]", got, "A bank has them: bank.energy.")
    if not 0 < number_of(pixel_m) < np.inf:
        raise InputError("pixel_m", "must be a positive number of metres", repr(pixel_m), "For example 2e-6 for 2 um.")
    given = np.asarray(radii_m)
    if given.ndim != 1 or given.size == 0 or given.dtype.kind not in "fiu" or not np.all(given >= 0):
        rule, cure = "must be several radii, numbers of metres of 0 or more", "For example [1e-6, 2e-6]."
        raise InputError("radii_m", rule, repr(radii_m), cure)
    y, x = psfs.shape[-2:]
    discs = [disc_weights((y, x), pixel_m, float(radius)) for radius in radii_m]
    if is_traced(psfs):
        return jnp.einsum("...yx,ryx->...r", psfs, np.stack(discs), precision="highest")
    flat = np.asarray(psfs).reshape(-1, y * x).astype(np.float64)
    energies = np.stack([flat @ disc.ravel() for disc in discs], axis=-1)
    return energies.reshape(*psfs.shape[:-2], len(radii_m))


def energy_within(psf: Psf, pixel_m: float, radius_m: float) -> Number:
    """Energy inside one centred disc (`encircled_energy`)."""
    energy = encircled_energy(psf, pixel_m, [radius_m])[0]
    return energy if is_traced(energy) else float(energy)


def disc_radius_m(camera: Camera, depth_m: float) -> float:
    """Radius of the disc to which light of `depth_m`, metres, is blurred if the DOE does not diffract it.

    That of geometric defocus, and one pixel.
    """
    return camera.defocus_radius_m(depth_m) + camera.pixel_m


class RingToDisc(NamedTuple):
    """Energy outside and inside the geometric defocus disc, within the window; lengths in metres."""

    ratio: Number
    ring: Number
    disc: Number
    disc_radius_m: float


def ring_to_disc(psf: Psf, camera: Camera, depth_m: float | str) -> RingToDisc:
    """Ring:disc ratio of a near `psf` `[y, x]` of a `camera` (3:1 in the paper's simulation, 1:1 in its prototype).

    The disc is that of `disc_radius_m`, `depth_m` in metres or with a unit; without light in it the ratio is infinite.

    Raises:
        InputError: no camera, no PSF, or a depth that is not positive.
    """
    require_kind("camera", camera, Camera, "A design has one: design.camera.")
    radius = disc_radius_m(camera, distance_from(depth_m, "depth_m"))
    disc = energy_within(psf, camera.pixel_m, radius)
    ring = total(psf) - disc
    if is_traced(disc):
        ratio = jnp.where(disc > 0, ring / jnp.where(disc > 0, disc, 1.0), jnp.inf)
    else:
        ratio = ring / disc if disc > 0 else np.inf
    return RingToDisc(ratio, ring, disc, radius)


def far_spot(psf: Psf, camera: Camera, colour: Colour) -> Number:
    """Energy inside the far spot (`spot_radius_m`)."""
    return energy_within(psf, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(colour)))


def participation(psf: Any) -> Array:
    """Sum of squared pixel energies, the concentration of a `psf`: 1 for one bright pixel, 1/n for n equal ones."""
    return jnp.sum(jnp.asarray(psf) ** 2, axis=(-2, -1))
