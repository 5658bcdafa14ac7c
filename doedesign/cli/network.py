"""The reconstruction network: train, finetune, reconstruct, evaluate."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from doedesign.cli.closing import say_closing
from doedesign.cli.console import print_paths, print_results
from doedesign.cli.options import AsJson, Flag, Overrides, Texts, length_of, refuse_options
from fab.errors import InputError

if TYPE_CHECKING:
    from doedesign.recon.model import Model, PsfPair

log = logging.getLogger("doedesign")

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
    Parameter(
        help='Distance of the scene, such as "5 m" or inf; by default that which the model was trained for, or the '
        "farthest there is a PSF of where the model states none or --psf has none of it."
    ),
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
    from doedesign.runs.costs import measured
    from doedesign.runs.folder import TRAINING_TABLES
    from doedesign.runs.level_maps import open_design
    from doedesign.training.train import train as work

    # The run's own levels: a mask order of it may draw them otherwise.
    design = open_design(run, False, overrides=set_, free=TRAINING_TABLES)
    several: Any = {"devices": devices, "coordinator": coordinator, "hosts": hosts, "host": host}
    how: Any = {"occlusion": occlusion, "obstruction": obstruction, "licence": licence, "tensorboard": tensorboard}
    how |= {"validation": validation, "lpips_weights": lpips_weights, "overrides": set_, **several}
    folder = out or run / "trained"
    with measured(run, "train", writes=folder) as taken:
        work(design, images, folder, **how)
    print_results(folder, json_, metrics=str(folder / "metrics.json"))
    say_closing(folder, run, taken)


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
    from doedesign.runs.costs import measured
    from doedesign.training.finetune import finetune as work

    folder, model = out or run / "finetuned", Model.open(run)
    how: Any = {"steps": steps, "learning_rate": learning_rate, "seed": seed, "validation": validation, "size": size}
    how |= {"lpips_weights": lpips_weights, "linear": linear, "mirrored": mirror}
    with measured(run, "finetune", writes=folder) as taken:
        work(model, pairs, folder, psfs=_psfs(model, psf, pixel, near_depth, far_depth), **how)
    print_results(folder, json_, metrics=str(folder / "metrics.json"))
    say_closing(folder, run, taken)


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
    from doedesign.runs.costs import measured

    first, *rest = captures
    alone = first.is_file() or (first.suffix.lower() in PHOTO_FILES and not first.is_dir())
    files, model = (captures, Model.released()) if alone else (rest, Model.open(first))
    ending = None if kind is None else f".{kind.lower().removeprefix('.')}"
    how: Any = {"tile": tile, "overlap": overlap, "linear": linear, "kind": ending, "beside": beside}
    given = {name: value for name, value in how.items() if value is not None}
    psfs = _psfs(model, psf, pixel, near_depth, far_depth)
    folder = out or Path("reconstructed")
    with measured(None if alone else first, "reconstruct", writes=folder) as taken:
        paths = reconstruct_files(model, files, folder, psfs=psfs, **given)
    print_paths(paths, json_)
    say_closing(folder, None if alone else first, taken)


def evaluate(
    run: Path,
    *,
    table: int = 2,
    rows: Texts = (),
    figure: str | None = None,
    occlusion: str | None = None,
    obstruction: str | None = None,
    pairs: int = 200,
    images: Path | None = None,
    test: Path | None = None,
    licence: str | None = None,
    train: Flag = False,
    seeds: Annotated[tuple[int, ...], Parameter(negative="", consume_multiple=True)] = (0,),
    seed: int = 0,
    reflect: Flag = False,
    robust: Path | None = None,
    process: str | None = None,
    draws: int = 4,
    method: Texts = (),
    lpips_weights: Files = (),
    workers: int | None = None,
    scheduler: str | None = None,
    out: Path | None = None,
    set_: Overrides = (),
    json_: AsJson = False,
) -> None:
    """Score the rows of one of the paper's tables on the same captures: networks, cameras, single-image methods.

    Writes the table as CSV, JSON, LaTeX and pictures. The same command goes on where it was stopped. With --figure,
    one of its figures instead, of the design alone: numbers and a picture.

    Args:
        run: Run folder of a design, or the folder of a released model.
        table: 1, networks and deconvolution behind the plate; or 2, other cameras and single-image methods.
        rows: Names of the rows to compute, such as proposed or conventional_network; all by default.
        figure: 4, PSFs and MTFs beside classic plates; 8, light against depth, as drawn and as fabricated; or bench,
            photographs of a plate on the paper's PSF bench, for calibrate.
        occlusion: radiometric, reciprocal, paper or paper_release; the spec's by default.
        obstruction: Kind, such as dirt, raindrop or fence, or a folder of masks; the spec's by default.
        pairs: Number of test pairs.
        images: Folder of pictures to train on; some of scikit-image's sample pictures by default.
        test: Folder of pictures to judge by, none of them trained on; the others of scikit-image's by default.
        licence: Licence of the pictures to train on, for the record.
        train: Train the networks that are missing, with the spec's [train]; otherwise their rows say why not.
        seeds: Seeds of the trainings.
        seed: Seed of the pairs.
        reflect: Mirror scenes beyond the edges of a capture, as in training, instead of letting them go on.
        robust: Run folder of a robust design of the same camera, for rows of its own in table 2.
        process: TOML file with a [process] table, or the name of a stock process, for the plates as fabricated; the
            run's own by default.
        draws: Plates as fabricated, over which the pairs are shared out.
        method: A program to score, "NAME=COMMAND {in} {out}"; NAME:scene= or NAME:plate= shows it something else.
        lpips_weights: Files with the weights of LPIPS; without them there is no such column.
        workers: Worker processes; as many as cores and memory allow by default, 0 for this process.
        scheduler: Address of a Dask scheduler whose workers are taken instead.
        out: Folder; RUN/evaluation by default.
    """
    from doedesign.runs.costs import measured

    folder = out or run / "evaluation"
    if figure is not None:
        idle: dict[str, object] = {"table": table, "rows": rows, "occlusion": occlusion, "obstruction": obstruction}
        idle |= {"pairs": pairs, "images": images, "test": test, "licence": licence, "train": train, "seeds": seeds}
        idle |= {"reflect": reflect, "robust": robust, "method": method, "lpips_weights": lpips_weights}
        idle |= {"workers": workers, "scheduler": scheduler, "set_": set_}
        cure = "Leave it out: --figure 8 takes --process, --draws and --seed, bench --process and --seed, all --out."
        refuse_options(evaluate, idle, "is of tables and does not go with --figure", cure)
        plates: dict[str, object] = {"draws": draws} if figure == "bench" else {}
        plates |= {"process": process, "draws": draws, "seed": seed} if figure == "4" else {}
        refuse_options(evaluate, plates, f"does not go with --figure {figure}", cure)
        from doedesign.evaluation.optics.figures import figure as draw

        with measured(run, "evaluate", writes=folder) as taken:
            drawn = draw(run, figure, folder, process=process, draws=draws, seed=seed)
        print_results(drawn, json_)
        say_closing(drawn, run, taken)
        return
    from doedesign.evaluation.evaluate import evaluate as work

    how: Any = {"occlusion": occlusion, "obstruction": obstruction, "images": images, "test": test, "licence": licence}
    how |= {"pairs": pairs, "train": train, "seeds": seeds, "seed": seed, "border": "reflect" if reflect else "own"}
    how |= {"robust": robust, "process": process, "draws": draws, "methods": method, "lpips_weights": lpips_weights}
    with measured(run, "evaluate", writes=folder) as taken:
        found = work(run, folder, table=table, rows=rows, overrides=set_, workers=workers, scheduler=scheduler, **how)
    log.info("%s", found.text())
    place = folder / found.folder_name
    print_results(place, json_, table=str(place / "table.csv"))
    say_closing(place, run, taken)


def _psfs(model: "Model", files: Sequence[Path], pixel: str | None, near: str | None, far: str | None) -> "PsfPair":
    """The PSFs of --psf, --pixel, --near-depth and --far-depth."""
    from math import inf

    pixel_m, near_m = length_of("--pixel", pixel), length_of("--near-depth", near)
    if pixel_m is not None and not pixel_m > 0:
        raise InputError("--pixel", "must be positive", f'"{pixel}"', 'For example --pixel "3.7 um".')
    far_m = inf if far == "inf" else length_of("--far-depth", far)
    return model.psfs(files, pixel_m=pixel_m, near_m=near_m, far_m=far_m)
