"""A small plate with hidden errors, and photographs of a point source through it as a lab would take them.

The light is computed over a larger window than any fit looks at, moved by an offset no fit knows, and only then given
noise, background, darkness and the limits of a 12-bit converter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from doedesign.calibration.forward_model import ForwardModel
from doedesign.calibration.unknowns import unknowns_of
from doedesign.design.design import Design
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Normal, Process, error_names
from sim.camera import Camera, Colour
from sim.psf_bank import PsfBank
from sim.store import write_bank

PIXEL_M, PITCH_M, PROBE_M = 1.85e-6, 1.85e-6, 520e-9
GAIN_E, READ_E, BLACK, TOP = 2.0, 4.0, 64.0, 4095.0
SHIFT = (3.37, -5.21)  # pixels by which the chief ray misses the frame's middle
_AROUND = 16  # pixels


def plate_drawn(cells: int = 200, count: int = 16, relief: float = 1.0, window: int = 96) -> Design:
    """Rings with something irregular in them, so that up differs from down and left from right."""
    y, x = np.indices((cells, cells)) - (cells - 1) / 2
    rough = np.random.default_rng(7).normal(size=(cells, cells))
    smooth = np.fft.ifft2(
        np.fft.fft2(rough) * np.exp(-4000 * np.add.outer(np.fft.fftfreq(cells) ** 2, np.fft.fftfreq(cells) ** 2) / 25)
    ).real
    radius = np.hypot(y, x)
    waves = radius / 4.1 * 0.6 + 0.4 * smooth / smooth.std() + 0.3 * (x > 0.3 * y)
    levels = Levels(count, 1.2e-6 / count)
    level = np.floor(relief * (waves % 1) * count).astype(np.uint8) + np.uint8((1 - relief) * (count - 1))
    grid = Grid((cells, cells), PITCH_M)
    aperture = cells * PITCH_M
    level_map = LevelMap(np.minimum(level, count - 1).astype(np.uint8), levels, grid, aperture, "fake")
    colour = Colour("550nm", (550e-9,), (1.0,))
    focal = 1.1e-3 * cells / 320 * 1.6
    camera = Camera(grid, aperture - 10e-6, "fused_silica", (colour,), focal, PIXEL_M, window)
    return Design(level_map, camera, (6e-3,), (np.inf,))


def usual_process(design: Design, **sigmas: float) -> Process:
    """A process with ordinary spreads; `sigmas` by key of `fab.process.DEVIATIONS` replace them."""
    spreads = {"common_depth_scale": 0.03, "common_cd_bias_m": 0.15e-6, "overlay_y_m": 0.5e-6, "overlay_x_m": 0.5e-6}
    masks = design.levels.bits
    each = {n: Normal(0.0, s) for key, s in {**spreads, **sigmas}.items() for n in error_names(masks, key) if s}
    return Process(design.levels, spreads=each, name="usual")


def light_of(
    design: Design, process: Process, hidden: Mapping[str, float], depths_m: Sequence[float], margin: int = 20
) -> list[np.ndarray]:
    """Images of a plate with hidden errors, `margin` pixels wider than the design's window, in wider frames.

    The chief ray misses the middle of the frame by `SHIFT`.
    """
    unknowns = unknowns_of(replace(process, spreads={n: Normal(v, 0.0) for n, v in hidden.items()}), ["etch_lag"])
    probe = Colour("probe", (PROBE_M,), (1.0,))
    camera = replace(design.camera, colours=(probe,), window=design.camera.window + margin)
    seen = ForwardModel(design.level_map.level, camera, unknowns, tuple(depths_m)).plate(np.zeros(1))
    whole = [round(s) for s in SHIFT]
    part = np.array([s - w for s, w in zip(SHIFT, whole, strict=True)] + [0.0] * 5)
    # The frame is wider still; what little light falls there is left out.
    around = [(_AROUND + w, _AROUND - w) for w in whole]
    return [np.pad(seen.image(i, part), around) for i in range(len(depths_m))]


def exposed(
    light: np.ndarray, electrons: float, exposure: float, rng: np.random.Generator, background: float = 200.0
) -> np.ndarray:
    """Counts of one exposure, row 0 at the lowest y.

    Args:
        light: energy per pixel.
        electrons: what the whole energy 1 gives in an exposure of 1.
        exposure: its length.
        rng: the noise.
        background: electrons per pixel and unit of exposure from elsewhere.
    """
    shot = rng.poisson((light * electrons + background) * exposure)
    counts = (shot + rng.normal(0, READ_E, light.shape)) / GAIN_E + BLACK
    return np.clip(np.rint(counts), 0, TOP).astype(np.uint16)


def write_frame(path: Path, counts: np.ndarray) -> None:
    """Write counts as a picture whose first row is the top, or as EXR."""
    if path.suffix == ".exr":
        write_bank(path, PsfBank(counts.astype(np.float32)[None, None], ("Y",), (np.inf,), PIXEL_M))
    elif path.suffix == ".png":
        Image.fromarray(np.ascontiguousarray(counts[::-1])).save(path)
    else:
        tifffile.imwrite(path, np.ascontiguousarray(counts[::-1]))


def photograph(
    folder: Path,
    lights: Sequence[np.ndarray],
    depths_m: Sequence[float],
    *,
    electrons: float = 3e7,
    exposures: Sequence[float] = (1.0, 0.1),
    kinds: Sequence[str] = ("tiff", "png"),
    seed: int = 5,
    more: str = "",
    image_more: str = "",
) -> Path:
    """Write a bracket of frames of every light, a dark frame for each, and the measurement's TOML file."""
    rng = np.random.default_rng(seed)
    lines = [
        'probe = "520 nm"',
        'pixel = "1.85 um"',
        f"gain = {GAIN_E}",
        f"read_noise = {READ_E}",
        f"saturation = {TOP}",
        more,
    ]
    for i, (light, depth) in enumerate(zip(lights, depths_m, strict=True)):
        kind = kinds[i % len(kinds)]
        files, darks = [], []
        for t in exposures:
            files.append(f"image{i}_{t:g}s.{kind}")
            darks.append(f"dark{i}_{t:g}s.{kind}")
            write_frame(folder / files[-1], exposed(light, electrons, t, rng))
            write_frame(folder / darks[-1], exposed(0 * light, 0.0, t, rng, background=0.0))
        depth_text = "inf" if np.isinf(depth) else f"{depth * 1e3:g} mm"
        lines += [
            "[[image]]",
            f'name = "{"far" if depth > 0.05 else "near"}{i}"',
            f'depth = "{depth_text}"',
            f"files = {files}",
            f"dark = {darks}",
            f"exposures = {[f'{t:g} s' for t in exposures]}",
            image_more,
        ]
    path = folder / "measurement.toml"
    path.write_text("\n".join(lines) + "\n")
    return path
