"""PSFs to look through by depth and colour: grey pictures of logarithms, which the page colours."""

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from doedesign.report.page.blocks import PsfBlock
from doedesign.report.page.files import RunFiles, listed_bytes
from doedesign.report.page.numbers import length, rounded
from fab.figure import shrunk
from fab.pictures import webp_bytes
from sim.store import StoredBank, read_stored_bank

_WHOLE_PX, _MIDDLE_PX = 256, 128  # of a picture: the whole window averaged, and its middle pixel by pixel
_DECADES = 5
_BANKS = (
    ("psf", "quantised", "as drawn"),
    ("psf", "continuous", "before rounding"),
    ("fabricated", "fabricated", "as fabricated, one plate"),
    ("as-built", "as-built", "as built"),
)


def banks_of(files: RunFiles) -> list[tuple[str, StoredBank]]:
    """All PSF banks of a run, each with its name in words, and its field where that is off the axis.

    Args:
        files: the run.
    """
    there = (
        (label, read_stored_bank(files.folder / folder / f"{name}.exr"))
        for folder, name, label in _BANKS
        if listed_bytes(files.folder / folder, f"{name}.exr") is not None
    )
    return [(with_field(label, bank), bank) for label, bank in there]


def with_field(label: str, bank: StoredBank) -> str:
    """A name of a bank and, where that is off the axis, its field.

    Args:
        label: the name.
        bank: the bank.
    """
    y, x = (f"{math.degrees(angle):.4g}°" for angle in bank.field_rad)
    return f"{label}, field angle {y} along y, {x} along x" if any(bank.field_rad) else label


def psf_block(banks: Sequence[tuple[str, StoredBank]]) -> PsfBlock | None:
    """PSFs one at a time, by bank, depth and colour; None without any.

    Args:
        banks: names and banks; those that differ from the first in depths, colours or pixels are left out.
    """
    if not banks:
        return None
    alike, first = _alike(banks), banks[0][1]
    window, pixel = first.energy.shape[-1], _pixel_text(first.pixel, first.sines)
    data = {**_data(alike), "window": window}
    note = (
        f"Energy per pixel of {pixel} over that of the brightest pixel at this depth and colour, in the window of "
        f"{window} pixels" + ("." if window <= _WHOLE_PX else ", averaged, or in its middle, pixel by pixel.")
    )
    if aslant := [label for label, bank in alike if any(bank.field_rad)]:
        note += f" Off the axis: {'; '.join(aslant)}."
    return PsfBlock("PSFs", tuple(data["banks"]), tuple(map(length, first.depths_m)), first.colours, data, note)


def compared_psfs(banks: Sequence[tuple[str, StoredBank]]) -> PsfBlock | None:
    """PSFs of several runs side by side, and those of the second less those of the first; None where none compare.

    Args:
        banks: names and banks; those that differ from the first in depths, colours, pixels or field are left out.
    """
    alike = [one for one in _alike(banks) if one[1].field_rad == banks[0][1].field_rad] if banks else []
    if len(alike) < 2:
        return None
    (name, first), (other_name, other) = alike[:2]
    data, most = _data(alike), {}
    for d, c in _places(first):
        off = shrunk(other.energy[c, d], _WHOLE_PX) - shrunk(first.energy[c, d], _WHOLE_PX)
        most[f"{d},{c}"] = rounded(float(np.abs(off).max()), 5) or 1e-12
        data["pictures"][f"{len(alike)},{d},{c}"] = {"whole": _signed(off / most[f"{d},{c}"])}
    labels = (*data["banks"], f"{other_name} less {name}")
    window = min(first.energy.shape[-1], _WHOLE_PX)
    data |= {"banks": list(labels), "signed": [len(alike)], "most": most, "window": window}
    note = "All on one scale; of the difference, blue is less light, white the same, red more."
    return PsfBlock("PSFs as drawn", labels, tuple(map(length, first.depths_m)), first.colours, data, note, True)


def _alike(banks: Sequence[tuple[str, StoredBank]]) -> list[tuple[str, StoredBank]]:
    looks = [(one.colours, one.depths_m, one.energy.shape, one.pixel) for _, one in banks]
    return [bank for bank, look in zip(banks, looks, strict=True) if look == looks[0]]


def _places(bank: StoredBank) -> list[tuple[int, int]]:
    """Positions (depth, colour) of a bank."""
    return [(d, c) for d in range(len(bank.depths_m)) for c in range(len(bank.colours))]


def _data(banks: Sequence[tuple[str, StoredBank]]) -> dict[str, Any]:
    """Pictures of all banks, those of one depth and colour on one scale."""
    places = _places(banks[0][1])
    peak = {(d, c): float(max(one.energy[c, d].max() for _, one in banks)) for d, c in places}
    return {
        "decades": _DECADES,
        "banks": [label for label, _ in banks],
        "peak": {f"{d},{c}": rounded(value, 5) for (d, c), value in peak.items()},
        "pictures": {
            f"{b},{d},{c}": _pictures(one.energy[c, d], peak[d, c])
            for b, (_, one) in enumerate(banks)
            for d, c in places
        },
    }


def _pixel_text(pixel: float, sines: bool) -> str:
    return f"{math.degrees(math.asin(pixel)):.4g}°" if sines else length(pixel)


def _pictures(energy: Float[np.ndarray, "y x"], peak: float) -> dict[str, str]:
    """The whole window, and its middle where that shows more."""
    side = energy.shape[0]
    found = {"whole": _grey(shrunk(energy, _WHOLE_PX), peak)}
    if side > _WHOLE_PX:
        first = (side - _MIDDLE_PX) // 2
        found["middle"] = _grey(energy[first : first + _MIDDLE_PX, first : first + _MIDDLE_PX], peak)
    return found


def _grey(energy: Float[np.ndarray, "y x"], peak: float) -> str:
    """Logarithms over some decades below the peak as numbers from 0 to 255."""
    over = np.log10(np.maximum(energy / max(peak, 1e-30), 10.0**-_DECADES)) / _DECADES + 1
    return base64.b64encode(webp_bytes(np.rint(255 * np.clip(over, 0, 1)).astype(np.uint8))).decode()


def _signed(share: Float[np.ndarray, "y x"]) -> str:
    """Values from -1 to 1 as a grey picture of numbers from 0 to 254."""
    return base64.b64encode(webp_bytes(np.rint(127 * (np.clip(share, -1, 1) + 1)).astype(np.uint8))).decode()
