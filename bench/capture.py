"""What the camera model costs: a 512² capture against its bare transforms, and a full frame by tiles.

    python -m bench.capture            minutes
    python -m bench.capture --quick    the 512² capture alone, seconds

**Capture.** 512 x 512 pixels in three colours, PSFs of 512 x 512 pixels at two depths, photon and read noise, one
obstruction at 5 cm. The floor is the bare transforms that the model cannot do without, `rfft2` and `irfft2` of jax over
the same shapes, in batches, with nothing between them: for `radiometric` 2 x 3 images forward and their 3 sums back in
1024², mask, disc and shadow in 720²; for `paper` the mask too is forward in 1024², and alpha and both images are back
for every colour. PSFs that are being learned add their own 6. (The capture itself transforms axis by axis and leaves
out what is zero, mirrored or cut off, so it can pass under this floor.) Captures and floors take turns, and a ratio is
the median of the ratios within rounds.

**Frame.** 4000 x 3000 pixels of 1.85 um in three colours, PSFs of 512 x 512 pixels on 5 x 5 field angles and two
depths, from arrays to array, in a process of its own whose peak memory is printed.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.psf import time_rounds
from doedesign.runtime.memory import peak_bytes
from sim.imaging.convolve import fast_length
from sim.imaging.formation import Optics, capture, shadow_px
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene
from sim.sensor.noise import photon_noise

TARGET_RATIO, TARGET_S, TARGET_GB = 1.5, 60.0, 8.0
PIXELS, WINDOW, COLOURS, ROUNDS = 512, 512, 3, 31
FULL_WELL_E, READ_NOISE_E = 10_000.0, 2.5
FRAME, NODES = (3000, 4000), 5
MODELS: tuple[Model, ...] = ("radiometric", "reciprocal", "paper", "paper_release")


def make_psf(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Speckle of unit sum."""
    psf = np.random.default_rng(seed).random(shape, np.float32) ** 4
    return psf / psf.sum(axis=(-2, -1), keepdims=True)


def make_scene(shape: tuple[int, int]) -> Scene:
    """A background and a spotted obstruction at 5 cm."""
    rng = np.random.default_rng(1)
    coarse = rng.random((shape[0] // 50 + 1, shape[1] // 50 + 1)) > 0.8
    mask = np.kron(coarse, np.ones((50, 50)))[: shape[0], : shape[1]].astype(np.float32)
    background, radiance = (rng.random((COLOURS, *shape), np.float32) for _ in range(2))
    return Scene(background, np.inf, (Obstruction(mask, 0.2 * radiance, 0.05),))


def bare(forward: int, back: int, smaller: tuple[int, int, int] | None = None) -> Callable[[], Any]:
    """Build so many transforms of 1024² each way, and (forward, back, length) smaller ones."""
    length = fast_length(PIXELS + WINDOW - 1)
    jobs = [(forward, back, length), *([smaller] if smaller else [])]
    rng = np.random.default_rng(0)
    inputs = [
        (
            jnp.asarray(rng.random((there, n, n), np.float32)),
            jnp.fft.rfft2(jnp.asarray(rng.random((again, n, n), np.float32))),
        )
        for there, again, n in jobs
    ]
    # Each in a program of its own: what they hand back then comes from memory that the process already has.
    there = [jax.jit(jnp.fft.rfft2) for _ in jobs]
    again = [jax.jit(lambda spectrum, n=n: jnp.fft.irfft2(spectrum, (n, n))) for _, _, n in jobs]

    def run() -> None:
        for (images, spectra), one, other in zip(inputs, there, again, strict=True):
            jax.block_until_ready((one(images), other(spectra)))

    return run


def noisy(scene: Scene, optics: Optics, model: Model) -> Callable[[], Any]:
    """Build a capture with photon and read noise, depths known, everything else an argument."""
    noise = jax.jit(lambda key, light: photon_noise(key, FULL_WELL_E * light, READ_NOISE_E))
    key = jax.random.key(0)
    return lambda: noise(key, capture(scene, optics, model)).block_until_ready()


def report_capture() -> None:
    """Measure and print the table of the 512² capture."""
    shape = (PIXELS, PIXELS)
    optics = Optics(jnp.asarray(make_psf(0, (2, COLOURS, WINDOW, WINDOW))), 4.44e-3, 8e-3, 3.7e-6)
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, make_scene(shape))
    disc = fast_length(PIXELS + shadow_px(scene, optics) - 1)
    print(f"Capture of {PIXELS} x {PIXELS} pixels, {COLOURS} colours, PSFs of {WINDOW} x {WINDOW} at two depths, noise")
    for what, given, learned in (
        ("PSFs at rest", optics.prepared(shape, depths_m=(np.inf, 0.05)), False),
        ("PSFs being learned", optics, True),
    ):
        for model in MODELS:
            # Forward and back at full size; those of the shadow disc, which is smaller; and what PSFs need besides:
            # forward for every layer, and forward and back for the common part.
            kernels, common, there, again, smaller = {
                "radiometric": (2, 0, 6, 3, (2, 1, disc)),
                "reciprocal": (4, COLOURS, 12, 3, (8, 7, disc)),
            }.get(model, (2, 0, 7, 9, None))
            more = learned * (kernels * COLOURS + 2 * common), learned * common
            floor = bare(there + more[0], again + more[1], smaller)
            seconds = time_rounds({"floor": floor, "capture": noisy(scene, given, model)}, ROUNDS)
            ratios = seconds["capture"] / seconds["floor"]
            met = "" if model != "radiometric" else "   " + verdict(float(np.median(ratios)), TARGET_RATIO)
            spread = f"({ratios.min():.2f}-{ratios.max():.2f})"
            took, least = (np.median(seconds[part]) * 1e3 for part in ("capture", "floor"))
            print(
                f"  {model:14s}{what:20s}{took:6.1f} ms, bare transforms {least:6.1f} ms: "
                f"{np.median(ratios):.2f} {spread}{met}"
            )


def one_frame(model: Model) -> None:
    """Form one frame, and print seconds and gigabytes."""
    from sim.imaging.field import FieldOptics, capture_frame

    psf = make_psf(0, (NODES, NODES, 2, COLOURS, WINDOW, WINDOW))
    y, x = (np.linspace(-n / 2, n / 2, NODES) * 1.85e-6 for n in FRAME)
    optics = FieldOptics(psf, y, x, Optics(psf[0, 0], 4.44e-3, 8e-3, 1.85e-6))
    scene = make_scene(FRAME)
    begun = time.perf_counter()
    capture_frame(scene, optics, model)
    took = time.perf_counter() - begun
    print(took, peak_bytes() / 1e9)


def report_frame() -> None:
    """Measure and print the table of the full frame."""
    what = f"{COLOURS} colours, PSFs of {WINDOW} x {WINDOW} on {NODES} x {NODES} field angles"
    print(f"Frame of {FRAME[1]} x {FRAME[0]} pixels, {what}")
    for model in MODELS[:2]:
        command = [sys.executable, "-m", "bench.capture", "--frame", model]
        took, peak = map(float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())
        print(
            f"  {model:14s}{took:6.1f} s   {verdict(took, TARGET_S)}; peak {peak:.2f} GB   {verdict(peak, TARGET_GB)}"
        )


def verdict(value: float, target: float) -> str:
    """Return the target and whether it is met."""
    return f"target <= {target:g}: {'ok' if value <= target else 'missed'}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="the 512² capture alone")
    parser.add_argument("--frame", choices=MODELS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.frame:
        one_frame(given.frame)
        return
    report_capture()
    if not given.quick:
        report_frame()


if __name__ == "__main__":
    main()
