"""What a joint training step costs against its bare transforms and convolutions, and what the trained network costs.

    python -m bench.train            some minutes
    python -m bench.train --quick    the small step alone

**Step.** Optics and network of `examples/automotive.toml` (2400 x 2400 cells, pictures of 512 x 512 pixels) and of
`examples/automotive_cpu.toml` (1200 x 1200, 256 x 256), width 12, mean absolute errors, batch 1, from a batch to the
new state. The floor is what the step cannot do without, each thing in a program of its own with nothing between them:

* optics: for every colour, near and far, forth and back, one transform of all cells;
* capture: what `bench.capture` counts for the model with PSFs that are learned, and on the way back the transforms of
  the three sums and of the six PSFs;
* Wiener filters: transforms of the image and the result, the same on the way back, and of the PSFs at every scale; for
  whole pictures at twice the side, with their mirror images;
* convolutions: forward, the gradient by the image, the gradient by the weights, and the same of the transposed ones,
  each in the fastest of the forms that are known (see `doedesign.recon.conv`), which is looked for at the beginning.

Steps and floors take turns, and a ratio is the median of the ratios within rounds, once by the clock and once by the
processor's time, which tells the same when others are at work. Peak memory is that of a process that does nothing else.

**Use.** A capture of 4000 x 3000 pixels through the network by tiles, with its peak, in a process of its own; and LPIPS
(squeeze) of 256 x 256 pixels with its gradient. Weights are drawn at random: time does not depend on them.
"""

import argparse
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import doedesign.recon.blocks as blocks
import doedesign.recon.network as layers
from bench.capture import make_psf, verdict
from doedesign.capture.from_spec import obstruction_from_spec, occlusion_from_spec
from doedesign.capture.scenes import Batch, NamedScene
from doedesign.recon.conv import convolution
from doedesign.recon.network import Network, NetworkShape
from doedesign.recon.tiles import reconstruct_tiled
from doedesign.runtime.memory import peak_bytes
from doedesign.spec import Spec, load_spec
from doedesign.training.checkpoint import settled
from doedesign.training.distance.backbones import convolutions, weight_shapes
from doedesign.training.distance.perceptual import Lpips
from doedesign.training.joint import JointState, Trainer
from sim.imaging.convolve import fast_length
from sim.imaging.scene import Obstruction, Scene

EXAMPLES = Path(__file__).parent.parent / "examples"
SPECS = {"automotive": 512, "automotive_cpu": 256}
TARGET_RATIO, TARGET_GB, TARGET_FRAME_S, TARGET_FRAME_GB = 1.6, 3.0, 90.0, 8.0
FRAME, LPIPS_PIXELS = (3000, 4000), 256
_DIMENSIONS = ("NHWC", "HWIO", "NHWC")

Call = Callable[[], Any]


def spec_of(name: str) -> Spec:
    """The spec of an example with the training that is measured."""
    return load_spec(EXAMPLES / f"{name}.toml", [f"train.size={SPECS[name]}", "train.batch=1", "train.perceptual=0.0"])


def make_training(spec: Spec) -> tuple[Trainer, JointState, Batch]:
    """A training, its first state, and a scene."""
    rng = np.random.default_rng(0)
    height = 1e-6 * rng.random(spec.doe.shape, np.float32)
    trainer = Trainer.of(spec, "", occlusion_from_spec(spec, ""), obstruction_from_spec(spec, ""), height)
    size = spec.train.size
    background, radiance = (rng.random((3, size, size), np.float32) for _ in range(2))
    mask = np.kron(rng.random((8, 8)) > 0.8, np.ones((size // 8, size // 8))).astype(np.float32)
    scene = Scene(background, 5.0, (Obstruction(mask, radiance, 0.08),))
    return trainer, settled(trainer.initial(height)), Batch(0, (NamedScene("", scene),))


def stepping(spec: Spec) -> Call:
    """Steps, one per call."""
    trainer, state, batch = make_training(spec)
    states = [state]

    def step() -> None:
        states[0], _ = trainer.step(states[0], batch)
        jax.block_until_ready(states[0])

    return step


# --- the floor -------------------------------------------------------------------------------------------------------


def random_array(*shape: int) -> jax.Array:
    """Numbers for a bare computation."""
    return jnp.asarray(np.random.default_rng(0).random(shape, np.float32))


def transforms(count: int, length: int, forth: bool = True) -> Call:
    """So many real transforms of `length`², forth or back."""
    if forth:
        images, run = random_array(count, length, length), jax.jit(jnp.fft.rfft2)
        return lambda: run(images).block_until_ready()
    spectra, back = (
        jnp.fft.rfft2(random_array(count, length, length)),
        jax.jit(lambda s: jnp.fft.irfft2(s, (length, length))),
    )
    return lambda: back(spectra).block_until_ready()


def optics_floor(spec: Spec) -> list[Call]:
    """One complex transform of all cells for every line, depth and direction."""
    cells = jnp.ones(spec.doe.shape, jnp.complex64)
    run = jax.jit(jnp.fft.fft2)
    lines = sum(len(colour.wavelengths_m) for colour in spec.optics.colours)
    return [lambda: run(cells).block_until_ready()] * (lines * 2 * 2)


def capture_floor(trainer: Trainer) -> list[Call]:
    """Images and PSFs forth and sums back; then slopes of the sums forth and those of the PSFs back."""
    size, window, colours = trainer.spec.train.size, trainer.bench.camera.window, len(trainer.bench.camera.colours)
    length, disc = fast_length(size + window - 1), fast_length(size + trainer.bench.shadow_px - 1)
    psfs = 2 * colours
    return [
        transforms(2 * colours + psfs, length),
        transforms(colours, length, forth=False),
        transforms(2, disc),
        transforms(1, disc, forth=False),
        transforms(colours, length),
        transforms(psfs, length, forth=False),
    ]


def network_floor(network: Network, size: int, window: int) -> tuple[list[Call], list[Call]]:
    """Bare transforms of the Wiener filters, and bare convolutions: those that the network is seen to ask for."""
    seen: dict[str, list[tuple[Any, ...]]] = {}

    def watched(name: str, where: Any = layers) -> Any:
        original, calls = getattr(where, name), seen.setdefault(name, [])

        def call(*given: Any, **more: Any) -> Any:
            calls.append((*(getattr(each, "shape", each) for each in given), more.get("unit", True)))
            return original(*given, **more)

        return mock.patch.object(where, name, call)

    colours = network.layout.colours
    shapes = [jax.ShapeDtypeStruct((1, colours, n, n), jnp.float32) for n in (size, window, window)]
    with (
        watched("convolution", blocks),
        watched("doubled"),
        watched("deblurred"),
        watched("blur_at"),
        watched("sharpened"),
    ):
        jax.eval_shape(network, *shapes)
    filters = []
    for (_, side, _, channels), *_ in seen["deblurred"]:
        filters += [transforms(2 * channels, side), transforms(2 * channels, side, forth=False)]
    for (_, side, _, channels), *_ in seen["sharpened"]:  # with its mirror images, and the PSF each time
        filters += [transforms(3 * channels, 2 * side), transforms(3 * channels, 2 * side, forth=False)]
    # A PSF that is wanted twice at one scale is transformed once; `unit` tells the far one from the near one.
    for side, _ in {(shape[0], unit) for _, shape, *_, unit in seen["blur_at"]}:
        filters += [transforms(colours, side), transforms(colours, side, forth=False)]
    layer_counts = Counter(tuple(call[:3]) for call in seen["convolution"])
    convolved = [call for layer, n in layer_counts.items() for call in bare_convolution(*layer) * n]
    for shape, kernel, *_ in seen["doubled"]:
        convolved += bare_doubled(shape, kernel)
    return filters, convolved


def bare_convolution(shape: tuple[int, ...], kernel: tuple[int, ...], stride: int) -> list[Call]:
    """A convolution, its gradient by the image and by the weights, in the fastest forms known."""
    image, weights, margin = random_array(*shape), random_array(*kernel), kernel[0] // 2
    sides = [(margin, margin)] * 2

    def plain(image: jax.Array, weights: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(image, weights, (stride, stride), sides, dimension_numbers=_DIMENSIONS)

    slope = random_array(*jax.eval_shape(plain, image, weights).shape)
    by_image = [jax.jit(lambda s: jax.linear_transpose(lambda i: plain(i, weights), image)(s)[0])]
    if stride == 1:
        turned = weights[::-1, ::-1].transpose(0, 1, 3, 2)
        by_image.append(jax.jit(lambda s: plain(s, turned)))
    own = jax.jit(lambda i, s: jax.vjp(lambda w: convolution(i, w, stride), weights)[1](s)[0])
    by_weights = [lambda: own(image, slope)]
    transposed = jax.jit(lambda i, s: jax.linear_transpose(lambda w: plain(i, w), weights)(s)[0])
    by_weights.append(lambda: transposed(image, slope))
    forward = jax.jit(plain)
    return [
        lambda: forward(image, weights).block_until_ready(),
        fastest([lambda run=run: run(slope).block_until_ready() for run in by_image]),
        fastest([lambda run=run: run().block_until_ready() for run in by_weights]),
    ]


def bare_doubled(shape: tuple[int, ...], kernel: tuple[int, ...]) -> list[Call]:
    """A transposed convolution of size and stride 2 is one matrix product, and so are its gradients."""
    pixels, inputs, outputs = shape[1] * shape[2], kernel[0], 4 * kernel[3]
    image, weights, slope = random_array(pixels, inputs), random_array(inputs, outputs), random_array(pixels, outputs)
    product = jax.jit(jnp.dot)
    pairs = ((image, weights), (slope, weights.T), (image.T, slope))
    return [lambda pair=pair: product(*pair).block_until_ready() for pair in pairs]


def fastest(calls: list[Call], rounds: int = 3) -> Call:
    """The call that takes the least time."""
    if len(calls) == 1:
        return calls[0]
    least = []
    for call in calls:
        call()
        least.append(min(clocked(call)[0] for _ in range(rounds)))
    return calls[int(np.argmin(least))]


def clocked(call: Call) -> tuple[float, float]:
    """Seconds of a call, by the clock and of the processor."""
    begun, busy = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - begun, time.process_time() - busy


# --- tables ----------------------------------------------------------------------------------------------------------


def report_step(name: str, rounds: int) -> None:
    """Print the table of a step."""
    spec = spec_of(name)
    trainer = make_training(spec)[0]
    filters, convolved = network_floor(Network.make(NetworkShape(), 0), spec.train.size, trainer.bench.camera.window)
    floors = {
        "transforms of the optics": optics_floor(spec),
        "transforms of the capture": capture_floor(trainer),
        "transforms of the Wiener filters": filters,
        "convolutions": convolved,
    }
    step, took = stepping(spec), []
    for turn in range(rounds + 1):
        parts = [np.sum([clocked(call) for call in calls], axis=0) for calls in floors.values()]
        if turn:  # the first compiles and touches memory
            took.append([clocked(step), *parts])
        else:
            step()
    seconds = np.array(took)  # [round, step or part, clock or processor]
    ratios = seconds[:, 0] / seconds[:, 1:].sum(axis=1)
    middle, (ratio, busy) = np.median(seconds, axis=0)[:, 0], np.median(ratios, axis=0)
    what = f"{spec.doe.samples} x {spec.doe.samples} cells, {spec.train.size} x {spec.train.size} pixels, width 12"
    print(f"Joint step of {name}: {what}, {trainer.bench.occlusion}, mean absolute errors, batch 1")
    print(f"  step {middle[0]:7.2f} s, bare {middle[1:].sum():6.2f} s: " + told(ratio, busy, ratios[:, 0]))
    for part, each in zip(floors, middle[1:], strict=True):
        print(f"    {part:34s}{each:6.2f} s")
    took_s, peak = alone("--step", name)
    print(f"  alone {took_s:6.2f} s, peak {peak:5.2f} GB   {verdict(peak, TARGET_GB)}")


def told(ratio: float, busy: float, all_of_them: np.ndarray) -> str:
    """A ratio with its spread."""
    spread = f"({all_of_them.min():.2f}-{all_of_them.max():.2f})"
    return f"{ratio:.2f} {spread}, by processor time {busy:.2f}   {verdict(ratio, TARGET_RATIO)}"


def alone(*arguments: str) -> tuple[float, float]:
    """Seconds and gigabytes that this module prints in a process of its own."""
    command = [sys.executable, "-m", "bench.train", *arguments]
    took, peak = map(float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-2:])
    return took, peak


def one_step(name: str, rounds: int = 3) -> None:
    """Print seconds and gigabytes of steps."""
    step = stepping(spec_of(name))
    step()
    print(np.median([clocked(step)[0] for _ in range(rounds)]), peak_bytes() / 1e9)


def one_frame() -> None:
    """Print seconds and gigabytes of a whole capture through the network."""
    network = Network.make(NetworkShape(), 0)
    frame = np.random.default_rng(0).random((3, *FRAME), np.float32)
    far, near = make_psf(0, (2, 3, 513, 513))
    took, _ = clocked(lambda: reconstruct_tiled(network, frame, far, near))
    print(took, peak_bytes() / 1e9)


def report_lpips(rounds: int = 9) -> None:
    """Print the time of LPIPS and its gradient."""
    rng = np.random.default_rng(0)
    shapes = dict(weight_shapes("squeeze"))
    weights = {key: jnp.asarray(0.1 * rng.random(shape, np.float32)) for key, shape in shapes.items()}
    convs = list(convolutions("squeeze"))
    model = Lpips(
        {c.key: weights[f"features.{c.key}.weight"].transpose(2, 3, 1, 0) for c in convs},
        {c.key: weights[f"features.{c.key}.bias"] for c in convs},
        tuple(weights[key] for key in shapes if key.startswith("lin")),
        "squeeze",
    )
    one, other = (jnp.asarray(rng.random((1, 3, LPIPS_PIXELS, LPIPS_PIXELS), np.float32)) for _ in range(2))
    run = jax.jit(jax.value_and_grad(lambda picture: jnp.sum(model(picture, other))))
    jax.block_until_ready(run(one))
    took = np.median([clocked(lambda: jax.block_until_ready(run(one)))[0] for _ in range(rounds)])
    print(f"LPIPS (squeeze) of {LPIPS_PIXELS} x {LPIPS_PIXELS} pixels with gradient: {took * 1e3:.0f} ms")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="the small step alone")
    parser.add_argument("--step", choices=SPECS, help=argparse.SUPPRESS)
    parser.add_argument("--frame", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.step:
        one_step(given.step)
    elif given.frame:
        one_frame()
    else:
        report_step("automotive_cpu", 7)
        if not given.quick:
            report_step("automotive", 5)
            took, peak = alone("--frame")
            print(f"Capture of {FRAME[1]} x {FRAME[0]} pixels through the network, compiling included")
            peak_told = f"peak {peak:.2f} GB   {verdict(peak, TARGET_FRAME_GB)}"
            print(f"  {took:6.1f} s   {verdict(took, TARGET_FRAME_S)}; {peak_told}")
            report_lpips()


if __name__ == "__main__":
    main()
