"""The second wafer: a design, its masks, a fab whose errors nobody told it, photographs, and masks that allow for them.

    python examples/second_wafer.py [FOLDER] [--fabs 5] [--spec examples/quick.toml]

For every fab these commands run, each printed before it does:

    doedesign optimize examples/quick.toml
    doedesign masks runs/quick
        (the fab makes a wafer, and photographs are taken of its light)
    doedesign calibrate runs/quick photographs/measurement.toml
        --errors depth --errors cd --errors overlay_y --errors overlay_x
    doedesign precompensate runs/quick --process calibration/process-estimate.toml --random overlay
    doedesign masks runs/quick_v2
        (the same fab makes another wafer)

The fab is hidden: the commands see its photographs alone. It shares no code with the process model that calibrates and
compensates. Its masks are what a level map and the moves of edges in an order's manifest say; a plate is a raster in
double precision with a line wherever an edge of any mask can lie and four more in a cell, twelve samples across,
so that edges lie where they are and not at the next sample. Its light is a plain sum over all samples. The camera that
photographs it is turned, stretched and noisy, and the fits are told of neither.

What repeats from wafer to wafer is how much too deep each mask etches and how far its openings widen, which a lab's
etcher, resist and mask shop give it. What does not is how well masks are aligned, and a little of depth and width; the
second wafer draws these anew. So the overlay that the calibration finds is that of the first wafer, and
`--random overlay` keeps it out of the compensation.
"""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from measure_psfs import MARGIN, MEASUREMENT, photographed
from scipy.interpolate import RectBivariateSpline

from doedesign.calibration.measurement import load_measurement
from doedesign.cli import exit_code, main
from doedesign.design.design import Design
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from fab.errors import CheckFailed
from fab.files import write_atomic
from sim.material import refractive_index

HERE = Path(__file__).parent
FABS = 5
ERRORS = ("depth", "cd", "overlay_y", "overlay_x")  # that the calibration looks for
# Standard deviations of what a fab is off by on every wafer ...
DEEP, OWN_DEEP = 0.04, 0.015  # share of all etches, and of each besides
WIDE_M, OWN_WIDE_M = 150e-9, 50e-9  # growth of openings per edge, likewise
# ... and of what is drawn anew for each.
OVERLAY_M, DEEP_AGAIN, WIDE_AGAIN_M = 80e-9, 0.003, 10e-9
TURNED, STRETCHED = np.radians(0.7), (0.012, -0.008)  # standard deviation, and scales along y and x, of the camera
LINES = 4  # of the raster in a cell, besides the edges
SPACING = 0.25  # of wavelength x focal length / aperture, at which light is sampled; twice as fine as it can vary
NODES = 3  # of Gauss's rule per axis of a pixel


class WaferErrors(NamedTuple):
    """Errors of a plate, first mask first: share of depth, growth per edge (metres), and places (y, x, metres)."""

    deep: Float[np.ndarray, " mask"]
    wide_m: Float[np.ndarray, " mask"]
    place_m: Float[np.ndarray, "mask 2"]


class HiddenFab(NamedTuple):
    """A fab: what all its wafers share, and the number that everything about it is drawn from."""

    deep: Float[np.ndarray, " mask"]
    wide_m: Float[np.ndarray, " mask"]
    seed: int

    @classmethod
    def draw(cls, seed: int, masks: int) -> "HiddenFab":
        """Draw one."""
        rng = np.random.default_rng(seed)
        deep = rng.normal(0, DEEP) + rng.normal(0, OWN_DEEP, masks)
        return cls(deep, rng.normal(0, WIDE_M) + rng.normal(0, OWN_WIDE_M, masks), seed)

    def wafer(self, number: int) -> WaferErrors:
        """Errors of one of its wafers."""
        rng, masks = np.random.default_rng((self.seed, number)), len(self.deep)
        deep, wide_m = self.deep + rng.normal(0, DEEP_AGAIN, masks), self.wide_m + rng.normal(0, WIDE_AGAIN_M, masks)
        return WaferErrors(deep, wide_m, rng.normal(0, OVERLAY_M, (masks, 2)))


def perfect(masks: int) -> WaferErrors:
    """No errors."""
    return WaferErrors(np.zeros(masks), np.zeros(masks), np.zeros((masks, 2)))


class Raster(NamedTuple):
    """A plate cut into rectangles: their middles and widths along y and x, and how deep each is etched, metres."""

    y_m: Float[np.ndarray, " y"]
    x_m: Float[np.ndarray, " x"]
    high_m: Float[np.ndarray, " y"]
    wide_m: Float[np.ndarray, " x"]
    depth_m: Float[np.ndarray, "y x"]


def etched(design: Design, errors: WaferErrors) -> Raster:
    """The plate that masks as drawn and a fab with these errors make, out to the rim of the chrome's opening."""
    grid, levels, radius = design.camera.grid, design.levels, design.camera.aperture_m / 2
    moves = np.array(design.edge_moves_m or (0.0,) * levels.bits) + errors.wide_m
    axes = []
    for axis, count in enumerate(grid.shape):
        drawn = (np.arange(count + 1) - count / 2) * grid.pitch_m
        own = zip(errors.place_m[:, axis], moves, strict=True)
        edges = [drawn + place + way * move for place, move in own for way in (-1, 1)]
        between = [drawn + part * grid.pitch_m / LINES for part in range(LINES)]
        lines = np.unique(np.concatenate([*edges, *between, [-radius, radius]]))
        axes.append(lines[(lines >= -radius) & (lines <= radius)])
    middles = [(lines[1:] + lines[:-1]) / 2 for lines in axes]
    depth = np.zeros([len(middle) for middle in middles])
    codes = np.pad(levels.count - 1 - design.level_map.level.astype(int), 1)  # blank glass all around
    for mask, nominal in enumerate(levels.depths_m):
        plane = (codes >> mask & 1).astype(bool)
        # A place is open if a pixel within the move of it is; or, where openings shrink, if all of them are.
        reach, near = abs(moves[mask]), []
        for axis, (middle, count) in enumerate(zip(middles, grid.shape, strict=True)):
            on_mask = [(middle - errors.place_m[mask, axis] + way * reach) / grid.pitch_m for way in (-1, 1)]
            near.append([np.clip(np.floor(place + count / 2).astype(int) + 1, 0, count + 1) for place in on_mask])
        around = [plane[np.ix_(rows, columns)] for rows in near[0] for columns in near[1]]
        opened = np.logical_or.reduce(around) if moves[mask] > 0 else np.logical_and.reduce(around)
        depth[opened] += nominal * (1 + errors.deep[mask])
    (y, x), (high, wide) = middles, (np.diff(lines) for lines in axes)
    return Raster(y, x, high, wide, depth)


class Bench(NamedTuple):
    """How a camera stands: turned from +x toward +y (radians), stretched along y and x, the chief ray off (pixels)."""

    rotation: float = 0.0
    scale: tuple[float, float] = (0.0, 0.0)
    off: tuple[float, float] = (0.0, 0.0)


UPRIGHT = Bench()


class PixelLight(NamedTuple):
    """Light at the nodes of all pixels: their distance from the chief ray, metres, and energy, ``[y, x, node]``."""

    radius_m: Float[np.ndarray, "y x n"]
    energy: Float[np.ndarray, "y x n"]

    def image(self) -> Float[np.ndarray, "y x"]:
        """Energy of every pixel, per unit power on the opening."""
        return self.energy.sum(axis=-1)

    def ring_to_disc(self, disc_m: float) -> float:
        """Energy outside a circle over that inside."""
        inside = self.energy[self.radius_m <= disc_m].sum()
        return float((self.energy.sum() - inside) / inside)


def light_on(
    design: Design, plate: Raster, wavelength_m: float, depth_m: float, bench: Bench = UPRIGHT, margin: int = 0
) -> PixelLight:
    """Light of a point source through a plate on a camera's pixels, `margin` more than the design's window has.

    Args:
        design: its camera.
        plate: the plate.
        wavelength_m: of the light.
        depth_m: of the source.
        bench: how the camera stands.
        margin: pixels.
    """
    camera, pixel = design.camera, design.camera.pixel_m
    square = plate.y_m[:, None] ** 2 + plate.x_m**2
    path = square / (np.sqrt(square + depth_m**2) + depth_m)
    index = refractive_index(camera.material, wavelength_m)
    field = np.exp(2j * np.pi / wavelength_m * (path - (index - 1) * plate.depth_m))
    field *= square <= camera.aperture_m**2 / 4
    nodes, parts = np.polynomial.legendre.leggauss(NODES)
    inner_y, inner_x = (n.ravel() * camera.fill / 2 for n in np.meshgrid(nodes, nodes, indexing="ij"))
    centre = np.arange(camera.window + margin) - (camera.window + margin - 1) / 2
    y = (centre[:, None, None] - bench.off[0] + inner_y) * pixel * (1 + bench.scale[0]) + 0 * centre[:, None]
    x = (centre[None, :, None] - bench.off[1] + inner_x) * pixel * (1 + bench.scale[1]) + 0 * centre[:, None, None]
    cos, sin = np.cos(bench.rotation), np.sin(bench.rotation)
    y, x = cos * y + sin * x, cos * x - sin * y
    # Sampled finely enough, and a few samples further than the outermost node.
    scale = wavelength_m * camera.focal_length_m
    step = SPACING * scale / camera.aperture_m
    u = np.arange(-(reach := int(np.hypot(y, x).max() / step) + 6), reach + 1) * step
    waves = [
        np.exp(-2j * np.pi / scale * np.outer(u, middle)) * np.sinc(np.outer(u, width) / scale) * width
        for middle, width in ((plate.y_m, plate.high_m), (plate.x_m, plate.wide_m))
    ]
    power = np.abs(waves[0] @ field @ waves[1].T / scale) ** 2 / (np.pi * camera.aperture_m**2 / 4)
    area = np.outer(parts, parts).ravel() / 4 * (camera.fill * pixel) ** 2 * np.prod(1 + np.array(bench.scale))
    return PixelLight(np.hypot(y, x), RectBivariateSpline(u, u, power).ev(y, x) * area)


def ratios(design: Design, plate: Raster) -> dict[str, float]:
    """Ring:disc ratio of every colour at the nearest depth; the disc is the geometric one and a pixel wider."""
    camera, depth_m = design.camera, design.near_m[0]
    disc_m = camera.aperture_m / 2 * camera.focal_length_m / depth_m + camera.pixel_m
    lines = {colour.name: colour.wavelengths_m[0] for colour in camera.colours}
    return {name: light_on(design, plate, line, depth_m).ring_to_disc(disc_m) for name, line in lines.items()}


def photographs(design: Design, plate: Raster, seed: int, out: Path) -> Path:
    """Photographs of a plate on a bench that stands askew; return their description."""
    spec, rng = load_measurement(MEASUREMENT), np.random.default_rng((seed, 0xCA3E7A))
    bench = Bench(rng.normal(0, TURNED), STRETCHED, (3.0, -5.0))
    probe = spec.probe_m
    lights = [light_on(design, plate, probe, image.depth_m, bench, MARGIN).image() for image in spec.image]
    return photographed(lights, spec, out, rng)


def run(*words: object) -> None:
    """Run a command of `doedesign`, printed as it would be typed."""
    command = [str(word) for word in words]
    print("\n$ doedesign", *(f'"{word}"' if " " in word else word for word in command), flush=True)
    if main(command) != 0:
        raise CheckFailed([f"doedesign {' '.join(command)} failed"])


class Outcome(NamedTuple):
    """Ring:disc ratios of a colour: of the design, and of the first and the second wafer of a fab."""

    fab: int
    colour: str
    design: float
    first: float
    second: float

    def off(self) -> tuple[float, float]:
        """Shares by which both wafers are off the design."""
        return self.first / self.design - 1, self.second / self.design - 1


def two_wafers(source: Path, order: Path, seed: int, out: Path) -> tuple[Raster, Raster]:
    """Two wafers of one fab, the second from masks that allow for what the first one showed.

    Args:
        source: run of the design.
        order: its masks.
        seed: of the fab.
        out: folder for what is made.
    """
    design = open_design(source, order)
    fab = HiddenFab.draw(seed, design.levels.bits)
    first = etched(design, fab.wafer(1))
    description = photographs(design, first, seed, out / "photographs")
    errors = [word for name in ERRORS for word in ("--errors", name)]
    run("calibrate", source, description, *errors, "--masks", order, "--out", out / "calibration")
    estimate = out / "calibration" / "process-estimate.toml"
    run("precompensate", source, "--process", estimate, "--random", "overlay", "--out", out / "run")
    run("masks", out / "run", "--out", out / "masks")
    return first, etched(open_design(out / "run", out / "masks"), fab.wafer(2))


def second_wafers(folder: Path, fabs: int = FABS, spec: Path = HERE / "quick.toml") -> list[Outcome]:
    """Wafers of several fabs in a folder, with a table at the end.

    Args:
        folder: where results go.
        fabs: number of fabs.
        spec: the spec.
    """
    spec, name = spec.resolve(), load_spec(spec).name
    folder.mkdir(parents=True, exist_ok=True)
    source, order, found = Path("runs") / name, Path("masks") / name, []
    with contextlib.chdir(folder):
        run("optimize", spec)
        run("masks", source)
        design = open_design(source, order)
        wanted = ratios(design, etched(design, perfect(design.levels.bits)))
        for seed in range(1, fabs + 1):
            first, second = (ratios(design, plate) for plate in two_wafers(source, order, seed, Path(f"fab-{seed}")))
            found += [Outcome(seed, name, wanted[name], first[name], second[name]) for name in wanted]
        lines = ["fab,colour,design,first_wafer,second_wafer"]
        lines += [f"{one.fab},{one.colour},{one.design:.4f},{one.first:.4f},{one.second:.4f}" for one in found]
        write_atomic("second_wafer.csv", ("\n".join(lines) + "\n").encode())
    print(f"\nring:disc ratio at {1e3 * load_spec(spec).scene.near_m[0]:g} mm")
    for one in found:
        first, second = (f"{ratio:.3f} ({100 * off:+.1f} %)" for ratio, off in zip(one[3:], one.off(), strict=True))
        print(f"fab {one.fab}, {one.colour}: design {one.design:.3f}, first wafer {first}, second wafer {second}")
    worst = [100 * max(abs(one.off()[k]) for one in found) for k in (0, 1)]
    print(f"at worst {worst[0]:.1f} % off on the first wafers, {worst[1]:.1f} % on the second ones")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("second-wafer"))
    parser.add_argument("--fabs", type=int, default=FABS)
    parser.add_argument("--spec", type=Path, default=HERE / "quick.toml")
    given = parser.parse_args()
    sys.exit(exit_code(lambda: second_wafers(given.folder, given.fabs, given.spec)))
