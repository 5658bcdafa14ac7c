"""Lessons for the low-resolution branch: what an obstruction did to the light of each cell, and learning it by itself.

A scene photographed without noise and without the obstruction says how bright every cell is behind it, and even light
how much of it comes through. Cells are few, so that a thousand of these lessons cost what some tens of steps of the
whole network do, and a branch that has had them begins where those would lead late.

The loss is what an error costs in the picture, in display values: that of a cell's brightness, and that of its gain
times the contrast that is there.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from doedesign.capture.camera import CaptureModel
from doedesign.recon.blocks import shrunk
from doedesign.recon.global_light import GlobalLight, described
from sim.imaging.scene import Scene

_BATCH, _PASSES, _RATE, _WARM_UP = 16, 12, 2e-3, 0.1
_GAMMA = 1 / 2.2  # of display values, near enough for a loss
_DARKEST = 1e-4  # light
_MOST_CONTRAST = 0.2  # of display values: what has more is an edge or noise in the dark, and would outweigh all else
_LEAST_KEPT = 0.05  # share of light: what is covered further cannot be won back


class Cells(NamedTuple):
    """Cells of scenes.

    Attributes:
        description: `doedesign.recon.global_light.described` of the capture.
        mean: mean light of the capture.
        clear: mean light of the same capture without the obstruction.
        contrast: spread of the clear light in display values that the capture still shows, before any gain.
        log_gain: logarithm of what makes up for the light that was kept off.
    """

    description: Float[Array, "b v u k"]
    mean: Float[Array, "b v u c"]
    clear: Float[Array, "b v u c"]
    contrast: Float[Array, "b v u c"]
    log_gain: Float[Array, "b v u 1"]


def cells_of(
    bench: CaptureModel,
    scene: Scene,
    far: Float[Array, "c ky kx"],
    near: Float[Array, "c kv ku"],
    key: Key[Array, ""],
    scale: int,
) -> Cells:
    """Photograph one obstruction before a background, and tell what it did to cells of `scale` pixels.

    Args:
        bench: the camera without its optic.
        scene: the scene, in the colours of the camera.
        far: PSFs of the background, energy per pixel.
        near: PSFs of the obstruction.
        key: of the noise.
        scale: pixels of a cell, of which the sides of the scene are multiples.
    """
    taken = [bench.developed(scene, far, near, key), bench.clear(scene, far, near), bench.kept(scene, far, near)]
    light, clear, kept = (image.transpose(1, 2, 0)[None] for image in taken)
    mean, behind = shrunk(light, scale), jnp.maximum(shrunk(clear, scale), _DARKEST)
    spread = jnp.sqrt(jnp.maximum(shrunk(light**2, scale) - mean**2, 0))
    contrast = jnp.minimum(spread * _GAMMA * behind ** (_GAMMA - 1), _MOST_CONTRAST)
    through = jnp.mean(shrunk(kept, scale), axis=-1, keepdims=True)
    log_gain = -jnp.log(jnp.clip(through, _LEAST_KEPT, 1))
    return Cells(described(light, scale), jnp.maximum(mean, _DARKEST), behind, contrast, log_gain)


def lesson_loss(light: GlobalLight, cells: Cells) -> Float[Array, ""]:
    """Mean error of a branch, display values (see the top of this file)."""
    log_gain, log_brightness = light.of_cells(cells.description)
    shown, wanted = (value**_GAMMA for value in (cells.mean * jnp.exp(log_brightness), cells.clear))
    of_gain = cells.contrast * jnp.abs(jnp.exp(log_gain) - jnp.exp(cells.log_gain))
    return jnp.mean(jnp.abs(shown - wanted)) + jnp.mean(of_gain)


def taught(light: GlobalLight, cells: Cells, seed: int) -> GlobalLight:
    """Let a branch learn from cells of square scenes, turned and mirrored at random, by Adam in twelve passes.

    Args:
        light: the branch as it is drawn.
        cells: of all scenes.
        seed: of the order, and of the turns.
    """
    count = len(cells.mean)
    size = min(_BATCH, count)
    steps = max(1, _PASSES * count // size)
    rate = optax.warmup_cosine_decay_schedule(0.0, _RATE, max(1, int(_WARM_UP * steps)), max(2, steps))
    adam = optax.adam(rate)

    @eqx.filter_jit
    def step(light: GlobalLight, moments: optax.OptState, batch: Cells) -> tuple[GlobalLight, optax.OptState]:
        slope = eqx.filter_grad(lesson_loss)(light, batch)
        moves, moments = adam.update(slope, moments)
        return eqx.apply_updates(light, moves), moments

    rng, moments = np.random.default_rng(seed), adam.init(eqx.filter(light, eqx.is_array))
    stored = jax.tree.map(np.asarray, cells)
    for _ in range(steps):
        chosen, turn = rng.integers(0, count, size), int(rng.integers(8))
        light, moments = step(light, moments, Cells(*(jnp.asarray(_turned(part[chosen], turn)) for part in stored)))
    return light


def _turned(cells: Float[np.ndarray, "b v u k"], turn: int) -> Float[np.ndarray, "b v u k"]:
    """One of the eight ways to turn and to mirror a square."""
    cells = cells[:, ::-1] if turn & 1 else cells
    cells = cells[:, :, ::-1] if turn & 2 else cells
    return np.ascontiguousarray(cells.transpose(0, 2, 1, 3) if turn & 4 else cells)
