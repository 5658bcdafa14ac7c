"""Simulated captures: a scene through a DOE, and through flat glass, onto the same sensor.

PSFs are computed at the very depths of the scene; nothing is interpolated between depths.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from doedesign.capture.camera import CaptureModel, depth_range_m
from doedesign.capture.from_spec import (
    obstruction_from_spec,
    occlusion_from_spec,
    rgb_from_channels,
    sensor_from_spec,
    sensor_side,
)
from doedesign.capture.images import display_values
from doedesign.capture.scenes import NamedScene, draw_scene, require_seed
from doedesign.design.design import Design
from doedesign.runs.level_maps import open_design
from doedesign.spec import Spec
from fab.errors import InputError
from fab.figure import bare, html_of, length_text, panels
from fab.pictures import read_display
from fab.units import is_whole
from sim.camera import Camera
from sim.imaging.formation import lost_share
from sim.imaging.occlusion import Model
from sim.imaging.scene import Scene
from sim.light import srgb_from_linear
from sim.obstruction import CameraView, ObstructionKind
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.rigorous.edge_optic import optic_as_drawn
from sim.surface import FabricatedDoe

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.runs.folder import Run

Psfs = Callable[[float], Float[np.ndarray, "c y x"]]

_USUAL_SIDE, _MOST_SIDE = 512, 1 << 14


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """A scene as a camera records it. Light is linear with white 1, in the colours of the camera; row 0 is lowest.

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
        near, far = length_text(self.depth_near_m), length_text(self.depth_far_m)
        covered = 100 * self.mask.mean(dtype=np.float64)
        words = f"{covered:.0f} % covered at {near}, scene at {far}; occlusion model {self.occlusion}"
        with panels(ax, (10.0, 2.5 * y / x + 1.2), self.name, words, layout="compressed") as figure:
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


def simulate(
    picture: str | Path | np.ndarray,
    design: "Design | Run | str | Path",
    *,
    obstruction: str | Path | ObstructionKind | None = None,
    occlusion: str | None = None,
    seed: int = 0,
    size: int | None = None,
    fabricated: FabricatedDoe | None = None,
) -> SimulatedCapture:
    """Photograph a picture behind an obstruction, with the DOE of a design and without.

    Args:
        picture: a file, or display values (sRGB) `[y, x, 3]`, uint8 or floats from 0 to 1, row 0 at the lowest y. A
            crop of it fills the frame; a smaller picture is enlarged.
        design: the DOE and its camera, or a finished run or its folder. Its spec says what is left out here, and what
            the sensor does.
        obstruction: a kind such as "dirt", "raindrop" or "fence", a folder of masks, or a kind with parameters of its
            own (`sim.obstruction`). A kind by its name has the spec's options where it is the spec's.
        occlusion: how an obstruction takes light from what lies behind it: "reciprocal", "radiometric", "paper" or
            "paper_release" (`sim.imaging.occlusion`). There is no default.
        seed: seed of the crop, the obstruction, its distance and the noise.
        size: pixels per side of the frame; 512, or what the sensor has.
        fabricated: a DOE as fabricated to look through instead (`Design.fabricated`).

    Raises:
        InputError: no occlusion model or obstruction is named, or a picture, name or number cannot be used.
    """
    design = open_design(design)
    require_seed(seed)
    stage = Stage.of(design, obstruction, occlusion, size)
    if isinstance(picture, str | Path):
        shown, name = read_display(picture, 2 * max(stage.view.shape)), Path(picture).name
    else:
        shown, name = display_values(picture), "picture"
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, 0)))
    sample = NamedScene(name, draw_scene(shown, stage.kind, stage.view, stage.far_m, rng))
    camera = stage.model.camera
    depths_m = (*depth_range_m(stage.kind), *stage.far_m)
    drawn = partial(optic_as_drawn, camera, design.level_map.height_m, depths_m=depths_m)
    made = psfs_by_depth(lambda: fabricated or drawn(), camera)
    return photograph(sample, stage.model, made, flat_psfs(camera), jax.random.fold_in(jax.random.key(seed), 0))


class Stage(NamedTuple):
    """The scenes of a design behind one kind of obstruction, within a frame, and the camera without its optic."""

    kind: ObstructionKind
    model: CaptureModel
    view: CameraView
    far_m: tuple[float, float]

    @classmethod
    def of(
        cls, design: Design, obstruction: str | Path | ObstructionKind | None, occlusion: str | None, size: int | None
    ) -> "Stage":
        """Take all that is not given from the design's spec; see `simulate`."""
        spec, source = design.spec, str((design.folder or Path()) / "spec.toml")
        chosen = occlusion_from_spec(spec, source, occlusion)
        if obstruction is None or isinstance(obstruction, str | Path):
            name = obstruction if obstruction is None else str(obstruction)
            kind = obstruction_from_spec(spec, source, name, design.near_m)
        else:
            if not hasattr(obstruction, "draw"):
                rule, cure = "must be a kind of obstruction, its name, or a folder of masks", "For example sim.Dirt()."
                raise InputError("obstruction", rule, repr(obstruction), cure)
            kind = obstruction
        camera = replace(design.camera, window=design.camera.window | 1)  # odd: the capture lies on the scene
        side = _side(spec, size)
        view = CameraView((side, side), camera.pixel_m, camera.sensor_distance_m)
        model = CaptureModel.make(camera, kind, chosen, sensor_from_spec(spec))
        return cls(kind, model, view, (min(design.far_m), max(design.far_m)))


def _side(spec: Spec | None, size: int | None) -> int:
    most = _MOST_SIDE if spec is None else sensor_side(spec)
    side = min(_USUAL_SIDE, most) if size is None else size
    if not is_whole(side, 16, most):
        rule = f"must lie from 16 to the {most} binned pixels of the sensor's shorter side"
        raise InputError("size", rule, side, "Choose another size.")
    return side


def photograph(
    sample: NamedScene, model: CaptureModel, with_doe: Psfs, without: Psfs, key: Key[Array, ""]
) -> SimulatedCapture:
    """Photograph one scene with two cameras, whose PSFs are given by depth and whose noise differs."""
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
    images = (np.asarray(seen.background), conventional, doe, mask, alpha[first], depth, *pairs[1])
    return SimulatedCapture(*images, near_m, far_m, model.camera, model.occlusion, sample.name)


def inner(scene: Scene, margin_px: int) -> Scene:
    """The middle of a scene: `margin_px` smaller along each axis."""
    return jax.tree.map(lambda leaf: leaf[(..., *_middle(leaf, margin_px))] if np.ndim(leaf) > 1 else leaf, scene)


def _middle(image: Any, margin_px: int) -> tuple[slice, slice]:
    first = margin_px // 2
    y, x = (slice(first, first + n - margin_px) for n in image.shape[-2:])
    return y, x


def psfs_by_depth(make_optic: Callable[[], Any], camera: Camera) -> Psfs:
    """PSFs of an optic by depth, exactly at the depth asked for, and kept; it is made at the first call."""
    made = cache(make_optic)
    return lru_cache(maxsize=8)(lambda depth_m: psf(made(), camera, depth_m).energy[:, 0])


def flat_psfs(camera: Camera) -> Psfs:
    """PSFs of flat glass of the same kind, which stands for the conventional camera."""
    return psfs_by_depth(lambda: HeightOptic.of(camera), camera)
