"""Numbers read off a PSF, each with its definition. All work on plain arrays; none changes a PSF's energy."""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.fft import fft2

from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour, SpectralLine
from sim.optic import HeightOptic


def radius_map_m(shape: tuple[int, int], pixel_m: float) -> Float[np.ndarray, "y x"]:
    """Distance of every pixel centre from the centre of the window, metres."""
    y, x = (pixel_m * (np.arange(n) - (n - 1) / 2) for n in shape)
    return np.hypot(y[:, None], x[None, :])


def disc_weights(shape: tuple[int, int], pixel_m: float, radius_m: float) -> Float[np.ndarray, "y x"]:
    """Share of every pixel's area inside a centred disc, float32."""
    return circle_coverage(Grid(shape, pixel_m), 2 * radius_m)


def airy_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius of the first dark ring of the ideal lens, 1.22 lambda d / D."""
    return 1.2197 * wavelength_m * camera.sensor_distance_m / camera.aperture_m


def mean_wavelength_m(colour: Colour) -> float:
    """Weighted mean wavelength of a colour channel."""
    return float(np.dot(colour.wavelengths_m, colour.weights))


def spot_radius_m(camera: Camera, wavelength_m: float) -> float:
    """Radius that counts as the far spot: the first dark ring plus one pixel.

    The pixel is there so that the spot is caught wherever it falls on the pixel grid.
    """
    return airy_radius_m(camera, wavelength_m) + camera.pixel_m


def energy_within(psf: Float[np.ndarray, "y x"], pixel_m: float, radius_m: float) -> float:
    """Energy inside a centred disc, with partly covered pixels counted by area."""
    return float(encircled_energy(psf, pixel_m, np.array([radius_m]))[0])


def encircled_energy(
    psfs: Float[np.ndarray, "*bank y x"], pixel_m: float, radii_m: Float[np.ndarray, " r"]
) -> Float[np.ndarray, "*bank r"]:
    """Energy of every PSF inside centred discs of growing radius (not divided by the total)."""
    y, x = psfs.shape[-2:]
    discs = (disc_weights((y, x), pixel_m, float(radius)) for radius in radii_m)
    flat = psfs.reshape(-1, y * x).astype(np.float64)
    energies = np.stack([flat @ disc.ravel() for disc in discs], axis=-1)
    return energies.reshape(*psfs.shape[:-2], len(radii_m))


class RingToDisc(NamedTuple):
    """Energy outside and inside the geometric defocus disc, within the window."""

    ratio: float
    ring: float
    disc: float
    disc_radius_m: float
    window_half_m: float


def ring_to_disc(psf: Float[np.ndarray, "y x"], camera: Camera, depth_m: float) -> RingToDisc:
    """Ring:disc ratio of a near PSF (the paper's simulation gives 3:1, its prototype 1:1).

    The disc is the geometric defocus disc widened by one pixel, where light that the DOE does not diffract lands.
    """
    radius = camera.defocus_radius_m(depth_m) + camera.pixel_m
    disc = energy_within(psf, camera.pixel_m, radius)
    ring = float(np.sum(psf, dtype=np.float64)) - disc
    return RingToDisc(ring / disc if disc > 0 else np.inf, ring, disc, radius, camera.window * camera.pixel_m / 2)


def participation(psf: Array) -> Array:
    """Sum of squared pixel energies, the concentration of a PSF: 1 for one bright pixel, 1/n for n equal ones."""
    return jnp.sum(psf**2, axis=(-2, -1))


def zeroth_order(camera: Camera, height_m: Float[np.ndarray, "y x"], wavelength_m: float) -> float:
    """Fraction |<t>|^2 of the light that passes as if the plate were flat, t = exp(i phi) over the clear aperture."""
    # A star in focus is a plane wave; out of focus, a phase that is not the plate's would be added.
    optic = HeightOptic.of(replace(camera, defocus_m=0.0), height_m)
    field = optic.field(SpectralLine(0, wavelength_m, 1.0))
    cells = np.pi * (camera.aperture_m / camera.grid.pitch_m) ** 2 / 4
    return float(np.abs(np.asarray(field, np.complex128).sum() / cells) ** 2)


class EnergyBudget(NamedTuple):
    """Where the power incident on the clear aperture goes; the five parts sum to 1.

    Attributes:
        reflected: by the two faces of the substrate.
        spot: inside the far-spot radius of the window.
        window: elsewhere in the sensor window.
        uncollected: within the DOE grid's band, but outside the window or between light-sensitive squares.
        higher_orders: at angles beyond lambda / (2 pitch), scattered by the square cells and the aperture's edge.
    """

    reflected: float
    spot: float
    window: float
    uncollected: float
    higher_orders: float


def _band_energy(field: Complex[np.ndarray, "y x"], slope: float) -> float:
    """Energy of square cells within the band of their grid, lit from a direction of `slope` waves per cell and cell.

    The factor sinc(nu - slope x) of a cell is interpolated between three directions (exact to 1e-3 for directions up to
    a sixth of the band, and a single one for a distant source), so nine transforms take the place of one sum per cell.
    """
    cells = field.shape[0]
    x, nu = np.arange(cells) - (cells - 1) / 2, np.fft.fftfreq(cells)
    reach = slope * cells / 2
    nodes = reach * np.cos(np.pi * np.array([1, 3, 5]) / 6) if slope else np.zeros(1)
    lit = slope * x
    shares = [np.prod([(lit - b) / (a - b) for b in nodes if b != a], axis=0) * np.ones(cells) for a in nodes]
    seen = [np.sinc(nu - a) for a in nodes]
    total = np.zeros(field.shape, np.complex64)
    for share_y, seen_y in zip(shares, seen, strict=True):
        for share_x, seen_x in zip(shares, seen, strict=True):
            part = field * (share_y[:, None] * share_x).astype(np.float32)
            total += np.asarray(fft2(part, workers=-1)) * (seen_y[:, None] * seen_x).astype(np.float32)
    return float(np.sum(np.square(np.abs(total)), dtype=np.float64))


def energy_budget(
    camera: Camera,
    height_m: Float[np.ndarray, "y x"],
    psf: Float[np.ndarray, "v u"],
    depth_m: float,
    colour: Colour,
) -> EnergyBudget:
    """Energy budget of one PSF of one colour.

    Args:
        camera: optics.
        height_m: `[y, x]` the map the PSF was made from.
        psf: `[y, x]` PSF on the sensor, Fresnel loss included.
        depth_m: source depth.
        colour: colour of this PSF.

    The band's share comes from a transform of its own (Parseval on the bare DOE grid, with the cells' sinc), not
    from the PSF, so `uncollected` near zero or below it would show a fault in either.
    """
    curvature = 1 / depth_m + 1 / camera.sensor_distance_m - 1 / camera.focal_length_m
    scale = camera.grid.shape[0] ** 2 * np.pi * (camera.aperture_m / camera.grid.pitch_m) ** 2 / 4
    passed = band = 0.0
    optic = HeightOptic.of(camera, height_m)
    for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
        field = np.asarray(optic.field(SpectralLine(0, wavelength, 1.0), depth_m))
        share = weight * camera.transmission(wavelength)
        passed += share
        band += share * _band_energy(field, curvature * camera.grid.pitch_m**2 / wavelength) / scale
    total = float(np.sum(psf, dtype=np.float64))
    spot = energy_within(psf, camera.pixel_m, spot_radius_m(camera, mean_wavelength_m(colour)))
    return EnergyBudget(1 - passed, spot, total - spot, band - total, passed - band)
