"""The whole chain in one picture: a plate, what it does to light, what the camera sees, what the network makes of it.

    python examples/see_through.py [MODEL] [--picture FILE] [--seed N] [--occlusion MODEL] [--out see_through.png]

MODEL is the folder of a training (RUN/trained), or the released one if left out. A picture that the network was not
trained on is put behind the obstruction of its spec, photographed with the plate and with a plain lens, with all noise
of the sensor, and reconstructed from the plate's capture.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from doedesign.build import camera_of
from doedesign.capture import obstruction_of, outside_of, seen_in, sensor_of, shown_as
from doedesign.cli import exit_code
from doedesign.images import Pictures, sample_files
from doedesign.recon.data import SceneData
from doedesign.recon.model import Model, open_model, released_model
from doedesign.recon.scores import scores
from doedesign.report.canvas import note, picture, place, scale_bar
from doedesign.spec import load_spec
from fab.units import format_length
from sim.camera import Camera
from sim.formation import Optics, capture, psf_at
from sim.light import srgb_from_linear
from sim.obstruction import View
from sim.psf import psf_bank
from sim.scene import Obstruction, Scene
from sim.sensor import developed, expose
from sim.store import read_height

SIDE, GAP, ROW = 1.75, 0.12, 0.42  # inches; ROW between two rows, for a scale bar and words


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
        file: the picture.
        seed: of the obstruction and the noise.
        occlusion: occlusion model; that of the training if None.
        side: pixels per side; those of the training if None.
    """
    spec = load_spec(model.folder / "spec.toml")
    camera = replace(camera_of(spec), window=model.bank.energy.shape[-1])
    kind, sensor = obstruction_of(spec, str(model.folder / "spec.toml")), sensor_of(spec)
    name: Any = occlusion or model.about["occlusion"]
    side = side or spec.train.size
    view = View((side, side), camera.pixel_m, camera.sensor_distance_m)
    far = (min(spec.scene.far_m), max(spec.scene.far_m))
    item = SceneData(Pictures((file,), most_px=2 * side), kind, view, far, seed, mirrored=False).item(0, 0)
    light = seen_in(item.background, camera)
    near = Obstruction(item.mask, seen_in(item.radiance, camera), item.depth_m)
    scene = Scene(light, item.background_depth_m, (near,))
    depths = (item.background_depth_m, item.depth_m)
    flat = psf_bank(camera, np.zeros(camera.grid.shape, np.float32), depths)
    shots = []
    for k, bank in enumerate((flat, model.bank)):
        optics = Optics.of(bank, camera, depths)
        seen = capture(scene, optics, name, outside=outside_of(kind))
        shots.append(np.asarray(developed(expose(seen, sensor, jax.random.key(seed + k)), sensor)))
    psfs = [psf_at(model.bank, depth) for depth in depths]
    found = np.asarray(eqx.filter_jit(model.network)(*(jnp.asarray(image[None]) for image in (shots[1], *psfs))))[0]
    clean, plain, plate = (np.clip(srgb_from_linear(np.asarray(image)), 0, 1) for image in (light, *shots))
    found = np.clip(found, 0, 1)
    psnr = {}
    for what, image in (("plain", plain), ("plate", plate), ("network", found)):
        judged = scores(image[None], clean[None], item.mask[None])
        psnr[what] = (float(judged.occluded.psnr[0]), float(judged.full.psnr[0]))
    told = f"{file.name} behind {getattr(kind, 'name', 'masks')} at {format_length(round(item.depth_m, 4))}, "
    told += f"occlusion model {name}. PSNR where it is covered, in brackets over all."
    pictures = {"scene": clean, "plain": plain, "plate": plate, "network": found, "far": psfs[0], "near": psfs[1]}
    shown = {name: shown_as(image, camera) for name, image in pictures.items()}
    return Chain(mask=item.mask, near_m=item.depth_m, psnr=psnr, words=told, **shown)


def draw(path: Path, chain: Chain, model: Model, camera: Camera) -> None:
    """Draw the chain: optics above, pictures below."""
    height = read_height(model.folder / "height.exr").height_m
    across, up = 4 * (SIDE + GAP) + GAP, 2 * (SIDE + ROW) + 0.65
    with picture(path, (across, up), "Through the dirt") as figure:
        tops = (up - 0.6, up - 0.6 - SIDE - ROW)
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
        for top, row in zip(tops, rows, strict=True):
            for k, (words, image, colours) in enumerate(row):
                axes = place(figure, GAP + k * (SIDE + GAP), top - SIDE, SIDE, SIDE)
                shown = image if image.ndim == 2 else image.transpose(1, 2, 0)
                most = 1.0 if colours == "gray" else None  # the height map takes all of its colours
                axes.imshow(shown, origin="lower", cmap=colours, aspect="auto", vmin=most and 0.0, vmax=most)
                axes.set_axis_off()
                note(figure, GAP + k * (SIDE + GAP), top + 0.03, words)
                if k == 0 and top == tops[0]:
                    scale_bar(axes, camera.grid.extent_m[1])
        note(figure, GAP, 0.08, chain.words)


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
        model = open_model(given.model or released_model())
        chain = photographed(model, given.picture or sample_files()[0], given.seed, given.occlusion)
        draw(given.out, chain, model, camera_of(load_spec(model.folder / "spec.toml")))
        print(given.out)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
