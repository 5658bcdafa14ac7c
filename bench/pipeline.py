"""The stream of training scenes: items per second at 512 x 512, from scikit-image's pictures behind dirt or drops.

    python -m bench.pipeline            two threads, pictures kept and decoded every time, and its parts
    python -m bench.pipeline --quick    fewer items

An item is a decoded or kept picture, its crop in linear light, and an obstruction drawn before it; see
`doedesign.capture.scenes`. Nothing here needs jax to compute, so a training step has both cores for most of the time,
or the threads have them while it waits for an accelerator.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable

import numpy as np

from doedesign.capture.images import Pictures, crop, linear_light, sample_files
from doedesign.capture.scenes import SceneData
from fab.pictures import read_display
from sim.obstruction import CameraView, Dirt, Fence, ObstructionKind, Raindrop

SHAPE = (512, 512)
VIEW = CameraView(SHAPE, 3.7e-6, 8e-3)
FENCE_VIEW = CameraView(SHAPE, 12.9e-6, 50e-3)


def rate(data: SceneData, items: int) -> float:
    """Items per second of a stream, after its first batch."""
    with data.batches(stop=items + 1) as batches:
        next(batches)
        start = time.perf_counter()
        for _ in batches:
            pass
        return items / (time.perf_counter() - start)


def streams(items: int) -> None:
    """Print the rate of every kind."""
    kinds: dict[str, tuple[ObstructionKind, CameraView]] = {
        "dirt": (Dirt(), VIEW),
        "raindrop": (Raindrop(), VIEW),
        "fence": (Fence(), FENCE_VIEW),
    }
    for name, (kind, view) in kinds.items():
        for workers in (1, 2):
            data = SceneData(Pictures(sample_files(), 1024), kind, view, (5.0, 10.0), workers=workers, ahead=8)
            print(f"  {name:10s}{workers} threads, pictures kept      {rate(data, items):8.1f} items/s")
    data = SceneData(Pictures(sample_files(), 1024, budget_bytes=0), Dirt(), VIEW, (5.0, 10.0), ahead=8)
    print(f"  dirt      2 threads, decoded every time {rate(data, items):8.1f} items/s")


def parts(rounds: int) -> None:
    """Print what an item is made of, on one thread."""
    picture, rng = read_display(sample_files()[0]), np.random.default_rng(0)
    background = linear_light(crop(picture, SHAPE, (0.5, 0.5)))
    height, width = picture.shape[:2]
    calls: dict[str, Callable[[], object]] = {
        f"decode a PNG of {width} x {height}": lambda: read_display(sample_files()[0]),
        "crop and linear light": lambda: linear_light(crop(picture, SHAPE, (0.5, 0.5))),
        "draw dirt": lambda: Dirt().draw(rng, VIEW, background),
        "draw raindrops": lambda: Raindrop().draw(rng, VIEW, background),
        "draw a fence": lambda: Fence().draw(rng, FENCE_VIEW, background),
    }
    for name, call in calls.items():
        call()
        seconds = []
        for _ in range(rounds):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
        print(f"  {name:30s}{statistics.median(seconds) * 1e3:8.1f} ms")


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description="Rate of the training scenes.")
    parser.add_argument("--quick", action="store_true", help="fewer items")
    quick = parser.parse_args().quick
    print(f"Training scenes of {SHAPE[1]} x {SHAPE[0]} pixels on {os.cpu_count()} cores")
    streams(12 if quick else 60)
    print(" its parts, one thread")
    parts(3 if quick else 9)


if __name__ == "__main__":
    main()
