"""Where to trust which model of obstructed light: plates and obstructions of every kind against wave optics.

    python examples/occlusion_table.py

Six plates (a bare lens, the circular grating that designs start from, an optimised free-form plate, a straight blazed
grating, a diffuser, and blazed rings, which leave no spot at all) look past four dark obstructions at three scenes: a
coarse one, bright points, and a photograph. `obstructed_light.py` computes what lands on the sensor by wave optics,
point by point; the models of `sim.imaging.occlusion` get the PSFs of the open plate. Written to `runs/occlusion`:

    occlusion.json    the errors
    occlusion.png     the same as a picture

The scale is that of `examples/quick.toml`, an eighth of the automotive camera: 320 cells of 1.85 um, f = 1 mm, pixels
of 1.85 um, 548 nm, obstructions at 10 mm, whose shadow disc is 32 pixels wide; a Fresnel number D² / (wavelength depth)
of 64, a tenth of the automotive camera's, so that fringes, which no model knows, are three times as wide against the
aperture. An error is the root of the summed squares of the difference to wave optics over the middle of the picture,
relative to the picture without the obstruction.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from obstructed_light import Obstacle, Rig, picture
from scipy.ndimage import gaussian_filter

import doedesign as dd
from doedesign.cli import exit_code
from doedesign.runtime.progress import meter
from fab.figure import SERIES, SMALL, panels, save
from fab.files import canonical_json, write_atomic
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.imaging.formation import Optics, capture
from sim.imaging.occlusion import Model, Outside
from sim.imaging.scene import Obstruction, Scene
from sim.psf_bank import psf

RIG = Rig(320, 1.85e-6, 0.592e-3, 1e-3, 1.85e-6, 10e-3, 160)
QUICK = Path(__file__).parent / "quick.toml"
JUDGED_PX = 65
# What is judged, half a window around it, and twice the shadow disc, which `reciprocal` needs besides.
VIEW_PX = JUDGED_PX + RIG.window + 64
PLATES = ("lens", "rings", "optimised", "straight grating", "diffuser", "blazed rings")
OBSTACLES = ("edge", "bar", "disc", "dots")
SCENES = ("coarse", "photograph", "points")
# What I_obs holds beside the obstruction is open in eq. 10: nothing as printed, the scene in the public code for bars.
MODELS: tuple[tuple[Model, Outside], ...] = (
    ("radiometric", "scene"),
    ("reciprocal", "scene"),
    ("paper", "nothing"),
    ("paper_release", "scene"),
)


@dataclass(frozen=True)
class Row:
    """Errors of all models for one plate and one obstruction: `error[model][scene]`, relative."""

    plate: str
    obstacle: str
    error: Mapping[str, Mapping[str, float]]


def camera() -> Camera:
    """The camera of the table; its window is odd, so that a picture lies on its scene."""
    colour = Colour("green", (RIG.wavelength_m,), (1.0,))
    grid = Grid((RIG.cells, RIG.cells), RIG.pitch_m)
    whole = Camera(grid, RIG.aperture_m, "fused_silica", (colour,), RIG.focal_m, RIG.pixel_m, RIG.window - 1)
    return replace(whole, mapping="sine")  # as a Fourier transform images directions


def plate_m(name: str) -> np.ndarray:
    """Heights `[y, x]` of a plate, metres."""
    if name in ("rings", "optimised"):
        steps = 0 if name == "rings" else 60
        return np.asarray(dd.optimize(dd.load_spec(QUICK, steps=steps)).level_map.height_m, np.float64)
    place = np.arange(RIG.cells) - (RIG.cells - 1) / 2
    steps = {
        "lens": np.zeros((RIG.cells, RIG.cells)),
        # Eight cells a period: the first order lands 20 pixels aside.
        "straight grating": np.tile(np.arange(RIG.cells) % 8, (RIG.cells, 1)),
        "blazed rings": np.floor(np.hypot(place[:, None], place) % 8),
        # Squares of four cells spread light over a quarter of the window.
        "diffuser": np.kron(np.random.default_rng(0).uniform(0, 8, (80, 80)), np.ones((4, 4))),
    }[name]
    return steps / 8 / camera().waves_per_metre(RIG.wavelength_m)


def obstacle(name: str) -> Obstacle:
    """An obstruction: bar and disc are half and three quarters as wide as the aperture's shadow, dots a third."""
    y, x = np.mgrid[:VIEW_PX, :VIEW_PX] - VIEW_PX // 2
    masks = {
        "edge": x >= 3,
        "bar": np.abs(x) <= 8,
        "disc": np.hypot(y - 3, x - 4) <= 12,
        "dots": np.hypot((y + 12) % 24 - 12, (x + 12) % 24 - 12) <= 6,
    }
    return Obstacle(masks[name].astype(float), name in ("edge", "bar"), 24 if name == "dots" else 0)


def scenes() -> np.ndarray:
    """Light `[scene, y, x]` of the three scenes, 1 in the mean."""
    import skimage.data

    rng = np.random.default_rng(1)
    coarse = gaussian_filter(rng.normal(size=(VIEW_PX, VIEW_PX)), 16, mode="wrap")
    points = np.zeros((VIEW_PX, VIEW_PX))
    corners = np.arange(0, VIEW_PX - 7, 8)
    aside = rng.integers(8, size=(2, len(corners), len(corners)))
    points[corners[:, None] + aside[0], corners + aside[1]] = 64.0
    photograph = (skimage.data.camera()[::-1][100 : 100 + VIEW_PX, 100 : 100 + VIEW_PX] / 255.0) ** 2.2
    coarse = 1 + 0.3 * (coarse - coarse.mean()) / coarse.std()
    return np.stack([coarse, photograph / photograph.mean(), points])


def modelled(optics: Optics, mask: np.ndarray, light: np.ndarray, model: Model, outside: Outside) -> np.ndarray:
    """The middle of the picture that a model makes of a scene `[y, x]`."""
    dark = Obstruction(mask.astype(np.float32), np.zeros((1, *light.shape), np.float32), RIG.depth_m)
    scene = Scene(light[None].astype(np.float32), np.inf, (dark,))
    image = np.asarray(capture(scene, optics, model, border="own", outside=outside), np.float64)[0]
    margin = (len(image) - JUDGED_PX) // 2
    return image[margin : margin + JUDGED_PX, margin : margin + JUDGED_PX]


def judge(plate: str, names: Iterable[str] = OBSTACLES) -> list[Row]:
    """Errors of every model for a plate behind some of the obstructions."""
    views, height_m, own = scenes(), plate_m(plate), camera()
    optics = Optics.of(psf(height_m, own, [RIG.depth_m, np.inf]), own, [np.inf, RIG.depth_m])
    # The reference leaves out what the two faces of the glass reflect.
    passed = own.transmission(RIG.wavelength_m)
    clear = [modelled(optics, np.zeros(views[0].shape), light, "radiometric", "scene") for light in views]
    rows = []
    for name in names:
        before = obstacle(name)
        reference = passed * picture(RIG, height_m * own.waves_per_metre(RIG.wavelength_m), before, views, JUDGED_PX)
        error: dict[str, dict[str, float]] = {}
        for model, outside in MODELS:
            found = [modelled(optics, before.mask, light, model, outside) for light in views]
            error[model] = {
                scene: float(np.linalg.norm(image - wanted) / np.linalg.norm(bright))
                for scene, image, wanted, bright in zip(SCENES, found, reference, clear, strict=True)
            }
        rows.append(Row(plate, name, error))
    return rows


def draw(path: Path, rows: list[Row]) -> None:
    """Draw the errors of every plate, obstruction and model, one panel for each kind of scene."""
    places = np.arange(len(rows)) + np.array([0.8 * PLATES.index(row.plate) for row in rows])
    with panels(None, (8.3, 6.6), "Error of the picture against wave optics (%)") as figure:
        for scene, axes in zip(SCENES, figure.subplots(len(SCENES), 1, sharex=True, sharey=True), strict=True):
            for (model, _), hue, mark in zip(MODELS, SERIES, "osD^", strict=False):
                values = [100 * row.error[model][scene] for row in rows]
                axes.plot(places, values, mark, color=hue, ms=4.5, mfc="none", mew=1.3, label=model)
            axes.set_yscale("log")
            axes.set_ylim(0.03, 200)
            if scene == SCENES[-1]:
                axes.legend(ncols=len(MODELS), loc="lower center")
            axes.set_title({"coarse": "coarse scene", "points": "bright points"}.get(scene, scene))
            axes.grid(True, axis="y")
            axes.set_xticks(places, [row.obstacle for row in rows])
            for plate in dict.fromkeys(row.plate for row in rows):
                middle = np.mean([at for at, row in zip(places, rows, strict=True) if row.plate == plate])
                axes.text(float(middle), 110, plate, ha="center", va="center", fontsize=SMALL)
    save(figure, path)


def text(rows: list[Row]) -> str:
    """The errors in per cent as a table."""
    names = [model for model, _ in MODELS]
    lines = [" " * 25 + "".join(f"{name:>22}" for name in names)]
    lines.append(" " * 25 + "".join(f"{'   '.join(('coarse', 'photo', 'pts')):>22}" for _ in names))
    for row in rows:
        cells = ("".join(f"{100 * row.error[name][scene]:7.2f}" for scene in SCENES) for name in names)
        lines.append(f"{row.plate:17}{row.obstacle:8}" + "".join(f" {cell:>21}" for cell in cells))
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description="Judge models of obstructed light by wave optics, plate by plate.")
    parser.add_argument("--out", type=Path, default=Path("runs/occlusion"), help="folder (default runs/occlusion)")
    parser.add_argument("--plates", nargs="+", choices=PLATES, default=PLATES, help="some of the plates")
    parser.add_argument("--obstructions", nargs="+", choices=OBSTACLES, default=OBSTACLES, help="some of them")
    asked = parser.parse_args(arguments)
    rows: list[Row] = []
    with meter("judging", len(asked.plates)) as progress:
        for number, plate in enumerate(asked.plates, start=1):
            rows += judge(plate, asked.obstructions)
            progress.advance(number)
    found: list[dict[str, Any]] = [{"plate": r.plate, "obstruction": r.obstacle, "error": r.error} for r in rows]
    write_atomic(asked.out / "occlusion.json", canonical_json({"rows": found}))
    draw(asked.out / "occlusion.png", rows)
    print(text(rows))


if __name__ == "__main__":
    sys.exit(exit_code(main))
