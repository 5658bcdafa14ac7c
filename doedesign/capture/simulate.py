"""One simulated capture: a scene through the plate of a run, and through a flat one, onto the same sensor.

PSFs are computed at the very depths of the scene; nothing is interpolated between depths.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from doedesign.capture.from_spec import channels_from_rgb
from doedesign.capture.scenes import SceneItem
from doedesign.design.design import Design
from fab.process import Process, Variation
from sim.camera import Camera
from sim.imaging.convolve import Border
from sim.imaging.disc import disc_window
from sim.imaging.formation import Optics, capture, lost_share, own_margin_px
from sim.imaging.occlusion import Model, Outside
from sim.imaging.scene import Obstruction, Scene
from sim.obstruction import ObstructionKind
from sim.psf_bank import psf_bank, surface_bank
from sim.sensor import Sensor, demosaiced, developed, expose
from sim.surface import as_fabricated

Psfs = Callable[[float], Float[np.ndarray, "c y x"]]


class CameraPair(NamedTuple):
    """Both cameras.

    Attributes:
        camera: optics, with an odd window, so that a capture lies on its scene.
        with_plate: PSFs by depth.
        without: PSFs by depth of the conventional camera.
        model: occlusion model.
        outside: see `sim.imaging.formation.capture`.
        sensor: the sensor.
        shadow_px: window of the shadow discs.
        border: what lies beyond an item. With `own` an item brings its surroundings along, so that light comes in over
            the edges as it does in the world, and everything captured is smaller than the item, by `margin_px`.
    """

    camera: Camera
    with_plate: Psfs
    without: Psfs
    model: Model
    outside: Outside
    sensor: Sensor
    shadow_px: int
    border: Border = "reflect"

    @property
    def margin_px(self) -> int:
        """Pixels per axis by which items are larger than what is captured of them."""
        return own_margin_px(self.camera.window, self.shadow_px, self.model) if self.border == "own" else 0


class SimulatedCapture(NamedTuple):
    """What one item shows, colours as the camera has them.

    Attributes:
        clean: `[c, y, x]` scene alone, sharp, white 1.
        conventional: developed capture with a flat plate.
        doe: developed capture with the plate.
        mask: `[y, x]` share of each direction that is blocked.
        alpha: `[1, y, x]` or `[c, y, x]` share of the background's light that the model takes away, with the plate.
        depth_m: `[y, x]` distance of what is seen: the obstruction where it blocks at least half.
    """

    clean: Float[np.ndarray, "c y x"]
    conventional: Float[np.ndarray, "c y x"]
    doe: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]
    alpha: Float[np.ndarray, "a y x"]
    depth_m: Float[np.ndarray, "y x"]


def captured(item: SceneItem, bench: CameraPair, key: Key[Array, ""]) -> SimulatedCapture:
    """Photograph one scene with both cameras.

    Args:
        item: the scene.
        bench: the cameras.
        key: key of the noise, which differs from camera to camera.
    """
    camera = bench.camera
    near = Obstruction(item.mask, channels_from_rgb(item.radiance, camera), item.depth_m)
    scene = Scene(channels_from_rgb(item.background, camera), item.background_depth_m, (near,))
    with_plate, without = (_optics(psfs, bench, item) for psfs in (bench.with_plate, bench.without))
    conventional, doe = (
        _recorded(scene, optics, bench, jax.random.fold_in(key, k)) for k, optics in enumerate((without, with_plate))
    )
    alpha = np.asarray(lost_share(scene, with_plate, bench.model))
    seen = within(item, bench.margin_px)
    depth = np.where(seen.mask >= 0.5, np.float32(item.depth_m), np.float32(item.background_depth_m))
    clean, alpha = (_within(np.asarray(image), bench.margin_px) for image in (scene.background, alpha))
    return SimulatedCapture(clean, conventional, doe, seen.mask, alpha, depth)


def within(item: SceneItem, margin_px: int) -> SceneItem:
    """The middle of a scene: `margin_px` smaller along each axis."""
    names = ("background", "mask", "radiance")
    return item._replace(**{name: _within(getattr(item, name), margin_px) for name in names})


def _within(image: np.ndarray, margin_px: int) -> np.ndarray:
    first = margin_px // 2
    y, x = (n - margin_px for n in image.shape[-2:])
    return image[..., first : first + y, first : first + x]


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


def depth_range_m(kind: Any) -> tuple[float, float]:
    """Least and greatest distance that a kind, or any it is mixed of, is drawn at."""
    depth = getattr(kind, "depth_m", None)
    if depth:
        return float(depth[0]), float(depth[1])
    inner = [depth_range_m(getattr(kind, name)) for name in ("dirt", "raindrop")]
    return min(low for low, _ in inner), max(high for _, high in inner)


def shadow_window(kind: ObstructionKind, camera: Camera) -> int:
    """Window that holds the shadow disc at every depth, so that all items share one compiled capture."""
    return disc_window(camera.aperture_m * camera.sensor_distance_m / (camera.pixel_m * depth_range_m(kind)[0]))


def _optics(psfs: Psfs, bench: CameraPair, item: SceneItem) -> Optics:
    camera, psf = bench.camera, np.stack([psfs(item.background_depth_m), psfs(item.depth_m)])
    return Optics(psf, camera.aperture_m, camera.sensor_distance_m, camera.pixel_m, bench.shadow_px)


def _recorded(scene: Scene, optics: Optics, bench: CameraPair, key: Array) -> Float[np.ndarray, "c y x"]:
    """The developed capture."""
    light = capture(scene, optics, bench.model, border=bench.border, outside=bench.outside)
    raw = np.asarray(expose(light, bench.sensor, key))
    return np.asarray(developed(demosaiced(raw, bench.sensor) if bench.sensor.pattern else raw, bench.sensor))
