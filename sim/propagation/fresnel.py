"""The direct path (paper eq. 5): lens and propagation kernel written out, with no cancellation assumed.

It needs the lens's quadratic phase sampled on the DOE grid, so eq. 6, N pitch^2 / lambda <= f, must hold; at the
paper's sizes that means cells below a micrometre, which is why `sim.propagation.farfield` is the default. Here it
serves as a reference and for small apertures. Two kernels: the paraxial `"fresnel"` transfer function exp(-i pi lambda
d nu^2) and the `"angular_spectrum"` exp(2 pi i d sqrt(1/lambda^2 - nu^2)), both band-limited after K. Matsushima and T.
Shimobaba, Opt. Express 17, 19662 (2009), so that the kernel itself never aliases: light that would leave the padded
grid is dropped. The band ends in a cosine, because a sharp end rings: 2 % in the image of a rough plate. Cells are
squares, of as many samples as the light between the rim and the window's corner needs. Without a lens it is how light
gets to a sensor too near for the far field.
"""

from typing import Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree
from scipy.fft import next_fast_len

from fab.aperture import RoundAperture
from fab.errors import InputError
from sim.camera import Camera
from sim.propagation.pixel import Banded, pixel_weights
from sim.propagation.pupil import DoeRows, PupilRows, SourceColumns, cis
from sim.source import wrapped_waves

Kernel = Literal["fresnel", "angular_spectrum"]

_UNTAPERED = 0.75  # share of the kernel's band that passes in full


class DirectPath(eqx.Module):
    """Operators of one wavelength on the direct path."""

    gather: tuple[Banded, Banded]  # samples, `parts` to a cell -> pixels, along y and x
    lens: Complex[Array, "y x"]  # `[y, x]` what the source's path lacks of the thin lens, or has too much without one
    kernel: Complex[Array, "ky kx"]  # `[ky, kx]` transfer function in FFT order on the padded grid
    first: tuple[int, int] = eqx.field(static=True)  # first sample (y, x) kept on the sensor
    parts: int = eqx.field(static=True)  # samples per cell and axis
    expected_error: float  # predicted relative L2 error of the pixel integration alone

    def energy(self, pupil: PupilRows, rows: PyTree, shared: PyTree) -> Float[Array, "v u"]:
        """Energy in every pixel of the window, per unit power on the clear aperture; see `FarField.energy`."""
        field = pupil(rows, shared) * self.lens
        if self.parts > 1:
            field = _in_parts(field, self._incident(rows, shared), self.parts)
        spectrum = jnp.fft.fft2(field, self.kernel.shape) * self.kernel
        (y, x), (first_y, first_x) = self.gather, self.first
        # Samples per axis that the pixels use.
        image = jnp.roll(jnp.fft.ifft2(spectrum), (-first_y, -first_x), (0, 1))[: y.inputs, : x.inputs]
        intensity = image.real**2 + image.imag**2
        return y(x(intensity).T).T

    def _incident(self, rows: DoeRows, shared: SourceColumns) -> Complex[Array, "y x"]:
        """The wave that lights the cells, through the lens, of any amplitude."""
        wave = cis(shared.waves(rows.source, None)) * self.lens
        return wave if rows.light is None else wave * rows.light


def _in_parts(field: Complex[Array, "y x"], incident: Complex[Array, "y x"], parts: int) -> Complex[Array, "fy fx"]:
    """The field of `parts` by `parts` samples of every cell, over which the incident wave goes on as to its neighbours.

    Held at its value in the middle, the wave of a near source would be a staircase, which sends light astray.
    """
    offset = (np.arange(parts) + 0.5) / parts - 0.5
    along_y, along_x = (_waves_per_cell(incident, axis)[:, None, :, None] for axis in (0, 1))
    whole = field[:, None, :, None] * cis(along_y * offset[:, None, None] + along_x * offset)
    return whole.reshape(field.shape[0] * parts, field.shape[1] * parts)


def _waves_per_cell(incident: Complex[Array, "y x"], axis: int) -> Float[Array, "y x"]:
    """How much a wave turns from cell to cell: the mean of the steps to both neighbours."""
    count = incident.shape[axis]
    before, behind = (jax.lax.slice_in_dim(incident, k, count - 1 + k, axis=axis) for k in (0, 1))
    step = jnp.angle(behind * jnp.conj(before)) / (2 * np.pi)
    padded = [(1, 1) if axis == other else (0, 0) for other in (0, 1)]
    steps = jnp.pad(step, padded, mode="edge")
    return (jax.lax.slice_in_dim(steps, 0, count, axis=axis) + jax.lax.slice_in_dim(steps, 1, None, axis=axis)) / 2


def nyquist_focal_length_m(cells: int, pitch_m: float, wavelength_m: float) -> float:
    """Shortest focal length whose lens phase N cells of that pitch can sample, N pitch^2 / lambda (eq. 6), metres."""
    return cells * pitch_m**2 / wavelength_m


def plan_direct(
    camera: Camera, wavelength_m: float, kernel: Kernel = "angular_spectrum", *, depth_m: float = np.inf
) -> DirectPath:
    """Prepare the direct path of one wavelength; phases are formed in float64 and wrapped before float32.

    It serves sources at every depth; without a lens it has samples enough for those at `depth_m` (metres) and beyond.

    The lens is the thin one of eq. 5, which has a mapping of its own: near that of tangents, with aberrations of the
    order of angle⁴. An InputError for a camera that asks for another, where eq. 6 does not hold, or where the window
    does not fit on the padded grid.
    """
    if camera.in_angles:
        rule, cure = "the direct path leads to a sensor", 'Use the "far_field" path.'
        raise InputError("propagation", rule, camera.lens_text, cure)
    if camera.is_tilted:
        rule = "on the direct path the sensor's window follows a beam that stands aslant"
        cure = 'Give its `angle` in place of its `tilt`, or use the "far_field" path.'
        raise InputError("illumination.tilt", rule, "a tilt", cure)
    if camera.doe_distance_m:
        rule, got = "on the direct path the DOE lies on the lens", f"{camera.doe_distance_m * 1e3:.4g} mm before it"
        raise InputError("camera.doe_distance", rule, got, 'Use the "far_field" path.')
    if not camera.is_sine:
        rule, cure = (
            "the direct path has the lens of eq. 5, whose mapping cannot be chosen",
            'Use the "far_field" path.',
        )
        raise InputError("camera.mapping", rule, camera.lens_text, cure)
    parts = _parts(camera, wavelength_m, depth_m, kernel)
    cells, pitch, distance = max(camera.grid.shape), camera.grid.pitch_m, camera.sensor_distance_m
    nyquist = nyquist_focal_length_m(cells, pitch, wavelength_m) if camera.distance_m is None else 0.0
    if nyquist > camera.focal_length_m * (1 + 1e-9):
        limit = wavelength_m * camera.focal_length_m / camera.opening.widest_m
        raise InputError(
            "propagation",
            f"the direct path needs N pitch^2 / wavelength (eq. 6) of at most the focal length, "
            f"{camera.focal_length_m * 1e3:.4g} mm",
            f"{nyquist * 1e3:.4g} mm at {wavelength_m * 1e9:.4g} nm with N = {cells} and {pitch * 1e6:.4g} um",
            f'Use propagation = "far_field", or a pitch of at most {limit * 1e6:.3g} um '
            f"(N = {int(np.ceil(camera.opening.widest_m / limit))}) for this aperture.",
        )
    cells, pitch = cells * parts, pitch / parts
    half = camera.window * camera.pixel_m / 2 / pitch
    width = camera.pixel_m * camera.fill / pitch
    kept = 2 * int(np.ceil(half + width + 8))
    if 2 * half > 3 * cells:
        rule = f"on the direct path the window must fit on three apertures, {3 * cells * pitch * 1e3:.4g} mm"
        got = f"{camera.window * camera.pixel_m * 1e3:.4g} mm"
        raise InputError("camera.window", rule, got, "Use a smaller window, or the far-field path behind a lens.")
    # Light from one rim of the aperture to the far edge of the window must pass the kernel's band untapered.
    padded = cast(int, next_fast_len(max(3 * cells, int(np.ceil((cells + 2 * half) / _UNTAPERED)))))
    cutoff = camera.opening.widest_m * pitch / (wavelength_m * distance)
    amount = pitch / np.sqrt(camera.opening.area_m2)
    is_round, is_bare = isinstance(camera.opening, RoundAperture), camera.distance_m is not None
    firsts, gathers, errors = [], [], []
    for count in camera.grid.shape:
        middle = (count * parts - 1) / 2  # the axis, in samples of the propagated grid
        firsts.append(int(np.floor(middle)) - kept // 2)
        weights = pixel_weights(camera.axis_m() / pitch + middle - firsts[-1], width, cutoff, kept, is_round)
        places = (np.arange(kept) + firsts[-1] - middle) * pitch
        # Behind a lens all light at a place left the cells in one direction, where a square has its sinc.
        envelope = np.ones(kept) if is_bare else np.sinc(places * pitch / (wavelength_m * distance)) ** 2
        gathers.append(Banded.from_dense(weights.matrix * (amount * envelope)[:, None]))
        errors.append(weights.expected_error)
    square = camera.grid.axis_m("y")[:, None] ** 2 + camera.grid.axis_m("x")[None, :] ** 2
    # `source_path_m` already holds the defocus remainder r^2/2 (1/d - 1/f), so what is left of the lens is -r^2/2d;
    # without a lens it holds r^2/2d, which this takes out again.
    lens = wrapped_waves(-square / (2 * distance * wavelength_m), 1.0)
    return DirectPath(
        gather=(gathers[0], gathers[1]),
        lens=cis(jnp.asarray(lens)),
        kernel=_kernel(padded, pitch, wavelength_m, distance, kernel, square_cells=is_bare),
        first=(firsts[0], firsts[1]),
        parts=parts,
        expected_error=np.hypot(*errors),
    )


def _parts(camera: Camera, wavelength_m: float, depth_m: float, kernel: Kernel) -> int:
    """Samples per cell and axis that carry light from one rim to the far corner of the window.

    A sample is a square that is lit evenly, but for the lens, so a wave from a near source must turn little over it: an
    eighth of a wave at the rim leaves 1 % of the light there.
    """
    own = camera.curvature_per_m() if camera.distance_m is None else 0.0
    own += camera.beam_curvature_per_m(wavelength_m)
    bend = max(abs(own), abs(own + 1 / depth_m))  # of a star and of the nearest source
    turned = 8 * camera.grid.pitch_m * camera.opening.reach_m * bend / wavelength_m
    across = camera.opening.reach_m + camera.window * camera.pixel_m / np.sqrt(2)
    far = camera.sensor_distance_m if kernel == "fresnel" else np.hypot(across, camera.sensor_distance_m)
    # Intensity has twice the band of the field.
    return max(1, int(np.ceil(4 * camera.grid.pitch_m * across / far / wavelength_m)), int(np.ceil(turned)))


def _kernel(
    padded: int, pitch_m: float, wavelength_m: float, distance_m: float, kernel: Kernel, *, square_cells: bool
) -> Complex[Array, "ky kx"]:
    frequency = np.fft.fftfreq(padded, pitch_m)
    square = frequency[:, None] ** 2 + frequency[None, :] ** 2
    step = 1 / (padded * pitch_m)
    carrier = 1 / wavelength_m**2
    if kernel == "fresnel":
        waves = -0.5 * wavelength_m * distance_m * square
        limit = 1 / (2 * step * distance_m * wavelength_m)
    else:
        # Relative to the carrier exp(ikd): sqrt(a - s) - sqrt(a) without cancellation.
        waves = -distance_m * square / (np.sqrt(np.maximum(carrier - square, 0.0)) + np.sqrt(carrier))
        limit = 1 / (wavelength_m * np.sqrt((2 * step * distance_m) ** 2 + 1))
    fall = np.clip((np.abs(frequency) / limit - _UNTAPERED) / (1 - _UNTAPERED), 0.0, 1.0)
    passed = np.cos(np.pi / 2 * fall) ** 2
    if square_cells:  # light of a cell is that of its whole square, and not of a point in its middle
        passed = passed * np.sinc(frequency * pitch_m)
    passed = passed[:, None] * passed[None, :] * (square < carrier)
    return cis(jnp.asarray(wrapped_waves(waves, 1.0))) * jnp.asarray(passed, jnp.float32)
