"""The whole chain in one picture: a plate, what it does to light, what the camera sees, what the network makes of it.

    python examples/see_through.py [MODEL] [--picture FILE] [--seed N] [--occlusion MODEL] [--out see_through.png]

MODEL is the folder of a training (RUN/trained), or the released one if left out. A picture that the network was not
trained on is put behind the obstruction of its spec, photographed with the plate and with a plain lens, with all noise
of the sensor, and reconstructed from the plate's capture. The picture goes on beyond what is shown of it, so that
light comes in over the edges as it does in the world.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doedesign.build import camera_from_spec
from doedesign.capture.camera import CaptureModel
from doedesign.capture.from_spec import obstruction_from_spec, occlusion_from_spec, rgb_from_channels, sensor_from_spec
from doedesign.capture.images import Pictures, sample_files
from doedesign.capture.scenes import SceneData
from doedesign.capture.simulate import Psfs, flat_psfs, photograph
from doedesign.cli import exit_code
from doedesign.recon.model import Model
from doedesign.spec import load_spec
from doedesign.training.scores import scores
from fab.figure import SMALL, panels, save, scale_bar
from fab.units import format_length
from sim.camera import Camera
from sim.light import srgb_from_linear
from sim.obstruction import CameraView, ObstructionKind
from sim.store import read_height


class Chain(NamedTuple):
    """What every link of the chain shows; display values `[c, y, x]` unless said otherwise.

    Attributes:
        scene: what was to be seen.
        mask: `[y, x]` what the obstruction blocks.
        plain: capture with a flat plate.
        plate: capture with the plate.
        network: what the network makes of it.
        far: `[c, y, x]` PSFs of the scene, energy per pixel.
        near: the same of the obstruction.
        near_m: distance of the obstruction.
        psnr: decibels in the occluded region and in all, by name.
        words: what it was made with.
    """

    scene: np.ndarray
    mask: np.ndarray
    plain: np.ndarray
    plate: np.ndarray
    network: np.ndarray
    far: np.ndarray
    near: np.ndarray
    near_m: float
    psnr: dict[str, tuple[float, float]]
    words: str


def photographed(model: Model, file: Path, seed: int, occlusion: str | None = None, side: int | None = None) -> Chain:
    """Put a picture behind the obstruction, and take it through the chain.

    Args:
        model: plate and network.
        file: the picture; enlarged where it does not hold the scene and what lies around it.
        seed: of the obstruction and the noise.
        occlusion: occlusion model; that of the training if None.
        side: pixels per side; those of the training if None.
    """
    capture_model, kind, far = capture_model_of(model, occlusion)
    camera = capture_model.camera
    wanted = (side or load_spec(folder_of(model) / "spec.toml").train.size) + capture_model.margin_px
    view = CameraView((wanted, wanted), camera.pixel_m, camera.sensor_distance_m)
    sample = SceneData(Pictures((file,), most_px=2 * wanted), kind, view, far, seed, mirrored=False).item(0)
    shot = photograph(sample, capture_model, psfs_of(model), flat_psfs(camera), jax.random.key(seed))
    psfs = [shot.psf_far, shot.psf_near]
    clean, plain, plate = (
        np.clip(srgb_from_linear(image), 0, 1) for image in (shot.clean, shot.conventional, shot.doe)
    )
    pictures = {"scene": clean, "plain": plain, "plate": plate, "network": restored(model, shot.doe, *psfs)}
    psnr = {}
    for what in ("plain", "plate", "network"):
        judged = scores(pictures[what][None], clean[None], shot.mask[None])
        psnr[what] = (float(judged.occluded.psnr[0]), float(judged.full.psnr[0]))
    told = f"{file.name} behind {getattr(kind, 'name', 'masks')} at {format_length(round(shot.depth_near_m, 4))}, "
    told += f"occlusion model {shot.occlusion}. PSNR where it is covered, in brackets over all."
    pictures |= {"far": psfs[0], "near": psfs[1]}
    shown = {name: rgb_from_channels(image, camera) for name, image in pictures.items()}
    return Chain(mask=shot.mask, near_m=shot.depth_near_m, psnr=psnr, words=told, **shown)


def folder_of(model: Model) -> Path:
    """Folder that a model was read from, with its spec and its design."""
    assert model.folder is not None
    return model.folder


def capture_model_of(
    model: Model, occlusion: str | None = None
) -> tuple[CaptureModel, ObstructionKind, tuple[float, float]]:
    """The camera of a model without its DOE, its obstruction, and the distances of its scenes.

    Args:
        model: plate and network.
        occlusion: occlusion model; that of the training if None.
    """
    file = folder_of(model) / "spec.toml"
    spec = load_spec(file)
    camera = replace(camera_from_spec(spec), window=model.bank.energy.shape[-1])
    kind = obstruction_from_spec(spec, str(file))
    name = occlusion_from_spec(spec, str(file), occlusion or model.about["occlusion"])
    made = replace(CaptureModel.make(camera, kind, name, sensor_from_spec(spec)), border="own")
    return made, kind, (min(spec.scene.far_m), max(spec.scene.far_m))


def psfs_of(model: Model) -> Psfs:
    """PSFs of a model's plate by the depth of a source, metres."""
    return lambda depth_m: np.asarray(model.bank.at(depth_m))


def restored(model: Model, capture: np.ndarray, far: np.ndarray, near: np.ndarray) -> np.ndarray:
    """What a network makes of a capture, `[c, y, x]` display values, told the PSFs of the scene and the obstruction."""
    found = eqx.filter_jit(model.network)(*(jnp.asarray(image[None]) for image in (capture, far, near)))
    return np.clip(np.asarray(found)[0], 0, 1)


def draw(path: Path, chain: Chain, model: Model, camera: Camera) -> None:
    """Draw the chain: optics above, pictures below."""
    height = read_height(folder_of(model) / "height.exr").height_m
    with panels(None, (7.6, 5.0), "Through the dirt", chain.words, "compressed") as figure:
        lens = np.log10(np.maximum(chain.far, 1e-7)), np.log10(np.maximum(chain.near, 1e-7))
        peak = max(float(image.max()) for image in lens)
        psfs = [np.clip((image - peak + 5) / 5, 0, 1) for image in lens]
        psnr = {name: f"{hidden:.1f} ({all_:.1f}) dB" for name, (hidden, all_) in chain.psnr.items()}
        rows = (
            (
                ("height map of the plate", height, "viridis"),
                ("its PSF far away, 5 decades", psfs[0], None),
                (f"its PSF at {format_length(round(chain.near_m, 4))}", psfs[1], None),
                ("what is in the way", 1 - chain.mask, "gray"),
            ),
            (
                ("scene", chain.scene, None),
                (f"plain lens, {psnr['plain']}", chain.plain, None),
                (f"plate, {psnr['plate']}", chain.plate, None),
                (f"network, {psnr['network']}", chain.network, None),
            ),
        )
        grid = figure.subplots(2, 4)
        for axes, (words, image, colours) in zip(grid.flat, (*rows[0], *rows[1]), strict=True):
            shown = image if image.ndim == 2 else image.transpose(1, 2, 0)
            most = 1.0 if colours == "gray" else None  # the height map takes all of its colours
            axes.imshow(shown, origin="lower", cmap=colours, vmin=most and 0.0, vmax=most)
            axes.set_axis_off()
            axes.set_title(words, fontsize=SMALL)
        scale_bar(grid[0, 0], camera.grid.extent_m[1])
    save(figure, path)


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="folder of a training; the released one by default")
    parser.add_argument("--picture", type=Path, help="picture of the scene")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--occlusion", help="occlusion model; that of the training by default")
    parser.add_argument("--out", type=Path, default=Path("see_through.png"))
    given = parser.parse_args()

    def work() -> None:
        model = Model.open(given.model) if given.model else Model.released()
        chain = photographed(model, given.picture or sample_files()[0], given.seed, given.occlusion)
        draw(given.out, chain, model, camera_from_spec(load_spec(folder_of(model) / "spec.toml")))
        print(given.out)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
