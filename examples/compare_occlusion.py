"""How far to trust a model of obstructed light: the camera's models against wave optics, for the plate of a run.

    python examples/compare_occlusion.py runs/automotive

`occlusion_table.py` does so for plates and obstructions of every kind, at a small scale.

A dark bar stands upright before the middle of the lens, at the nearest depth of the spec; it is a quarter to twice as
wide as the aperture (1 to 10 mm for the automotive plate). Behind it, bright lines at equal distances fill the view.
The reference (`sim.imaging.shadow`) sends the light of every line past the bar to the aperture, wave by wave, and
through the partly shaded plate; the models of `sim.imaging.occlusion` mix the PSFs of the open plate. Written beside
the run, in `occlusion/`:

    occlusion.json    for every width: the light that passes on the axis, and the error of every model
    occlusion.png     the same as a picture

Bar and lines run over the whole height of the view, so one row of scene points, and PSFs summed over their columns,
tell everything: nothing is left of the second dimension to approximate. An error is the root of the summed squares of
the difference to the reference over the middle of the picture, relative to the picture without the bar. It is told for
the lines, which show what happens to sharp detail, and for an even light, to which the lines blur over their distance.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.build import camera_from_spec
from doedesign.cli import exit_code
from doedesign.runs.folder import open_run
from doedesign.runtime.progress import meter
from fab.figure import INK, SERIES, panels, save
from fab.files import canonical_json, write_atomic
from fab.units import MM, format_length
from sim.camera import Camera
from sim.imaging.formation import Optics, capture
from sim.imaging.occlusion import Model, Outside
from sim.imaging.scene import Obstruction, Scene
from sim.imaging.shadow import shadowed_psf
from sim.psf_bank import psf
from sim.store import read_height

# Widths of the bar over the diameter of the aperture: 1, 2, 3, 4, 6, 8 and 10 mm for 4.44 mm.
SHARES = (0.225, 0.45, 0.675, 0.9, 1.35, 1.8, 2.25)
# What I_obs holds beside the obstruction is open in eq. 10: nothing as printed, the scene in the public code for bars.
MODELS: tuple[tuple[Model, Outside], ...] = (
    ("radiometric", "scene"),
    ("reciprocal", "scene"),
    ("paper", "nothing"),
    ("paper_release", "scene"),
)
MIDDLE_PX = 120


def bar(camera: Camera, depth_m: float, pixels: int, width_m: float) -> np.ndarray:
    """A bar in the middle of a view one row high, an odd number of whole pixels wide that is near `width_m`."""
    half = max(round((width_m / pixel_at(camera, depth_m) - 1) / 2), 0)
    mask = np.zeros((1, pixels), np.float32)
    mask[:, pixels // 2 - half : pixels // 2 + half + 1] = 1
    return mask


def pixel_at(camera: Camera, depth_m: float) -> float:
    """Width of a pixel at a depth, metres (eq. 11)."""
    return camera.pixel_m * depth_m / camera.focal_length_m


def compare(
    camera: Camera, height_m: np.ndarray, depth_m: float, background_m: float, line_px: int, middle_px: int = MIDDLE_PX
) -> list[dict[str, Any]]:
    """Compare the models with the reference at every width of the bar.

    Args:
        camera: a camera of one colour with an odd window.
        height_m: `[y, x]` height of the plate, metres.
        depth_m: distance of the bar.
        background_m: distance of the lines.
        line_px: distance of neighbouring lines, pixels.
        middle_px: width of the middle of the picture, which is judged, pixels.

    Returns:
        for every width: the share of light that passes on the axis, by the reference, the geometric shadow and eq. 10,
        and the error of every model.
    """
    half = camera.window // 2
    optics = Optics.of(psf(height_m, camera, [depth_m, background_m]), camera, [background_m, depth_m])
    pixels = middle_px + 2 * half + 1
    middle = slice(half, half + middle_px + 1)
    lines = range(pixels // 2 % line_px, pixels, line_px)
    light = np.zeros((1, 1, pixels), np.float32)
    light[..., list(lines)] = 1
    open_psf = optics.psf[0, 0]
    bright = _on_lines([np.asarray(open_psf.sum(axis=0))] * len(lines), lines, pixels)[middle]
    rows = []
    with meter("comparing", len(SHARES) * len(lines)) as progress:
        for n, share in enumerate(SHARES):
            mask = bar(camera, depth_m, pixels, share * camera.aperture_m)
            width_m = int(mask.sum()) * pixel_at(camera, depth_m)
            profiles = []
            for k, line in enumerate(lines):
                image = shadowed_psf(camera, height_m, mask, depth_m, background_m, (0, line))[0]
                profiles.append(image.sum(axis=0))
                progress.advance(n * len(lines) + k + 1)
            reference = _on_lines(profiles, lines, pixels)[middle]
            scene = Scene(light, background_m, (Obstruction(mask, np.zeros_like(light), depth_m),))
            off = {model: _modelled(scene, optics, model, outside)[middle] - reference for model, outside in MODELS}
            on_axis = lines.index(pixels // 2)
            rows.append(
                {
                    "width_m": width_m,
                    "depth_m": depth_m,
                    "passed": float(profiles[on_axis].sum() / open_psf.sum()),
                    "geometry": _open_share(width_m / camera.aperture_m),
                    "eq_10": _eq_10_share(optics, mask),
                    "lines": {model: _relative(off[model], bright) for model in off},
                    "even": {model: _relative(_even(off[model], line_px), _even(bright, line_px)) for model in off},
                }
            )
    return rows


def _on_lines(profiles: list[np.ndarray], lines: range, pixels: int) -> np.ndarray:
    """A row of the picture: every line's light where it lands."""
    half = len(profiles[0]) // 2
    row = np.zeros(pixels + 2 * half)
    for line, profile in zip(lines, profiles, strict=True):
        row[line : line + len(profile)] += profile
    return row[half : half + pixels]


def _modelled(scene: Scene, optics: Optics, model: Model, outside: Outside) -> np.ndarray:
    # The edge of a view one row high is the view itself, so every row of the PSF finds the same lines.
    return np.asarray(capture(scene, optics, model, border="edge", outside=outside))[0, 0]


def _relative(difference: np.ndarray, whole: np.ndarray) -> float:
    return float(np.linalg.norm(difference) / np.linalg.norm(whole))


def _even(row: np.ndarray, line_px: int) -> np.ndarray:
    """What a row of lines is to a view that cannot tell them apart."""
    return np.convolve(row, np.full(line_px, 1 / line_px), "valid")


def _open_share(width: float) -> float:
    """Share of a disc of diameter 1 that a bar through its middle leaves open."""
    a = min(width, 1.0)
    return float(1 - 2 / np.pi * (np.arcsin(a) + a * np.sqrt(1 - a * a)))


def _eq_10_share(optics: Optics, mask: np.ndarray) -> float:
    """1 - p_near * M on the axis: what eq. 10 lets pass there."""
    near = optics.psf[1, 0].sum(axis=0)
    half, middle = len(near) // 2, mask.shape[1] // 2
    return float(1 - near[::-1] @ mask[0, middle - half : middle + half + 1] / near.sum())


def draw(path: Path, rows: list[dict[str, Any]], name: str) -> None:
    """Draw what passes on the axis, and the errors, over the width of the bar."""
    widths = [row["width_m"] / MM for row in rows]
    title = f"{name}: light past a bar {format_length(rows[0]['depth_m'])} before the lens"
    with panels(None, (8.3, 3.9), title) as figure:
        left, right = figure.subplots(1, 2)
        for key, words, mark, line, hue in (
            ("eq_10", "eq. 10: 1 - p near * M", "s", "-", SERIES[1]),
            ("geometry", "radiometric: 1 - d * M", "o", "-", SERIES[0]),
            ("passed", "wave optics", "x", "", INK),
        ):
            left.plot(widths, [row[key] for row in rows], marker=mark, ls=line, color=hue, label=words, ms=5)
        left.set_title("Light of a point on the axis that passes")
        for (model, _), hue in zip(MODELS, SERIES, strict=False):
            right.plot(widths, [100 * row["even"][model] for row in rows], "o-", color=hue, label=model, ms=5)
            right.plot(widths, [100 * row["lines"][model] for row in rows], ":", color=hue)
        right.set_title("Error against wave optics (%)")
        for axes, words in ((left, ""), (right, ". Lines: even light; dots: fine bright lines")):
            axes.set_xlabel(f"width of the bar (mm){words}")
            axes.set_ylim(bottom=0)
            axes.legend()
    save(figure, path)


def main(arguments: list[str] | None = None) -> None:
    """Compare for the run that is named."""
    parser = argparse.ArgumentParser(description="Compare models of obstructed light with wave optics.")
    parser.add_argument("run", type=Path, help="a finished run")
    parser.add_argument("--colour", type=int, default=1, help="number of the colour, 0 first (default 1)")
    parser.add_argument("--line-px", type=int, default=8, help="distance of the bright lines in pixels (default 8)")
    asked = parser.parse_args(arguments)
    run = open_run(asked.run)
    spec, whole = run.spec, camera_from_spec(run.spec)
    colour = whole.colours[min(asked.colour, len(whole.colours) - 1)]
    # An odd window has the chief ray in the middle of a pixel, so the picture lies on its scene.
    camera = replace(whole, window=whole.window - 1 + whole.window % 2, colours=(colour,))
    height_m = read_height(run.path("height.exr")).height_m
    rows = compare(camera, height_m, min(spec.scene.near_m), max(spec.scene.far_m), asked.line_px)
    folder = asked.run / "occlusion"
    write_atomic(folder / "occlusion.json", canonical_json({"rows": rows}))
    draw(folder / "occlusion.png", rows, spec.name)
    print("width     passes  geometry  eq. 10   error for even light, for fine lines")
    print(" " * 36 + "".join(f"{model:>20}" for model, _ in MODELS))
    for row in rows:
        pairs = ((100 * row["even"][model], 100 * row["lines"][model]) for model, _ in MODELS)
        errors = "".join(f"{even:9.2f} %,{lines:6.2f} %" for even, lines in pairs)
        shares = "  ".join(f"{row[key]:6.3f}" for key in ("passed", "geometry", "eq_10"))
        print(f"{row['width_m'] / MM:5.2f} mm  {shares}   {errors}")


if __name__ == "__main__":
    sys.exit(exit_code(main))
