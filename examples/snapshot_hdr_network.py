"""A network for lamps beyond the full well, the same and trained in the same way behind a plain lens and the plate.

    doedesign optimize examples/snapshot_hdr.toml
    python examples/snapshot_hdr_network.py runs/snapshot_hdr --training DIR [--images DIR] [--scenes 50] [--out DIR]

Each camera has its network, which goes on from the estimate of a solver that is stopped after two thirds of its rounds
(`doedesign.hdr.network`). It is trained on pictures of one folder, on plates of the process that are not those it is
judged on, and judged on the scenes, plates and noise of `examples/snapshot_hdr.py`, before pictures of another folder.
Solver and network know the plate as drawn.

`network.csv` gets rows of the cases "quick solver" and "network" for every scene, `network.json` the means, the plate's
gain over the plain lens and the network's over its solver, with 95 % intervals. The same command goes on where it was
stopped. Some 25 minutes on two cores. `examples/results` has what it left: trained on 60 photographs of BSDS500 and 23
of CLIC and others, judged on those of `examples/snapshot_hdr.py`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from snapshot_hdr import PARTS, PROCESS, SEED, asked_of, gained, study_of, summary, table  # pyright: ignore[reportMissingImports]
from snapshot_hdr import read_rows as rows_of  # pyright: ignore[reportMissingImports]

from doedesign.capture.images import Pictures, picture_files
from doedesign.cli import exit_code
from doedesign.hdr.capture import LinePsfs
from doedesign.hdr.learning import LampTraining, lamp_examples, trained_lamp_network
from doedesign.hdr.network import LampNetwork, refined
from doedesign.hdr.scenes import Lamps, LampScenes
from doedesign.hdr.scores import judged_light
from doedesign.hdr.solver import LampSolver
from doedesign.hdr.study import CASES, LampRow, LampStudy
from doedesign.runs.journal import study_folder
from doedesign.runs.level_maps import open_design
from fab.files import canonical_json, csv_table, write_atomic

CAMERAS: tuple[str, ...] = ("plain lens", "plate")
JUDGED = ("quick solver", "network")
QUICK = LampSolver(rounds=4)
PLATES = 10  # plates of a training
_FRAME_PX = 160
_SHORTER_SIDE = 640
_LAMPS = Lamps(number=(1, 3))  # as many in a frame of 160 pixels as 2 to 4 in one of 256, and some more


def learnt(study: LampStudy, run: Path, pictures: Pictures, out: Path, how: LampTraining) -> dict[str, LampNetwork]:
    """The networks of both cameras, trained on scenes and plates of another seed than the study's."""
    design = open_design(run)
    seed = study.scenes.seed + 1
    scenes = LampScenes(pictures, _LAMPS, frame_px=_FRAME_PX, seed=seed)

    def plates(camera: str) -> list[LinePsfs]:
        if camera == "plain lens":
            made = [study.plain]
        else:
            drawn = (design.fabricated(PROCESS, seed=seed, draw=f"normal/{n}") for n in range(PLATES))
            made = [study.series.psf(plate) for plate in drawn]
        return [psfs.with_glare(study.glare) for psfs in made]

    def examples(camera: str) -> object:
        known = study.known(camera)
        return lamp_examples(study.camera, scenes, plates(camera), known, range(how.examples), study.solver)

    def told(camera: str, steps: int, loss: float) -> None:
        if steps % 20 == 0:
            print(f"{camera}, step {steps} of {how.steps}: loss {loss:.3f}", file=sys.stderr, flush=True)

    settings = {"process": PROCESS, "seed": seed, "frame_px": _FRAME_PX, "level_map": design.level_map.digest}
    settings |= {"pictures_sha256": pictures.digest()}
    return {
        camera: trained_lamp_network(
            out / camera.replace(" ", "_"),
            partial(examples, camera),  # pyright: ignore[reportArgumentType]
            study.known(camera),
            how,
            {"camera": camera, **settings},
            partial(told, camera),
        )
        for camera in CAMERAS
    }


def measure(study: LampStudy, networks: dict[str, LampNetwork], out: Path, scenes: int) -> list[LampRow]:
    """Rows of solver and network for every scene."""
    path = out / "network.csv"
    rows = rows_of(path)
    done = {row.scene for row in rows}
    known = {camera: study.known(camera) for camera in CAMERAS}
    for number in (n for n in range(scenes) if n not in done):
        shots = study.shots(CASES[0], number)
        truth = shots["plate"].scene.light()
        saturated = study.camera.saturated(shots["plate"].scene)
        for name, shot in shots.items():
            rows.append(LampRow(JUDGED[0], name, number, shot.scene.name, *shot.score))
            score = shot.score
            if name in networks:
                found = refined(networks[name], shot.capture, shot.found, known[name])
                score = judged_light(found, truth, saturated)
            rows.append(LampRow(JUDGED[1], name, number, shot.scene.name, *score))
        write_atomic(path, csv_table(rows).encode())
        print(f"scene {number + 1} of {scenes}", file=sys.stderr, flush=True)
    return rows


def over_solver(rows: Sequence[LampRow]) -> dict[str, dict[str, dict[str, float]]]:
    """Each camera's gain by its network over the solver that it goes on from, scene by scene."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for camera in CAMERAS:
        own = {case: {r.scene: r for r in rows if (r.case, r.camera) == (case, camera)} for case in JUDGED}
        pairs = [(own["network"][n], own["quick solver"][n]) for n in sorted(own["network"])]
        found[camera] = {
            part: gained(*([getattr(pair[k], part) for pair in pairs] for k in range(2))) for part in PARTS
        }
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and judge; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--training", type=Path, required=True, help="a folder of pictures to train on")
    parser.add_argument("--images", type=Path, help="a folder of others to judge on; scikit-image's by default")
    parser.add_argument("--scenes", type=int, default=50, help="scenes and plates to judge on")
    parser.add_argument("--examples", type=int, default=LampTraining.examples, help="scenes to train on")
    parser.add_argument("--steps", type=int, default=LampTraining.steps)
    parser.add_argument("--out", type=Path, help="RUN/hdr_network by default")
    given = parser.parse_args(arguments)

    def work() -> None:
        out = given.out or given.run / "hdr_network"
        study = replace(study_of(given.run, given.images, SEED), solver=QUICK)
        pictures = Pictures(picture_files(given.training), most_px=_SHORTER_SIDE)
        how = replace(LampTraining(), steps=given.steps, examples=given.examples)
        asked = asked_of(given.run, study, training_sha256=pictures.digest(), steps=how.steps, examples=how.examples)
        with study_folder(out, asked):
            rows = measure(study, learnt(study, given.run, pictures, out, how), out, given.scenes)
            found = summary(rows)
            write_atomic(out / "network.json", canonical_json({"cases": found, "over_solver": over_solver(rows)}))
        print(table(found))

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
