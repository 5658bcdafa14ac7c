"""Files of a run and of what lies beside it; every one that a manifest lists is checked against its digest."""

import base64
import contextlib
import csv
import gzip
import io
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doedesign.overview.kinds import has_record, record_of
from doedesign.report.page.blocks import PageImage
from doedesign.runs.folder import CHECKPOINT, FORMAT, LEVEL_MAP, Run, is_worked_in, open_run
from doedesign.runs.orders import order_of_run
from doedesign.spec import Spec, load_spec
from doedesign.training.history import HISTORY_NAME, read_history
from fab.archive import read_archive
from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_bytes, read_json, sha256_bytes
from fab.level_map import read_level_map
from fab.manifest.records import Manifest, read_manifest
from fab.pictures import read_display, webp_bytes

_ENDLESS = 1 << 62
_MOST_PX = 1600  # of a drawn picture; more is not seen on a page
_log = logging.getLogger("doedesign")


class RunFiles(NamedTuple):
    """All that a report reads.

    Attributes:
        folder: the run folder.
        spec: its spec.
        run: the run, if it is finished.
        manifest: its manifest.
        order: its mask order, if there is one that draws this run.
        order_folder: the folder of the order.
        reconstructed: folder of reconstructions beside the run, if there is one.
    """

    folder: Path
    spec: Spec
    run: Run | None
    manifest: Mapping[str, Any]
    order: Manifest | None
    order_folder: Path
    reconstructed: Path | None

    @property
    def name(self) -> str:
        """Name of the design."""
        return self.spec.name


def open_files(folder: Path, order: Path | None = None) -> RunFiles:
    """Look at a run folder, finished or not, and at what lies beside it.

    Args:
        folder: the run folder.
        order: its mask order; `masks/NAME` beside the folder of runs, or where the program runs, by default.

    Raises:
        InputError: no run, a damaged or changed one, or an order that was given and is not that of the run.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file() or read_json(path).get("state") != "running" or read_json(path).get("format") != FORMAT:
        run = open_run(folder)
        spec, manifest = run.spec, read_json(path)
    else:
        run, manifest = None, read_json(path)
        spec = load_spec(folder / "spec.toml")
    homes = [folder.resolve().parent.parent, Path()]
    found = order or order_of_run(
        spec.name, folder, None if run is None else read_level_map(run.path(LEVEL_MAP)), homes
    )
    read = read_manifest(found) if order is not None or (found / MANIFEST_NAME).is_file() else None
    digest = None if read is None else read.source.get("level_map_sha256")
    if read is not None and run is not None and digest not in (None, digest_of(run)):
        if order is not None:
            cure = "Give the order of this run, or draw its masks into a folder of their own: doedesign masks RUN."
            raise InputError(str(order), "must be the mask order of this run", "that of another level map", cure)
        read = None
    return RunFiles(folder, spec, run, manifest, read, found, _reconstructed(homes))


def _reconstructed(homes: Sequence[Path]) -> Path | None:
    """Folder of reconstructions; one that is not this program's or cannot be read is no part of the run."""
    for folder in (home / "reconstructed" for home in homes):
        try:
            if has_record(folder) and record_of(folder).kind == "reconstructions":
                return folder
        except InputError as error:
            _log.warning("no reconstructions are shown: %s", error)
    return None


def digest_of(run: Run) -> str:
    """SHA-256 of the level numbers of a run."""
    return read_level_map(run.path(LEVEL_MAP)).digest


def listed_bytes(folder: Path, name: str) -> bytes | None:
    """Content of a file that the manifest of a folder of results lists; None where it lists none of that name.

    Raises:
        InputError: the file is missing or another than was listed.
    """
    path = folder / MANIFEST_NAME
    if not path.is_file():
        return None
    digests = read_json(path).get("results_sha256")
    if not isinstance(digests, dict) or name not in digests:
        return None
    data = read_bytes(folder / name)
    if sha256_bytes(data) != digests[name]:
        cure = "Restore it, or run the command that wrote it again."
        raise InputError(str(folder / name), "must be the file that the manifest lists", "a changed file", cure)
    return data


def listed_json(folder: Path, name: str) -> dict[str, Any] | None:
    """A JSON file that a manifest lists, as `listed_bytes`."""
    return None if listed_bytes(folder, name) is None else read_json(folder / name)


def listed_csv(folder: Path, name: str) -> list[dict[str, str]] | None:
    """Rows of a CSV file that a manifest lists, as `listed_bytes`."""
    data = listed_bytes(folder, name)
    if data is None:
        return None
    try:
        return list(csv.DictReader(io.StringIO(data.decode())))
    except (UnicodeDecodeError, csv.Error) as error:
        cure = "Run the command that wrote it again."
        raise InputError(str(folder / name), "must be a table (CSV)", f'"{error}"', cure) from error


def listed_lines(folder: Path, name: str) -> list[str] | None:
    """Lines of a text file that a manifest lists, as `listed_bytes`."""
    data = listed_bytes(folder, name)
    return None if data is None else data.decode(errors="replace").splitlines()


def listed_picture(folder: Path, name: str, *, photo: bool = False) -> PageImage | None:
    """A picture that a manifest lists (WebP); None where it lists none of that name.

    Args:
        folder: the folder.
        name: the file.
        photo: whether it may lose what eyes do not see, which drawings may not.
    """
    return None if listed_bytes(folder, name) is None else picture_image(folder / name, photo=photo)


def picture_image(path: Path, *, photo: bool = False) -> PageImage:
    """A picture file for a page; `photo` as in `listed_picture`."""
    return pixels_image(read_display(path), photo=photo)


def pixels_image(pixels: np.ndarray, *, photo: bool) -> PageImage:
    """Display values `[y, x]` or `[y, x, 3]`, uint8, row 0 at the lowest y, for a page (WebP)."""
    data = webp_bytes(pixels, 85 if photo else None, most_px=_MOST_PX)
    height, width = pixels.shape[:2]
    return PageImage(f"data:image/webp;base64,{base64.b64encode(data).decode()}", width, height)


@contextlib.contextmanager
def understood(folder: Path, what: str) -> Iterator[None]:
    """Turn what goes wrong with results of another form into an InputError that names them.

    Args:
        folder: the run folder.
        what: the results, in words.

    Raises:
        InputError: results within this block that are not as this version's commands write them.
    """
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        rule, cure = "must hold what the commands of this version write", "Run them again, or remove their results."
        raise InputError(f"{folder}: {what}", rule, f'"{type(error).__name__}: {error}"', cure) from error


def history_of(files: RunFiles) -> list[dict[str, Any]]:
    """Records of the steps of an optimisation; of a run that works, up to its last checkpoint."""
    path = files.folder / HISTORY_NAME
    if files.run is not None:
        return [] if listed_bytes(files.folder, HISTORY_NAME) is None else read_history(path, _ENDLESS)
    checkpoint = files.folder / CHECKPOINT
    if not checkpoint.is_file():
        return []
    header, _ = read_archive(checkpoint, "checkpoint", "Resume the run.")
    history = header.get("history")
    return history if isinstance(history, list) else []


def work_state(folder: Path) -> tuple[bool, tuple[tuple[str, int, int], ...]]:
    """Whether a run or a training in its folder is at work, and a state that differs once any of its files did.

    Args:
        folder: the run folder.
    """
    homes = [folder, *(folder / name for name in ("trained", "finetuned"))]
    working = [home for home in homes if (home / MANIFEST_NAME).is_file() and _is_at_work(home)]
    watched = sorted([*folder.glob(f"*/{MANIFEST_NAME}"), *folder.glob(f"*/{HISTORY_NAME}"), folder / MANIFEST_NAME,
                      folder / CHECKPOINT])  # fmt: skip
    facts = []
    for path in watched:
        with contextlib.suppress(FileNotFoundError):  # a checkpoint may go meanwhile
            about = path.stat()
            facts.append((str(path), about.st_mtime_ns, about.st_size))
    return bool(working), (("working", len(working), 0), *facts)


def _is_at_work(home: Path) -> bool:
    """Whether a run or a training is neither done nor stopped; in this order, so that none ends between."""
    worked_in = is_worked_in(home)
    return worked_in and read_json(home / MANIFEST_NAME).get("state") == "running"


def training_of(folder: Path) -> list[dict[str, Any]]:
    """Records of the steps of a training in a folder; the last line of one that works may be unfinished."""
    path = folder / HISTORY_NAME
    return read_history(path, _ENDLESS) if path.is_file() else []


def safe_json(value: object) -> str:
    """A value as JSON that may stand inside a script element: no text in it can end the element."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def packed(data: bytes) -> str:
    """Bytes packed by gzip, in base 64; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()
