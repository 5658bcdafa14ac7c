"""From the field behind the DOE to the energy in every sensor pixel: the default path (paper eqs. 7-9).

With the sensor in the focal plane the lens cancels the quadratic term of Fresnel propagation and the field on the
sensor is the Fourier transform of the pupil, U(u) = (1 / lambda d) ∫ t exp(-2 pi i x.u / (lambda d)) d²x.

* **The sensor's own pixels.** The paper takes one FFT and resizes the result by nearest neighbour. Here the intensity
  is sampled finely enough to be integrated over each pixel (`sim.propagation.pixel`).
* **The cell of the DOE.** A DOE is a plate of squares with a constant phase, not a comb of points; its far field
  carries the factor sinc² along each axis and what that removes from the window goes to higher orders. At the ring of
  the paper's design (lambda / 3 pitch) the factor is 0.68: a comb would overstate the ring by half.
* **Only what is needed.** The transform along x keeps the samples the window needs before the transform along y, both
  in blocks of rows that stay in the processor's cache. The *field* holds half the frequencies of its intensity: it is
  transformed at 1.25 samples per lambda d / D and interpolated, by short banded products, to the spacing at which its
  intensity can be integrated.

A near source lights the cells obliquely, so the sinc of a cell is centred on the direction in which its undiffracted
light leaves. 5 cm before the paper's plate that is up to a seventh of the band; one sinc about the axis would take 3 %
from the blur disc and leave errors of 3-8 % in the image. The direction is linear in the cell's position, so the
interpolation carries the factor: its weights become complex and nothing is transformed twice.

Samples are equidistant in the direction sine, and so are the pixels of an ideal "sine" lens. Behind any other
(`Camera.mapping`, `Camera.distortion`), and on a sensor that is turned or stretched, pixels lie elsewhere among the
samples (`sim.propagation.places`) and are integrated there (`sim.propagation.mapped`).

A plan (`plan_far_field`) is made once in float64 on the host and holds float32 operators. `FarField.energy` applies it
to a pupil given as a function of blocks of rows (`sim.propagation.pupil`), so a phase-only pupil is never stored; its
gradient is written out (one adjoint transform) and checked against finite differences.

`sampling` counts samples per lambda d / D: 2 is the Nyquist rate of the intensity, and the default adds as much as a
short integration rule needs for a predicted error of 2e-3. At 1 the transform is the bare FFT of the pupil: a quarter
of the work, enough to estimate energies when the image moves by a fraction of a pixel from call to call (`displaced`).
"""

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree
from scipy.fft import next_fast_len

from fab.aperture import RoundAperture
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera
from sim.lens import direction_sines
from sim.propagation.field_weights import FIELD_TAPS, field_weights
from sim.propagation.mapped import MappedPixels, plan_mapped_pixels
from sim.propagation.pixel import Banded, PixelWeights, pixel_weights, sampling_for
from sim.propagation.places import cubic_places, largest_reach, window_places
from sim.propagation.pupil import PupilRows, block_size, cis, in_blocks

TOLERANCE = 2e-3  # predicted relative L2 error of pixel energies, unless a plan says otherwise
# Samples of the field per lambda d / D; 1 is its Nyquist rate, and a fourth more lets few taps interpolate it.
_FIELD_SAMPLING = 1.25
_ROWS = 64  # of samples of the intensity: their number is a multiple, and so many stay in a processor's cache


class FarField(eqx.Module):
    """Operators of one wavelength and depth."""

    # Samples -> pixels: along either axis, with all constant factors (`spread` is its transpose), or at places of a map
    gather: Banded | None
    spread: Banded | None
    pixels: MappedPixels | None
    # Samples of the field -> samples of the intensity along either axis, with the cell's sinc (real weights for a
    # distant source), or None if the samples are the same; `coarsen` is its transpose
    refine: Banded | None
    coarsen: Banded | None
    # Phase ramps (y, x) over the pupil that displace the image, or None (see `displaced`)
    tilt: tuple[Complex[Array, " cell"], Complex[Array, " cell"]] | None
    # Share of every pixel that is a direction of light (y, x), or None where all of them are
    visible: Float[Array, "v u"] | None
    cells: tuple[int, int] = eqx.field(static=True)  # DOE cells (y, x)
    length: int = eqx.field(static=True)  # transform length per axis
    kept: int = eqx.field(static=True)  # samples of the field kept around the axis
    blocks: tuple[int, int] = eqx.field(static=True)  # rows per block in the pupil and on the sensor
    spacing_m: float = eqx.field(static=True)  # distance of the field's samples on the sensor
    sample_m: float = eqx.field(static=True)  # distance of the intensity's samples
    # No static field: it changes with depth, and every depth would be compiled anew.
    expected_error: float  # predicted relative L2 error of the pixel energies of a speckle-like image

    @property
    def looped(self) -> "FarField":
        """The same, compiled in a third of the time: to the same bits, and at most a tenth slower."""
        parts = (self.gather, self.spread, self.refine, self.coarsen)
        gather, spread, refine, coarsen = (part and part.looped for part in parts)
        return replace(self, gather=gather, spread=spread, refine=refine, coarsen=coarsen)

    def energy(self, pupil: PupilRows, rows: PyTree, shared: PyTree) -> Float[Array, "v u"]:
        """Energy `[y, x]` in every pixel of the window, per unit power incident on the clear aperture.

        Args:
            pupil: function (rows, shared) -> complex field `[row, x]` behind the DOE; zero rows must give a zero field.
            rows: pytree of arrays whose first axis is the grid's y; `pupil` receives blocks of them.
            shared: pytree passed to every block unchanged. The result is differentiable in it, `rows` and `pixels`.
        """
        energy = _pixel_energy((rows, shared, self.pixels), pupil, _with_pixels(self, None))
        return energy if self.visible is None else energy * self.visible


@lru_cache(maxsize=32)
def plan_far_field(
    camera: Camera,
    wavelength_m: float,
    *,
    depth_m: float = np.inf,
    sampling: float | None = None,
    cell: bool = True,
    field_rad: tuple[float, float] = (0.0, 0.0),
    room: float = 0.0,
) -> FarField:
    """Prepare the transform of one wavelength and depth. Kept, for every DOE of a tolerance study needs the same few.

    Args:
        camera: DOE grid, aperture, lens and sensor.
        wavelength_m: vacuum wavelength.
        depth_m: source depth; without influence below a `sampling` of 2, where the cell's sinc stays centred on the
            axis.
        sampling: samples per lambda d / D on the sensor, D the longer side of an aperture that is not round, at least
            1; by default as many as predict an error of `TOLERANCE`.
        cell: include the sinc² of a square DOE cell; False treats cells as points.
        field_rad: field angles (y, x); without influence if the lens has the mapping "sine" and no distortion, and no
            beam is tilted. Without a sensor they say which pixels lie beyond a sine of 1, where there is no light.
        room: by how much `bent` may turn, shear or stretch the image, a share; 0 is for a sensor that is perfect.
    """
    ny, nx = camera.grid.shape
    is_round = isinstance(camera.opening, RoundAperture)
    if sampling is None:
        airy = wavelength_m * camera.sensor_distance_m / camera.opening.widest_m
        sampling = sampling_for(camera.pixel_m * camera.fill / airy, TOLERANCE, is_round)
    if sampling < 1:
        raise ValueError(f"`sampling` must be at least 1, but got {sampling}")
    scale = wavelength_m * camera.sensor_distance_m
    pitch, aperture = camera.grid.pitch_m, camera.opening.widest_m
    # Below two samples the intensity is aliased whatever is done, and the bare transform is the cheapest estimate.
    bare = sampling < 2
    needed = (sampling if bare else _FIELD_SAMPLING) * aperture / pitch
    length = cast(int, next_fast_len(max(ny, nx, int(np.ceil(needed - 1e-9))), real=True))
    spacing = scale / (length * pitch)
    fine = spacing if bare else scale / (sampling * aperture)
    width = camera.pixel_m * camera.fill / fine
    places = None if camera.images_alike and not room else window_places(camera, fine, field_rad)
    reach = camera.window * camera.pixel_m / 2 / fine
    if places is not None:
        reach = largest_reach(places, camera.window) * (1 + 2 * room)
    half = reach + width + 8
    samples = _ROWS * int(np.ceil(2 * half / _ROWS))
    kept = samples if bare else 64 * int(np.ceil((samples * fine / spacing + FIELD_TAPS + 2) / 64))
    positions = (np.arange(samples) - samples // 2) * fine
    # An amplitude per cell of area pitch² gives U = sum t pitch² / (lambda d); a sample stands for fine².
    amount = pitch**2 / scale * fine / np.sqrt(camera.opening.area_m2)
    envelope = np.sinc(positions * pitch / scale) ** 2 if cell and bare else np.ones(samples)
    cutoff, factor = aperture * fine / scale, amount * envelope
    gather, spread, pixels, refine, missed = None, None, None, None, 0.0
    # Bare transforms are those of long optimisations, compiled once.
    banded = partial(Banded.from_dense, batched=not bare)
    if places is None:
        weights = _pixel_rule(camera, width, fine, cutoff, samples, is_round)
        matrix, miscounted = weights.matrix * factor[:, None], np.sqrt(2) * weights.expected_error
        gather, spread = banded(matrix), banded(matrix.T, 256)
    else:
        pixels, miscounted = plan_mapped_pixels(places, camera.window, camera.fill, cutoff, factor, room, is_round)
    if not bare:
        curvature = camera.curvature_per_m(1 / depth_m) + camera.beam_curvature_per_m(wavelength_m)
        slope = curvature * pitch**2 / wavelength_m if cell else None
        refine, missed = field_weights(positions / spacing + kept // 2, kept, length, aperture / pitch, slope, is_round)
    return FarField(
        gather=gather,
        spread=spread,
        pixels=pixels,
        refine=None if refine is None else banded(refine),
        coarsen=None if refine is None else banded(refine.T),
        tilt=None,
        visible=_visible(camera, field_rad),
        cells=(ny, nx),
        length=length,
        kept=kept,
        blocks=(block_size(ny), block_size(kept)),
        spacing_m=spacing,
        sample_m=fine,
        expected_error=np.hypot(miscounted, 2 * np.sqrt(2) * missed),
    )


def _visible(camera: Camera, field_rad: tuple[float, float]) -> Array | None:
    """Share of every pixel within a sine of 1, or None where all lie there."""
    chief, half = direction_sines(field_rad), camera.window * camera.pixel_m / 2
    if not camera.in_angles or np.hypot(*(np.abs(chief) + half)) <= 1:
        return None
    y, x = (float(-sine) for sine in chief)
    with jax.ensure_compile_time_eval():  # the plan is kept, and the first to ask for it may be a trace
        return jnp.asarray(circle_coverage(Grid((camera.window, camera.window), camera.pixel_m), 2.0, (y, x)))


@lru_cache(maxsize=32)
def _pixel_rule(camera: Camera, width: float, fine: float, cutoff: float, samples: int, is_round: bool) -> PixelWeights:
    """`pixel_weights` for samples `fine` metres apart; kept, for every depth of a wavelength has the same."""
    return pixel_weights(camera.axis_m() / fine + samples // 2, width, cutoff, samples, is_round)


def displaced(plan: FarField, offset_m: Float[Array, "2"]) -> FarField:
    """The same plan with every image moved by (y, x) metres on the sensor, by tilting the pupil.

    The optimiser moves the image by a random fraction of a pixel at every step: a design must not depend on where on
    the pixel grid a point falls, and the errors of a sparse `sampling` average out.
    """
    cells = [jnp.arange(count) - (count - 1) / 2 for count in plan.cells]
    waves = [one / (plan.length * plan.spacing_m) for one in cells]
    tilt = cis(waves[0] * offset_m[0]), cis(waves[1] * offset_m[1])
    return eqx.tree_at(lambda p: p.tilt, plan, tilt, is_leaf=lambda leaf: leaf is None)


def bent(plan: FarField, camera: Camera, displacement_m: Float[Array, "2 term"]) -> FarField:
    """The same plan with pixels displaced on the sensor by cubic polynomials of their place; differentiable in them.

    Args:
        plan: one that was made for this camera on the axis, with enough `room`; farther pixels are NaN.
        camera: the camera, whose window follows no beam aslant; a ValueError otherwise.
        displacement_m: coefficients (`sim.propagation.places.cubic_places`), metres.
    """
    if plan.pixels is None:
        raise ValueError("`plan` must have been made with `room` for its pixels to move")
    if any(camera.chief_rad((0.0, 0.0))):
        raise ValueError(f"`camera` must look along its axis, but its beam's angle is {camera.chief_rad((0.0, 0.0))}")
    moved = plan.pixels.at(cubic_places(window_places(camera, plan.sample_m), camera, displacement_m))
    return _with_pixels(plan, moved)


def _with_pixels(plan: FarField, pixels: MappedPixels | None) -> FarField:
    return eqx.tree_at(lambda p: p.pixels, plan, pixels, is_leaf=lambda leaf: leaf is None)


def _transform(plan: FarField, field: Complex[Array, "row n"]) -> Complex[Array, "row length"]:
    """FFT of rows; where it is to be interpolated their middle is the origin, so that it varies slowly enough."""
    cells = field.shape[-1]
    middle = 0 if plan.refine is None else cells // 2
    if middle or plan.length > cells:
        gap = jnp.zeros((field.shape[0], plan.length - cells), field.dtype)
        field = jnp.concatenate([field[:, middle:], gap, field[:, :middle]], axis=-1)
    return jnp.fft.fft(field)


def _untransform(plan: FarField, spectrum: Complex[Array, "row length"], cells: int) -> Complex[Array, "row n"]:
    """Transpose of `_transform` of so many cells."""
    middle, field = 0 if plan.refine is None else cells // 2, jnp.fft.fft(spectrum)
    if not middle:
        return field[:, :cells]
    return jnp.concatenate([field[:, plan.length - middle :], field[:, : cells - middle]], axis=-1)


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
    """Pixel energies, and the sensor field at the samples of the intensity for the way back.

    It is `[real or imaginary, y, x]`, or `[block, x, y]` and complex where nothing is interpolated.
    """
    pupil_block, sensor_block = plan.blocks

    def along_x(block_rows: PyTree) -> Array:
        field = pupil(block_rows, shared)
        if plan.tilt is not None:
            field = field * plan.tilt[1]
        return _central(_transform(plan, field), plan.kept)

    half_done = jax.lax.map(along_x, in_blocks(rows, pupil_block))
    half_done = half_done.reshape(-1, plan.kept)[: plan.cells[0]]

    def along_y(block: Array) -> Array:
        columns = jax.lax.dynamic_slice(half_done, (0, block * sensor_block), (plan.cells[0], sensor_block)).T
        if plan.tilt is not None:
            columns = columns * plan.tilt[0]
        return _central(_transform(plan, columns), plan.kept)

    blocks, refine, pixels = jnp.arange(plan.kept // sensor_block), plan.refine, plan.pixels
    gather = cast(Banded, plan.gather)  # used where there are no `pixels`
    if refine is None and pixels is not None:
        fields = jax.lax.map(along_y, blocks)
        return pixels.energy(_intensity(plan, fields)), fields
    if refine is None:
        # The samples are those of the intensity: a block is integrated while it is in the cache.
        def integrated(block: Array) -> tuple[Array, Array]:
            field = along_y(block)
            return gather(field.real**2 + field.imag**2), field

        columns, fields = jax.lax.map(integrated, blocks)
        return gather(columns.reshape(plan.kept, -1).T), fields

    def refined(block: Array) -> Array:
        field = along_y(block)
        return refine.of_complex(jnp.stack([field.real, field.imag]))

    parts = jax.lax.map(refined, blocks)  # [block, part, x, y]
    parts = jnp.transpose(parts, (1, 3, 0, 2)).reshape(2, parts.shape[3], plan.kept)
    if pixels is not None:
        parts = refine.of_complex(parts)
        return pixels.energy(_intensity(plan, parts)), parts

    # Rows of samples are integrated while they are in the cache.
    def integrated_rows(rows: Array) -> tuple[Array, Array]:
        fine = refine.of_complex(rows)
        return gather(fine[0] ** 2 + fine[1] ** 2), fine

    count = _ROWS if jax.default_backend() == "cpu" else parts.shape[1]
    rows = jnp.moveaxis(parts.reshape(2, -1, count, plan.kept), 1, 0)
    columns, fine = jax.lax.map(integrated_rows, rows)
    columns, parts = columns.reshape(-1, columns.shape[-1]), jnp.moveaxis(fine, 0, 1)
    return gather(columns.T).T, parts.reshape(2, len(columns), -1)


def _intensity(plan: FarField, parts: Array) -> Float[Array, "y x"]:
    """Intensity of a field as `_forward` leaves it."""
    if plan.refine is None:
        return (parts.real**2 + parts.imag**2).reshape(plan.kept, -1).T
    return parts[0] ** 2 + parts[1] ** 2


Operands = tuple[PyTree, PyTree, MappedPixels | None]


@eqx.filter_custom_vjp
def _pixel_energy(operands: Operands, pupil: PupilRows, plan: FarField) -> Array:
    return _images(operands, pupil, plan)[0]


@_pixel_energy.def_fwd
def _save_field(_perturbed: PyTree, operands: Operands, pupil: PupilRows, plan: FarField) -> Any:
    return _images(operands, pupil, plan)


def _images(operands: Operands, pupil: PupilRows, plan: FarField) -> tuple[Array, Array]:
    rows, shared, pixels = operands
    return _forward(_with_pixels(plan, pixels), pupil, rows, shared)


@_pixel_energy.def_bwd
def _adjoint(
    parts: Array,
    cotangent: Array,
    perturbed: tuple[PyTree, PyTree, PyTree],
    operands: Operands,
    pupil: PupilRows,
    plan: FarField,
) -> tuple[PyTree, PyTree, PyTree]:
    """Transposed operators: pixels -> samples -> pupil -> whatever made the pupil.

    With L = sum cotangent * energy, dL/dU = 2 conj(U) * (spread cotangent) in JAX's convention for complex
    cotangents, and the transpose of a Fourier transform is itself.
    """
    (rows, shared, pixels), (constant_rows, constant_shared, constant_pixels) = eqx.partition(operands, perturbed)
    (pupil_block, sensor_block), coarsen, spread = plan.blocks, plan.coarsen, plan.spread
    to_pixels: Any = None

    def along_y(samples: Array) -> Array:
        columns = _untransform(plan, _uncentral(samples, plan.length), plan.cells[0])
        return columns if plan.tilt is None else columns * plan.tilt[0]

    if spread is None:

        def energy_of(intensity: Array, pixels: MappedPixels) -> Array:
            return eqx.combine(pixels, constant_pixels).energy(intensity)

        weights, to_pixels = eqx.filter_vjp(energy_of, _intensity(plan, parts), pixels)[1](cotangent)
    else:
        weights = spread(cotangent).T  # the other axis is left to blocks where there is no other pass
        weights = weights if coarsen is None else spread(weights).T
    if coarsen is None:
        by_column = weights.T if spread is None else weights

        def spread_block(block: tuple[Array, Array]) -> Array:
            weights, field = block
            weights = weights if spread is None else spread(weights)
            return along_y(2.0 * weights * jnp.conj(field))

        half_done = jax.lax.map(spread_block, (by_column.reshape(-1, sensor_block, by_column.shape[1]), parts))
    else:
        back = jnp.stack([2.0 * weights * parts[0], -2.0 * weights * parts[1]])
        back = coarsen.of_complex(back)
        back = jnp.transpose(back.reshape(2, back.shape[1], -1, sensor_block), (2, 0, 3, 1))

        def coarse_block(block: Array) -> Array:
            real, imaginary = coarsen.of_complex(block)
            return along_y(jax.lax.complex(real, imaginary))

        half_done = jax.lax.map(coarse_block, back)
    half_done = half_done.reshape(plan.kept, plan.cells[0])
    half_done = jnp.pad(half_done, ((0, 0), (0, -plan.cells[0] % pupil_block)))

    def along_x(carry: PyTree, block: tuple[Array, PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        index, block_rows, block_constants = block
        columns = jax.lax.dynamic_slice(half_done, (0, index * pupil_block), (plan.kept, pupil_block)).T
        cotangents = _untransform(plan, _uncentral(columns, plan.length), plan.cells[1])
        if plan.tilt is not None:
            cotangents = cotangents * plan.tilt[1]

        def field_of(rows: PyTree, shared: PyTree) -> Array:
            return pupil(eqx.combine(rows, block_constants), eqx.combine(shared, constant_shared))

        row_part, shared_part = jax.vjp(field_of, block_rows, shared)[1](cotangents)
        return jax.tree.map(jnp.add, carry, shared_part), row_part

    count = half_done.shape[1] // pupil_block
    blocks = (jnp.arange(count), *(in_blocks(r, pupil_block) for r in (rows, constant_rows)))
    shared_part, row_parts = jax.lax.scan(along_x, jax.tree.map(jnp.zeros_like, shared), blocks)
    row_parts = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: plan.cells[0]], row_parts)
    return row_parts, shared_part, to_pixels
