"""What every case begins with: the smallest files of every kind, and each command on them undisturbed."""

import itertools
import json
import shutil
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tifffile
from PIL import Image

from tests.campaign.planted import write_base
from tests.campaign.process import End, Worker, content
from tests.campaign.shim import Fault

SPEC = Path(__file__).with_name("tiny.toml")
BARE = ("--levels", 4, "--step", "300 nm", "--pitch", "1.85 um", "--out", "order")
QUICK = ("--masks", "order")
ONE_ERROR = ("--errors", "common_depth_scale")
RATIO = ("--ring-to-disc", 1.0, "--probe", "550 nm", "--depth", "6 mm")


class Command(NamedTuple):
    """A command that the campaign disturbs.

    Attributes:
        arguments: its arguments; the working folder is a copy of what it needs.
        needs: files and folders that are there before it.
        writes: folder that it writes, or None.
    """

    arguments: tuple[object, ...]
    needs: tuple[str, ...]
    writes: str | None = "out"


COMMANDS = {
    "optimize": Command(("optimize", "spec.toml", "--out", "out"), ("spec.toml",)),
    "optimize-resumed": Command(("optimize", "spec.toml", "--out", "half"), ("spec.toml", "half"), "half"),
    "masks": Command(("masks", "run", "--out", "out"), ("run",)),
    "masks-process": Command(
        ("masks", "run", "--process", "process.toml", "--wafer", "wafer.toml", "--out", "out"),
        ("run", "process.toml", "wafer.toml"),
    ),
    **{
        f"masks-{kind}": Command(("masks", f"heights.{kind}", *more, *BARE[:-1], "out"), (f"heights.{kind}",))
        for kind, more in {"npy": (), "exr": (), "tif": ("--scale", "1 nm"), "png": ("--scale", "1 nm")}.items()
    },
    "as-built": Command(
        ("masks", "run", "--order", "order", "--as-built", "measured.json"),
        ("run", "order", "measured.json"),
        "run/as-built",
    ),
    "verify": Command(("verify", "order"), ("order",), None),
    "psf": Command(("psf", "run", *QUICK), ("run", "order"), "run/psf"),
    "psf-fabricated": Command(
        ("psf", "run", *QUICK, "--fabricated", "--process", "process.toml", "--variation", "variation.toml"),
        ("run", "order", "process.toml", "variation.toml"),
        "run/fabricated",
    ),
    "certify": Command(("certify", "run", "--cells", 4, "--pieces", 0), ("run", "order"), "run/certificate"),
    "tolerance": Command(
        ("tolerance", "run", *QUICK, "--draws", 2, "--sensitivity", "none", "--workers", 1, "--out", "out"),
        ("run", "order"),
    ),
    "simulate": Command(
        ("simulate", "run", *QUICK, "--images", "pictures", "--count", 2, "--size", 32, "--out", "out"),
        ("run", "order", "pictures"),
    ),
    "simulate-masks": Command(
        ("simulate", "run", *QUICK, "--images", "pictures", "--obstruction", "dirt", "--size", 32, "--out", "out"),
        ("run", "order", "pictures", "dirt"),
    ),
    "train": Command(("train", "run", "--images", "pictures", "--out", "out"), ("run", "pictures")),
    "finetune": Command(
        ("finetune", "model", "--pairs", "pairs", "--steps", 2, "--validation", 1, "--size", 32, "--out", "out"),
        ("model", "pairs"),
    ),
    "reconstruct": Command(
        ("reconstruct", "model", "one.png", "two.exr", "three.tif", "--out", "out"),
        ("model", "one.png", "two.exr", "three.tif"),
    ),
    "calibrate": Command(
        ("calibrate", "run", "measurement.toml", *QUICK, *ONE_ERROR, "--evaluations", 2, "--out", "out"),
        ("run", "order", "measurement.toml", "image.tiff", "dark.tiff"),
    ),
    "precompensate": Command(
        ("precompensate", "run", "--process", "process.toml", "--evaluations", 2, "--out", "out"),
        ("run", "process.toml"),
    ),
    "explanations": Command(
        ("calibrate", "run", *QUICK, *ONE_ERROR, *RATIO, "--no-pairs", "--out", "out"),
        ("run", "order"),
    ),
}


WRITING = tuple(name for name, command in COMMANDS.items() if command.writes is not None)


def in_turn(names: Sequence[str], seed: int, count: int) -> Iterator[str]:
    """So many names, one after another in an order that the seed chooses."""
    order = np.random.default_rng(seed).permutation(np.array(names, object))
    yield from itertools.islice(itertools.cycle(order), count)


class Ground:
    """The files, and what each command makes of them.

    Attributes:
        folder: where they are kept; what is missing there is made when it is needed.
        worker: process that commands run in.
    """

    def __init__(self, folder: Path, worker: Worker) -> None:
        self.folder, self.worker = folder, worker
        self._lock = threading.RLock()
        self._makers = {
            "run": self._optimized,
            "order": self._ordered,
            "measured.json": self._measured,
            "model": self._trained,
            "half": self._stopped,
        }
        self._contents: dict[str, dict[str, bytes]] = {}
        if not self.work.exists():
            self.work.mkdir(parents=True)
            _small_files(self.work)

    @property
    def work(self) -> Path:
        """The files."""
        return self.folder / "work"

    def _run(self, place: Path, *arguments: object) -> End:
        end = self.worker.run(arguments, place)
        if end.code != 0:
            raise RuntimeError(f"{' '.join(map(str, arguments))}: {end}\n{end.err}")
        return end

    def _ready(self, needed: str) -> Path:
        """Path of a file or folder that is there from now on."""
        path = self.work / needed
        with self._lock:
            if not path.exists():
                self._makers[needed]()
        return path

    def _optimized(self) -> None:
        self._run(self.folder, "optimize", "spec.toml", "--out", "run")

    def _ordered(self) -> None:
        self._ready("run")
        self._run(self.folder, "masks", "run", "--out", "order")

    def _trained(self) -> None:
        self._ready("run")
        self._run(self.folder, "train", "run", "--images", "pictures", "--out", "model")

    def _measured(self) -> None:
        sheet = json.loads(next(self._ready("order").glob("*_RUNSHEET.json")).read_text())
        sheet["measured"]["mask 1"]["depth_nm"] = 301.0
        (self.work / "measured.json").write_text(json.dumps(sheet, indent=1))

    def _stopped(self) -> None:
        """A run that was ended when its last checkpoint was on the disk."""
        half, arguments = self.work / "half", COMMANDS["optimize-resumed"].arguments
        calls = len(self._run(self.folder, *arguments).calls)
        for call in range(20, calls):
            shutil.rmtree(half)
            self.worker.run(arguments, self.folder, Fault(call=call, number=signal.SIGINT))
            if (half / "checkpoint.npz").exists():
                return

    def base(self) -> Path:
        """The order that defects are planted in."""
        path = self.folder / "planted"
        with self._lock:
            if not path.exists():
                write_base(path)
        return path

    def lay(self, name: str, place: Path) -> Path:
        """Copy what a command needs into `place`/work; returns that folder."""
        shutil.rmtree(place, ignore_errors=True)
        for needed in COMMANDS[name].needs:
            source, target = self._ready(needed), place / "work" / needed
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, symlinks=True)
            else:
                shutil.copy2(source, target)
        return place / "work"

    def whole(self, name: str) -> tuple[Path, End]:
        """The folder after the undisturbed command, and how that ended; computed at the first call."""
        place = self.folder / "whole" / name
        ended = place / "end.json"
        with self._lock:
            if not ended.exists():
                self.lay(name, place)
                self._run(place, *COMMANDS[name].arguments)  # everything is compiled from here on
                self.lay(name, place)
                ended.write_text(json.dumps(self._run(place, *COMMANDS[name].arguments)))
        *rest, calls, read = json.loads(ended.read_text())
        return place / "work", End(*rest, calls=tuple(calls), read=tuple(read))

    def lay_whole(self, name: str, place: Path) -> None:
        """Copy the folder after the undisturbed command to `place`/work."""
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(self.whole(name)[0], place / "work", symlinks=True)

    def forget(self, name: str) -> None:
        """Read the folder after a command anew at the next call of `after`."""
        self._contents.pop(name, None)

    def after(self, name: str) -> dict[str, bytes]:
        """Every file after the undisturbed command."""
        if name not in self._contents:
            self._contents[name] = content(self.whole(name)[0])
        return self._contents[name]


def differences(found: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """Names that are missing, new or have other content."""
    return [name for name in sorted({*found, *wanted}) if found.get(name) != wanted.get(name)]


def leftovers(names: Iterable[str]) -> list[str]:
    """Names of temporary files and folders."""
    return [name for name in names if any(part.startswith(".") for part in Path(name).parts)]


def _small_files(work: Path) -> None:
    shutil.copy(SPEC, work / "spec.toml")
    (work / "pictures").mkdir()
    rng = np.random.default_rng(0)
    for k, kind in enumerate(("png", "tif", "png", "png")):
        picture = Image.fromarray(rng.integers(30, 256, (5, 6, 3), np.uint8)).resize((48, 40))
        picture.save(work / "pictures" / f"{k}.{kind}")
    (work / "dirt").mkdir()
    mask = np.zeros((40, 48), np.uint8)
    mask[10:20, 12:30] = 255
    Image.fromarray(mask).save(work / "dirt" / "one.png")
    (work / "pairs").mkdir()
    for k in range(3):
        scene = rng.integers(30, 256, (5, 6), np.uint8)
        for name, gain in (("reference", 1.0), ("capture", 0.7)):
            picture = Image.fromarray((scene * gain).astype(np.uint8)).resize((44, 36))
            picture.save(work / "pairs" / f"{k}_{name}.png")
    level = rng.integers(0, 4, (16, 16))
    np.save(work / "heights.npy", level * 300e-9)
    tifffile.imwrite(work / "heights.tif", (level * 300).astype(np.uint16))
    Image.fromarray((level * 300).astype(np.uint16)).save(work / "heights.png")
    from sim.store import write_height, write_picture

    write_height(work / "heights.exr", (level * 300e-9).astype(np.float32), 1.85e-6, 16 * 1.85e-6)
    light = rng.uniform(0, 1, (32, 40)).astype(np.float32)
    write_picture(work / "two.exr", {"Y": light})
    for name in ("one.png", "three.tif"):
        Image.fromarray((light * 255).astype(np.uint8)).save(work / name)
    (work / "process.toml").write_text(
        '[process]\nlevels = 4\nlevel_step = "300 nm"\nminimum_line = "2 um"\n\n[process.errors]\n'
        'overlay_x = "0.3 um"\nroughness = { mean = "2 nm", sigma = "0.5 nm" }\n'
    )
    (work / "wafer.toml").write_text('[wafer]\ndiameter = "50 mm"\ndies = [1, 2]\nchrome = "etch"\n')
    (work / "variation.toml").write_text('[variation]\noverlay_x = ["0.1 um", "0.2 um"]\ncommon_depth_scale = 0.02\n')
    counts = np.clip(64 + 900 * np.exp(-((np.indices((40, 40)) - 19.5) ** 2).sum(0) / 60), 0, 4095)
    tifffile.imwrite(work / "image.tiff", np.rint(counts).astype(np.uint16))
    tifffile.imwrite(work / "dark.tiff", np.full((40, 40), 64, np.uint16))
    (work / "measurement.toml").write_text(
        'probe = "550 nm"\npixel = "1.85 um"\ngain = 2.0\nread_noise = 4.0\nsaturation = 4095\n'
        '[[image]]\nname = "near"\ndepth = "6 mm"\nfiles = ["image.tiff"]\ndark = ["dark.tiff"]\n'
    )
