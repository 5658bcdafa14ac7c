"""The main job from end to end: a spec becomes a wafer order and a report of the light that it will make.

    python examples/demo.py [SPEC]

A small design comes first, to have something to look at; the full-size one is optimised beside it. For each of them the
demo does what these commands do, says which pictures to open, and prints a summary:

    doedesign optimize examples/automotive.toml
    doedesign masks runs/automotive
    doedesign psf runs/automotive
    doedesign report runs/automotive

Repeated, it finds the finished runs and says so at once.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax

from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.report.page.write import write_report
from doedesign.runs.psfs import psfs
from doedesign.spec import load_spec
from fab.errors import CheckFailed
from fab.files import MANIFEST_NAME, read_json
from fab.order.verify import verify
from fab.units import format_length

HERE = Path(__file__).parent
QUICK, FULL = HERE / "quick.toml", HERE / "automotive.toml"

_KEPT = "JAX_COMPILATION_CACHE_DIR"
_BEGUN = time.monotonic()


def demo(first: Path = QUICK, main: Path | None = FULL, runs: Path = Path("runs"), masks: Path = Path("masks")) -> str:
    """Make the order and the report of a small design, and of the main one, which is optimised meanwhile.

    Args:
        first: spec of the small design.
        main: spec of the main one; without it the first one is all.
        runs: where run folders go.
        masks: where mask orders go.

    Returns:
        the summary of the last one; that of the small one is printed.
    """
    if main is None:
        return made(first, runs, masks)
    with programs_kept():
        with optimised_beside(main, runs) as wait_for_main:
            print(made(first, runs, masks), flush=True)
            say(f"{main}, which was begun meanwhile:")
            wait_for_main()
        return made(main, runs, masks)


def made(spec_path: Path, runs: Path, masks: Path) -> str:
    """Optimise a spec, draw its masks, prove them, compute the PSFs of what was drawn, and report.

    Args:
        spec_path: the spec.
        runs: where the run folder goes.
        masks: where the mask order goes.

    Returns:
        the summary.
    """
    folder = runs / load_spec(spec_path).name
    say(f"optimising {spec_path}")
    design = optimize(spec_path, folder)
    say(f"a first look: {folder / 'height.png'} and {folder / 'psf.png'}")

    order, light, page = masks / design.name, folder / "psf", folder / "report.html"
    say(f"drawing {design.levels.count} levels into {order}")
    drawn = is_drawn(design, order)
    if drawn:
        report = verify(order)
        report.require()
    else:
        report = write_masks(folder, order).report
    say(f"what goes to the lab: {next(order.glob('*_PREVIEW.png'))}")

    say(f"PSFs of the continuous, the quantised and the drawn design into {light}")
    lit = (light / "from_masks.exr").is_file()
    if not lit:
        psfs(folder, order, out=light)
    if not (drawn and lit and page.is_file()):
        write_report(folder, order=order, out=page)
    say(f"all of it on one page: {page}")
    return summary(folder, order, light, len(report.checks))


def say(text: str) -> None:
    """Print a message with the time since the demo began."""
    print(f"  [{time.monotonic() - _BEGUN:3.0f} s] {text}", file=sys.stderr, flush=True)


@contextmanager
def programs_kept() -> Iterator[None]:
    """Keep what either process compiles for the other, as long as the demo lasts."""
    if _KEPT in os.environ:
        yield
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ[_KEPT] = folder
        jax.config.update("jax_compilation_cache_dir", folder)
        try:
            yield
        finally:
            jax.config.update("jax_compilation_cache_dir", None)
            del os.environ[_KEPT]


@contextmanager
def optimised_beside(spec_path: Path, runs: Path) -> Iterator[Callable[[], None]]:
    """Optimise a spec in a process of its own, which leaves the cores to this one as long as it needs them.

    Yields:
        a function that waits for the end and shows how it goes on. Without it the process ends with the block; its run
        keeps its checkpoints.
    """
    out = runs / load_spec(spec_path).name
    command = [sys.executable, "-m", "doedesign", "optimize", str(spec_path), "--out", str(out)]
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "log").open("w") as log:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        if hasattr(os, "setpriority"):
            os.setpriority(os.PRIO_PROCESS, process.pid, 5)
        try:
            yield lambda: wait(process, Path(log.name))
        finally:
            process.terminate()
            process.wait()


def wait(process: "subprocess.Popen[bytes]", log: Path) -> None:
    """Wait for a process and show what it writes; of what it wrote before, the last line.

    Raises:
        CheckFailed: the process failed.
    """
    with log.open() as written:
        shown = "".join(written.readlines()[-1:])
        while True:
            ended = process.poll() is not None
            print(shown + written.read(), end="", file=sys.stderr, flush=True)
            if ended:
                break
            shown = ""
            time.sleep(0.5)
    if process.returncode:
        raise CheckFailed(["the optimisation beside this one failed; its last words stand above"])


def is_drawn(design: Design, order: Path) -> bool:
    """Whether a mask order of exactly this level map lies there already."""
    if not (order / MANIFEST_NAME).is_file():
        return False
    return read_json(order / MANIFEST_NAME).get("level_map_sha256") == design.level_map.digest


def summary(run_folder: Path, order: Path, light: Path, checks: int) -> str:
    """The table of the quantised design, and where everything is."""
    rows = read_json(light / "metrics.json")["quantised"]
    lines = ["", "colour  depth     in window  far spot  ring:disc  concentration (bound)", "-" * 72]
    for row in rows:
        depth = "inf" if row["depth_m"] is None else format_length(row["depth_m"])
        far = f"{row['far_spot']:8.3f}" if "far_spot" in row else " " * 8
        near = ""
        if "concentration" in row:
            ratio = row["ring_to_disc"]
            shown = "-" if ratio is None else f"{ratio:.2f}"
            near = f"{shown:>9}  {row['concentration']:.4f} ({row['concentration_bound']:.4f})"
        lines.append(f"{row['colour']:<7} {depth:>7} {row['throughput']:10.3f}  {far}  {near}")
    lines += ["", f"{checks} checks of the mask order passed: every pixel of every file is as designed.", ""]
    lines += [f"run       {run_folder}", f"masks     {order}", f"PSFs      {light}"]
    lines += [f"report    {page}" for page in run_folder.glob("report.html")] + ["pictures"]
    lines += [f"  {path}" for folder in (run_folder, order, light) for path in sorted(folder.glob("*.png"))]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("spec", nargs="?", type=Path, default=FULL)
    given = parser.parse_args()
    sys.exit(exit_code(lambda: print(demo(QUICK, None if given.spec.samefile(QUICK) else given.spec))))
