"""Lamps 50 to 200 times brighter than white, read from the weak copies of a nearly flat plate.

    doedesign optimize examples/snapshot_hdr.toml
    python examples/snapshot_hdr.py runs/snapshot_hdr [--images DIR] [--scenes 50] [--others 8] [--out DIR]
    python examples/snapshot_hdr.py runs/snapshot_hdr [--images DIR] [--others 20] [--case "without lamps"]

A camera with a plain lens and one with the run's plate photograph the same scenes: photographs with lamps of random
shapes and colours before them, behind a lens with 2 % of veiling glare, on a sensor that fills up at 1.25 times white.
One solver is given both captures and the PSFs as they are known: the plain lens's, and those of the plate as drawn. The
first case takes a plate of the process's own errors for every scene; the others, over fewer scenes, say what goes wrong
if copies are not as strong as known, if lamps have narrow spectra, with other glare, with blooming, without lamps, and
with a chequerboard of 20 um in the place of the plate.

`scores.csv` gets a row for every scene, camera and case, as soon as it is known: the same command goes on from there.
`summary.json` has, of each case, the means and the plate's gain over the plain lens with its 95 % interval; differences
between cases, scene by scene; and where the plate's light goes. `scenes.png` shows some scenes. An hour on two cores.

`examples/results` has what these commands left, over 50 photographs (roads of CamVid, BDD100K, TuSimple and Udacity;
Kodak's, CLIC's and others), and the picture that the first one makes of scikit-image's photographs.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.capture.from_spec import sensor_from_spec
from doedesign.capture.images import Pictures, picture_files
from doedesign.cli import exit_code
from doedesign.hdr.capture import LampCamera, PlateSeries
from doedesign.hdr.scenes import Lamps, LampScenes
from doedesign.hdr.study import CASES, LampCase, LampRow, LampStudy
from doedesign.runs.journal import study_folder
from doedesign.runs.level_maps import open_design
from doedesign.spec import spec_digest
from doedesign.training.scores import paired_difference
from fab.files import canonical_json, csv_table, write_atomic
from sim.light import srgb_from_linear

SEED = 4711  # of scenes and plates; the solver's numbers were chosen with others
PROCESS = "contact_aligner"
CAMERAS = ("clipped", "plain lens", "plate")
PARTS = ("lamps", "elsewhere")
_SHORTER_SIDE = 640
_SHOWN = 3  # scenes of the picture
_STOPS = 200.0  # the brightest light of a scene as it is shown


def study_of(
    run: Path, images: Path | None, seed: int = SEED, lamps: Lamps | None = None, cells_px: Sequence[int] = ()
) -> LampStudy:
    """The study of a run's plate, before pictures of a folder or those of scikit-image.

    `cells_px` are pixels of the design along the squares of chequerboards that cases ask for.
    """
    design = open_design(run)
    camera = LampCamera(design.camera, sensor_from_spec(design.spec))
    boards = {cells: camera.psf(chequerboard(design.height_m, cells), 2.0) for cells in cells_px}
    pictures = Pictures(picture_files(images), most_px=_SHORTER_SIDE)
    scenes = LampScenes(pictures, lamps or Lamps(), seed=seed)
    plain = camera.psf(np.zeros_like(design.height_m))
    series = PlateSeries.of(camera, design)
    return LampStudy(camera, series, plain, lambda draw: _plate(design, seed, draw), scenes=scenes, boards=boards)


def chequerboard(height_m: np.ndarray, cells_px: int) -> np.ndarray:
    """Heights of a chequerboard of a design's highest step, with squares of so many of its pixels."""
    y, x = (np.arange(n) // cells_px % 2 for n in height_m.shape)
    return float(height_m.max()) * (y[:, None] ^ x)


def asked_of(run: Path, study: LampStudy, **more: Any) -> dict[str, Any]:
    """What the rows of a study depend on, for its folder."""
    design, scenes = open_design(run), study.scenes
    assert design.spec is not None
    own = {"level_map": design.level_map.digest, "spec_sha256": spec_digest(design.spec), "process": PROCESS}
    return {**own, "pictures_sha256": scenes.pictures.digest(), "seed": scenes.seed, **more}


def _plate(design: Any, seed: int, draw: int) -> Any:
    return design.fabricated(PROCESS, seed=seed, draw=f"normal/{draw}")


def summary(rows: Sequence[LampRow]) -> dict[str, Any]:
    """Means of every case and camera, and the plate's gain over the plain lens, with 95 % intervals."""
    found: dict[str, Any] = {}
    for case in dict.fromkeys(row.case for row in rows):
        own = {
            camera: {row.scene: row for row in rows if (row.case, row.camera) == (case, camera)} for camera in CAMERAS
        }
        numbers = sorted(set.intersection(*(set(of) for of in own.values())))
        entry: dict[str, Any] = {"scenes": len(numbers)}
        for camera, of in own.items():
            means = {part: float(np.mean([getattr(of[n], part) for n in numbers])) for part in PARTS}
            entry[camera] = {part: value if np.isfinite(value) else None for part, value in means.items()}
        for part in PARTS:
            a, b = ([getattr(own[camera][n], part) for n in numbers] for camera in ("plate", "plain lens"))
            if gain := gained(a, b):
                entry[f"gain_{part}"] = gain
        found[case] = entry
    return found


def gained(a: Sequence[float], b: Sequence[float]) -> dict[str, float]:
    """Differences of scores scene by scene: mean, 95 % interval, least, and that of a tenth; empty for too few."""
    gains = np.subtract(a, b)
    if not np.isfinite(gains).any():
        return {}
    found = paired_difference(a, b)
    if not np.isfinite(found.low):
        return {}
    return {
        "mean": found.mean,
        "low": found.low,
        "high": found.high,
        "least": float(gains.min()),
        "tenth": float(np.percentile(gains, 10)),
    }


def between_cases(rows: Sequence[LampRow]) -> dict[str, Any]:
    """The plate's differences between cases, over the scenes that both have."""
    own = {case.name: {r.scene: r for r in rows if (r.case, r.camera) == (case.name, "plate")} for case in CASES}
    found: dict[str, Any] = {}
    for one, other in (("fabricated", "as drawn"), ("as drawn", "chequerboard")):
        numbers = sorted(own[one].keys() & own[other].keys())
        gains = {p: gained(*([getattr(own[c][n], p) for n in numbers] for c in (one, other))) for p in PARTS}
        found[f"{one} over {other}"] = {"scenes": len(numbers), **gains}
    return found


def light_of_plate(study: LampStudy, copies: int = 8, near_px: float = 20, half_px: int = 5) -> dict[str, Any]:
    """Where a plate's light goes, colour by colour: the 0th order's share of what passes, and its strongest copies.

    A copy is its distance from the middle in pixels, and the share of the incident light within 11 x 11 pixels.
    """
    found: dict[str, Any] = {}
    plate, plain = study.series.exact, study.plain
    middle = plate.energy.shape[-1] // 2
    axis = np.arange(plate.energy.shape[-1]) - middle
    for number, colour in enumerate(study.camera.camera.colours):
        weights = plate.weights[number]
        straight = np.sum(weights * plate.energy[number, :, middle, middle] / plain.energy[number, :, middle, middle])
        white = plate.white()[number]
        rest = np.where(np.hypot(axis[:, None], axis) < near_px, 0, white)
        places: list[list[float]] = []
        for _ in range(copies):
            y, x = np.unravel_index(rest.argmax(), rest.shape)
            part = tuple(slice(max(int(at) - half_px, 0), int(at) + half_px + 1) for at in (y, x))
            places.append([round(float(np.hypot(y - middle, x - middle)), 1), round(float(white[part].sum()), 5)])
            rest[part] = 0
        found[colour.name] = {"straight": round(float(straight), 4), "copies": sorted(places)}
    return found


def table(found: dict[str, Any]) -> str:
    """The summary as text."""
    lines = [f"{'case':34} {'scenes':>6}  clipped      plain lens   plate        gain, lamps           gain, elsewhere"]
    for case, entry in found.items():
        pairs = "  ".join("/".join(_decibels(entry[c][part]) for part in PARTS) for c in CAMERAS)
        gains = (entry.get(f"gain_{part}") for part in ("lamps", "elsewhere"))
        texts = [f"{g['mean']:+5.1f} ({g['low']:+5.1f} {g['high']:+5.1f})" if g else "" for g in gains]
        lines.append(f"{case:34} {entry['scenes']:6d}  {pairs}  {'  '.join(texts)}")
    return "\n".join(lines)


def _decibels(value: float | None) -> str:
    return "    -" if value is None else f"{value:5.1f}"


def read_rows(path: Path) -> list[LampRow]:
    """Rows that an earlier run wrote; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [
            LampRow(r["case"], r["camera"], int(r["scene"]), r["picture"], float(r["lamps"]), float(r["elsewhere"]))
            for r in csv.DictReader(file)
        ]


def measure(study: LampStudy, out: Path, scenes: int, others: int, cases: Sequence[LampCase] = CASES) -> list[LampRow]:
    """Rows of cases, with those of earlier calls; of the first of all over `scenes` scenes, of others over `others`."""
    path = out / "scores.csv"
    rows = read_rows(path)
    done = {(row.case, row.scene) for row in rows}
    for number in range(max(scenes, others)):
        asked = [case for case in cases if number < (scenes if case == CASES[0] else others)]
        asked = [case for case in asked if (case.name, number) not in done]
        made = study.fabricated(number) if any(case.fabricated for case in asked) else None
        for case in asked:
            rows += study.rows(case, number, made)
            write_atomic(path, csv_table(rows).encode())
        print(f"scene {number + 1} of {max(scenes, others)}", file=sys.stderr)
    return rows


def shown(light: np.ndarray) -> np.ndarray:
    """Light as a picture `[y, x, colour]`, what is brighter than 0.8 of white compressed logarithmically."""
    bend = 0.8
    over = np.maximum(light / bend, 1.0)
    toned = np.minimum(light, bend) * (1 + (1 / bend - 1) * np.log(over) / np.log(_STOPS / bend))
    return np.clip(srgb_from_linear(np.moveaxis(np.clip(toned, 0, 1), 0, -1)), 0, 1)[::-1]


def draw_scenes(study: LampStudy, path: Path, numbers: Sequence[int], case: LampCase = CASES[0]) -> None:
    """Draw scenes, captures and reconstructions; and the lamps' light alone, 1/200 as bright."""
    import io

    from matplotlib.figure import Figure

    titles = ("scene", "plain capture", "plate capture", "plain lens, solved", "plate, solved")
    figure = Figure(figsize=(2.4 * len(titles), 5.1 * len(numbers)), layout="constrained")
    axes = figure.subplots(2 * len(numbers), len(titles), squeeze=False)
    for row, number in enumerate(numbers):
        shots = study.shots(case, number)
        plain, plate = shots["plain lens"], shots["plate"]
        lights = (plain.scene.light(), plain.capture.light, plate.capture.light, plain.found, plate.found)
        scores = ("", shots["clipped"].score, None, plain.score, plate.score)
        for column, (light, title, score) in enumerate(zip(lights, titles, scores, strict=True)):
            upper, lower = axes[2 * row, column], axes[2 * row + 1, column]
            upper.imshow(shown(light), interpolation="nearest")
            lower.imshow(shown(light / _STOPS), interpolation="nearest")
            upper.set_title(f"{title}\n{score[0]:.1f} / {score[1]:.1f} dB" if score else f"{title}\n", fontsize=10)
            lower.set_title("the same, exposed 200 times shorter", fontsize=8)
            for ax in (upper, lower):
                ax.set_axis_off()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=60)
    write_atomic(path, buffer.getvalue())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--images", type=Path, help="a folder of pictures; scikit-image's by default")
    parser.add_argument("--scenes", type=int, default=50, help="scenes and plates of the first case")
    parser.add_argument("--others", type=int, default=8, help="scenes of every other case")
    names = [case.name for case in CASES]
    parser.add_argument("--case", action="append", choices=names, help="measure this case alone; may be repeated")
    parser.add_argument("--out", type=Path, help="RUN/hdr by default")
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args(arguments)

    def work() -> None:
        out = given.out or given.run / "hdr"
        cases = [case for case in CASES if given.case is None or case.name in given.case]
        boards = {case.cells_px for case in cases if case.cells_px is not None}
        study = study_of(given.run, given.images, given.seed, cells_px=sorted(boards))
        with study_folder(out, asked_of(given.run, study)):
            rows = measure(study, out, given.scenes, given.others, cases)
            found = summary(rows)
            said = {"cases": found, "between_cases": between_cases(rows), "light": light_of_plate(study)}
            write_atomic(out / "summary.json", canonical_json(said))
            if CASES[0] in cases:
                draw_scenes(study, out / "scenes.png", range(min(_SHOWN, given.scenes)))
        print(table(found))

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
