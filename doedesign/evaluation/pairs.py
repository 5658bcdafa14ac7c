"""Test pairs: an obstruction before a picture, fixed by a seed, at depths where PSFs are computed exactly.

Pair i is a function of the seed and i alone: picture, crop, obstruction and both depths. Near depths are some that lie
evenly in 1/z within the range of the obstruction, or of that which it is of several; far ones are the ends of the
scene's range. So a plate's PSFs are computed once for all pairs, and nothing is interpolated. Scenes bring their
surroundings along, so that light comes in over the edges of a capture as it does in the world; with `border="reflect"`
they are mirrored there, as in training.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from doedesign.build import camera_from_spec
from doedesign.capture.camera import CaptureModel, depth_range_m
from doedesign.capture.from_spec import at_depth, obstruction_from_spec, occlusion_from_spec, sensor_from_spec
from doedesign.capture.images import Pictures
from doedesign.capture.scenes import NamedScene, SceneData
from doedesign.capture.simulate import inner
from doedesign.spec import Spec
from doedesign.training.train import training_size
from fab.errors import InputError
from sim.imaging.convolve import Border
from sim.obstruction import CameraView, ObstructionKind
from sim.psf_bank import PsfBank

NEAR_DEPTHS = 8
_SALT_DEPTHS, _SALT_PARTS = 5, 6
_OTHER_SEEDS = 3 << 32  # beyond those of trainings, and of what they hold out


class PairDepths(NamedTuple):
    """Distances of the scene and of the obstruction before it, metres."""

    far_m: float
    near_m: float


def parts_of(kind: ObstructionKind) -> tuple[tuple[float, ObstructionKind], ...]:
    """Kinds that an obstruction is by lot, each with how often; itself where it is one alone."""
    return getattr(kind, "parts", ((1.0, kind),))


def _even_depths_m(kind: ObstructionKind) -> tuple[float, ...]:
    """Distances at which pairs have a kind of obstruction, even in 1/z."""
    least, most = depth_range_m(kind)
    if least == most:
        return (least,)
    return tuple(float(depth) for depth in 1 / np.linspace(1 / most, 1 / least, NEAR_DEPTHS))


@dataclass(frozen=True, eq=False)
class PairSet:
    """Test pairs before one camera.

    Attributes:
        files: pictures that lie behind the obstruction; none of them may have been trained on.
        kind: the obstruction.
        model: the camera without its optic.
        size: pixels per side of a capture.
        near_m: distances at which obstructions lie.
        far_m: distances at which scenes lie.
        seed: seed of everything.
    """

    files: tuple[Path, ...]
    kind: ObstructionKind
    model: CaptureModel
    size: int
    near_m: tuple[float, ...]
    far_m: tuple[float, ...]
    seed: int = 0

    @classmethod
    def of(
        cls,
        spec: Spec,
        source: str,
        files: Sequence[Path],
        *,
        occlusion: str | None = None,
        obstruction: str | None = None,
        seed: int = 0,
        border: Border = "own",
    ) -> "PairSet":
        """Pairs before the camera of a spec, of the size that its networks are trained with.

        Args:
            spec: the camera, and what is not given here.
            source: its file, for messages.
            files: pictures.
            occlusion: occlusion model; that of the spec if None.
            obstruction: kind, or folder of masks; that of the spec if None.
            seed: seed of everything.
            border: "own" or "reflect".

        Raises:
            InputError: no occlusion model or obstruction is named, or it cannot be used.
        """
        kind = obstruction_from_spec(spec, source, obstruction)
        camera = replace(camera_from_spec(spec), window=spec.sensor.window | 1)
        name = occlusion_from_spec(spec, source, occlusion)
        model = replace(CaptureModel.make(camera, kind, name, sensor_from_spec(spec)), border=border)
        near = tuple(dict.fromkeys(depth for _, part in parts_of(kind) for depth in _even_depths_m(part)))
        far = tuple(dict.fromkeys((min(spec.scene.far_m), max(spec.scene.far_m))))
        if max(near) >= min(far):
            rule, got = "obstructions must lie before the scene", f"{max(near):g} m and {min(far):g} m"
            raise InputError(f"{source}: scene", rule, got, "Change scene.near or scene.far.")
        size = training_size(spec)
        return cls(tuple(files), kind, model, size, near, far, seed)

    @property
    def depths_m(self) -> tuple[float, ...]:
        """All distances that PSFs are needed for, near ones first."""
        return (*self.near_m, *self.far_m)

    def depths(self, number: int) -> PairDepths:
        """Distances of a pair."""
        rng = np.random.default_rng((self.seed, _SALT_DEPTHS, number))
        far_m = float(rng.choice(self.far_m))
        return PairDepths(far_m, float(rng.choice(_even_depths_m(self._part(number)))))

    def _part(self, number: int) -> ObstructionKind:
        """The obstruction of a pair: one of several by lot."""
        parts = parts_of(self.kind)
        if len(parts) == 1:
            return self.kind
        shares = np.array([share for share, _ in parts])
        rng = np.random.default_rng((self.seed, _SALT_PARTS, number))
        return parts[rng.choice(len(parts), p=shares / shares.sum())][1]

    def scene(self, number: int) -> NamedScene:
        """The scene of a pair, with its surroundings, in red, green and blue.

        Raises:
            InputError: no picture is whole, or the obstruction cannot be drawn.
        """
        far, near = self.depths(number)
        kind = at_depth(self._part(number), (near, near))
        # A training of the same seed draws distances, where there are several, and then other obstructions than these.
        seed = self.seed if len(self.far_m) > 1 else self.seed + _OTHER_SEEDS
        return SceneData(self._pictures, kind, self._view, (far, far), seed, mirrored=False).item(number)

    @cached_property
    def _pictures(self) -> Pictures:
        return Pictures(self.files, most_px=2 * (self.size + self.model.margin_px))

    @property
    def _view(self) -> CameraView:
        side = self.size + self.model.margin_px
        return CameraView((side, side), self.model.camera.pixel_m, self.model.camera.sensor_distance_m)

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: pictures that are in memory stay here."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def photographed(self, number: int, scene: NamedScene, bank: PsfBank) -> Float[np.ndarray, "c y x"]:
        """The developed capture `[c, y, x]` of a pair's scene by a camera whose plate has these PSFs; linear light.

        White is 1. Every camera gets the same draws of noise.
        """
        depths = self.depths(number)
        far, near = (np.asarray(bank.at(depth)) for depth in depths)
        key = jax.random.fold_in(jax.random.key(self.seed), number)
        return np.asarray(self.model.developed(self.model.scene(scene.scene), far, near, key), np.float32)

    def shown(self, scene: NamedScene) -> tuple[Float[np.ndarray, "c y x"], Float[np.ndarray, "y x"]]:
        """The scene alone, linear light, and the sharp mask of the obstruction, both within the capture."""
        within = inner(self.model.scene(scene.scene), self.model.margin_px)
        return np.asarray(within.background, np.float32), np.asarray(within.obstructions[0].mask, np.float32)
