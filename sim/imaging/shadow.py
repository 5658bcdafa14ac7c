"""The reference for obstructed light: what an obstruction does to the wave of one scene point, by wave optics.

The light of a point passes the plane of the obstruction, is cut there, spreads by Fresnel diffraction to the aperture,
and makes the PSF of a pupil that is partly in shadow. It assumes nothing of how PSFs and masks go together, so it
judges the fast models of `sim.imaging.occlusion`; one PSF per scene point takes seconds, a picture hours.

For a point at distance b and an obstruction at distance z the ray to the aperture's point x crosses the obstruction at
x (1 - z / b) from the chief ray. About that crossing the path differences are quadratic with the effective distance
z (b - z) / b (J. W. Goodman, Introduction to Fourier Optics, ch. 4), so the shadow of a rectangle is a product of two
differences of Fresnel integrals, and a mask of pixels is a sum of rectangles: exact within the Fresnel approximation.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from sim.camera import Camera
from sim.optic import HeightOptic
from sim.propagation.pupil import cis
from sim.psf_bank import psf

Border = Literal["edge", "zero"]
Point = tuple[float, float]


def shadow(
    camera: Camera,
    mask: Float[np.ndarray, "v u"],
    depth_m: float,
    background_depth_m: float,
    wavelength_m: float,
    point: Point,
    border: Border = "edge",
) -> Complex[np.ndarray, "y x"]:
    """Field `[y, x]` that reaches every DOE cell past an obstruction, over the field without it.

    Args:
        camera: lens, sensor and grid.
        mask: `[y, x]` blocked share of every pixel of the view, the middle of the view in the middle of the array.
        depth_m: distance of the obstruction, metres.
        background_depth_m: distance of the scene point behind it, metres; `inf` allowed.
        wavelength_m: wavelength, metres.
        point: where in the view the scene point is, pixels (row, column), as indices of the mask.
        border: whether the outermost pixels of the mask go on for ever ("edge") or nothing lies beyond them ("zero").
    """
    if not 0 < depth_m < background_depth_m:
        raise ValueError(f"`depth_m` must lie from 0 to the background's {background_depth_m}, but got {depth_m}")
    nearness = 1.0 - depth_m / background_depth_m
    effective_m = depth_m * nearness
    rows, row_edges = _runs(mask, 0)
    runs, column_edges = _runs(rows, 1)
    # A pixel at u in the picture is at -u depth / sensor distance before the lens, which turns the picture round.
    scale_m = camera.pixel_m * depth_m / camera.sensor_distance_m
    factors = []
    for edges, at, axis in zip((row_edges, column_edges), point, ("y", "x"), strict=True):
        lines_m = -(edges - 0.5 - at) * scale_m
        if border == "edge":
            lines_m[[0, -1]] = np.inf, -np.inf
        crossing_m = camera.grid.axis_m(axis) * nearness
        factors.append(_fresnel_shares(crossing_m, lines_m, effective_m, wavelength_m))
    return 1.0 - np.linalg.multi_dot([factors[0], runs.astype(np.complex128), factors[1].T])


def _runs(mask: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The mask with equal neighbours along an axis taken together, and the edges of what is left, in pixels."""
    lines = np.moveaxis(mask, axis, 0)
    first = np.flatnonzero(np.concatenate([[True], np.any(lines[1:] != lines[:-1], axis=1)]))
    return np.moveaxis(lines[first], 0, axis), np.append(first, len(lines)).astype(np.float64)


def _fresnel_shares(
    crossing_m: Float[np.ndarray, " x"], lines_m: Float[np.ndarray, " line"], distance_m: float, wavelength_m: float
) -> Complex[np.ndarray, "x strip"]:
    """Amplitude that passes each strip between two lines, toward -x, of that which passes an open plane."""
    from scipy.special import fresnel

    tau = (lines_m[None, :] - crossing_m[:, None]) * np.sqrt(2.0 / (wavelength_m * distance_m))
    sine, cosine = fresnel(tau)
    total = cosine + 1j * sine
    return (total[:, :-1] - total[:, 1:]) / np.sqrt(2j)


def shadowed_psf(
    camera: Camera,
    height_m: Float[np.ndarray, "y x"],
    mask: Float[np.ndarray, "v u"],
    depth_m: float,
    background_depth_m: float,
    point: Point,
    border: Border = "edge",
) -> Float[np.ndarray, "c window window"]:
    """PSF `[colour, y, x]` of a scene point behind an obstruction, of the DOE as it is on the axis; see `shadow`.

    Energy per pixel per unit power that would reach the clear aperture without the obstruction, the chief ray in the
    middle of the window.
    """
    height = jnp.asarray(height_m, jnp.float32)
    bare, fields = HeightOptic.of(camera), {}
    for wavelength in bare.wavelengths_m:
        passed = shadow(camera, mask, depth_m, background_depth_m, wavelength, point, border)
        doe = cis(height * jnp.float32(camera.waves_per_metre(wavelength)))
        fields[wavelength] = jnp.asarray(passed, jnp.complex64) * doe
    optic = HeightOptic(camera, bare.coverage, None, fields)
    return np.asarray(psf(optic, depths=background_depth_m).energy[:, 0])
