"""A design as it is given away: its plate, its numbers, and what a stock process makes of it.

    python examples/release_design.py RUN [--draws 64] [--process contact_aligner] [--out masks/NAME]

RUN is what `doedesign optimize` wrote. OUT is a run, too, but small: whatever takes a run (`masks`, `psf`, `tolerance`,
`simulate`) takes it. It gets

    level_map.npz    the plate
    spec.toml        what it was optimised for
    metrics.json     its numbers as drawn
    tolerance.json   predicted plates of the process: statistics of their numbers, and the yield
    manifest.json    digests of all of these
    README.md        the numbers in words, and the commands that make it again

Predicted plates are looked at from the nearest and the farthest depth: each of the full automotive design takes ten
seconds of two cores.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from doedesign.cli import exit_code
from doedesign.runs.folder import LEVEL_MAP, open_run
from doedesign.runs.level_maps import open_design
from doedesign.tolerancing.results import tolerance
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from fab.level_map import read_level_map
from fab.units import format_length
from sim.metrics import METRICS

TOLERANCE = "tolerance.json"
PROCESS = "contact_aligner"
COPIED = ("spec.toml", LEVEL_MAP, "metrics.json")
# Of a spec without limits of its own: two thirds of a spot of 0.3, and most of what is near spread about its disc.
LIMITS = ("far_spot >= 20 %", "ring_to_disc >= 0.8")
SHOWN = ("far_spot", "zeroth_order", "ring_to_disc", "outside_window", "strehl")


def release(
    run: Path, out: Path, spec: str, draws: int = 64, process: str = PROCESS, workers: int | None = None
) -> None:
    """Write the folder.

    Args:
        run: folder of a finished run.
        out: where to.
        spec: the spec as its reader would name it.
        draws: predicted plates.
        process: that which makes them.
        workers: worker processes; all cores by default.

    Raises:
        InputError: no finished run, or one without obstructions or a scene.
    """
    design = open_design(open_run(run), False)
    if not (design.near_m and design.far_m and design.spec):
        raise InputError(str(run), "must be a plate to see through", "one without obstructions", "Give another run.")
    ends = replace(design.bare(), near_m=(min(design.near_m),), far_m=(max(design.far_m),))
    limits = design.spec.limits or LIMITS
    found = tolerance(
        ends, process=process, limits=limits, draws=draws, sensitivity="none", workers=workers, out=run / "released"
    )
    record = found.record() | {"process": process}
    for name in COPIED:
        write_atomic(out / name, (run / name).read_bytes())
    write_atomic(out / TOLERANCE, canonical_json(record))
    digest = read_level_map(out / LEVEL_MAP).digest
    manifest = read_json(run / MANIFEST_NAME)
    commands = commands_of(f"runs/{out.name}", spec, manifest["overrides"], draws, process)
    rows = read_json(out / "metrics.json")["psf"]
    text = words(design.name, spec, commands, digest, rows, record, str(found.yield_))
    write_atomic(out / "README.md", text.encode())
    names = (*COPIED, TOLERANCE, "README.md")
    digests = {name: sha256_file(out / name) for name in sorted(names)}
    said = manifest | {"results_sha256": digests}
    write_atomic(out / MANIFEST_NAME, canonical_json(said))


def commands_of(run: str, spec: str, overrides: Sequence[str], draws: int, process: str) -> str:
    """The commands that make a folder again, indented."""
    other = "" if process == PROCESS else f" --process {process}"
    changes = "".join(f" \\\n        --set {quoted(one)}" for one in overrides)
    return (
        f"    doedesign optimize {spec} --out {run}{changes}\n"
        f"    python examples/release_design.py {run} --draws {draws}{other} --spec {spec}"
    )


def quoted(text: str) -> str:
    """A word as a shell reads it, in double quotes where it holds single ones and nothing that a shell replaces."""
    return f'"{text}"' if "'" in text and not set(text) & set('"$`\\!') else shlex.quote(text)


def words(
    name: str,
    spec: str,
    commands: str,
    digest: str,
    rows: Sequence[dict[str, Any]],
    record: dict[str, Any],
    share: str,
) -> str:
    """The README of a folder: the commands that make it again, and numbers as drawn and as predicted."""
    drawn = ["| | " + " | ".join(dict.fromkeys(row["colour"] for row in rows)) + " |"]
    drawn.append("|---" * drawn[0].count(" | ") + "|---|")
    for depth in dict.fromkeys(row["depth_m"] for row in rows):
        of = [row for row in rows if row["depth_m"] == depth]
        where = "at infinity" if depth is None else f"at {format_length(depth)}"
        kinds = {"far_spot": "sharp spot", "concentration": "concentration (its bound)", "throughput": "in the window"}
        for key, label in kinds.items():
            if key in of[0]:
                cells = [f"{row[key]:.3f}" for row in of]
                if key == "concentration":
                    cells = [f"{row[key]:.3f} ({row['concentration_bound']:.3f})" for row in of]
                drawn.append(f"| {label} {where} | " + " | ".join(cells) + " |")
    plates = [
        f"| worst colour, nearest and farthest depth | {' | '.join(('as drawn', 'mean', '5 %', 'median', '95 %'))} |",
        "|---" * 6 + "|",
    ]
    statistics = {row["quantity"]: row for row in record["plates"]["statistics"] if row["colour"] is None}
    for quantity in SHOWN:
        worst = max if METRICS[quantity].worse == "high" else min
        as_drawn = worst(row[quantity] for row in record["nominal"] if row.get(quantity) is not None)
        numbers = [as_drawn, *(statistics[quantity][key] for key in ("mean", "p05", "median", "p95"))]
        plates.append(f"| {METRICS[quantity].label} | " + " | ".join(f"{number:.3f}" for number in numbers) + " |")
    limits = ", ".join(one["limit"] for one in record["plates"]["yield"]["limits"])
    count, process = record["plates"]["count"], record["process"]
    parts = [
        f"# {name}",
        f"A plate to see through, from `{spec}`; digest of its level map {digest[:16]}. It was made by",
        commands,
        "and is a run itself: `doedesign masks` draws its order; `doedesign psf`, `tolerance` and `simulate` take it.\n"
        "The same bytes come out on the same processor and libraries; on others some cells may take another level.",
        "As drawn, shares of the incident light (concentration: over that of the plain lens; one below its bound\n"
        "means that light leaves the window):",
        "\n".join(drawn),
        f"{count} predicted plates of the stock process `{process}`, from the nearest and the farthest depth:",
        "\n".join(plates),
        f"A lab with such a process should expect a yield of {share} by: {limits}.\n"
        "The interval is that of so few plates; `tolerance.json` has every colour and depth.",
    ]
    return "\n\n".join(parts) + "\n"


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--draws", type=int, default=64)
    parser.add_argument("--process", default=PROCESS)
    parser.add_argument("--spec", help="the spec, for the words; examples/NAME.toml by default")
    parser.add_argument("--out", type=Path, help="masks/ and the name of the run's folder by default")
    given = parser.parse_args()

    def work() -> None:
        out = given.out or Path("masks") / given.run.name
        spec = given.spec or f"examples/{open_run(given.run).spec.name}.toml"
        release(given.run, out, spec, given.draws, given.process)
        print(out)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
