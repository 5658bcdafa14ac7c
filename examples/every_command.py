"""Every command of doedesign on one small design, as a new user types them: from a spec to masks, light and networks.

    python examples/every_command.py [FOLDER] [--spec examples/quick.toml]

Refinement is shown on `examples/cell.toml`, which repeats. Results go to FOLDER (`every-command` by default), each
command is printed before it runs, and all but refinement, the certificate, tolerance, the table, fine-tuning and
pre-compensation, which are cut short, take their defaults. Seven minutes on two cores; a second call resumes what was
stopped.
"""

import argparse
import contextlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from measure_psfs import measure

from doedesign.cli import exit_code, main
from doedesign.spec import load_spec
from fab.errors import CheckFailed

HERE = Path(__file__).parent


def commands(spec: Path, name: str) -> Iterator[list[str]]:
    """Yield every command in its order; what one needs beyond the results of those before it is made in between.

    Args:
        spec: the spec.
        name: of its design.
    """
    run, order = Path("runs") / name, Path("masks") / name
    yield ["doctor"]
    yield ["new"]
    yield ["spec", "optimize.steps"]
    yield ["optimize", str(spec)]
    yield ["optimize", str(HERE / "cell.toml")]
    yield ["refine", str(Path("runs") / "cell"), "--steps", "10"]
    yield ["compare", str(Path("runs") / "cell"), str(Path("runs") / "cell_refined")]
    yield ["masks", str(run)]
    yield ["verify", str(order)]
    yield ["psf", str(run)]
    yield ["psf", str(run), "--fabricated", "--seed", "0"]
    yield ["certify", str(run), "--cells", "12", "--pieces", "0"]
    yield ["tolerance", str(run), "--draws", "40"]
    yield ["simulate", str(run)]
    yield ["train", str(run)]
    yield ["evaluate", str(run), "--pairs", "6"]
    yield ["evaluate", str(run), "--figure", "8"]
    items = sorted(path.parent for path in (run / "simulated").glob("*/capture.exr"))
    yield ["reconstruct", str(run), str(items[0] / "capture.exr")]
    yield ["finetune", str(run), "--pairs", str(pairs_of(items, Path("pairs"))), "--steps", "10"]
    yield ["calibrate", str(run), str(measure(run, Path("measurement")))]
    estimate = run / "calibration" / "process-estimate.toml"
    yield ["precompensate", str(run), "--process", str(estimate), "--random", "overlay", "--evaluations", "30"]
    yield ["calibrate", str(run), "--ring-to-disc", "1", "--probe", "520 nm", "--depth", "10 mm", "--no-pairs"]
    yield ["runs"]
    yield ["show", str(run), "all", "--print"]
    yield ["report", str(run)]


def pairs_of(items: list[Path], folder: Path) -> Path:
    """Copy simulated captures and their scenes as pairs for fine-tuning into a folder; return it."""
    folder.mkdir(exist_ok=True)
    for item in items:
        for file, part in (("capture.exr", "capture"), ("clean.exr", "reference"), ("mask.exr", "mask")):
            shutil.copyfile(item / file, folder / f"{item.name}_{part}.exr")
    return folder


def every_command(folder: Path, spec: Path = HERE / "quick.toml") -> list[str]:
    """Run every command in a folder.

    Args:
        folder: where results go.
        spec: the spec.

    Returns:
        names of the commands that ran.

    Raises:
        CheckFailed: a command ended with another exit code than 0.
    """
    spec, done = spec.resolve(), []
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(folder):
        for command in commands(spec, load_spec(spec).name):
            print("\n$ doedesign", *(f'"{word}"' if " " in word else word for word in command), flush=True)
            if main(command) != 0:
                raise CheckFailed([f"doedesign {' '.join(command)} failed"])
            done.append(command[0])
    return done


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("every-command"))
    parser.add_argument("--spec", type=Path, default=HERE / "quick.toml")
    given = parser.parse_args()
    sys.exit(exit_code(lambda: every_command(given.folder, given.spec)))
