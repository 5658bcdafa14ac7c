"""Simulated captures: a scene through a DOE, and through flat glass, onto the same sensor.

PSFs are computed at the very depths of the scene; nothing is interpolated between depths.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from doedesign.capture.camera import CaptureModel
from doedesign.capture.from_spec import rgb_from_channels
from doedesign.capture.scenes import NamedScene
from doedesign.design.design import Design
from fab.figure import bare, html_of, length_text, panels
from fab.process import Process, Variation
from sim.camera import Camera
from sim.imaging.formation import lost_share
from sim.imaging.occlusion import Model
from sim.imaging.scene import Scene
from sim.light import srgb_from_linear
from sim.psf_bank import psf_bank, surface_bank
from sim.surface import as_fabricated

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

Psfs = Callable[[float], Float[np.ndarray, "c y x"]]


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """What a camera records of one scene. Light is linear with white 1, in the colours of the camera; row 0 is lowest.

    Attributes:
        clean: `[c, y, x]` scene alone, sharp.
        conventional: `[c, y, x]` developed capture with flat glass instead of the DOE.
        doe: `[c, y, x]` developed capture with the DOE.
        mask: `[y, x]` share of each pixel's direction that the obstruction blocks, sharp.
        alpha: `[1, y, x]` or `[c, y, x]` share of the background's light that the occlusion model takes away.
        depth_m: `[y, x]` distance of what is seen: the obstruction where it blocks at least half.
        psf_far: `[c, y, x]` PSFs of the DOE at the background, energy per pixel.
        psf_near: `[c, y, x]` PSFs of the DOE at the obstruction.
        depth_near_m: distance of the obstruction, metres.
        depth_far_m: distance of the background, metres.
        camera: lens and pixels.
        occlusion: occlusion model.
        name: of the picture.
    """

    clean: Float[np.ndarray, "c y x"]
    conventional: Float[np.ndarray, "c y x"]
    doe: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]
    alpha: Float[np.ndarray, "a y x"]
    depth_m: Float[np.ndarray, "y x"]
    psf_far: Float[np.ndarray, "c ky kx"]
    psf_near: Float[np.ndarray, "c ky kx"]
    depth_near_m: float
    depth_far_m: float
    camera: Camera
    occlusion: Model
    name: str = "scene"

    def rgb(self, image: Float[np.ndarray, "k y x"]) -> Float[np.ndarray, "k y x"]:
        """An image in the colours of the camera as red, green and blue; one of a single colour stays as it is."""
        return rgb_from_channels(image, self.camera) if len(image) == 3 else image

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw scene, conventional capture, capture with the DOE, and mask side by side; return the figure."""
        y, x = self.mask.shape
        pictures = {"scene": self.clean, "conventional camera": self.conventional, "camera with the DOE": self.doe}
        with panels(ax, (10.0, 2.5 * y / x + 0.9), note=self._words(), layout="compressed") as figure:
            *shown, last = figure.subplots(1, 4)
            for axes, (title, light) in zip(shown, pictures.items(), strict=True):
                display = np.broadcast_to(np.clip(srgb_from_linear(self.rgb(light)), 0, 1), (3, y, x))
                axes.imshow(display.transpose(1, 2, 0), origin="lower")
                axes.set_title(title)
            last.imshow(self.mask, origin="lower", cmap="gray", vmin=0, vmax=1)
            last.set_title("mask of the obstruction")
            for axes in (*shown, last):
                bare(axes)
        return figure

    def _words(self) -> str:
        near, far = length_text(self.depth_near_m), length_text(self.depth_far_m)
        covered = 100 * self.mask.mean(dtype=np.float64)
        return f"{self.name}: {covered:.0f} % covered at {near}, scene at {far}; occlusion model {self.occlusion}"

    def _repr_html_(self) -> str:
        y, x = self.mask.shape
        rows = {
            "pixels": f"{x} x {y}",
            "obstruction at": length_text(self.depth_near_m),
            "scene at": length_text(self.depth_far_m),
            "covered": f"{100 * self.mask.mean(dtype=np.float64):.0f} %",
            "occlusion model": self.occlusion,
        }
        return html_of(f"Simulated capture of {self.name}", rows, self.plot())


def photograph(
    sample: NamedScene, model: CaptureModel, with_doe: Psfs, without: Psfs, key: Key[Array, ""]
) -> SimulatedCapture:
    """Photograph one scene with two cameras.

    Args:
        sample: the scene, in red, green and blue.
        model: what both cameras share.
        with_doe: PSFs of the camera with the DOE, by depth.
        without: PSFs of the conventional camera.
        key: key of the noise, which differs from camera to camera.
    """
    scene, near_m = model.scene(sample.scene), float(sample.scene.obstructions[0].depth_m)
    far_m = float(sample.scene.background_depth_m)
    pairs = [(psfs(far_m), psfs(near_m)) for psfs in (without, with_doe)]
    conventional, doe = (
        np.asarray(model.developed(scene, *pair, jax.random.fold_in(key, k))) for k, pair in enumerate(pairs)
    )
    alpha = np.asarray(lost_share(scene, model.optics(*pairs[1]), model.occlusion))
    seen = inner(scene, model.margin_px)
    first = (slice(None), *_middle(alpha, model.margin_px))
    mask = np.asarray(seen.obstructions[0].mask)
    depth = np.where(mask >= 0.5, np.float32(near_m), np.float32(far_m))
    facts = (near_m, far_m, model.camera, model.occlusion, sample.name)
    return SimulatedCapture(
        np.asarray(seen.background), conventional, doe, mask, alpha[first], depth, *pairs[1], *facts
    )


def inner(scene: Scene, margin_px: int) -> Scene:
    """The middle of a scene: `margin_px` smaller along each axis."""
    return jax.tree.map(lambda leaf: leaf[(..., *_middle(leaf, margin_px))] if np.ndim(leaf) > 1 else leaf, scene)


def _middle(image: Any, margin_px: int) -> tuple[slice, slice]:
    first = margin_px // 2
    y, x = (slice(first, first + n - margin_px) for n in image.shape[-2:])
    return y, x


def plate_psfs(design: Design, camera: Camera, process: Process | None, errors: Variation | None) -> Psfs:
    """PSFs of the plate by depth; exactly at the depth asked for, and kept while a simulation lasts."""
    made_by, variation = (process or Process(design.levels)), (errors or Variation())

    @lru_cache(maxsize=1)
    def surface() -> Any:
        return as_fabricated(design.level_map.level, camera, made_by, variation)

    @lru_cache(maxsize=8)
    def at(depth_m: float) -> Float[np.ndarray, "c y x"]:
        return surface_bank(camera, surface(), (depth_m,)).energy[:, 0]

    return at


def flat_psfs(camera: Camera) -> Psfs:
    """PSFs of a flat plate of the same glass, which stands for the conventional camera."""
    flat = np.zeros(camera.grid.shape, np.float32)

    @lru_cache(maxsize=8)
    def at(depth_m: float) -> Float[np.ndarray, "c y x"]:
        return psf_bank(camera, flat, (depth_m,)).energy[:, 0]

    return at
