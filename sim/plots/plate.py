"""The picture of a DOE as fabricated: what its cells do to light, beside what was drawn."""

from typing import TYPE_CHECKING

import numpy as np

from fab.figure import CHROME, length_text, panels, shrunk
from fab.plots.maps import box_mm, frame_window, show_map, window_around
from sim.metrics import in_parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from sim.surface import FabricatedDoe

_WINDOW, _MOST = 32, 480  # drawn cells of the middle that are shown, and dots of the whole
_LEAST = 1e-3  # waves: the scale of a plate without errors


def plot_plate(plate: "FabricatedDoe", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the phase error of a plate, and the phase of its middle cells as drawn and as fabricated.

    Phases are those of light from the farthest source at the plate's first wavelength, in waves; the phase of a cell is
    that of its mean transmission.
    """
    from matplotlib import colormaps
    from matplotlib.ticker import MaxNLocator

    wavelength = plate.wavelengths_m[0]
    grid, parts = plate.grid, plate.grid.shape[0] // plate.drawn_m.shape[0]
    drawn = in_parts(np.asarray(plate.drawn_m, np.float64), parts) * plate.camera.waves_per_metre(wavelength)
    light = np.exp(2j * np.pi * drawn) if plate.height_m is not None else np.asarray(plate.at(wavelength))
    covered = np.asarray(plate.coverage) < 0.5
    error = np.ma.array(np.angle(light * np.exp(-2j * np.pi * drawn)) / (2 * np.pi), mask=covered)
    phases = [np.ma.array(np.mod(waves, 1.0), mask=covered) for waves in (drawn, np.angle(light) / (2 * np.pi))]
    most = max(float(np.quantile(np.abs(error.compressed()), 0.99)) if error.count() else 0.0, _LEAST)
    errors = {"cmap": colormaps["RdBu_r"].with_extremes(bad=CHROME), "vmin": -most, "vmax": most}
    turns = {"cmap": colormaps["twilight"].with_extremes(bad=CHROME), "vmin": 0.0, "vmax": 1.0}
    note = f"phases at {length_text(wavelength)}, of the mean transmission of a cell; grey: chrome"
    with panels(ax, (10.1, 4.6), "Plate as fabricated", note) as figure:
        whole, before, after = figure.subplots(1, 3, width_ratios=(1.3, 1, 1))
        share = shrunk((~covered).astype(np.float32), _MOST, "smooth")
        mean = shrunk(error.filled(0.0).astype(np.float32), _MOST, "smooth") / np.maximum(share, 1e-3)
        shown = np.ma.array(mean, mask=share < 0.5)
        whole.imshow(shown, origin="lower", extent=box_mm(grid), interpolation="auto", **errors)
        whole.set(title=f"phase error, {grid.shape[1]} × {grid.shape[0]} cells", xlabel="x (mm)", ylabel="y (mm)")
        whole.locator_params(nbins=5, steps=[1, 2, 5, 10])
        window = window_around(grid, 0.0, 0.0, _WINDOW * parts)
        for axes, phase, words in ((before, phases[0], "as drawn"), (after, phases[1], "as fabricated")):
            show_map(axes, phase[window], grid, window, f"middle, {words}", **turns)
        frame_window(whole, grid, window, "middle")
        for axes, words in (([whole], "phase error (waves)"), ([before, after], "phase (waves)")):
            bar = figure.colorbar(
                axes[0].images[0], ax=axes, location="bottom", aspect=25 * len(axes), format="{x:.2g}"
            )
            bar.locator = MaxNLocator(5)
            bar.update_ticks()
            bar.set_label(words)
    return figure
