"""Every file that a command writes, by the folder it lies in."""

from fnmatch import fnmatchcase
from pathlib import PurePosixPath
from typing import NamedTuple


class WrittenFile(NamedTuple):
    """A file of a folder.

    Attributes:
        name: its path in the folder; `*` stands for any part of a name.
        content: what it holds.
    """

    name: str
    content: str


class WrittenFolder(NamedTuple):
    """A folder that a command writes.

    Attributes:
        path: where it lies by default; NAME is that of the design, RUN the folder of its run.
        command: the command that writes it.
        about: what it is.
        files: its files.
    """

    path: str
    command: str
    about: str
    files: tuple[WrittenFile, ...]


_MANIFEST = WrittenFile(
    "manifest.json", "format, version of doedesign, what the folder was made from, and the SHA-256 of every result"
)
_BANK = "PSF bank: OpenEXR, a channel per colour and depth, energy per pixel per unit power on the aperture"
_DESIGN = (
    WrittenFile(
        "level_map.npz", "the design: level of every cell, staircase, grid and aperture; row 0 at the lowest y"
    ),
    WrittenFile("height.exr", "heights that follow from it, metres, for other programs"),
    WrittenFile("height_continuous.exr", "heights before rounding to levels, metres"),
)
_STUDY = (
    WrittenFile("study.json", "what was asked; only results of the same study are kept together"),
    _MANIFEST,
)
_TRAINING = (
    WrittenFile("network.npz", "weights and shape of the network, and the facts of its camera"),
    WrittenFile("psf.exr", f"PSFs that the network is given. {_BANK}"),
    WrittenFile("history.jsonl", "a line of JSON per step: loss, its terms, step sizes, seconds"),
    WrittenFile("curves.png", "the history in one picture"),
    WrittenFile("validation/*.png", "pictures that were never trained on, as captured, as reconstructed, as they are"),
    WrittenFile("metrics.json", "scores on held-out pictures: means, and those of every scene"),
    WrittenFile("checkpoint.npz", "all that a step changes; only while the training is unfinished"),
    WrittenFile("tensorboard/*", "the history for TensorBoard, on request"),
    _MANIFEST,
)

FOLDERS: tuple[WrittenFolder, ...] = (
    WrittenFolder(
        "runs/NAME/",
        "optimize, refine, precompensate",
        "A run: one design from its spec to its results. It goes on where it was stopped and ends with the same bytes.",
        (
            WrittenFile("spec.toml", "the spec with overrides and defaults; optional keys where they differ"),
            *_DESIGN,
            WrittenFile("history.jsonl", "a line of JSON per step: step, loss, terms of the loss and their names"),
            WrittenFile("metrics.json", "numbers of the design as drawn; see the reference of numbers"),
            WrittenFile("height.png", "the relief"),
            WrittenFile("psf.png", "PSFs of every colour and depth, and how far they may be off"),
            WrittenFile("mtf.png", "modulation transfer of the design and of the plain lens"),
            WrittenFile("mtf.csv", "the same as numbers, a row per depth, colour and frequency along x"),
            WrittenFile("encircled.png", "light within a radius, of the design and of the plain lens"),
            WrittenFile("encircled.csv", "the same as numbers, a row per depth, colour and radius"),
            WrittenFile("history.png", "loss and terms against steps; of spots their light and uniformity error"),
            WrittenFile("pattern*.png", "light drawn beside a target pattern, for each of them"),
            WrittenFile("orders.csv", "a row per spot: order, place, efficiency, light over the light wanted"),
            WrittenFile("orders.png", "light of every spot, and where spots lie"),
            WrittenFile("area.csv", "profiles through each area along x and y, and the light wanted"),
            WrittenFile("area.png", "light on each area with its profiles"),
            WrittenFile("focus.csv", "a row per focus: distance, colour, widths, strength, share"),
            WrittenFile("focus.png", "widths and light through the distances"),
            WrittenFile("refinement.csv", "of a refined run: light of the cell before and after, scalar and rigorous"),
            WrittenFile(
                "precompensation.csv", "of a pre-compensated run: a row per mask, depth to command, move of edges"
            ),
            WrittenFile(
                "precompensation_light.csv",
                "every number of the light as designed, and as fabricated without and with it",
            ),
            WrittenFile("illumination*", "copy of the picture of the beam"),
            WrittenFile("area_*", "copies of the pictures of areas"),
            WrittenFile(
                "cost.jsonl",
                "a line per command that worked on the run: time, processor time, memory, host; no digest covers it",
            ),
            WrittenFile("report.html", "the page of the run, with `report`"),
            WrittenFile("comparison.html", "the run beside others, with `report --compare`"),
            WrittenFile("checkpoint.npz", "parameters, moments and history; only while the run is unfinished"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "masks/NAME/",
        "masks",
        "A mask order: all that a fab lab needs, read back and proved before the folder appears. Names begin with the "
        "identity of the job, such as QUICK_A_1P85_3F2A.",
        (
            WrittenFile(
                "*_ALL.oas", "the review file: mask blank, wafer, dies, DOE, marks, test structures, labels (OASIS)"
            ),
            WrittenFile("*_ALL.gds", "the same as GDSII, with --combined-gds"),
            WrittenFile("*_M[0-9]*.gds.gz", "one file per etch mask, GDSII packed by gzip (.gds with --plates gds)"),
            WrittenFile("*_M[0-9]*.gds", "the same, plain"),
            WrittenFile("*_CHROME.gds*", "the mask of the chrome aperture; a polygon is chrome"),
            WrittenFile("*_ORDER.html", "order form for the mask shop, after SEMI P10"),
            WrittenFile("*_ORDER.csv", "the same as a table, a row per mask"),
            WrittenFile("*_LAYERS.lyp", "layer names and colours for KLayout"),
            WrittenFile("*_CHECK.drc", "checks for KLayout that need nothing of this toolkit"),
            WrittenFile(
                "*_RUNSHEET.html", "run sheet: every step with target, blanks for what is measured, predictions"
            ),
            WrittenFile("*_RUNSHEET.json", "the same for `masks --as-built`; measured numbers are filled in here"),
            WrittenFile("*_PLATE.step", "glass, chrome and place of the relief; rings of a radial design as circles"),
            WrittenFile("*_WAFER.step", "the wafer with its dies"),
            WrittenFile("*_RELIEF.3mf", "the relief as a closed mesh, block-reduced, metres"),
            WrittenFile("*_RELIEF.glb", "the same for viewers"),
            WrittenFile("*_RELIEF_MM.stl", "the same, millimetres"),
            WrittenFile("*_PATCH*", "a window of the relief at full resolution, with --patch or --mesh-patch"),
            WrittenFile("*_HEIGHT.tif", "heights, 16 bits"),
            WrittenFile("*_HEIGHT.npy", "heights, metres, float32"),
            WrittenFile("*_LEVELS.npy", "level of every cell"),
            WrittenFile("*_SAG.DAT", "grid sag for optics programs"),
            WrittenFile("*_GREY.png", "grey picture for greyscale writers"),
            WrittenFile("*_PREVIEW.png", "the masks"),
            WrittenFile("*_WAFER.png", "dies and marks on the wafer"),
            WrittenFile("*_MARKS.png", "an alignment site"),
            WrittenFile("*_RULES.png", "where a mask breaks the rules of the process"),
            WrittenFile("*_DIRECT*", "one layer per level, merged, with --direct-write; OASIS, and DXF in micrometres"),
            WrittenFile("*_DOSE.csv", "heights and depths of the levels, blanks for the doses, with --direct-write"),
            WrittenFile(
                "manifest.json",
                "digest, unit, layers, tone, reading sense, areas, smallest features, places, and the "
                "request from which everything is drawn again",
            ),
        ),
    ),
    WrittenFolder(
        "RUN/psf/",
        "psf",
        "PSFs of a run: of its heights before rounding, of its level map, and of what its masks draw.",
        (
            WrittenFile("continuous*.exr", f"heights before rounding. {_BANK}"),
            WrittenFile("quantised*.exr", "the level map, likewise"),
            WrittenFile("from_masks*.exr", "the level map that the mask files draw, likewise"),
            WrittenFile("*_psf.png", "PSFs of every colour and depth"),
            WrittenFile("*_mtf.png", "modulation transfer"),
            WrittenFile("*_mtf.csv", "the same as numbers, a row per depth, colour and frequency along x"),
            WrittenFile("*_encircled.png", "light within a radius"),
            WrittenFile("*_encircled.csv", "the same as numbers, a row per depth, colour and radius"),
            WrittenFile("continuous_height.png", "the relief before rounding"),
            WrittenFile("metrics.json", "rows of numbers for each of the three"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/fabricated/",
        "psf --fabricated",
        "One plate as a process makes it, beside the design as drawn.",
        (
            WrittenFile("fabricated.exr", _BANK),
            WrittenFile("fabricated_psf.png", "PSFs of every colour and depth"),
            WrittenFile("leakage.png", "light that the relief leaves undiffracted, and what it diffracts"),
            WrittenFile("variation.toml", "the errors of this plate, which `--variation` reads"),
            WrittenFile("orders.*", "table and picture of the spots of the plate"),
            WrittenFile("area.*", "those of its areas"),
            WrittenFile("focus.*", "those of its foci"),
            WrittenFile("metrics.json", "rows of numbers, nominal and fabricated"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/certificate/",
        "certify",
        "Rows and squares of the design by Maxwell's equations, beside thin elements and edges.",
        (
            WrittenFile("certificate.json", "every cut-out, 0th orders and PSFs of the whole, the verdict"),
            WrittenFile("certificate.png", "errors of both models over the height of walls"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/tolerance/",
        "tolerance",
        "A tolerance study; a stopped one goes on, and one that asks for more takes the finished draws over.",
        (
            WrittenFile("results.json", "yield, statistics, sensitivities and budget"),
            WrittenFile("draws.csv", "a row per draw, colour and depth with every number"),
            WrittenFile("errors.csv", "a row per draw with every error, SI units"),
            WrittenFile("draws.jsonl", "a line per finished draw, from which a stopped study goes on"),
            WrittenFile("histograms.png", "how every number is distributed"),
            WrittenFile("yield.png", "share of plates that obey the limits"),
            WrittenFile("one_at_a_time.png", "what every error does alone"),
            WrittenFile("sobol.png", "Sobol indices of the sources of error"),
            WrittenFile("budget.png", "yield against the size of the errors of the budget"),
            WrittenFile("nominal_psf.png", "PSFs of the design as drawn"),
            WrittenFile("worst_psf.png", "PSFs of the worst draw"),
            *_STUDY,
        ),
    ),
    WrittenFolder(
        "RUN/simulated/",
        "simulate",
        "Captures past an obstruction, with the DOE and without; a folder per item.",
        (
            WrittenFile("contact.png", "the items side by side"),
            WrittenFile("*/clean.*", "the scene alone, sharp, linear light with white 1"),
            WrittenFile("*/conventional.*", "the capture of the same camera with a flat plate"),
            WrittenFile("*/capture.*", "the capture with the DOE"),
            WrittenFile("*/mask.*", "share of each pixel's direction that the obstruction blocks"),
            WrittenFile("*/alpha.*", "share of the background's light that the occlusion model takes away"),
            WrittenFile("*/depth.*", "metres to what is seen"),
            WrittenFile("*/manifest.json", "digests, meaning of the numbers, and what was drawn for the item"),
            WrittenFile("variation.toml", "errors of the plate, where captures are through a fabricated one"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/trained/",
        "train",
        "A reconstruction network with its DOE; a folder that `reconstruct` and `psf` take.",
        (
            WrittenFile("spec.toml", "the spec with overrides and defaults; optional keys where they differ"),
            WrittenFile("pictures.json", "names of all pictures, trained on and held out, and their licence"),
            *_DESIGN,
            *_TRAINING,
        ),
    ),
    WrittenFolder(
        "RUN/finetuned/",
        "finetune",
        "The network, trained further on real pairs.",
        (
            WrittenFile("spec.toml", "the spec of the model that was tuned"),
            WrittenFile("pairs.json", "names of all pairs, trained on and held out"),
            *_TRAINING,
        ),
    ),
    WrittenFolder(
        "reconstructed/",
        "reconstruct",
        "Pictures that the network makes of captures, under the names of these.",
        (
            WrittenFile("*.exr", "reconstruction in linear light, of a capture in linear light"),
            WrittenFile("*.png", "reconstruction in display values"),
            WrittenFile("*.tif*", "reconstruction, as many bits as the capture"),
            WrittenFile("manifest.json", "model and settings of every result"),
        ),
    ),
    WrittenFolder(
        "RUN/evaluation/",
        "evaluate",
        "Tables 1 and 2 of the paper on one set of test pairs, and figures of optics.",
        (
            WrittenFile("table*/table.json", "every score with its interval, gains, and the paper's numbers"),
            WrittenFile("table*/table.csv", "a row per method, region and score"),
            WrittenFile("table*/table.tex", "the table for a paper"),
            WrittenFile("table*/table.png", "the table as bars with intervals"),
            WrittenFile("table*/pictures.png", "some pairs as every row shows them"),
            WrittenFile("table*/pairs.csv", "photograph, distances and covered share of every pair"),
            WrittenFile("table*/study.json", "what was asked"),
            WrittenFile("table*/scores.jsonl", "a line per finished score"),
            WrittenFile("table*/external/*", "pairs for other programs, and what they make of them"),
            WrittenFile("trained/*", "networks that rows of the tables need, each as in RUN/trained/"),
            WrittenFile("pictures/*", "sample photographs, where no folder is given"),
            WrittenFile("figure4/plates.csv", "a row per plate and colour: light, concentration, modulation transfer"),
            WrittenFile("figure8/depths.csv", "a row per plate and depth: ring:disc, light, 0th order"),
            WrittenFile("bench/images.csv", "a row per image of the bench"),
            WrittenFile("bench/*", "the bench's measurement, which `calibrate` takes, and the errors that it hides"),
            WrittenFile("figure*/figure.png", "the figure"),
            WrittenFile("figure*/manifest.json", _MANIFEST.content),
        ),
    ),
    WrittenFolder(
        "RUN/calibration/",
        "calibrate",
        "Errors of the process that explain measured PSFs.",
        (
            WrittenFile("calibration.json", "estimates with uncertainty and correlation, fit of every image, remarks"),
            WrittenFile("process-estimate.toml", "the estimate, which every command takes as --process"),
            WrittenFile("plate.toml", "errors of this plate, which `psf --fabricated --variation` takes"),
            WrittenFile("*.png", "estimates, measured and fitted PSFs, and what remains"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/explanations/",
        "calibrate --ring-to-disc",
        "Families of errors that explain a throughput and a ring:disc ratio.",
        (
            WrittenFile("explanations.json", "each error and each pair of errors that explains them"),
            WrittenFile("explanations.txt", "the same for people"),
            WrittenFile("explanations.png", "the same as a picture"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "RUN/as-built/",
        "masks --as-built",
        "The plate of a filled run sheet.",
        (
            WrittenFile("as-built.json", "every error, where it comes from, and the comparison with the run sheet"),
            WrittenFile("as-built.exr", _BANK),
            WrittenFile("as-built_psf.png", "PSFs of every colour and depth"),
            WrittenFile("variation.toml", "errors of the plate, which `psf --fabricated --variation` takes"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "masks/released/, masks/released-raindrop/, masks/released-fence/, masks/released-all/",
        "examples/release_model.py",
        "A released model: network and plate; `reconstruct` takes the first where none is named.",
        (
            WrittenFile("spec.toml", "the spec"),
            *_DESIGN[:2],
            *_TRAINING[:2],
            WrittenFile("masks.json", "manifest of the mask order of the plate, where one was named; not for fences"),
            WrittenFile("capture.png", "a capture to try it on"),
            _MANIFEST,
        ),
    ),
    WrittenFolder(
        "masks/automotive-2400/, masks/automotive-robust-2400/, masks/dslr-2800/",
        "examples/release_design.py",
        "Released full-size designs.",
        (
            WrittenFile("README.md", "the design in words, with its main numbers"),
            WrittenFile("spec.toml", "the spec"),
            _DESIGN[0],
            WrittenFile("metrics.json", "numbers of the design as drawn"),
            WrittenFile("tolerance.json", "statistics of predicted plates, and the yield"),
            _MANIFEST,
        ),
    ),
)


def folder_of(path: str) -> WrittenFolder | None:
    """The entry of a folder such as "runs/quick/psf"; None for one that no command writes."""
    parts = PurePosixPath(path).parts
    known = {PurePosixPath(place.strip()).parts: one for one in FOLDERS for place in one.path.split(",")}
    if len(parts) == 3:
        return known.get(("RUN", parts[2])) if parts[0] == "runs" else None
    return known.get(parts) or (known.get((parts[0], "NAME")) if len(parts) == 2 else None)


def described(folder: WrittenFolder, name: str) -> WrittenFile | None:
    """The entry of a file by its path in a folder; None where it has none."""
    return next((one for one in folder.files if fnmatchcase(name, one.name)), None)
