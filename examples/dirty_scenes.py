"""Dirt close before a lens, the light past it part by part of the aperture, and what a camera may believe of it.

A part of `wide_aperture.py`. Dirt is known as one knows it in practice: its sizes, place, distance and light are off by
`DirtErrors`, and whoever looks at a capture is told only that. Its layer is drawn on pixels eight times as coarse as
the camera's, for its shadows are hundreds of those wide.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage

from doedesign.capture.images import Pictures, crop, linear_light
from sim.camera import Camera
from sim.imaging.parts import ApertureParts, CoarseMask, passed_shares, spread_by_disc, through_parts
from sim.obstruction import CameraView, ObstructionKind

COARSE = 8  # pixels of the camera per pixel of the dirt's layer
DIRT_PX = 160  # coarse pixels of the layer: half the widest shadow, half a view and errors on either side
LEAST_PASSED = 0.05  # share below which no more light is made up for


@dataclass(frozen=True)
class DirtErrors:
    """How far what is believed of the dirt may be from what it is; every sign is drawn for each scene.

    Attributes:
        width: its sizes, a share.
        place_m: its place, in a random direction.
        distance: its distance, a share.
        radiance: its light, a share.
    """

    width: float = 0.03
    place_m: float = 0.15e-3
    distance: float = 0.03
    radiance: float = 0.07


class DirtyScene(NamedTuple):
    """A scene behind dirt, and what is believed of the dirt.

    Attributes:
        background: `[c, y, x]` linear light with a margin of half a PSF.
        blocked: `[y, x]` dirt on coarse pixels.
        radiance: `[c]` its light.
        near_m: its distance.
        believed: `[y, x]` dirt as it is believed to be.
        believed_radiance: `[c]` its light as believed.
        believed_m: its distance as believed.
        covered: `[y, x]` share of every pixel of the picture that is covered, sharp.
        picture: file name of what lies behind.
        key: of the stream, and its number there.
    """

    background: np.ndarray
    blocked: np.ndarray
    radiance: np.ndarray
    near_m: float
    believed: np.ndarray
    believed_radiance: np.ndarray
    believed_m: float
    covered: np.ndarray
    picture: str
    key: tuple[int, int]


def dirty_scenes(
    pictures: Pictures, camera: Camera, kind: ObstructionKind, size: int, count: int, stream: tuple[int, int]
) -> Iterator[DirtyScene]:
    """Scenes of a stream; each is a function of the stream and its number.

    Args:
        pictures: what lies behind the dirt.
        camera: whose pixels a scene is made of.
        kind: the dirt.
        size: pixels per side of a picture of it.
        count: number of scenes.
        stream: seed and number of the stream.
    """
    side = size + (camera.window | 1) - 1
    wide = 2 * DIRT_PX
    view = CameraView((wide, wide), COARSE * camera.pixel_m, camera.sensor_distance_m)
    dark = np.zeros((3, wide, wide), np.float32)
    errors = DirtErrors()
    for number in range(count):
        rng = np.random.default_rng((*stream, number))
        name, picture = pictures.following(number)
        place = (rng.uniform(), rng.uniform())
        background = linear_light(crop(picture, (side, side), place, bool(rng.integers(2))))
        drawn = kind.draw(rng, view, dark)
        mask, near_m = np.asarray(drawn.mask), float(drawn.depth_m)
        # Pictures are about places that are covered: half a layer from them to every side.
        half = DIRT_PX // 2
        inner = np.argwhere(mask[half:-half, half:-half] >= 0.5)
        y, x = inner[rng.integers(len(inner))] if len(inner) else (half, half)
        blocked = mask[y : y + DIRT_PX, x : x + DIRT_PX]
        radiance = np.asarray(drawn.radiance).mean(axis=(1, 2))
        signs = rng.choice([-1.0, 1.0], 3)
        turn = rng.uniform(0, 2 * np.pi)
        distance = 1 + errors.distance * signs[1]
        moved = errors.place_m * camera.sensor_distance_m / (near_m * COARSE * camera.pixel_m)
        scale = (1 + errors.width * signs[0]) / distance
        middle = (DIRT_PX - 1) / 2
        offset = middle - (middle + moved * np.array([np.sin(turn), np.cos(turn)])) / scale
        believed = scipy.ndimage.affine_transform(blocked, np.full(2, 1 / scale), offset, order=1, mode="nearest")
        at = (np.arange(size) - (size - 1) / 2) / COARSE + middle
        covered = scipy.ndimage.map_coordinates(blocked, np.meshgrid(at, at, indexing="ij"), order=1)
        yield DirtyScene(
            background,
            blocked,
            radiance,
            near_m,
            believed,
            radiance * np.float32(1 + errors.radiance * signs[2]),
            near_m * distance,
            covered.astype(np.float32),
            name,
            (stream[1], number),
        )


def veil(parts: ApertureParts, blocked: np.ndarray, radiance: np.ndarray, near_m: float, size: int) -> np.ndarray:
    """Light `[c, y, x]` of the dirt itself on the sensor, through an aperture whose parts have this energy."""
    camera = parts.camera
    width = camera.aperture_m * camera.sensor_distance_m / (near_m * camera.pixel_m)
    spread = spread_by_disc(blocked, width, COARSE, (size, size))
    return (parts.whole.sum(axis=(1, 2)) * radiance)[:, None, None] * spread


def light_of(scene: DirtyScene, parts: ApertureParts, otfs: Sequence[Any], size: int) -> np.ndarray:
    """Light `[c, y, x]` on the sensor without noise, white through a lossless lens of this aperture being 1."""
    side = scene.background.shape[-1]
    passed = passed_shares(parts, CoarseMask(scene.blocked, float(COARSE)), scene.near_m, (side, side), 4)
    seen = np.asarray(through_parts(scene.background, passed, otfs))
    return seen + veil(parts, scene.blocked, scene.radiance, scene.near_m, size)


def believed_shadow(scene: DirtyScene, parts: ApertureParts, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Share of light that the believed dirt lets pass, `[y, x]`, and its own light on the sensor, `[c, y, x]`."""
    mask = CoarseMask(scene.believed, float(COARSE))
    shares = passed_shares(parts, mask, scene.believed_m, (size, size), 4)
    passed = np.tensordot(parts.side_m**2 / np.sum(parts.side_m**2), shares, 1)
    return passed, veil(parts, scene.believed, scene.believed_radiance, scene.believed_m, size)


def corrected(light: np.ndarray, shadow: tuple[np.ndarray, np.ndarray], energy: np.ndarray) -> np.ndarray:
    """A capture `[c + 1, y, x]` with the believed dirt taken off; the last channel is the light's share that passed.

    Args:
        light: `[c, y, x]` capture.
        shadow: what `believed_shadow` says of it.
        energy: `[c]` light that the PSF keeps.
    """
    passed, own = shadow
    found = (light - own) / (np.maximum(passed, LEAST_PASSED) * energy[:, None, None])
    return np.concatenate([np.clip(found, -0.25, 1.5), passed[None]]).astype(np.float32)
