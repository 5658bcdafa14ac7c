"""Extended depth of focus beside classic formulas: widths and light of the foci from 5 mm to 1.2 m behind one plate.

    python -m bench.focus            about five minutes

The judge shares nothing with the engine: it takes the level map alone, parts every cell into 3 x 3 squares, and sums
the first Rayleigh-Sommerfeld integral over all of them in double precision, at places along a line of its own. The
plate is that of `doedesign new edof`: 850 nm, an aperture of 1.8 mm, cells of 3 um. (S. Banerji et al., Optica 7, 214,
2020, measured 6.6 um at 5 mm and 524 um at 1200 mm; the template's aperture and rings are not taken from there.)
"""

import time
from pathlib import Path

import numpy as np

from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design import analytic
from doedesign.optimization import optimize
from doedesign.spec import load_spec
from fab.levels import height_of
from sim.camera import Camera

TEMPLATE = Path(__file__).parents[1] / "doedesign" / "templates" / "edof.toml"
WAVE_M, PARTS = 850e-9, 3
ENDS_M, WIDTHS_M = (5e-3, 1.2), (6.6e-6, 524e-6)


def wanted(distance_m: float) -> float:
    """Width allowed at a distance: a power of it between both ends."""
    share = np.log(distance_m / ENDS_M[0]) / np.log(ENDS_M[1] / ENDS_M[0])
    return float(WIDTHS_M[0] * (WIDTHS_M[1] / WIDTHS_M[0]) ** share)


def focus_of(transmission: np.ndarray, pitch_m: float, radius_m: float, distance_m: float) -> tuple[float, float]:
    """Full width at half of the light on the axis, and that light over an ideal lens's."""
    field = np.kron(transmission, np.ones((PARTS, PARTS)))
    at = (np.arange(len(field)) - (len(field) - 1) / 2) * pitch_m / PARTS
    square = at[:, None] ** 2 + at**2
    open_ = square <= radius_m**2
    field, x, square = field[open_], np.broadcast_to(at, open_.shape)[open_], square[open_]
    places = np.linspace(0, 1.2, 25) * wanted(distance_m)
    light, most = [], 0.0
    for place in places:
        path = np.sqrt(square - 2 * x * place + place**2 + distance_m**2)
        part = field * distance_m / path**2
        light.append(abs(np.sum(part * np.exp(2j * np.pi / WAVE_M * (path - distance_m)))) ** 2)
        most = most or float(np.abs(part).sum()) ** 2
    below = np.flatnonzero(np.array(light) < light[0] / 2)
    if not len(below):
        return np.inf, light[0] / most
    k = below[0]
    half = places[k] - (places[k] - places[k - 1]) * (light[0] / 2 - light[k]) / (light[k - 1] - light[k])
    return 2 * float(half), light[0] / most


def plate(waves: np.ndarray, camera: Camera, heights_m: np.ndarray) -> np.ndarray:
    """Transmission of a phase in waves rounded to the nearest of some heights."""
    turns = camera.waves_per_metre(WAVE_M) * heights_m
    nearest = np.abs(np.exp(2j * np.pi * waves)[..., None] - np.exp(2j * np.pi * turns)).argmin(-1)
    return np.exp(2j * np.pi * turns)[nearest]


def main() -> None:
    """Print the table."""
    spec = load_spec(TEMPLATE)
    camera, heights = camera_from_spec(spec), levels_from_spec(spec.process).heights_m()
    grid, rim = camera.grid, camera.aperture_m / 2
    radius = np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x"))
    begun = time.perf_counter()
    design = optimize(spec)
    taken = time.perf_counter() - begun
    turns = camera.waves_per_metre(WAVE_M) * height_of(design.level_map.level, design.levels)
    plates = {f"doedesign, {taken:.0f} s": np.exp(2j * np.pi * turns)}
    for name in ("axilens", "logarithmic_asphere"):
        waves = getattr(analytic, name)(radius, *ENDS_M, rim, WAVE_M)
        plates[name.replace("_", " ")] = plate(waves, camera, heights)
    plates["lens of 20 mm"] = plate(-(np.hypot(radius, 20e-3) - 20e-3) / WAVE_M, camera, heights)
    distances = np.geomspace(*ENDS_M, 13)
    print(f"{'width / um (light over an ideal lens / %)':44}" + "".join(f"{d * 1e3:>14.4g} mm" for d in distances[::3]))
    print(f"{'allowed':44}" + "".join(f"{wanted(d) * 1e6:>17.4g}" for d in distances[::3]))
    for name, transmission in plates.items():
        found = [focus_of(transmission, grid.pitch_m, rim, d) for d in distances]
        good = sum(width <= wanted(d) for (width, _), d in zip(found, distances, strict=True))
        cells = "".join(f"{w * 1e6:>9.4g} ({100 * s:5.2f})" for w, s in found[::3])
        print(f"{name + f': {good} of {len(found)} in focus':44}{cells}")


if __name__ == "__main__":
    main()
