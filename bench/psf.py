"""Far-field PSFs against prysm and against bare transforms: time, accuracy, memory.

    python -m bench.psf            N = 2048 and 4096, some minutes
    python -m bench.psf --quick    N = 1024 alone, in seconds; the targets are for the full sizes

The task: a 4 mm plate, f = 8 mm, 589 nm, sixteen levels, 512 x 512 pixels of 1.85 um. Ours are energies integrated over
the pixel; prysm's are float32 chirp-z *point samples* of the same pitch (`Wavefront.focus_fixed_sampling`), the easier
task. Its gradient is written by hand with `unfocus_fixed_sampling`, whose conjugate is the adjoint, and is checked
against finite differences before anything is timed. prysm runs twice: as it comes, and with every core in its FFT.

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
from doedesign.runtime.memory import peak_bytes
from sim.aperture import circle_coverage
from sim.camera import Camera

TARGET_RATIO = {2048: 0.5, 4096: 0.25}
TARGET_ERROR = 3e-3
TARGET_PEAK_MB = 700
FEATURE_M = 8e-6  # correlation length of the plate: most of the light falls into the window
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

    from sim.propagation.farfield import plan_far_field
    from sim.propagation.pupil import DoeRows, doe_field
    from sim.source import MapColumns

    plan = plan_far_field(task.camera, YELLOW_M)
    columns = MapColumns(jnp.float32(task.camera.waves_per_metre(YELLOW_M)))
    height, coverage, weights = (jnp.asarray(a) for a in (task.height_m, task.coverage, task.weights))
    source = jnp.zeros_like(height)

    def psf(height: jax.Array, source: jax.Array, coverage: jax.Array) -> jax.Array:
        return plan.energy(doe_field, DoeRows(coverage, height, None, source), columns)

    forward = jax.jit(psf)
    gradient = jax.jit(jax.value_and_grad(lambda *rows: jnp.sum(weights * psf(*rows))))
    return Method(
        lambda: forward(height, source, coverage).block_until_ready(),
        lambda: jax.block_until_ready(gradient(height, source, coverage))[1],
    )


def prysm_wavefronts(task: Task, shift_px: float = 0.0) -> tuple[Any, Any]:
    """Return prysm's fields in the pupil and at points of the sensor, moved by a share of a pixel.

    Its samples lie on multiples of the pixel; half a pixel moves them to the centres of an even window.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # prysm reads its version through pkg_resources
        from prysm.conf import config  # pyright: ignore[reportMissingImports]
        from prysm.propagation import Wavefront  # pyright: ignore[reportMissingImports]
    config.precision = 32
    camera = task.camera
    delay_nm = np.float32(camera.waves_per_metre(YELLOW_M) * YELLOW_M * 1e9)
    pixel_um, pitch_mm = camera.pixel_m * 1e6, camera.grid.pitch_m * 1e3
    pupil = Wavefront.from_amp_and_phase(task.coverage, task.height_m * delay_nm, YELLOW_M * 1e6, pitch_mm)
    shift = (-shift_px * pixel_um, -shift_px * pixel_um)
    return pupil, pupil.focus_fixed_sampling(camera.focal_length_m * 1e3, pixel_um, camera.window, shift, "czt")


def prysm(task: Task) -> Method:
    """Build prysm's chirp-z transform in single precision and its adjoint."""
    camera = task.camera
    focal_mm, pixel_um, pitch_mm = camera.focal_length_m * 1e3, camera.pixel_m * 1e6, camera.grid.pitch_m * 1e3
    cells = camera.grid.shape[0]
    # Their forward transform carries 1 / (Q N) and their backward one 1 / window, both per two axes.
    samples_per_airy = YELLOW_M * 1e6 * focal_mm / (cells * pitch_mm * pixel_um)
    factor = -4 * np.pi * camera.waves_per_metre(YELLOW_M) * camera.window / (cells * samples_per_airy)

    def gradient() -> NDArray[np.float32]:
        pupil, sensor = prysm_wavefronts(task)
        sensor.data = task.weights * sensor.data
        back = sensor.unfocus_fixed_sampling(focal_mm, pitch_mm, cells, method="czt")
        return (back.data * pupil.data).imag * np.float32(factor)

    return Method(lambda: prysm_wavefronts(task)[1].intensity.data, gradient)


def prysm_threaded(task: Task) -> Method:
    """Build the same with scipy's FFT, which prysm calls, told to use every core."""
    import os

    from scipy.fft import set_workers

    plain, cores = prysm(task), os.cpu_count() or 1

    def threaded(call: Callable[[], Any]) -> Callable[[], Any]:
        def run() -> Any:
            with set_workers(cores):
                return call()

        return run

    return Method(threaded(plain.forward), threaded(plain.gradient))


def bare_fft(task: Task) -> Method:
    """Build the floor: one full complex64 transform of the plate's size, and two of them."""
    import jax
    import jax.numpy as jnp

    transform = jax.jit(jnp.fft.fft2)
    field = jnp.ones(task.camera.grid.shape, jnp.complex64)
    return Method(lambda: transform(field).block_until_ready(), lambda: transform(transform(field)).block_until_ready())


METHODS: dict[str, tuple[str, Callable[[Task], Method]]] = {
    "ours": ("pixel-integrated, doedesign", ours),
    "prysm": ("point samples, prysm float32 CZT", prysm),
    "prysm2": ("the same, all cores in its FFT", prysm_threaded),
    "fft": ("bare FFT of N x N (gradient: two)", bare_fft),
}


def adjoint_error(build: Callable[[Task], Method]) -> float:
    """Relative difference between a method's gradient and central differences along it, on a small plate."""
    task = make_task(256)
    height = np.zeros_like(task.height_m)
    height += task.height_m
    gradient = np.asarray(build(task).gradient(), np.float64)
    way = gradient / np.abs(gradient).max() * 1e-8

    def loss(step: float) -> float:
        moved = build(task._replace(height_m=(height + step * way).astype(np.float32)))
        return float(np.sum(task.weights * np.asarray(moved.forward(), np.float64)))

    slope = (loss(1.0) - loss(-1.0)) / 2
    return abs(slope / float(np.sum(gradient * way)) - 1)


def time_rounds(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, NDArray[np.float64]]:
    """Return seconds `[round]` of every call, all of them taking turns; a first turn of each is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            if turn:
                seconds[name].append(time.perf_counter() - start)
    return {name: np.array(values) for name, values in seconds.items()}


def report_peak(name: str, cells: int, folder: Path) -> None:
    """Print the growth of this process's peak over three calls, in MB; inputs are read from `folder`."""
    build = METHODS[name][1]
    tiny = build(make_task(64))
    tiny.forward()
    tiny.gradient()
    before = peak_bytes() / 1e6
    arrays = [np.load(folder / f"{part}.npy", allow_pickle=False) for part in ("height", "coverage", "weights")]
    method = build(Task(make_camera(cells, 4e-3, 8e-3, 1.85e-6, 512), *arrays))
    del arrays
    for _ in range(3):
        method.forward()
    forward = peak_bytes() / 1e6 - before
    for _ in range(3):
        method.gradient()
    print(f"{forward:.0f} {peak_bytes() / 1e6 - before:.0f}")


def measure_peaks(task: Task) -> dict[str, tuple[float, float]]:
    """Return the peak of every method, (forward, with gradient), in MB over what its imports take."""
    peaks = {}
    with tempfile.TemporaryDirectory() as folder:
        for part, values in zip(("height", "coverage", "weights"), task[1:], strict=True):
            np.save(Path(folder) / f"{part}.npy", values)
        for name in ("ours", "prysm"):
            command = [sys.executable, "-m", "bench.psf", "--peak", name, "--folder", folder]
            command += ["--cells", str(task.camera.grid.shape[0])]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            forward, gradient = done.stdout.split()[-2:]
            peaks[name] = float(forward), float(gradient)
    return peaks


def verdict(value: float, target: float | None) -> str:
    """Return the target and whether it is met, or nothing."""
    return "" if target is None else f"   target <= {target:g}: {'ok' if value <= target else 'missed'}"


def report(cells: int) -> None:
    """Measure and print the table of one size."""
    task = make_task(cells)
    methods = {name: build(task) for name, (_, build) in METHODS.items()}
    target = TARGET_RATIO.get(cells)
    print(f"\nPSF of 512 x 512 pixels of 1.85 um, 4 mm plate of N = {cells}, f = 8 mm, 589 nm")
    for part in ("forward", "gradient"):
        seconds = time_rounds({name: getattr(m, part) for name, m in methods.items()}, ROUNDS[cells])
        print(f"  {'value and gradient' if part == 'gradient' else 'forward'}")
        for name, (title, _) in METHODS.items():
            ratios = seconds[name] / seconds["prysm"]
            told = verdict(float(np.median(ratios)), target if name == "ours" else None)
            print(
                f"    {title:36s}{np.median(seconds[name]) * 1e3:8.0f} ms   {np.median(ratios):5.2f} x prysm"
                f" ({ratios.min():.2f}-{ratios.max():.2f}){told}"
            )
    field = task.coverage * np.exp(2j * np.pi * task.height_m * task.camera.waves_per_metre(YELLOW_M))
    wanted = oversampled_psf(task.camera, YELLOW_M, field)
    del field
    image = np.asarray(methods["ours"].forward())
    points = np.asarray(prysm_wavefronts(task, 0.5)[1].intensity.data, np.float64)
    points *= wanted.sum() / points.sum()
    error = relative_error(image, wanted)
    print(
        f"  relative L2 error against 16 x 16 float64 samples per pixel; {wanted.sum():.0%} of the light in the window"
    )
    print(f"    {METHODS['ours'][0]:36s}{error:8.1e}" + verdict(error, TARGET_ERROR))
    print(f"    {METHODS['prysm'][0]:36s}{relative_error(points, wanted):8.1e}   (at the pixels' centres, same sum)")
    print("  peak memory over imports, inputs included, MB: forward, with gradient")
    for name, (forward, gradient) in measure_peaks(task).items():
        aim = TARGET_PEAK_MB if (name, cells) == ("ours", 4096) else None
        print(f"    {METHODS[name][0]:36s}{forward:8.0f}{gradient:8.0f}" + verdict(max(forward, gradient), aim))


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description="Far-field PSFs against prysm and bare transforms.")
    parser.add_argument("--quick", action="store_true", help="N = 1024 only")
    parser.add_argument("--peak", choices=tuple(METHODS), help=argparse.SUPPRESS)
    parser.add_argument("--cells", type=int, default=1024, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.peak:
        report_peak(given.peak, given.cells, given.folder)
        return
    print(f"prysm's adjoint by hand against finite differences: {adjoint_error(prysm):.1e}")
    for cells in (1024,) if given.quick else (2048, 4096):
        report(cells)


if __name__ == "__main__":
    main()
