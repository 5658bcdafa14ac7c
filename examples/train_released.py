"""The models that come with the project: a network for each obstruction and one for all three, on free pictures.

    python examples/train_released.py [KIND ...] [--steps N] [--occlusion MODEL] [--data DIR] [--out OUT]

KIND is dirt, raindrop, fence or all; all four one after the other if left out. Each is trained behind a plate that is
there already and stays as it is: that of `masks/released`, and for the fence that of `masks/dslr-2800`, with its own
camera. The network has the low-resolution branch for veil and gain, crops span 0.4 to all of a picture, and a running
mean of the weights is what is judged and given away (their worth: CHANGELOG). About 50 minutes a kind on two free
cores; what was stopped goes on with the same command. `history.jsonl` and `validation/` show held-out scores as they
come, `curves.png` all of them in the end.

Trained on: every picture of DATA that its licence lets a released model be trained on (`FREE`), and scikit-image's own
photographs but the first, which is the one that a released model is shown by. Judged by: others, which no model is
trained on. OUT and the project get

    OUT/KIND/               the training (`doedesign.training.train`)
    OUT/pictures/           links to the pictures that were used
    masks/released-KIND/    the model (`release_model.py`), with every picture and its licence in its manifest; that for
                            dirt is `masks/released`, which is taken where no model is named
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import release_model
import train_demo

from doedesign.capture.images import PICTURE_FILES, picture_files, sample_files
from doedesign.cli import exit_code
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.level_maps import open_design
from doedesign.training.train import train
from fab.errors import InputError
from fab.files import MANIFEST_NAME, sha256_file

MASKS = Path(__file__).parents[1] / "masks"
# By a pattern of their files below DATA. Not for a released model: BSDS500 (research), CamVid and BDD (non-commercial).
FREE = {
    "training_free/clic2025_*": "Unsplash License (CLIC 2025)",
    "training_free/gb82_*": "CC0 1.0 (GB82)",
    "backgrounds_kodak/*": "unrestricted (Kodak PCD0992)",
}
# Of scikit-image's documentation of its data.
SAMPLES = {
    "rocket.jpg": "public domain (SpaceX, by way of scikit-image)",
    "coffee.png": "CC0 (by way of scikit-image)",
    "astronaut.png": "public domain (NASA, by way of scikit-image)",
    "chelsea.png": "CC0 (by way of scikit-image)",
    "camera.png": "CC0 (by way of scikit-image)",
}
STEPS = 4000
HOW = (
    'train.freeze="optics"',
    'train.mode="simultaneous"',
    "train.learning_rate=2e-3",
    "train.size=256",
    "train.perceptual=0.0",
    "train.zoom=[0.4, 1.0]",
    "train.average=0.995",
    "train.checkpoint_every=100",
    "train.validate_every=500",
    "network.global_light=true",
    "train.light_scenes=4800",
)
# As heavy as the paper's (`automotive_cpu.toml`).
_HEAVY = 'clump = ["6 mm", "12 mm"], {0}coverage = [0.15, 0.4]'


class Kind(NamedTuple):
    """What a model is for: the folder of its plate, and the obstruction as overrides of its spec say it."""

    plate: str
    obstruction: str


KINDS = {
    "dirt": Kind("released", f'{{ kind = "dirt", options = {{ {_HEAVY.format("")} }} }}'),
    "raindrop": Kind("released", '{ kind = "raindrop" }'),
    "fence": Kind("dslr-2800", '{ kind = "fence" }'),
    "all": Kind("released", f'{{ kind = "dirt_raindrop_fence", options = {{ dirt_{_HEAVY.format("dirt_")} }} }}'),
}


class FreePictures(NamedTuple):
    """Folders of links to pictures to train on and to judge by, and the licence of each of the first by its name."""

    images: Path
    test: Path | None
    licences: Mapping[str, str]


def free_pictures(data: Path, out: Path) -> FreePictures:
    """Link the pictures; those of scikit-image alone, some of them held out, where there are no others.

    Raises:
        InputError: pictures to train on without any to judge by.
    """
    samples = {path: SAMPLES[path.name] for path in sample_files() if path.name in SAMPLES}
    given = {path: licence for pattern, licence in FREE.items() for path in sorted(data.glob(pattern))}
    given = {path: licence for path, licence in given.items() if path.suffix.lower() in PICTURE_FILES}
    judged = [path for pattern in train_demo.JUDGED_BY for path in sorted(data.glob(pattern))]
    judged = [path for path in judged if path.suffix.lower() in PICTURE_FILES]
    if given and not judged:
        cure = f"Put others there ({', '.join(train_demo.JUDGED_BY)})."
        raise InputError(str(data), "must hold pictures to judge by", "none", cure)
    used = given | samples
    images, test = out / "pictures" / "trained_on", out / "pictures" / "judged_by"
    train_demo.link(images, list(used))
    if judged:
        train_demo.link(test, judged, train_demo.MOST_JUDGED)
    licences = {path.name: licence for path, licence in used.items()}
    return FreePictures(images, test if judged else None, licences)


def trained(
    name: str, pictures: FreePictures, out: Path, occlusion: str, overrides: Sequence[str] = (), masks: Path = MASKS
) -> Path:
    """Train the model of a kind, or go on; return the folder of the training.

    Args:
        name: one of `KINDS`.
        pictures: pictures to train on and to judge by.
        out: folder of all trainings.
        occlusion: occlusion model.
        overrides: changes to the spec beside those of the kind.
        masks: folder of the plates.
    """
    kind, folder = KINDS[name], out / name
    count = train_demo.MOST_JUDGED if pictures.test is None else len(picture_files(pictures.test))
    changes = (f"obstruction={kind.obstruction}", f"train.steps={STEPS}", f"train.validation={count}", *HOW, *overrides)
    design = open_design(masks / kind.plate, False, overrides=changes, free=TRAINING_TABLES)
    licence = ", ".join(dict.fromkeys(pictures.licences.values()))
    how: Any = {"validation": pictures.test, "licence": licence, "occlusion": occlusion}
    train(design, pictures.images, folder, overrides=changes, **how)
    return folder


def listed(pictures: FreePictures) -> list[dict[str, str]]:
    """Name, digest and licence of every picture, for the manifest of a model."""
    files = picture_files(pictures.images)
    return [{"name": p.name, "sha256": sha256_file(p), "licence": pictures.licences[p.name]} for p in files]


def run(names: Sequence[str], data: Path, out: Path, occlusion: str, overrides: Sequence[str] = ()) -> list[Path]:
    """Train and release the models of these kinds; return their folders."""
    pictures, made = free_pictures(data, out), []
    for name in names:
        folder = trained(name, pictures, out, occlusion, overrides)
        order = MASKS / KINDS[name].plate / "masks.json"
        home = MASKS / ("released" if name == "dirt" else f"released-{name}")
        release_model.release(folder, order if order.is_file() else None, home, pictures=listed(pictures))
        train_demo.say(f"{home}: {(home / MANIFEST_NAME).stat().st_size} bytes of manifest")
        made.append(home)
    return made


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--steps", type=int, help=f"steps of every training; {STEPS} if left out")
    parser.add_argument("--occlusion", default="paper", help="occlusion model")
    parser.add_argument("--data", type=Path, default=train_demo.DATA, help="folder of folders of pictures")
    parser.add_argument("--out", type=Path, default=Path("runs") / "train_released")
    given = parser.parse_args()
    if unknown := [name for name in given.kinds if name not in KINDS]:
        parser.error(f"KIND must be one of {', '.join(KINDS)}, but got {unknown[0]}")
    overrides = [] if given.steps is None else [f"train.steps={given.steps}"]

    def work() -> None:
        for home in run(given.kinds or list(KINDS), given.data, given.out, given.occlusion, overrides):
            print(home)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
