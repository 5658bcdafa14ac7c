"""Photographs of a plate on the paper's PSF bench, as a measurement that `doedesign.calibration` reads.

The plate has errors that the description of the measurement does not tell; `doedesign.evaluation.optics.psf_bench` says
what else a fit is not told.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt16

from doedesign.design.design import Design
from doedesign.evaluation.optics.psf_bench import (
    BenchThroughput,
    PsfBench,
    bench_camera,
    bench_light,
    bench_throughput,
    clear_window,
)
from doedesign.spec import variation_to_toml
from fab.errors import InputError
from fab.figure import LIGHT, SMALL, bare, extent_of, length_text, panels, scale_bar
from fab.files import write_atomic
from fab.pictures import write_pixels
from fab.process import Process, Variation
from fab.units import UM
from sim.camera import Camera
from sim.psf_bank import Length, depths_from

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

_FULL = 0.7  # of a pixel's range, that the brightest pixel reaches in the shortest exposure
_MOST_FULL = 0.25  # of a frame's pixels, that may be full in a longer one


class BenchRow(NamedTuple):
    """Numbers of one image: depths stated and true (m), exposures (s), and shares of the light.

    `rim` is the irradiance at the rim of the aperture over that in the middle, `relay` what the relay lets pass of the
    light in the frame.
    """

    name: str
    depth_m: float
    source_m: float
    shortest_s: float
    longest_s: float
    rim: float
    relay: float
    in_frame: float
    peak: float
    full_px: int


@dataclass(frozen=True, eq=False)
class BenchImage:
    """Frames of a point source at one depth, row 0 at the lowest y of the camera.

    Attributes:
        name: its name.
        depth_m: of the source as it is stated, metres.
        source_m: of the source as it is.
        light: ``[y, x]`` energy per pixel on the plate's axes, per unit power on the clear aperture.
        exposures_s: of the frames, seconds.
        frames: ``[exposure, y, x]`` counts.
        darks: the same without light.
        row: its numbers.
    """

    name: str
    depth_m: float
    source_m: float
    light: Float[np.ndarray, "y x"]
    exposures_s: tuple[float, ...]
    frames: UInt16[np.ndarray, "e y x"]
    darks: UInt16[np.ndarray, "e y x"]
    row: BenchRow


@dataclass(frozen=True, eq=False)
class BenchMeasurement:
    """Photographs of a point source through a plate on a bench.

    Attributes:
        bench: the bench.
        pixel_m: pixel pitch of its camera, metres.
        window: pixels per side that are to be compared, or None for those of the design.
        errors: those of the plate.
        images: one for every depth.
        throughput: what of the light passes.
        name: that of the design.
    """

    bench: PsfBench
    pixel_m: float
    window: int | None
    errors: Variation
    images: tuple[BenchImage, ...]
    throughput: BenchThroughput
    name: str

    @property
    def rows(self) -> tuple[BenchRow, ...]:
        """Numbers of every image."""
        return tuple(image.row for image in self.images)

    def write(self, folder: str | Path) -> Path:
        """Write the frames, the file that describes them and the hidden errors; return the description.

        Args:
            folder: where to, made where it is missing.
        """
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for image in self.images:
            for kind, frames in (("", image.frames), ("dark_", image.darks)):
                for number, counts in enumerate(frames):
                    write_pixels(folder / f"{kind}{image.name}_{number}.tiff", counts)
        path = folder / "measurement.toml"
        write_atomic(path, "\n".join(self._description()).encode())
        hidden = variation_to_toml(self.errors, [f"errors of the plate {self.name} on the bench, not to be looked at"])
        write_atomic(folder / "hidden.toml", hidden.encode())
        return path

    def _description(self) -> Iterator[str]:
        bench, through = self.bench, self.throughput
        stated = "" if through.stated is None else f", {100 * through.stated:.3g} % as stated"
        yield f"# Photographs of the plate {self.name} on a simulated bench: {bench.probe_m / 1e-9:.4g} nm from a fibre"
        yield f"# with a mode field of {bench.mode_field_m / UM:.3g} um, tip near by or collimated, and a 4F relay."
        yield f"# Throughput of the plate {100 * through.throughput:.3g} % by faces and relay{stated}."
        yield f'probe = "{bench.probe_m / 1e-9:.9g} nm"'
        yield f'pixel = "{self.pixel_m / UM:.9g} um"'
        yield f"gain = {bench.gain!r}"
        yield f"read_noise = {bench.read_noise!r}"
        yield f"saturation = {bench.full}"
        if bench.mode_field_m:
            yield f'mode_field = "{bench.mode_field_m / UM:.9g} um"'
        if bench.mode_field_m and any(math.isinf(image.depth_m) for image in self.images):
            yield f'collimator = "{bench.collimator_m * 1e3:.9g} mm"'
        if self.window is not None:
            yield f"window = {self.window} # that the relay passes whole"
        yield "quarter_turns = 2 # the relay's half turn"
        for image in self.images:
            count = range(len(image.exposures_s))
            yield "\n[[image]]"
            yield f'name = "{image.name}"'
            yield f'depth = "{_depth_text(image.depth_m)}"'
            if bench.depth_sigma_m and math.isfinite(image.depth_m):
                yield f'depth_sigma = "{bench.depth_sigma_m / UM:.9g} um"'
            for kind, words in (("", "files"), ("dark_", "dark")):
                yield f"{words} = {[f'{kind}{image.name}_{number}.tiff' for number in count]}"
            yield f"exposures = {[f'{seconds / 1e-6:.9g} us' for seconds in image.exposures_s]}"
        yield ""

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw all exposures of every image as the camera has them; on `ax`, or on a new figure."""
        from matplotlib.colors import LogNorm
        from matplotlib.patheffects import withStroke

        rim, bench, columns = [withStroke(linewidth=2, foreground="black")], self.bench, len(self.images)
        rows = max(len(image.frames) for image in self.images)
        norm = LogNorm(bench.read_noise / bench.gain, bench.full - bench.black, clip=True)
        title = f"{self.name} on the PSF bench, {length_text(bench.probe_m)}"
        note = "as the camera has them, the relay's half turn included; a full pixel is white"
        with panels(ax, (0.9 + 2.35 * columns, 0.9 + 2.3 * rows), title, note, layout="compressed") as figure:
            grid = figure.subplots(rows, columns, squeeze=False)
            shown = None
            for image, panes in zip(self.images, grid.T, strict=True):
                for axes in panes[len(image.frames) :]:  # it would show little but full pixels
                    axes.set_axis_off()
                for number, axes in enumerate(panes[: len(image.frames)]):
                    counts = np.maximum(image.frames[number].astype(np.float64) - bench.black, 1e-3)
                    extent = extent_of(counts.shape, self.pixel_m, 1.0)
                    shown = axes.imshow(counts, cmap=LIGHT, norm=norm, extent=extent, interpolation="auto")
                    full = np.ma.masked_less(image.frames[number], bench.full)
                    axes.imshow(full, cmap="gray", vmin=0, vmax=bench.full, extent=extent, interpolation="nearest")
                    seconds = image.exposures_s[number]
                    time = f"{seconds / 1e-6:.3g} µs" if seconds < 1e-3 else f"{seconds / 1e-3:.3g} ms"
                    style: Any = {"color": "white", "fontsize": SMALL, "transform": axes.transAxes, "path_effects": rim}
                    axes.text(0.03, 0.03, time, **style)
                    bare(axes)
                panes[0].set_title(length_text(image.depth_m) if math.isfinite(image.depth_m) else "collimated")
            scale_bar(grid[0, 0], self.images[0].light.shape[1] * self.pixel_m)
            for number, times in enumerate(bench.bracket[:rows]):
                first = next(k for k, image in enumerate(self.images) if len(image.frames) > number)
                grid[number, first].set_ylabel(f"{times:g} times the shortest" if times != 1 else "shortest exposure")
            assert shown is not None
            figure.colorbar(shown, ax=grid.ravel().tolist(), shrink=0.7, aspect=30, label="counts above black")
        return figure


def _depth_text(depth_m: float) -> str:
    return "inf" if math.isinf(depth_m) else f"{depth_m * 1e3:.9g} mm"


def bench_measurement(
    design: Design,
    process: Process,
    errors: Variation,
    bench: PsfBench | None = None,
    depths: Length | Sequence[Length] = (),
    seed: int = 0,
) -> BenchMeasurement:
    """Photograph a plate with some errors on a bench.

    Args:
        design: the plate as drawn, and the camera whose aperture the relay images it to.
        process: the process that made it.
        errors: its errors, SI units; `Variation()` for the plate as drawn.
        bench: the bench; the paper's by default.
        depths: of the sources, metres or with a unit, "inf" for collimated light; those of the design by default.
        seed: of noise and of the true depths.

    Raises:
        InputError: a design that no lens images, a depth that is not positive, or errors beyond the model
            (`sim.surface.as_fabricated`).
    """
    bench = bench or PsfBench()
    depths_m = depths_from(depths) if not isinstance(depths, Sequence) or len(depths) else design.depths_m
    if design.camera.distance_m is not None:
        rule, cure = "the bench's camera has a lens", "Choose a design with a focal length."
        raise InputError("bench", rule, design.camera.lens_text, cure)
    camera, rng = bench_camera(design, bench), np.random.default_rng(seed)
    window = clear_window(camera, bench) if bench.within_relay else None  # refuses before minutes of work
    plate = replace(design, camera=camera).fabricated(process, variation=errors, depths=depths_m)
    through = bench_throughput(plate, bench)
    # Faces and relay are in the light; what else is lost makes it dimmer.
    dimmer = 1.0 if through.stated is None else through.stated / through.throughput
    images = []
    for number, depth in enumerate(depths_m):
        off = rng.normal(0, bench.depth_sigma_m) if math.isfinite(depth) else 0.0
        open_, light = bench_light(plate, bench, depth + off)
        name = f"{number}_{'far' if math.isinf(depth) else _depth_text(depth).replace(' ', '')}"
        images.append(_photographed(name, (depth, depth + off), (open_, light), dimmer, plate.camera, bench, rng))
    return BenchMeasurement(bench, camera.pixel_m, window, errors, tuple(images), through, design.name)


def _photographed(
    name: str,
    depths_m: tuple[float, float],
    lights: tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]],
    dimmer: float,
    camera: Camera,
    bench: PsfBench,
    rng: np.random.Generator,
) -> BenchImage:
    """Frames of the light at a depth (stated, true), with the relay left out and with it."""
    open_, light = lights
    (stated, true), radius = depths_m, camera.opening.reach_m
    edge = bench.beam_radius_m(true)
    # Of the fibre's light, what falls on the aperture; a point's is taken to fill it.
    caught = -math.expm1(-2 * (radius / edge) ** 2) if math.isfinite(edge) else 1.0
    rate = bench.source_e_per_s * caught * dimmer
    shortest = _FULL * (bench.full - bench.black) * bench.gain / (rate * float(light.max()))
    # The relay turns the picture by half a turn.
    turned = light[::-1, ::-1]
    per_s = turned * rate + bench.background_e_per_s

    def shows_enough(times: float) -> bool:
        return float(np.mean(per_s * shortest * times >= (bench.full - bench.black) * bench.gain)) <= _MOST_FULL

    first, *longer = bench.bracket
    bracket = (first, *(times for times in longer if shows_enough(times)))
    exposures = tuple(float(f"{shortest * times:.3g}") for times in bracket)

    def counts(electrons: Float[np.ndarray, "y x"]) -> UInt16[np.ndarray, "y x"]:
        seen = rng.poisson(np.maximum(electrons, 0.0)) + rng.normal(0, bench.read_noise, electrons.shape)
        return np.clip(np.rint(seen / bench.gain) + bench.black, 0, bench.full).astype(np.uint16)

    frames = np.stack([counts(per_s * seconds) for seconds in exposures])
    darks = np.stack([counts(np.zeros_like(light)) for _ in exposures])
    row = BenchRow(
        name=name,
        depth_m=stated,
        source_m=true,
        shortest_s=exposures[0],
        longest_s=exposures[-1],
        rim=math.exp(-2 * (radius / edge) ** 2),
        relay=float(light.sum() / open_.sum()),
        in_frame=float(light.sum()),
        peak=float(light.max()),
        full_px=int((frames[-1] >= bench.full).sum()),
    )
    return BenchImage(name, stated, true, light, exposures, frames, darks, row)


def bench_errors(design: Design, process: Process, seed: int) -> Variation:
    """Errors of a plate: those that a calibration looks for by default drawn, all others at the process's means.

    Places are relative to mask 0, by whose marks all others and the chrome are aligned, as a calibration has them.

    Args:
        design: the plate.
        process: its process.
        seed: of the draw.
    """
    drawn, _ = design.plate_errors(process, seed=seed)
    found: dict[str, Any] = {name: getattr(drawn, name) for name in ("common_depth_scale", "common_cd_bias_m")}
    for name in ("overlay_y_m", "overlay_x_m"):
        places_m = getattr(drawn, name)
        found[name] = tuple(place - places_m[0] for place in places_m)
    return replace(process.expected(), **found)
