"""Spots and orders beside Gerchberg-Saxton as everybody writes it, and beside what light allows.

    python -m bench.spots            all tasks, some minutes
    python -m bench.spots --quick    the smallest of each kind

The judge shares nothing with the engine: it takes the level map alone and sums one period, or the whole aperture, in
double precision. Peers run in the same process on the same task: Gerchberg-Saxton and its weighted form on a transform
of the target plane, phase rounded to the levels at the end (R. W. Gerchberg and W. O. Saxton, Optik 35, 237, 1972;
R. Di Leonardo et al., Opt. Express 15, 1913, 2007). Efficiencies are of the light on the aperture, without Fresnel
loss.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from doedesign.optimization import optimize
from doedesign.spec import load_spec
from fab.levels import height_of
from sim.camera import Camera

SPEC = """
name = "spots"
[optics]
focal_length = "20 mm"
wavelengths = ["532 nm"]
design_wavelength = "532 nm"
[doe]
samples = 512
pitch = "2 um"
aperture = "1.024 mm"
material = "fused_silica"
[process]
levels = {levels}
level_step = "{step} nm"
[scene]
far = ["inf"]
[sensor]
pitch = "3.45 um"
resolution = [1440, 1080]
window = 512
[spots]
count = [{columns}, {rows}]
{place}
uniformity = {uniformity}
[optimize]
steps = 100
"""
WAVE_NM = 1155.0  # of fused silica at 532 nm
SPACING_M = 250e-6


class Task(NamedTuple):
    """Spots, levels, cells of a period (0 for spots apart), and the least efficiency and largest error promised."""

    columns: int
    rows: int
    levels: int
    period: int
    uniformity: float
    least: float
    most: float

    def text(self) -> str:
        """The spec."""
        place = f'period = "{2 * self.period} um"' if self.period else f'spacing = "{SPACING_M * 1e6:g} um"'
        return SPEC.format(
            levels=self.levels,
            step=WAVE_NM / self.levels,
            columns=self.columns,
            rows=self.rows,
            place=place,
            uniformity=self.uniformity,
        )


def bound(known: float) -> float:
    """98 % of a ceiling with 16 levels."""
    return 0.98 * 0.987 * known


TASKS = (
    Task(5, 5, 16, 0, 1.0, 0.89, 0.003),
    Task(5, 5, 8, 0, 1.0, 0.85, 0.005),
    Task(2, 1, 16, 256, 3.0, bound(0.811), 0.005),
    Task(3, 1, 16, 256, 3.0, bound(0.926), 0.005),
    Task(5, 1, 16, 256, 3.0, bound(0.921), 0.005),
    Task(6, 1, 16, 256, 3.0, bound(0.891), 0.005),
    Task(7, 1, 16, 256, 3.0, bound(0.968), 0.005),
    Task(9, 1, 16, 256, 10.0, bound(0.993), 0.005),
    Task(2, 2, 16, 96, 3.0, bound(0.918), 0.005),
    Task(3, 3, 16, 96, 3.0, bound(0.939), 0.005),
    Task(5, 5, 16, 96, 3.0, bound(0.940), 0.005),
    Task(7, 7, 16, 96, 3.0, bound(0.940), 0.005),
    Task(9, 9, 16, 128, 3.0, bound(0.940), 0.005),
    Task(7, 1, 2, 256, 0.2, 0.785, 0.05),
    Task(7, 7, 2, 128, 0.6, 0.785, 0.01),
)


def numbers(count: int) -> np.ndarray:
    """Orders of a row of spots."""
    return (2 * np.arange(count) - (count - 1)) // (2 if count % 2 else 1)


def judge(level: np.ndarray, task: Task, camera: Camera, heights_m: np.ndarray) -> tuple[float, float]:
    """Efficiency and uniformity error of a level map, from sums in double precision."""
    light = np.exp(2j * np.pi * camera.waves_per_metre(532e-9) * heights_m[level])
    pitch, cells = camera.grid.pitch_m, camera.grid.shape[0]
    orders = numbers(task.rows), numbers(task.columns)
    if task.period:
        middle = (cells - task.period) // 2
        light = light[middle : middle + task.period, middle : middle + task.period]
        waves = [each / (task.period * pitch) for each in orders]
        place = (np.arange(task.period) + 0.5) * pitch
        area = task.period**2
    else:
        waves = [each * SPACING_M / (532e-9 * camera.focal_length_m) for each in orders]
        place = (np.arange(cells) - (cells - 1) / 2) * pitch
        light = np.where(np.hypot(place[:, None], place[None, :]) <= camera.aperture_m / 2, light, 0)
        area = np.count_nonzero(light)
    rows, columns = (np.exp(-2j * np.pi * np.outer(u, place)) * np.sinc(u * pitch)[:, None] for u in waves)
    found = np.abs(rows @ light @ columns.T / area).ravel() ** 2
    return float(found.sum()), float((found.max() - found.min()) / (found.max() + found.min()))


def gerchberg_saxton(task: Task, cells: int, weighted: bool, seconds: float) -> np.ndarray:
    """Level map of one period by transforms back and forth, levels rounded at the end, for so many seconds."""
    rng = np.random.default_rng(0)
    y, x = (numbers(n) for n in (task.rows, task.columns))
    at = np.ix_(y % cells, x % cells)
    phase, weights = rng.uniform(0, 2 * np.pi, (cells, cells)), np.ones((task.rows, task.columns))
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        far = np.fft.fft2(np.exp(1j * phase), norm="forward")
        if weighted:
            size = np.abs(far[at])
            weights *= size.mean() / np.maximum(size, 1e-12)
        kept = np.zeros((cells, cells), complex)
        kept[at] = weights * np.exp(1j * np.angle(far[at]))
        phase = np.angle(np.fft.ifft2(kept))
    return np.mod(np.rint(phase / (2 * np.pi / task.levels)), task.levels).astype(np.uint8)


def report(task: Task, folder: Path) -> None:
    """Design, judge and print one task."""
    path = folder / "spots.toml"
    path.write_text(task.text())
    begun = time.perf_counter()
    design = optimize(load_spec(path))
    seconds = time.perf_counter() - begun
    levels, camera = design.levels, design.camera
    heights = height_of(np.arange(levels.count, dtype=np.uint8)[None], levels)[0]
    efficiency, error = judge(design.level_map.level, task, camera, heights)
    good = efficiency >= task.least and error <= task.most
    kind = f"period of {task.period} cells" if task.period else "spots 250 um apart"
    print(f"{task.columns} x {task.rows}, {task.levels:2d} levels, {kind:20s}", end="")
    print(f"{efficiency:8.4f}  u {100 * error:5.2f} %  {seconds:5.1f} s", end="")
    print(f"   promised {task.least:.3f}, {100 * task.most:.1f} %: {'ok' if good else 'missed'}", end="")
    if task.period and task.rows > 1:
        for name, weighted in (("GS", False), ("weighted GS", True)):
            cell = gerchberg_saxton(task, task.period, weighted, seconds)
            repeats = -(-camera.grid.shape[0] // task.period)
            level = np.tile(cell, (repeats, repeats))[: camera.grid.shape[0], : camera.grid.shape[0]]
            peer, unequal = judge(level, task, camera, heights)
            print(f"   {name} {peer:.3f}, {100 * unequal:.1f} %", end="")
    print(flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Spots and orders beside Gerchberg-Saxton.")
    parser.add_argument("--quick", action="store_true", help="three tasks")
    chosen = (TASKS[1], TASKS[6], TASKS[9]) if parser.parse_args().quick else TASKS
    with tempfile.TemporaryDirectory() as folder:
        for task in chosen:
            report(task, Path(folder))


if __name__ == "__main__":
    main()
