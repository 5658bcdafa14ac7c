"""From the field behind the DOE to the energy in every sensor pixel: the default path (paper eqs. 7-9).

With the sensor in the focal plane the lens cancels the quadratic term of Fresnel propagation and the field on the
sensor is the Fourier transform of the pupil, U(u) = (1 / lambda d) ∫ t exp(-2 pi i x.u / (lambda d)) d²x. Three things
make this both right and fast:

* **The sensor's own pixels.** The paper takes one FFT and resizes the result by nearest neighbour. Here the
  intensity is sampled finely enough to be integrated over each pixel (`sim.pixel`).
* **The cell of the DOE.** A DOE is a plate of squares with a constant phase, not a comb of points; its far field
  carries the factor sinc² along each axis and what that removes from the window goes to higher orders. At the
  ring of the paper's design (lambda / 3 pitch) the factor is 0.68: a comb would overstate the ring by half.
* **Nothing that is not needed.** The transform along x keeps only the samples the window needs before the transform
  along y, both run in blocks of rows that stay in the processor's cache, and the intensity of a block is
  integrated at once, so neither the padded pupil nor the fine intensity ever exists as a whole.

A plan (`plan_far_field`) is made once in float64 on the host and holds float32 operators. `FarField.energy` applies
it to a pupil given as a function of blocks of rows (`sim.pupil`), so a phase-only pupil is never stored either; its
gradient is written out here (one adjoint transform) and checked against finite differences.

Sampling. `sampling` counts samples per lambda d / D: 2 is the Nyquist rate of the intensity, and the default adds as
much as a short integration rule needs for a predicted error of 2e-3. At `sampling=1` the transform is the bare FFT of
the pupil: a quarter of the work, enough to estimate energies when the image moves by a fraction of a pixel from call
to call (`displaced`).
"""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree
from scipy.fft import next_fast_len

from sim.camera import Camera
from sim.pixel import Banded, pixel_weights, sampling_for
from sim.pupil import PupilRows, block_size, cis, in_blocks

TOLERANCE = 2e-3  # predicted relative L2 error of pixel energies, unless a plan says otherwise


class FarField(eqx.Module):
    """Operators of one wavelength, shared by every depth and field angle.

    Attributes:
        gather: samples -> pixels along either axis, with the cell's sinc² and all constant factors.
        spread: its transpose.
        tilt: phase ramps (y, x) over the pupil that displace the image, or None (see `displaced`).
        cells: DOE cells per axis.
        length: transform length per axis.
        kept: samples kept around the axis.
        blocks: rows per block in the pupil and on the sensor.
        spacing_m: distance of samples on the sensor.
        expected_error: predicted relative L2 error of the pixel energies of a speckle-like image.
    """

    gather: Banded
    spread: Banded
    tilt: tuple[Complex[Array, " cell"], Complex[Array, " cell"]] | None
    cells: int = eqx.field(static=True)
    length: int = eqx.field(static=True)
    kept: int = eqx.field(static=True)
    blocks: tuple[int, int] = eqx.field(static=True)
    spacing_m: float = eqx.field(static=True)
    expected_error: float = eqx.field(static=True)

    def energy(self, pupil: PupilRows, rows: PyTree, shared: PyTree) -> Float[Array, "v u"]:
        """Energy in every pixel of the window, per unit power incident on the clear aperture.

        Args:
            pupil: function (rows, shared) -> complex field `[row, x]` behind the DOE; zero rows must give a
                zero field.
            rows: pytree of arrays whose first axis is the grid's y; `pupil` receives blocks of them.
            shared: pytree passed to every block unchanged.

        Returns:
            `[y, x]` energies; differentiable in every floating-point leaf of `rows` and `shared`.
        """
        return _pixel_energy((rows, shared), pupil, self)


def plan_far_field(
    camera: Camera,
    wavelength_m: float,
    *,
    sampling: float | None = None,
    cell: bool = True,
) -> FarField:
    """Prepare the transform of one wavelength.

    Args:
        camera: DOE grid (square), aperture, lens and sensor.
        wavelength_m: vacuum wavelength.
        sampling: samples per lambda d / D on the sensor, at least 1; by default as many as predict an error of
            at most `TOLERANCE`.
        cell: include the sinc² of a square DOE cell; False treats cells as points.

    Returns:
        a plan whose pixel energies are per unit power incident on the clear aperture.

    Raises:
        ValueError: a DOE grid that is not square, or `sampling` below 1.
    """
    ny, nx = camera.grid.shape
    if ny != nx:
        raise ValueError(f"`camera.grid` must be square, but got {camera.grid.shape}")
    if sampling is None:
        airy = wavelength_m * camera.sensor_distance_m / camera.aperture_m
        sampling = sampling_for(camera.pixel_m * camera.fill / airy, TOLERANCE)
    if sampling < 1:
        raise ValueError(f"`sampling` must be at least 1, but got {sampling}")
    pitch = camera.grid.pitch_m
    needed = max(nx, int(np.ceil(sampling * camera.aperture_m / pitch - 1e-9)))
    length = cast(int, next_fast_len(needed, real=True))
    spacing = wavelength_m * camera.sensor_distance_m / (length * pitch)
    width = camera.pixel_m * camera.fill / spacing
    half = camera.window * camera.pixel_m / 2 / spacing + width + 8
    kept = 64 * int(np.ceil(2 * half / 64))
    cutoff = camera.aperture_m / (length * pitch)
    # An amplitude per cell of area pitch² gives U = sum t pitch² / (lambda d); a sample stands for spacing².
    area = np.pi * camera.aperture_m**2 / 4
    scale = (pitch**2 / (wavelength_m * camera.sensor_distance_m)) * spacing / np.sqrt(area)
    weights = pixel_weights(camera.axis_m() / spacing + kept // 2, width, cutoff, kept)
    envelope = np.sinc((np.arange(kept) - kept // 2) / length) ** 2 if cell else np.ones(kept)
    matrix = weights.matrix * (scale * envelope)[:, None]
    return FarField(
        gather=Banded.from_dense(matrix),
        spread=Banded.from_dense(matrix.T, 256),
        tilt=None,
        cells=nx,
        length=length,
        kept=kept,
        blocks=(block_size(nx), block_size(kept)),
        spacing_m=spacing,
        expected_error=float(np.sqrt(2) * weights.expected_error),
    )


def displaced(plan: FarField, offset_m: Float[Array, "2"]) -> FarField:
    """The same plan with every image moved by (y, x) metres on the sensor, by tilting the pupil.

    The optimiser moves the image by a random fraction of a pixel at every step: a design must not depend on where
    on the pixel grid a point of the scene falls, and the errors of a sparse `sampling` then average out.
    """
    cells = jnp.arange(plan.cells) - (plan.cells - 1) / 2
    waves = cells / (plan.length * plan.spacing_m)
    return eqx.tree_at(
        lambda p: p.tilt,
        plan,
        (cis(waves * offset_m[0]), cis(waves * offset_m[1])),
        is_leaf=lambda leaf: leaf is None,
    )


def _transform(field: Complex[Array, "row n"], length: int) -> Complex[Array, "row length"]:
    padding = length - field.shape[-1]
    if padding:
        field = jnp.concatenate([field, jnp.zeros((field.shape[0], padding), field.dtype)], axis=-1)
    return jnp.fft.fft(field)


def _central(spectrum: Complex[Array, "row length"], kept: int) -> Complex[Array, "row kept"]:
    """Samples -kept/2 .. kept/2-1 of a periodic spectrum in FFT order."""
    half, length = kept // 2, spectrum.shape[-1]
    if kept > length:
        return jnp.take(spectrum, np.arange(-half, half) % length, axis=-1)
    return jnp.concatenate([spectrum[..., length - half :], spectrum[..., :half]], axis=-1)


def _uncentral(samples: Complex[Array, "row kept"], length: int) -> Complex[Array, "row length"]:
    """Transpose of `_central`."""
    kept = samples.shape[-1]
    half = kept // 2
    if kept > length:
        out = jnp.zeros((samples.shape[0], length), samples.dtype)
        return out.at[:, np.arange(-half, half) % length].add(samples)
    gap = jnp.zeros((samples.shape[0], length - kept), samples.dtype)
    return jnp.concatenate([samples[..., half:], gap, samples[..., :half]], axis=-1)


def _forward(plan: FarField, pupil: PupilRows, rows: PyTree, shared: PyTree) -> tuple[Array, Array]:
    """Pixel energies, and the sensor field `[x, y]` at the kept samples."""
    pupil_block, sensor_block = plan.blocks

    def along_x(block_rows: PyTree) -> Array:
        field = pupil(block_rows, shared)
        if plan.tilt is not None:
            field = field * plan.tilt[1]
        return _central(_transform(field, plan.length), plan.kept)

    half_done = jax.lax.map(along_x, in_blocks(rows, pupil_block))
    half_done = half_done.reshape(-1, plan.kept)[: plan.cells]

    def along_y(block: Array) -> tuple[Array, Array]:
        columns = jax.lax.dynamic_slice(half_done, (0, block * sensor_block), (plan.cells, sensor_block)).T
        if plan.tilt is not None:
            columns = columns * plan.tilt[0]
        field = _central(_transform(columns, plan.length), plan.kept)
        return plan.gather(field.real**2 + field.imag**2), field

    columns, field = jax.lax.map(along_y, jnp.arange(plan.kept // sensor_block))
    return plan.gather(columns.reshape(plan.kept, -1).T), field


@eqx.filter_custom_vjp
def _pixel_energy(operands: tuple[PyTree, PyTree], pupil: PupilRows, plan: FarField) -> Array:
    return _forward(plan, pupil, *operands)[0]


@_pixel_energy.def_fwd
def _save_field(_perturbed: PyTree, operands: tuple[PyTree, PyTree], pupil: PupilRows, plan: FarField) -> Any:
    return _forward(plan, pupil, *operands)


@_pixel_energy.def_bwd
def _adjoint(
    field: Array,
    cotangent: Array,
    perturbed: tuple[PyTree, PyTree],
    operands: tuple[PyTree, PyTree],
    pupil: PupilRows,
    plan: FarField,
) -> tuple[PyTree, PyTree]:
    """Transposed transforms: pixels -> samples -> pupil -> whatever made the pupil.

    With L = sum cotangent * energy, dL/dU = 2 conj(U) * (spread cotangent) in JAX's convention for complex
    cotangents, and the transpose of a Fourier transform is itself.
    """
    (rows, shared), (constant_rows, constant_shared) = eqx.partition(operands, perturbed)
    pupil_block, sensor_block = plan.blocks
    half_spread = plan.spread(cotangent).T.reshape(-1, sensor_block, cotangent.shape[0])

    def along_y(block: tuple[Array, Array]) -> Array:
        weights, sensor = block
        back = 2.0 * plan.spread(weights) * jnp.conj(sensor)
        columns = _transform(_uncentral(back, plan.length), plan.length)[:, : plan.cells]
        return columns if plan.tilt is None else columns * plan.tilt[0]

    half_done = jax.lax.map(along_y, (half_spread, field)).reshape(plan.kept, plan.cells)
    half_done = jnp.pad(half_done, ((0, 0), (0, -plan.cells % pupil_block)))

    def along_x(carry: PyTree, block: tuple[Array, PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        index, block_rows, block_constants = block
        columns = jax.lax.dynamic_slice(half_done, (0, index * pupil_block), (plan.kept, pupil_block)).T
        cotangents = _transform(_uncentral(columns, plan.length), plan.length)[:, : plan.cells]
        if plan.tilt is not None:
            cotangents = cotangents * plan.tilt[1]

        def field_of(rows: PyTree, shared: PyTree) -> Array:
            return pupil(eqx.combine(rows, block_constants), eqx.combine(shared, constant_shared))

        row_part, shared_part = jax.vjp(field_of, block_rows, shared)[1](cotangents)
        return jax.tree.map(jnp.add, carry, shared_part), row_part

    count = half_done.shape[1] // pupil_block
    blocks = (jnp.arange(count), *(in_blocks(r, pupil_block) for r in (rows, constant_rows)))
    shared_part, row_parts = jax.lax.scan(along_x, jax.tree.map(jnp.zeros_like, shared), blocks)
    row_parts = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: plan.cells], row_parts)
    return row_parts, shared_part
