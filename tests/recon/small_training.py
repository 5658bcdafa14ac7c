"""A training of the smallest size that has all its parts: 96 x 96 cells, one colour, 32 x 32 pixels."""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.capture.from_spec import obstruction_from_spec
from doedesign.capture.scenes import Batch, NamedScene
from doedesign.spec import Spec, load_spec
from doedesign.training.joint import Trainer
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene

PIXELS, CELLS = 32, 96
# The least network, which compiles in the least time.
PLAIN = ("network.width=1", "network.wiener=false", "network.near_estimate=false", "network.refine=false")
SPEC = """
name = "small"
[optics]
focal_length = "1 mm"
wavelengths = ["550 nm"]
design_wavelength = "550 nm"
[doe]
samples = 96
pitch = "1.85 um"
aperture = "0.1776 mm"
material = "fused_silica"
[process]
levels = 4
level_step = "300 nm"
[scene]
near = ["6 mm", "9 mm"]
far = ["0.6 m"]
[obstruction]
kind = "dirt"
[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 32
full_well = 20000
read_noise = 4.0
[optimize]
start = "ring"
steps = 0
[network]
width = 3
depth = 1
[train]
size = 32
steps = 100
perceptual = 0.0
[[objective]]
name = "far_spot"
"""


@cache
def small_spec(*changes: str) -> Spec:
    """The spec with changes such as "train.batch=2"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.toml"
        path.write_text(SPEC)
        return load_spec(path, changes)


def heights() -> np.ndarray:
    """A diffuser of a wave at most, which leaves a part of the light on the axis."""
    rng = np.random.default_rng(0)
    return (0.6e-6 * rng.random((CELLS, CELLS))).astype(np.float32)


def trainer(*changes: str, model: Model = "paper", height_m: np.ndarray | None = None, **more: Any) -> Trainer:
    """A trainer for the spec with changes."""
    spec = small_spec(*changes)
    kind = obstruction_from_spec(spec, "small.toml")
    height = heights() if height_m is None else height_m
    return Trainer.of(spec, "small.toml", model, kind, height, **more)


def batch(count: int = 1, step: int = 0) -> Batch:
    """Scenes of soft blobs behind a disc."""
    y, x = np.mgrid[:PIXELS, :PIXELS] / PIXELS - 0.5
    items = [np.random.default_rng((step, k)) for k in range(count)]
    waves = [rng.uniform(-4, 4, (3, 3)) for rng in items]
    background = np.stack([[0.5 + 0.4 * np.sin(2 * np.pi * (a + b * y + c * x)) for a, b, c in w] for w in waves])
    places = [rng.uniform(-0.2, 0.2, 2) for rng in items]
    mask = np.stack([np.clip(4 - 20 * np.hypot(y - v, x - u), 0, 1) for v, u in places])
    radiance = np.stack([np.full((3, PIXELS, PIXELS), 0.2 * rng.random()) for rng in items])
    near = [rng.uniform(6e-3, 9e-3) for rng in items]
    background, mask, radiance = (part.astype(np.float32) for part in (background, mask, radiance))
    scenes = [Scene(background[k], 0.6, (Obstruction(mask[k], radiance[k], near[k]),)) for k in range(count)]
    return Batch(step, tuple(NamedScene(f"{step}-{k}", scene) for k, scene in enumerate(scenes)))
