"""Far-field PSFs against prysm and against bare transforms: time, accuracy, memory.

    python -m bench.psf            N = 2048 and 4096, some minutes
    python -m bench.psf --quick    N = 1024 alone, in seconds; the targets are for the full sizes

The task: a 4 mm plate, f = 8 mm, 589 nm, sixteen levels, 512 x 512 pixels of 1.85 um. Ours are energies integrated over
the pixel; prysm's are float32 chirp-z *point samples* on the same grid (`Wavefront.focus_fixed_sampling`), the easier task.
Its gradient is written by hand with `unfocus_fixed_sampling`, whose conjugate is the adjoint, and is checked against
finite differences before anything is timed. prysm runs twice: as it comes, and with both of its FFT's workers.

Every method takes its turn in every round, and a ratio is the median of the ratios within rounds. Memory is measured in
a process of its own per method, from its peak after the imports to its peak after three calls, inputs included.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.reference import YELLOW_M, make_camera, oversampled_psf, relative_error, wrapped_map
from sim.aperture import circle_coverage
from sim.camera import Camera

TARGET_RATIO = {2048: 0.5, 4096: 0.25}
TARGET_ERROR = 3e-3
TARGET_PEAK_MB = 700
FEATURE_M = 8e-6  # correlation length of the plate: two thirds of the light fall into the window
ROUNDS = {1024: 5, 2048: 11, 4096: 7}


class Task(NamedTuple):
    """Optics, the plate and the weights of the scalar whose gradient is taken."""

    camera: Camera
    height_m: NDArray[np.float32]
    coverage: NDArray[np.float32]
    weights: NDArray[np.float32]


class Method(NamedTuple):
    """One way to the PSF `[y, x]` and to the gradient `[y, x]` of its weighted sum by the height."""

    forward: Callable[[], Any]
    gradient: Callable[[], Any]


def make_task(cells: int) -> Task:
    """Return the task for a plate of so many cells."""
    camera = make_camera(cells, 4e-3, 8e-3, 1.85e-6, 512)
    height = wrapped_map(cells, smooth_cells=FEATURE_M / camera.grid.pitch_m).astype(np.float32)
    weights = np.random.default_rng(0).uniform(size=(512, 512)).astype(np.float32)
    return Task(camera, height, circle_coverage(camera.grid, camera.aperture_m), weights)


def ours(task: Task) -> Method:
    """Build `FarField.energy` at its default sampling, compiled."""
    import jax
    import jax.numpy as jnp

    from sim.farfield import plan_far_field
    from sim.pupil import PhaseRows, phase_pupil

    plan = plan_far_field(task.camera, YELLOW_M)
    rate = jnp.float32(task.camera.waves_per_metre(YELLOW_M))
    height, coverage, weights = (jnp.asarray(a) for a in (task.height_m, task.coverage, task.weights))
    source = jnp.zeros_like(height)

    def psf(height: jax.Array, source: jax.Array, coverage: jax.Array) -> jax.Array:
        return plan.energy(phase_pupil, PhaseRows(height, source, coverage), rate)

    forward = jax.jit(psf)
    gradient = jax.jit(jax.value_and_grad(lambda *rows: jnp.sum(weights * psf(*rows))))
    return Method(
        lambda: forward(height, source, coverage).block_until_ready(),
        lambda: jax.block_until_ready(gradient(height, source, coverage))[1],
    )


def prysm(task: Task) -> Method:
    """Build prysm's chirp-z transform in single precision and its adjoint."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # prysm reads its version through pkg_resources
        from prysm.conf import config
        from prysm.propagation import Wavefront
    config.precision = 32
    camera = task.camera
    lens = {"efl": camera.focal_length_m * 1e3, "method": "czt"}
    pixel_um, pitch_mm, wavelength_um = camera.pixel_m * 1e6, camera.grid.pitch_m * 1e3, YELLOW_M * 1e6
    delay_nm = np.float32(camera.waves_per_metre(YELLOW_M) * YELLOW_M * 1e9)
    cells = camera.grid.shape[0]
    # One sample of theirs is sqrt(energy per pixel): U pitch² pixel / (lambda f) / sqrt(area), with their 1 / (Q N) taken out.
    in_um = (1 / (pixel_um * pitch_mm * 1e3)) * wavelength_um * camera.focal_length_m * 1e6
    energy = np.float32((cells * in_um / cells / cells) ** 0)

    def image() -> tuple[Wavefront, Wavefront]:
        pupil = Wavefront.from_amp_and_phase(task.coverage, task.height_m * delay_nm, wavelength_um, pitch_mm)
        return pupil, pupil.focus_fixed_sampling(dx=pixel_um, samples=camera.window, **lens)

    def gradient() -> NDArray[np.float32]:
        pupil, sensor = image()
        back = Wavefront(task.weights * sensor.data, wavelength_um, pixel_um, space="psf")
        back = back.unfocus_fixed_sampling(dx=pitch_mm, samples=cells, **lens)
        return (back.data * pupil.data).imag * energy

    return Method(lambda: image()[1].intensity.data, gradient)
