"""SHA-256 of every file that a standard session writes, to prove that a change leaves results as they are.

    python -m bench.digests before.json            # at the old state
    python -m bench.digests after.json             # at the new one
    python -m bench.digests --compare before.json after.json

The session runs the command line only: the quick example, its mask order, PSFs, plates as fabricated, a tolerance
study, captures and two training steps; and the small order of `masks/example`. Digests hold on one machine: another
processor rounds differently. Where a command fails there are none, for files that are missing twice are no proof.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXAMPLE = ["--set", "name=example", "--set", "doe.samples=96", "--set", "doe.aperture=0.1776 mm"]
TRAINING = ["train.size=64", "train.steps=2", "train.perceptual=0.0", "network.width=3", "network.depth=1"]


def session(folder: Path) -> None:
    """Run every command that writes results into a folder.

    Raises:
        SystemExit: one of them failed.
    """
    bare = str(next((ROOT / "masks" / "example").glob("*_HEIGHT.npy")))
    quick = str(ROOT / "examples" / "quick.toml")
    run, small = str(folder / "quick"), str(folder / "example")
    stock = ["--set", "process.stock=contact_aligner"]
    images = _pictures(folder / "pictures")
    commands = [
        ["optimize", quick, "--out", run, *stock],
        ["masks", run, "--out", str(folder / "quick-masks")],
        ["masks", run, "--levels", "8", "--out", str(folder / "quick-masks-8")],
        ["psf", run, "--masks", str(folder / "quick-masks")],
        ["psf", run, "--fabricated", "--seed", "0"],
        ["tolerance", run, "--draws", "6", "--workers", "1"],
        ["simulate", run, "--images", images, "--count", "2"],
        ["train", run, "--images", images, *(word for change in TRAINING for word in ("--set", change))],
        ["optimize", quick, "--out", small, *EXAMPLE, *stock],
        ["masks", small, "--out", str(folder / "example-masks")],
        ["masks", bare, "--levels", "16", "--step", "75 nm", "--pitch", "1.85 um", "--out", str(folder / "bare-masks")],
        ["verify", str(folder / "quick-masks")],
    ]
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", "doedesign", *command], capture_output=True, text=True, check=False, cwd=ROOT
        )
        print(f"{done.returncode} doedesign {' '.join(command)}".replace(str(folder), "."), file=sys.stderr)
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            raise SystemExit(1)


def _pictures(folder: Path) -> str:
    """Sample pictures of scikit-image, as a user's folder."""
    from PIL import Image
    from skimage import data

    folder.mkdir()
    for name in ("astronaut", "chelsea", "coffee", "rocket"):
        picture = Image.fromarray(getattr(data, name)())
        for part, box in enumerate([(0, 0, 300, 300), (100, 0, 400, 300), (50, 50, 350, 300)]):
            picture.crop(box).save(folder / f"{name}{part}.png")
    return str(folder)


def digests() -> dict[str, str]:
    """Digest of every file of the session by its path in it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "session"
        folder.mkdir()
        session(folder)
        # What commands cost differs from call to call.
        files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "cost.jsonl")
        return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def compare(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Every file that differs, is missing or is new."""
    return [name for name in sorted({*before, *after}) if before.get(name) != after.get(name)]


def main() -> int:
    """Write the digests of this state, or compare those of two; return 1 if they differ."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", type=Path, nargs="?", help="file for the digests of this state")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="two such files")
    given = parser.parse_args()
    if (given.file is None) == (given.compare is None):
        parser.error("give a file for the digests, or two such files with --compare")
    if given.compare is not None:
        differences = compare(*(json.loads(path.read_text()) for path in given.compare))
        print("\n".join(differences) or "every file is the same")
        return int(bool(differences))
    given.file.write_text(json.dumps(digests(), indent=1, sort_keys=True) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
