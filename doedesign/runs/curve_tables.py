"""Tables of the curves that pictures of light draw: modulation transfer, and light within a radius."""

import csv
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fab.units import MM
from sim.camera import Camera
from sim.plots.curves import encircled_radii_m
from sim.plots.places import unit_of
from sim.psf_bank import PsfBank
from sim.transfer import TransferBank

_DIGITS = 6


def mtf_csv(transfer: TransferBank, lens: TransferBank) -> str:
    """MTF along x of a DOE, and of the lens or the aperture alone, as CSV.

    Args:
        transfer: of the DOE.
        lens: without it, at the same depths and frequencies.

    Returns:
        a row per depth, colour and frequency, in cycles per millimetre or per degree about the axis.
    """
    in_angles = transfer.camera.in_angles
    per, unit = (np.radians(1.0), "deg") if in_angles else (MM, "mm")
    curves = (transfer.transfer, lens.transfer)
    return _csv(transfer.camera, transfer.depths_m, (f"frequency_per_{unit}", transfer.frequencies_per_m * per), curves)


def encircled_csv(bank: PsfBank, curves: Sequence[Float[np.ndarray, "w d r"]], camera: Camera) -> str:
    """Light within centred circles of a DOE, and of the lens or the aperture alone, as CSV.

    Args:
        bank: PSFs of the DOE.
        curves: `sim.plots.curves.encircled_curves` of the DOE, and without it, at the same depths.
        camera: lens and sensor of both.

    Returns:
        a row per depth, colour and radius, in micrometres or degrees; shares of all light on the clear aperture.
    """
    unit = unit_of(camera)
    return _csv(camera, bank.depths_m, (f"radius_{unit.suffix}", unit.of(encircled_radii_m(bank))), curves)


def _csv(
    camera: Camera,
    depths_m: Sequence[float],
    over: tuple[str, Float[np.ndarray, " x"]],
    curves: Sequence[Float[np.ndarray, "w d x"]],
) -> str:
    """Curves of the design and without it over named places, as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["depth_m", "colour", over[0], "design", "without"])
    for d, depth in enumerate(depths_m):
        for c, colour in enumerate(camera.colours):
            for at, *values in zip(over[1], *(curve[c, d] for curve in curves), strict=True):
                writer.writerow([f"{depth:.12g}", colour.name, *(f"{value:.{_DIGITS}g}" for value in (at, *values))])
    return text.getvalue()
