"""A robust step of a round of four plates as fabricated against a step that looks at the plate as drawn; full size.

    python -m bench.robust           ten minutes
    python -m bench.robust --quick   examples/quick.toml; the targets are for the full size

Both look at all colours. A round of robust steps (`doedesign.design.robust.ROUND`) makes its plates once and moves the
level map every so many steps; what that takes is part of the steps. A step looks at one pair of the plates.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from doedesign.design.optimize import finished_design, initial_state, make_update, optimiser_of, step_inputs
from doedesign.design.problem import problem_of
from doedesign.design.robust import ROUND, RobustTask
from doedesign.runtime.memory import peak_bytes
from doedesign.spec import load_spec

EXAMPLES = Path(__file__).parent.parent / "examples"
TARGET_RATIO, TARGET_PEAK_GB, PLAIN_STEPS = 5.0, 6.0, 6


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    sets = ["optimize.colours=together", "optimize.min_feature=1 um", f"robust.steps={2 * ROUND}", "robust.draws=4"]
    spec = load_spec(EXAMPLES / ("quick.toml" if quick else "automotive.toml"), sets)
    problem, scene = problem_of(spec, {})
    first = initial_state(spec, problem, scene, {}, lambda path: np.load(path, allow_pickle=False))
    update, state, plain_s = make_update(optimiser_of(spec)), (first.parameters, first.adam), []
    for step in range(PLAIN_STEPS + 2):
        start = time.perf_counter()
        state, loss, _ = update(step_inputs(spec, problem, scene, step), state)
        jax.block_until_ready((state, loss))
        plain_s.append(time.perf_counter() - start)
    plain = float(np.median(plain_s[2:]))  # the first two compile and touch memory
    task = RobustTask.of(spec, problem, scene)
    level = finished_design(spec, problem, first._replace(parameters=state[0])).level_map.level
    begun, ends = task.initial_state(level), []
    for _ in task.steps(begun, 0):
        ends.append(time.perf_counter())
    robust = (ends[2 * ROUND - 1] - ends[ROUND - 1]) / ROUND  # the second round; the first one compiles
    peak = peak_bytes() / 1e9
    ratio = robust / plain
    print(f"Robust step with 4 plates, {spec.name}, {problem.camera.grid.shape[0]} cells per side, 3 colours")
    print(f"  plain step {plain * 1e3:8.0f} ms    robust step {robust * 1e3:8.0f} ms")
    print(f"  ratio {ratio:6.2f}   (target <= {TARGET_RATIO:g}: {'ok' if ratio <= TARGET_RATIO else 'missed'})")
    print(f"  peak {peak:6.2f} GB  (target < {TARGET_PEAK_GB:g}: {'ok' if peak < TARGET_PEAK_GB else 'missed'})")


if __name__ == "__main__":
    main()
