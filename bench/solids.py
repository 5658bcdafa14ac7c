"""Speed and memory of the solids: STEP of a radial design, closed meshes and their files.

    python -m bench.solids            a minute or two
    python -m bench.solids --quick    a quarter of the steps and of the width, in seconds; targets are for the full one

Each case runs in a process of its own, so that its memory is its own. The first call of a compiled loop is not
counted; files are forced to the disk, as in use.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.masks import bench_map
from doedesign.runtime.memory import peak_bytes
from fab.aperture import RoundAperture
from fab.solids.columns import Columns, reduced_cells, whole, window_cells
from fab.solids.mesh import closed_volume_m3, relief_mesh
from fab.solids.meshfile import read_mesh, write_3mf, write_glb, write_stl
from fab.solids.step import step_bodies
from fab.solids.substrate import ChromeFilm, Rings, Substrate, substrate_bodies, substrate_step
from fab.units import MM, NM, UM

BASE = 5 * UM
TARGET_STEP_S, TARGET_MESH_S = 15.0, 15.0
CASES = ("step", "ring", "field", "reduced")


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call returns and the seconds that it takes."""
    start = time.perf_counter()
    value = work()
    return value, time.perf_counter() - start


def verdict(seconds: float, target: float) -> str:
    """Say whether a target is met."""
    return f"{seconds:6.2f} s  (target < {target:g} s: {'ok' if seconds < target else 'missed'})"


def bench_step(quick: bool, folder: Path) -> None:
    """Print the STEP file of a radial design with a step at every ring."""
    count = 2000 if quick else 8000
    rings = Rings(np.arange(1, count + 1) * 2.2 * MM / count, np.arange(count) % 16 * 75 * NM, 1125 * NM)
    die, chrome = Substrate("die", 10 * MM, 0.5 * MM), ChromeFilm(RoundAperture(4.39 * MM), 3.7 * MM)
    path = folder / "r.step"
    # The kernel takes its time to load, and every process does that once.
    substrate_step(folder / "first.step", die, RoundAperture(4.4 * MM), chrome)
    step_bodies(folder / "first.step")
    _, written = timed(lambda: substrate_step(path, die, RoundAperture(4.4 * MM), chrome, rings))
    found, read = timed(lambda: step_bodies(path))
    want = substrate_bodies(die, chrome, rings)
    wrong = max(abs(found[name].volume_m3 / want[name].volume_m3 - 1) for name in want)
    print(f"  STEP, {count} steps      write {verdict(written, TARGET_STEP_S)}")
    print(f"    {path.stat().st_size / 1e6:.1f} MB, read back and measured in {read:.2f} s, volumes off by {wrong:.0e}")


def bench_mesh(name: str, cells: Columns, folder: Path) -> None:
    """Print mesh, check and files of a relief."""
    mesh, made = timed(lambda: relief_mesh(cells, BASE))
    want = cells.volume_m3 + BASE * cells.area_m2
    closed, checked = timed(lambda: closed_volume_m3(mesh))
    shape = "x".join(map(str, cells.height_m.shape))
    print(
        f"  {name} {shape}, {len(mesh.triangles) / 1e6:.2f}M triangles   mesh {made:.2f} s, manifold3d {checked:.2f} s"
    )
    print(f"    both {verdict(made + checked, TARGET_MESH_S)}")
    print(
        f"    volume off by {abs(mesh.volume_m3 / want - 1):.0e}, to manifold3d {abs(closed / want - 1):.0e} (float32)"
    )
    for suffix, write in ((".3mf", write_3mf), (".glb", write_glb), (".stl", write_stl)):
        path = folder / f"m{suffix}"
        _, written = timed(lambda write=write, path=path: write(path, mesh))
        back, read = timed(lambda path=path, suffix=suffix: read_mesh(path, "mm" if suffix == ".stl" else None))
        wrong, size = abs(back.volume_m3 / want - 1), path.stat().st_size / 1e6
        print(f"    {suffix} {size:6.1f} MB  write {written:5.2f} s  read {read:5.2f} s  volume off by {wrong:.0e}")


def bench_case(case: str, quick: bool) -> None:
    """Print one case."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if case == "step":
            bench_step(quick, folder)
        else:
            tiny = relief_mesh(reduced_cells(bench_map("ring", 20), 5), BASE)
            for write in (write_3mf, write_glb, write_stl):
                write(folder / "first", tiny)
            closed_volume_m3(tiny)
            count = 1100 if case == "reduced" and quick else 4400 if case == "reduced" else 250 if quick else 1000
            level_map = bench_map("field" if case == "field" else "ring", count)
            if case == "reduced":
                cells, took = timed(lambda: reduced_cells(level_map, 400))
                print(f"  {count}x{count} reduced by {cells.block} in {took:.2f} s")
            else:
                cells = window_cells(level_map, whole(level_map.grid))
            bench_mesh(case, cells, folder)
    print(f"    peak {peak_bytes() / 1e9:.2f} GB", flush=True)


def main() -> int:
    """Print the table; return 1 if a case could not run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="small cases, in seconds")
    parser.add_argument("--case", choices=CASES, help="one case, in this process")
    given = parser.parse_args()
    if given.case:
        bench_case(given.case, given.quick)
        return 0
    print("Solids: STEP by the kernel of cadquery, meshes judged by manifold3d", flush=True)
    more = ["--quick"] if given.quick else []
    runs = [
        subprocess.run([sys.executable, "-m", "bench.solids", "--case", case, *more], check=False) for case in CASES
    ]
    return int(any(run.returncode for run in runs))


if __name__ == "__main__":
    sys.exit(main())
