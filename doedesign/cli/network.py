"""The reconstruction network: train, finetune, reconstruct."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from doedesign.cli.console import print_paths, print_results
from doedesign.cli.options import AsJson, Flag, Overrides, length_of
from fab.errors import InputError

if TYPE_CHECKING:
    from doedesign.recon.model import Model, PsfPair

Files = Annotated[tuple[Path, ...], Parameter(negative="", show_default=False)]
PsfFiles = Annotated[
    Files,
    Parameter(
        name="--psf",
        help="PSFs other than the model's: one bank, or first a file of the scene and then one of the obstruction.",
    ),
]
PixelPitch = Annotated[str | None, Parameter(help='Pixel pitch of PSFs from another program, such as "3.7 um".')]
NearDepth = Annotated[
    str | None,
    Parameter(help='Distance of the obstruction, such as "7 cm"; the middle, in 1/z, of those trained on by default.'),
]
FarDepth = Annotated[
    str | None,
    Parameter(help='Distance of the scene, such as "5 m" or inf; the farthest there is a PSF of by default.'),
]


def train(
    run: Path,
    *,
    images: Path | None = None,
    occlusion: str | None = None,
    obstruction: str | None = None,
    out: Path | None = None,
    validation: Path | None = None,
    lpips_weights: Files = (),
    licence: str | None = None,
    tensorboard: Flag = False,
    devices: int | None = None,
    coordinator: str | None = None,
    hosts: int | None = None,
    host: int | None = None,
    set_: Overrides = (),
    json_: AsJson = False,
) -> None:
    """Train the reconstruction network, jointly with the optics unless those are frozen.

    Args:
        run: Run folder; its design is where the optics begin.
        images: Folder of pictures; sample pictures of scikit-image by default.
        occlusion: radiometric, reciprocal, paper or paper_release; the spec's by default.
        obstruction: Kind, such as dirt, raindrop or fence, or a folder of masks; the spec's by default.
        out: Folder; RUN/trained by default. The same command resumes a stopped training.
        validation: Folder to hold pictures out from; the same folder by default.
        lpips_weights: Files with the weights of LPIPS; multi-scale SSIM stands in without them.
        licence: Licence of the pictures, for the record.
        tensorboard: Write for TensorBoard, too.
        devices: Number of devices; all by default.
        coordinator: With several hosts, HOST:PORT of host 0, or auto where the cluster tells (SLURM, Open MPI).
        hosts: Number of hosts; each runs this command, and all see the same folders.
        host: Number of this host, from 0.
    """
    from doedesign.runs.folder import TRAINING_TABLES
    from doedesign.runs.level_maps import open_design
    from doedesign.training.train import train as work

    # The run's own levels: a mask order of it may draw them otherwise.
    design = open_design(run, False, overrides=set_, free=TRAINING_TABLES)
    several: Any = {"devices": devices, "coordinator": coordinator, "hosts": hosts, "host": host}
    how: Any = {"occlusion": occlusion, "obstruction": obstruction, "licence": licence, "tensorboard": tensorboard}
    how |= {"validation": validation, "lpips_weights": lpips_weights, "overrides": set_, **several}
    folder = out or run / "trained"
    work(design, images, folder, **how)
    print_results(folder, json_, metrics=str(folder / "metrics.json"))


def finetune(
    run: Path,
    *,
    pairs: Path,
    psf: PsfFiles = (),
    pixel: PixelPitch = None,
    near_depth: NearDepth = None,
    far_depth: FarDepth = None,
    out: Path | None = None,
    steps: int = 2000,
    learning_rate: float | None = None,
    seed: int = 0,
    validation: int | None = None,
    size: int | None = None,
    lpips_weights: Files = (),
    linear: bool | None = None,
    mirror: bool = True,
    json_: AsJson = False,
) -> None:
    """Fine-tune a trained network on real pairs of capture and reference; the result is a model for reconstruct.

    Args:
        run: Run folder with a training, or the folder of a model.
        pairs: Folder with NAME_capture.* and NAME_reference.* (and NAME_mask.* where it is known), or with folders
            capture, reference and mask.
        out: Folder; RUN/finetuned by default. The same command resumes a stopped fine-tuning.
        steps: Steps.
        learning_rate: First step size of the network; a tenth of that of its training by default.
        seed: Seed of everything random.
        validation: Pairs that are never trained on; a fifth, and at most eight, by default.
        size: Pixels per side of a crop; those of its training by default, and at most what every pair has.
        lpips_weights: Files with the weights of LPIPS; multi-scale SSIM stands in without them.
        linear: Whether PNG and TIFF hold linear light; by default those of 8 and 16 bits hold display values.
        mirror: Exchange left and right at random, of captures and PSFs.
    """
    from doedesign.recon.model import Model
    from doedesign.training.finetune import finetune as work

    folder, model = out or run / "finetuned", Model.open(run)
    how: Any = {"steps": steps, "learning_rate": learning_rate, "seed": seed, "validation": validation, "size": size}
    how |= {"lpips_weights": lpips_weights, "linear": linear, "mirrored": mirror}
    work(model, pairs, folder, psfs=_psfs(model, psf, pixel, near_depth, far_depth), **how)
    print_results(folder, json_, metrics=str(folder / "metrics.json"))


def reconstruct(
    captures: Files,
    /,
    *,
    out: Path | None = None,
    psf: PsfFiles = (),
    pixel: PixelPitch = None,
    near_depth: NearDepth = None,
    far_depth: FarDepth = None,
    tile: int | None = None,
    overlap: int | None = None,
    linear: bool | None = None,
    kind: str | None = None,
    beside: Flag = False,
    json_: AsJson = False,
) -> None:
    """Reconstruct what captures show behind their obstruction. With captures alone, the released model is taken.

    Args:
        captures: PNG, TIFF, EXR or RAW files of any size; before them RUN, the run folder with a training or the folder
            of a model, where it is not the released one.
        out: Folder; "reconstructed" by default. A later call adds to it.
        tile: The most pixels of a tile's side; 1536 by default. Less takes less memory.
        overlap: Pixels that tiles share; 256 by default.
        linear: Whether PNG and TIFF hold linear light; by default those of 8 and 16 bits hold display values.
        kind: Kind of the results: png, tif or exr; that of the capture by default.
        beside: Draw every capture and its reconstruction side by side, too.
    """
    from doedesign.recon.files import reconstruct_files
    from doedesign.recon.model import Model
    from doedesign.recon.photos import PHOTO_FILES

    first, *rest = captures
    alone = first.is_file() or (first.suffix.lower() in PHOTO_FILES and not first.is_dir())
    files, model = (captures, Model.released()) if alone else (rest, Model.open(first))
    ending = None if kind is None else f".{kind.lower().removeprefix('.')}"
    how: Any = {"tile": tile, "overlap": overlap, "linear": linear, "kind": ending, "beside": beside}
    given = {name: value for name, value in how.items() if value is not None}
    psfs = _psfs(model, psf, pixel, near_depth, far_depth)
    print_paths(reconstruct_files(model, files, out or Path("reconstructed"), psfs=psfs, **given), json_)


def _psfs(model: "Model", files: Sequence[Path], pixel: str | None, near: str | None, far: str | None) -> "PsfPair":
    """The PSFs of --psf, --pixel, --near-depth and --far-depth."""
    from math import inf

    pixel_m, near_m = length_of("--pixel", pixel), length_of("--near-depth", near)
    if pixel_m is not None and not pixel_m > 0:
        raise InputError("--pixel", "must be positive", f'"{pixel}"', 'For example --pixel "3.7 um".')
    far_m = inf if far == "inf" else length_of("--far-depth", far)
    return model.psfs(files, pixel_m=pixel_m, near_m=near_m, far_m=far_m)
