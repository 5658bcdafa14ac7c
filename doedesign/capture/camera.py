"""From light to a developed capture: the part of a camera that is the same whatever optic it has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doedesign.capture.from_spec import channels_from_rgb, outside_from_kind
from fab.aperture import RoundAperture
from fab.errors import InputError
from sim.camera import Camera
from sim.imaging.convolve import Border
from sim.imaging.disc import disc_window
from sim.imaging.formation import Optics, capture, own_margin_px
from sim.imaging.occlusion import Model, Outside
from sim.imaging.scene import Obstruction, Scene
from sim.obstruction import ObstructionKind
from sim.sensor import Sensor, demosaiced, developed, expose

Psf = Float[Array, "c ky kx"] | Float[np.ndarray, "c ky kx"]


@dataclass(frozen=True)
class CaptureModel:
    """A camera without its optic.

    Attributes:
        camera: lens and pixels, with an odd window, so that a capture lies on its scene.
        occlusion: occlusion model.
        outside: the obstruction's picture in eq. 10 where there is none (`sim.imaging.formation.capture`).
        sensor: the sensor.
        shadow_px: window of the shadow discs.
        border: continuation of a scene beyond its edges. With `own` a scene brings its surroundings along, so that
            light comes in over the edges, and everything captured is smaller than the scene, by `margin_px`.
    """

    camera: Camera
    occlusion: Model
    outside: Outside
    sensor: Sensor
    shadow_px: int
    border: Border = "reflect"

    @classmethod
    def make(cls, camera: Camera, kind: ObstructionKind, occlusion: Model, sensor: Sensor) -> "CaptureModel":
        """A camera for one kind of obstruction, at whatever depth: all its scenes share one compiled capture."""
        if not isinstance(camera.opening, RoundAperture):
            rule, cure = "obstructions are captured through a round aperture", "Give its diameter."
            raise InputError("doe.aperture", rule, str(camera.opening), cure)
        disc = camera.aperture_m * camera.sensor_distance_m / (camera.pixel_m * depth_range_m(kind)[0])
        return cls(camera, occlusion, outside_from_kind(kind), sensor, disc_window(disc))

    @property
    def margin_px(self) -> int:
        """Pixels per axis by which scenes are larger than what is captured of them."""
        return own_margin_px(self.camera.window, self.shadow_px, self.occlusion) if self.border == "own" else 0

    def scene(self, scene: Scene) -> Scene:
        """A scene in red, green and blue in the colours of the camera."""
        rgb, near = np.asarray(scene.background), scene.obstructions[0]
        seen = Obstruction(near.mask, channels_from_rgb(np.asarray(near.radiance), self.camera), near.depth_m)
        return Scene(channels_from_rgb(rgb, self.camera), scene.background_depth_m, (seen,))

    def optics(self, far: Psf, near: Psf) -> Optics:
        """This camera with an optic that has these PSFs, of the background and of the obstruction."""
        camera, psf = self.camera, jnp.stack([jnp.asarray(far), jnp.asarray(near)])
        return Optics(psf, camera.aperture_m, camera.sensor_distance_m, camera.pixel_m, self.shadow_px)

    def clear(self, scene: Scene, far: Psf, near: Psf) -> Float[Array, "c y x"]:
        """Light on the sensor without noise and without the obstruction of the scene."""
        return self._light(_without(scene), far, near, self.outside)

    def kept(self, scene: Scene, far: Psf, near: Psf) -> Float[Array, "c y x"]:
        """Share of even light that gets past the one obstruction of a scene."""
        (near_by,) = scene.obstructions
        even = jnp.ones_like(scene.background)
        black = Obstruction(near_by.mask, jnp.zeros_like(even), near_by.depth_m)
        dark = Scene(even, scene.background_depth_m, (black,))
        # Of eq. 10, too, nothing but the light behind the obstruction is to be seen.
        passed, whole = (self._light(one, far, near, "nothing") for one in (dark, _without(dark)))
        return passed / whole

    def _light(self, scene: Scene, far: Psf, near: Psf, outside: Outside) -> Float[Array, "c y x"]:
        return capture(scene, self.optics(far, near), self.occlusion, border=self.border, outside=outside)

    def developed(self, scene: Scene, far: Psf, near: Psf, key: Key[Array, ""]) -> Float[Array, "c y x"]:
        """Photograph one obstruction before a background, with the PSFs of both, in the colours of the camera.

        The result is linear light with noise, white 1. Differentiable, but for a mosaic.
        """
        light = self._light(scene, far, near, self.outside)
        raw: Any = expose(light, self.sensor, key)
        return developed(demosaiced(np.asarray(raw), self.sensor) if self.sensor.pattern else raw, self.sensor)


def _without(scene: Scene) -> Scene:
    """The scene with nothing where its obstruction was."""
    (near,) = scene.obstructions
    return Scene(scene.background, scene.background_depth_m, (Obstruction(0 * near.mask, near.radiance, near.depth_m),))


def depth_range_m(kind: Any) -> tuple[float, float]:
    """Least and greatest distance that a kind of obstruction, or any it is mixed of, is drawn at, metres."""
    depth = getattr(kind, "depth_m", None)
    if depth:
        return float(depth[0]), float(depth[1])
    inner = [depth_range_m(part) for _, part in kind.parts]
    return min(low for low, _ in inner), max(high for _, high in inner)


def middle_depth_m(depths_m: Sequence[float]) -> float:
    """Depth, metres, in the middle of several in 1/z: the nearest is as much out of focus there as the farthest."""
    near, far = min(depths_m), max(depths_m)
    return near if near == far else 2 / (1 / near + 1 / far)
