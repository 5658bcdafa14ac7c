"""Cameras of 16 mm before dirt: their light by parts of the aperture, their sensor and one filter for all depths.

A part of `wide_aperture.py`: stopped down to 4.44 mm, at f/2, at f/1.4, and at f/1.4 with the plate of
`wide_aperture.toml`, and with classic plates in its place. All expose as long, so that the stop gets 0.15 of the light.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from dirty_scenes import DirtyScene, believed_shadow, corrected

from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import sensor_from_spec
from doedesign.spec import Spec, load_spec
from fab.archive import read_archive, write_archive
from sim.camera import Camera
from sim.imaging.filtering import common_filter, photograph_spectrum, transfers
from sim.imaging.parts import ApertureParts, aperture_parts
from sim.light import srgb_from_linear
from sim.sensor import Sensor, developed, expose

SPEC = Path(__file__).parent / "wide_aperture.toml"
JUDGED_M = (2.0, 4.0, np.inf)
AGAIN = "Remove it; it is computed again."


class CameraKind(NamedTuple):
    """A camera of the comparison: cells over its aperture, parts across, and its plate.

    That is "optimised", a start of the optimiser that is a design of its own, or "" for none.
    """

    name: str
    aperture: str
    samples: int
    across: int
    plate: str = ""


CAMERAS = (
    CameraKind("stop", "4.44 mm", 584, 3),
    CameraKind("f2", "8 mm", 1053, 5),
    CameraKind("open", "11.4 mm", 1500, 7),
    CameraKind("plate", "11.4 mm", 1500, 7, "optimised"),
)
# Zones of the asphere focus from 2 m on, so its lens is focused at infinity; the others' is focused at 4 m.
DEFOCUS = {"logarithmic_asphere": "0 um"}
CLASSIC = tuple(CameraKind(name, "11.4 mm", 1500, 7, name) for name in ("quartic", "cubic", "logarithmic_asphere"))


def camera_of(kind: CameraKind) -> tuple[Camera, Spec]:
    """The lens and sensor of a camera, with an odd window, and its spec."""
    words = [f"doe.samples={kind.samples}", f'doe.aperture="{kind.aperture}"', *focus_words(kind.plate)]
    spec = load_spec(SPEC, words)
    return replace(camera_from_spec(spec), window=spec.sensor.window | 1), spec


def focus_words(plate: str) -> list[str]:
    """Changes to the spec that focus the lens for a plate."""
    return [f'sensor.defocus="{DEFOCUS[plate]}"'] if plate in DEFOCUS else []


def depths_of(spec: Spec) -> tuple[float, ...]:
    """Depths of the scenes to train on."""
    return tuple(spec.scene.far_m)


class Bench:
    """A camera of the comparison: its light by parts of the aperture at every depth, and its sensor.

    Attributes:
        kind: which camera.
        camera: lens and sensor.
        size: pixels per side of a picture, a multiple of 8, at least 40.
        spec: its spec.
    """

    def __init__(self, kind: CameraKind, size: int, folder: Path, make: Any) -> None:
        self.kind, self.size = kind, size
        self.camera, self.spec = camera_of(kind)
        self._make, self._folder = make, folder
        self._kept: dict[float, tuple[ApertureParts, list[Any]]] = {}
        self._filters: dict[int, np.ndarray] = {}
        self._shadows: dict[Any, tuple[np.ndarray, np.ndarray]] = {}

    def at(self, depth_m: float) -> tuple[ApertureParts, list[Any]]:
        """Parts of the PSF for a depth, and their transforms; computed once and kept in a file."""
        if depth_m not in self._kept:
            path = self._folder / f"parts_{depth_m:g}.npz"
            if path.is_file():
                _, arrays = read_archive(path, "parts of an aperture", AGAIN)
                parts = ApertureParts(arrays["psf"], arrays["centre_m"], arrays["side_m"], self.camera, depth_m)
            else:
                parts = aperture_parts(self._make(), depth_m, self.kind.across)
                if not self.kind.plate:  # a lens without a plate has no faces of glass that reflect
                    lost = [line.factor for line in self.camera.lines]
                    parts = replace(parts, psf=parts.psf / np.array(lost, np.float32)[:, None, None])
                self._folder.mkdir(parents=True, exist_ok=True)
                arrays = {"psf": parts.psf, "centre_m": parts.centre_m, "side_m": parts.side_m}
                write_archive(path, {"format": "parts of an aperture 1"}, arrays)
            side = self.size + self.camera.window - 1
            self._kept[depth_m] = parts, parts.otfs((side, side))
        return self._kept[depth_m]

    def corrected(self, light: np.ndarray, scene: DirtyScene, depth_m: float) -> np.ndarray:
        """A capture with the believed dirt taken off (`corrected`), as this camera's PSFs for a depth say it."""
        parts, key = self.at(depth_m)[0], (scene.key, depth_m)
        if key not in self._shadows:
            self._shadows[key] = believed_shadow(scene, parts, self.size)
        return corrected(light, self._shadows[key], parts.whole.sum(axis=(1, 2)))

    def sensor(self, brightness: float = 1.0) -> Sensor:
        """The sensor after the same time for every camera: the widest aperture fills the stated share of its well."""
        plain = sensor_from_spec(self.spec)
        widest = max(camera_of(kind)[0].aperture_m for kind in CAMERAS)
        return replace(plain, exposure=plain.exposure * brightness * (self.camera.aperture_m / widest) ** 2)

    def filter(self, side: int) -> np.ndarray:
        """The best linear filter for all depths, `[c, fy, fx]`, for pictures of an even `side`, in daylight."""
        if side not in self._filters:
            psfs = np.stack([self.at(depth)[0].whole for depth in depths_of(self.spec)], axis=1)
            window = psfs.shape[-1]
            wide = np.zeros((*psfs.shape[:2], side, side), np.float32)
            wide[..., :window, :window] = psfs / psfs.sum(axis=(-2, -1), keepdims=True)
            transfer = transfers(np.roll(wide, (side // 2 - window // 2,) * 2, axis=(-2, -1)))
            # The middle of an even window lies half a pixel before the middle pixel of what was put there.
            waves = np.fft.fftfreq(side)[:, None] + np.fft.rfftfreq(side)
            white = float(self.sensor().white_e(3).mean())
            # Half of a picture as bright as 0.3 of white passes.
            variance = 0.3 / (0.5 * white) + (self.sensor().read_noise_e / (0.5 * white)) ** 2
            transfer = transfer * np.exp(1j * np.pi * waves)
            found = common_filter(transfer, photograph_spectrum(side, 0.05), variance / side**2)
            self._filters[side] = np.array(found)
            self._filters[side][..., 0, 0] = 1.0  # the mean is known
        return self._filters[side]

    def told(self) -> np.ndarray:
        """PSFs that the network is told, those of the middle depth; nothing blurs the share that passed."""
        whole = self.at(JUDGED_M[1])[0].whole
        still = np.zeros_like(whole[:1])
        still[0, whole.shape[1] // 2, whole.shape[2] // 2] = 1.0
        # What is lost has been made up for.
        return np.concatenate([whole / whole.sum(axis=(1, 2), keepdims=True), still])


def taken(light: np.ndarray, sensor: Sensor, key: Any) -> np.ndarray:
    """A developed capture of light, with noise."""
    return np.asarray(developed(expose(jnp.asarray(light), sensor, key), sensor))


def filtered(seen: np.ndarray, bench: Bench) -> np.ndarray:
    """The classical way: holes filled from their surroundings, then one filter for all depths; display values."""
    light, passed = seen[:3], seen[3]
    weight = np.clip((passed - 0.1) / 0.3, 0.0, 1.0) + 1e-4
    near = [scipy.ndimage.gaussian_filter(image, 6) for image in (*(light * weight), weight)]
    light = weight * light + (1 - np.minimum(weight, 1)) * np.stack(near[:3]) / near[3]
    mirrored = np.pad(light, ((0, 0), (0, light.shape[1]), (0, light.shape[2])), mode="symmetric")
    side = mirrored.shape[-1]
    sharp = np.fft.irfft2(np.fft.rfft2(mirrored) * bench.filter(side), (side, side))
    return np.clip(srgb_from_linear(sharp[:, : light.shape[1], : light.shape[2]]), 0, 1).astype(np.float32)
