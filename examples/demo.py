"""The main job from end to end: one spec to one wafer order, and the light it will make.

    python examples/demo.py [SPEC]

It does what these three commands do, and prints a summary:

    doedesign optimize examples/automotive.toml
    doedesign masks runs/automotive --levels 16
    doedesign psf runs/automotive

Repeated, it finds the finished run and says so at once.
"""

import argparse
import sys
from pathlib import Path

from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.runs.psfs import psfs
from doedesign.spec import load_spec
from fab.files import MANIFEST_NAME, read_json
from fab.order.verify import verify
from fab.units import format_length

HERE = Path(__file__).parent


def demo(spec_path: Path = HERE / "automotive.toml", runs: Path = Path("runs"), masks: Path = Path("masks")) -> str:
    """Optimise a spec, draw its masks, prove them, and compute the PSFs of what was drawn.

    Args:
        spec_path: the spec.
        runs: where the run folder goes.
        masks: where the mask order goes.

    Returns:
        the summary that is printed.
    """

    def say(text: str) -> None:
        print(f"  {text}", file=sys.stderr, flush=True)

    say(f"1/3 optimising {spec_path}")
    folder = runs / load_spec(spec_path).name
    design = optimize(spec_path, folder)

    order = masks / design.name
    say(f"2/3 drawing {design.levels.count} levels into {order}")
    if is_drawn(design, order):
        report = verify(order)
        report.require()
    else:
        report = write_masks(folder, order).report

    light = folder / "psf"
    say(f"3/3 PSFs of the continuous, the quantised and the drawn design into {light}")
    if not (light / "from_masks.exr").is_file():
        psfs(folder, order, out=light)
    return summary(folder, order, light, len(report.checks))


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
    lines += [f"run       {run_folder}", f"masks     {order}", f"PSFs      {light}", "pictures"]
    lines += [f"  {path}" for folder in (run_folder, order, light) for path in sorted(folder.glob("*.png"))]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("spec", nargs="?", type=Path, default=HERE / "automotive.toml")
    given = parser.parse_args()
    sys.exit(exit_code(lambda: print(demo(given.spec))))
