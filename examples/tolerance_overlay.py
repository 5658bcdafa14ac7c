"""How well must the masks be aligned? A tolerance study of one's own, in five lines and a few words around them.

    python examples/tolerance_overlay.py [RUN]

Without a run folder it first designs a small plate from examples/quick.toml (half a minute). Then it asks two questions
about a mask aligner that misses by a quarter of a micrometre:

1. What do a few dozen plates look like?     doedesign tolerance RUN --draws 40
2. Which mask must be aligned best?          doedesign tolerance RUN --sensitivity one_at_a_time

The deepest etch should matter most: a misplaced edge of mask k leaves a strip that is wrong by 2^k level steps.
"""

import argparse
import sys
from pathlib import Path

from doedesign.cli import exit_code
from doedesign.optimization import optimize
from doedesign.tolerancing.analysis import Sample
from doedesign.tolerancing.plots import plot_effects, plot_histograms
from doedesign.tolerancing.sensitivity import Effect
from doedesign.tolerancing.studies import Study, study
from fab.figure import save

HERE = Path(__file__).parent


def design(spec: Path = HERE / "quick.toml", runs: Path = Path("runs"), overrides: tuple[str, ...] = ()) -> Path:
    """A small design to study; a finished one is taken as it is."""
    changes = ("optimize.steps=20", 'optics.wavelengths=["550 nm"]', 'scene.near=["10 mm"]', 'scene.far=["1.2 m"]')
    folder = runs / "tolerance-example"
    optimize(spec, folder, overrides=(*changes, *overrides))
    return folder


def overlay(run: Path, draws: int = 40, sigma: str = "0.25 um", workers: int | None = None) -> str:
    """Study the alignment of a run's masks.

    Args:
        run: a finished run.
        draws: plates to look at.
        sigma: how far a mask usually lies off, along x and along y.
        workers: worker processes; all cores by default.

    Returns:
        the table that is printed.
    """
    # The whole study. Everything after it only words the answers.
    errors = {"overlay_x": sigma, "overlay_y": sigma}
    asked = study(run, process="ideal", errors=errors, limits=["strehl >= 0.6"], workers=workers)
    plates = asked.monte_carlo(draws)
    changes = asked.one_at_a_time()

    drawn = asked.sample(["expected"])  # without a mean error, the plate as drawn
    pictures = draw(run / "overlay", asked, plates, drawn, changes)
    lines = [f"yield of {draws} plates: {plates.yield_}", "", "quantity        as drawn     mean    worst plate"]
    for quantity in plates.values:
        found = next(s for s in plates.statistics() if s["quantity"] == quantity and s["colour"] is None)
        worst = found["max" if quantity in ("zeroth_order", "outside_window") else "min"]
        lines.append(f"{quantity:<15} {drawn.worst(quantity)[0]:8.4f} {found['mean']:8.4f} {worst:14.4f}")
    lines += ["", f"what {sigma} along x does to the Strehl ratio", "mask  one sigma left  one sigma right"]
    lines += [f"{k:<4} {low:15.4f} {high:16.4f}" for k, (low, high) in enumerate(strehl_by_mask(changes))]
    return "\n".join([*lines, "", *map(str, pictures)])


def strehl_by_mask(changes: list[Effect]) -> list[tuple[float, float]]:
    """The Strehl ratio with each mask one sigma to the left and to the right, the worst colour."""
    chosen = [c for c in changes if c.quantity == "strehl" and c.colour is None and c.error.startswith("overlay_x_m")]
    return [(c.low if c.low is not None else c.expected, c.high) for c in chosen]


def draw(folder: Path, asked: Study, plates: Sample, drawn: Sample, changes: list[Effect]) -> list[Path]:
    """Histograms of the plates, and what every mask does alone."""
    files = [folder / "histograms.png", folder / "masks.png"]
    save(plot_histograms(plates, drawn, asked.design.camera), files[0])
    save(plot_effects(changes), files[1])
    return files


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", nargs="?", type=Path)
    given = parser.parse_args()
    sys.exit(exit_code(lambda: print(overlay(given.run or design()))))
