"""What must the fab lab hold, and what may it not care about? The inverse of a tolerance study.

    python examples/tolerance_budget.py [RUN]

Without a run folder it first designs a small plate from examples/quick.toml (half a minute). Then every source of error
of an ordinary process is made smaller and larger while the others stay as they are, and the factor is sought at which
three plates in four are good. A factor of 0.6 says: this must become better; "beyond": this may stay as it is.

    doedesign tolerance RUN --budget overlay --yield 0.75

answers the same for one source, with more plates.
"""

import argparse
import sys
from pathlib import Path

from doedesign.cli import exit_code
from doedesign.optimization import optimize
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.plots import plot_budget
from doedesign.tolerancing.studies import study
from fab.figure import save
from fab.units import format_length

HERE = Path(__file__).parent

# A mask aligner and a plasma etcher that are somewhat worse than they should be.
PROCESS = {
    "overlay_x": "0.18 um",
    "overlay_y": "0.18 um",
    "depth_scale": 0.02,
    "common_depth_scale": 0.03,
    "cd_bias": "50 nm",
}


def design(spec: Path = HERE / "quick.toml", runs: Path = Path("runs"), overrides: tuple[str, ...] = ()) -> Path:
    """A small design to study; a finished one is taken as it is."""
    changes = ("optimize.steps=20", 'optics.wavelengths=["550 nm"]', 'scene.near=["10 mm"]', 'scene.far=["1.2 m"]')
    folder = runs / "tolerance-example"
    optimize(spec, folder, overrides=(*changes, *overrides))
    return folder


def budgets(
    run: Path,
    sources: tuple[str, ...] = ("overlay", "depth", "cd"),
    draws: int = 24,
    limits: tuple[str, ...] = ("strehl >= 0.6",),
    wanted: float = 0.75,
    workers: int | None = None,
) -> str:
    """Find how large each source of error may be.

    Args:
        run: a finished run.
        sources: sources of error, or single errors such as "overlay_x".
        draws: plates per point; two dozen give a first idea, two hundred an answer.
        limits: what a good plate obeys.
        wanted: the share of plates that shall be good.
        workers: worker processes; all cores by default.

    Returns:
        the table that is printed.
    """
    asked = study(run, errors=PROCESS, limits=limits, workers=workers)
    # Asked for at once, all plates are shared out among the workers in one go.
    factors = (0.0, 0.5, 1.0, 2.0)
    asked.sample([k for source in sources for some in asked.budget_keys(source, wanted, draws, factors) for k in some])
    found = [asked.budget(source, wanted, draws, factors) for source in sources]

    lines = [f"yield as the process is: {asked.monte_carlo(draws).yield_}", ""]
    lines += [f"source     factor  between        largest sigma for a yield of {100 * wanted:g} %"]
    lines += [f"{b.what:<10} {b.factor:6.2f}  {b.low:.2f} and {b.high:.2f}  {sigmas(b)}" for b in found]
    pictures = [run / "budget" / f"{budget.what}.png" for budget in found]
    for path, budget in zip(pictures, found, strict=True):
        save(plot_budget(budget), path)
    return "\n".join([*lines, "", *map(str, pictures)])


def sigmas(budget: Budget) -> str:
    """The standard deviations that a budget allows, masks alike named once."""
    if budget.verdict == "out of reach":
        return "none: the other errors alone spoil too many plates"
    by_name = {name.partition("[")[0]: float(f"{sigma:.2g}") for name, sigma in budget.sigmas.items()}
    told = [f"{n.removesuffix('_m')} {format_length(s) if n.endswith('_m') else s}" for n, s in by_name.items()]
    text = ", ".join(told)
    return text if budget.verdict == "found" else f"more than {text}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", nargs="?", type=Path)
    given = parser.parse_args()
    sys.exit(exit_code(lambda: print(budgets(given.run or design()))))
