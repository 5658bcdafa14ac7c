"""PSF banks: the image of a point source for every colour and depth of one DOE height map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from sim.aperture import circle_coverage
from sim.camera import Camera, source_path_m, wrapped_waves
from sim.propagation.farfield import FarField, plan_far_field
from sim.propagation.fresnel import DirectPath, plan_direct
from sim.propagation.hankel import plan_hankel, ring_source_waves
from sim.propagation.pupil import PhaseRows, PupilRows, SurfaceRows, phase_pupil, surface_pupil
from sim.surface import FabricatedDoe

Propagation = Literal["far_field", "fresnel", "angular_spectrum"]


class PsfBank(eqx.Module):
    """PSFs of one optical system, on one field angle.

    Attributes:
        energy: `[wavelength, depth, y, x]` energy per pixel per unit power incident on the clear aperture.
        colours: name of each entry of the first axis.
        depths_m: source depth of each entry of the second axis, metres.
        pixel_m: pixel pitch, metres. The chief ray is at the centre of the window.
        field_rad: field angles (y, x).
    """

    energy: Float[np.ndarray, "w d y x"]
    colours: tuple[str, ...] = eqx.field(static=True)
    depths_m: tuple[float, ...] = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    field_rad: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.0))


def plan_propagation(
    camera: Camera,
    wavelength_m: float,
    depth_m: float,
    propagation: Propagation = "far_field",
    sampling: float | None = None,
) -> FarField | DirectPath:
    """Operators of one wavelength and depth for the propagation a spec names (a direct path serves every depth).

    Raises:
        InputError: the direct path is asked for where eq. 6 does not hold.
    """
    if propagation == "far_field":
        return plan_far_field(camera, wavelength_m, depth_m=depth_m, sampling=sampling)
    return plan_direct(camera, wavelength_m, propagation)


def pixel_energy(plan: FarField | DirectPath, pupil: PupilRows, rows: PyTree, shared: PyTree) -> Array:
    """`plan.energy`, compiled once per shape."""
    # The error that a plan predicts changes with depth; kept, it would have every depth compiled anew.
    timeless = replace(plan, expected_error=0.0) if isinstance(plan, FarField) else plan
    return _compiled_energy(timeless, pupil, rows, shared)


@eqx.filter_jit
def _compiled_energy(plan: FarField | DirectPath, pupil: PupilRows, rows: PyTree, shared: PyTree) -> Array:
    return plan.energy(pupil, rows, shared)


def psf_bank(
    camera: Camera,
    height_m: Float[np.ndarray, "y x"],
    depths_m: Sequence[float],
    *,
    field_rad: tuple[float, float] = (0.0, 0.0),
    propagation: Propagation = "far_field",
    sampling: float | None = None,
    on_psf: Callable[[], None] = lambda: None,
) -> PsfBank:
    """PSFs of a height map for every colour of the camera and every depth.

    Args:
        camera: lens, sensor, substrate and DOE grid.
        height_m: `[y, x]` DOE height on `camera.grid`, metres.
        depths_m: source depths, metres (`inf` allowed).
        field_rad: field angles (y, x); the window follows the chief ray.
        propagation: far field, or one of the direct kernels.
        sampling: intensity samples per lambda d / D (far field only); see `plan_far_field`.
        on_psf: called after every single PSF, for progress.

    Returns:
        the bank, Fresnel loss of the substrate included.

    Raises:
        ValueError: `height_m` does not match `camera.grid`.
        InputError: a wavelength outside the material's range, or eq. 6 violated on a direct path.
    """
    if height_m.shape != camera.grid.shape:
        raise ValueError(f"`height_m` must have the grid's shape {camera.grid.shape}, but got {height_m.shape}")
    height = jnp.asarray(height_m, jnp.float32)
    coverage = jnp.asarray(circle_coverage(camera.grid, camera.aperture_m))
    lines = [
        (c, weight * camera.transmission(wavelength), wavelength)
        for c, colour in enumerate(camera.colours)
        for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True)
    ]
    energy = np.zeros((len(camera.colours), len(depths_m), camera.window, camera.window), np.float32)
    for d, depth in enumerate(depths_m):
        path = source_path_m(camera, depth, field_rad)
        for c, factor, wavelength in lines:
            plan = plan_propagation(camera, wavelength, depth, propagation, sampling)
            rate = jnp.float32(camera.waves_per_metre(wavelength, field_rad))
            rows = PhaseRows(height, jnp.asarray(wrapped_waves(path, wavelength)), coverage)
            energy[c, d] += factor * np.asarray(pixel_energy(plan, phase_pupil, rows, rate))
            on_psf()
    return PsfBank(energy, tuple(c.name for c in camera.colours), tuple(depths_m), camera.pixel_m, field_rad)


def surface_bank(
    camera: Camera,
    surface: FabricatedDoe,
    depths_m: Sequence[float],
    *,
    field_rad: tuple[float, float] = (0.0, 0.0),
    on_psf: Callable[[], None] = lambda: None,
) -> PsfBank:
    """PSFs of a plate as fabricated, for every colour of the camera and every depth, in the far field.

    Args:
        camera: lens, sensor and substrate.
        surface: the plate, with every wavelength of the camera.
        depths_m: source depths, metres (`inf` allowed).
        field_rad: field angles (y, x); the plate's transmission is taken as that on the axis.
        on_psf: called after every single PSF, for progress.

    Returns:
        the bank, per unit power incident on the *nominal* clear aperture, Fresnel loss of the substrate included.
    """
    own = replace(camera, grid=surface.grid)
    energy = np.zeros((len(camera.colours), len(depths_m), camera.window, camera.window), np.float32)
    for d, depth in enumerate(depths_m):
        path = source_path_m(own, depth, field_rad)
        for c, colour in enumerate(camera.colours):
            for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
                plan = plan_propagation(own, wavelength, depth)
                source = jnp.asarray(wrapped_waves(path, wavelength))
                factor = weight * camera.transmission(wavelength)
                energy[c, d] += factor * surface_energy(plan, camera, surface, wavelength, source)
                on_psf()
    return PsfBank(energy, tuple(c.name for c in camera.colours), tuple(depths_m), camera.pixel_m, field_rad)


def surface_energy(
    plan: FarField | DirectPath, camera: Camera, surface: FabricatedDoe, wavelength_m: float, source_waves: Array
) -> Float[np.ndarray, "v u"]:
    """Pixel energies of a plate for one wavelength and source, without Fresnel loss.

    A plate exactly as drawn takes the way of `psf_bank`, so that both agree to the last bit.
    """
    if surface.height_m is not None:
        rows = PhaseRows(surface.height_m, source_waves, surface.coverage)
        rate = jnp.float32(camera.waves_per_metre(wavelength_m))
        return np.asarray(pixel_energy(plan, phase_pupil, rows, rate))
    field = SurfaceRows(surface.at(wavelength_m), source_waves, surface.coverage)
    return np.asarray(pixel_energy(plan, surface_pupil, field, None))


def pupil_field(
    camera: Camera, height_m: Float[np.ndarray, "y x"], depth_m: float, wavelength_m: float
) -> Complex[Array, "y x"]:
    """The whole field behind the DOE for a source on the axis, `[y, x]`, unit amplitude where open."""
    source = jnp.asarray(wrapped_waves(source_path_m(camera, depth_m), wavelength_m))
    coverage = jnp.asarray(circle_coverage(camera.grid, camera.aperture_m))
    rows = PhaseRows(jnp.asarray(height_m, jnp.float32), source, coverage)
    return jax.jit(phase_pupil)(rows, jnp.float32(camera.waves_per_metre(wavelength_m)))


def radial_psf_bank(
    camera: Camera,
    profile_m: Float[np.ndarray, " ring"],
    depths_m: Sequence[float],
    *,
    on_psf: Callable[[], None] = lambda: None,
) -> PsfBank:
    """PSFs on the axis of rings drawn as rings, by the Hankel path.

    Args:
        camera: optics.
        profile_m: height of every ring of one cell's width, metres (`sim.propagation.hankel.ring_count` of them).
        depths_m: source depths, metres.
        on_psf: called after every single PSF, for progress.

    Returns:
        the bank, Fresnel loss of the substrate included.
    """
    energy = np.zeros((len(camera.colours), len(depths_m), camera.window, camera.window), np.float32)
    profile = jnp.asarray(profile_m, jnp.float32)
    for c, colour in enumerate(camera.colours):
        for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
            plan = plan_hankel(camera, wavelength)
            rate = jnp.float32(camera.waves_per_metre(wavelength))
            for d, depth in enumerate(depths_m):
                source = jnp.asarray(ring_source_waves(camera, depth, wavelength))
                energy[c, d] += (
                    weight * camera.transmission(wavelength) * np.asarray(plan.energy(profile, source, rate))
                )
                on_psf()
    return PsfBank(energy, tuple(c.name for c in camera.colours), tuple(depths_m), camera.pixel_m)
