"""Certificate of a design: what light does at its walls, proved on rows and squares against Maxwell's equations."""

import logging
import math
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from doedesign.design.design import Design
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from doedesign.runtime.progress import meter
from fab.errors import InputError
from fab.figure import save
from fab.files import canonical_json
from sim.metrics import zeroth_order
from sim.optic import HeightOptic
from sim.plots.orders import plot_certificate
from sim.psf_bank import PsfBank, psf
from sim.rigorous.certificate import (
    PLACES,
    CertifiedPiece,
    CertifiedRow,
    Piece,
    Row,
    certify_pieces,
    certify_rows,
    cut_pieces,
    cut_rows,
)
from sim.rigorous.crossed import CROSSED_POLARISATIONS
from sim.rigorous.edge_optic import with_edges
from sim.rigorous.rows import POLARISATIONS

CELLS = 24  # of a row
PIECES, SIDE = 3, 2  # squares, and cells of a side
_KINDS, _NAMES = ("scalar", "edges", "rigorous"), ("scalar", "with edges", "rigorous")
_FEWEST, _MOST = 4, 64
_SIDES = (2, 4)

log = logging.getLogger("doedesign")


class Certificate(NamedTuple):
    """A design as a thin element, with the light of its walls, and by Maxwell's equations.

    Attributes:
        rows: cut-outs at every wavelength, per polarisation.
        orders: 0th order of the whole DOE, by name of the colour and vacuum wavelength (metres): as a thin element, and
            with edges in unpolarised light.
        scalar: PSFs of the thin element, energy per pixel per unit power incident on the clear aperture.
        edges: PSFs with the light of its walls, unpolarised.
        pieces: squares at every wavelength, per polarisation; none where they were not asked for.
    """

    rows: tuple[CertifiedRow, ...]
    orders: dict[tuple[str, float], tuple[float, float]]
    scalar: PsfBank
    edges: PsfBank
    pieces: tuple[CertifiedPiece, ...] = ()

    def changes(self) -> list[dict[str, Any]]:
        """Rows with colour, depth_m, the relative difference of the PSFs (L2), and ring:disc of both."""
        energies = (np.asarray(self.scalar.energy), np.asarray(self.edges.energy))
        ratios = (np.asarray(self.scalar.ring_to_disc()), np.asarray(self.edges.ring_to_disc()))
        off = np.linalg.norm(energies[1] - energies[0], axis=(2, 3)) / np.linalg.norm(energies[1], axis=(2, 3))
        return [
            {
                "colour": colour,
                "depth_m": None if math.isinf(depth) else depth,
                "difference": float(off[c, d]),
                "ring_to_disc_scalar": _finite(ratios[0][c, d]),
                "ring_to_disc_edges": _finite(ratios[1][c, d]),
            }
            for c, colour in enumerate(self.scalar.colours)
            for d, depth in enumerate(self.scalar.depths_m)
        ]

    def worst(self, kind: str, cut: Literal["rows", "pieces"] = "rows") -> float:
        """Largest relative error (L2) of the orders of a cut-out, as "scalar" light or with "edges"."""
        return max(float(one.orders.error(getattr(one.orders, kind)).max()) for one in getattr(self, cut))

    def cut_orders(self, wavelength_m: float, cut: Literal["rows", "pieces"] = "rows") -> dict[str, float] | None:
        """Mean 0th order of the cut-outs at a wavelength, "scalar", with "edges" and "rigorous"; None without any."""
        own = [one.orders for one in getattr(self, cut) if one.wavelength_m == wavelength_m]
        means = {kind: [np.mean(orders.zeroth(getattr(orders, kind))) for orders in own] for kind in _KINDS}
        return {kind: float(np.mean(values)) for kind, values in means.items()} if own else None


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def certify(
    source: Design | Run | str | Path,
    masks: str | Path | None = None,
    *,
    cells: int = CELLS,
    pieces: int = PIECES,
    side: int = SIDE,
    out: str | Path | None = None,
) -> Certificate:
    """Compare what a design does as a thin element, with edges and by Maxwell's equations.

    Rows of cells are cut out of it, on the axis and at four radii, and solved rigorously in both polarisations as
    gratings that repeat, and so are a few squares, in two dimensions. The whole design is computed as a thin element
    and with edges, which the cut-outs prove.

    Args:
        source: a design, a finished run or its folder.
        masks: mask order of the run, whose files are read; `masks/NAME` if there is one, else the run's own map.
        cells: cells of a row, 4 to 64; time grows with their third power.
        pieces: number of squares.
        side: cells of a square's side, 2 to 4; time grows with their sixth power and with the heights in a square.
            Larger ones than 2 are continued by mirrors through the middle of their outer cells.
        out: folder for the certificate (JSON, SI units) and its picture.

    Raises:
        InputError: something that cannot be read, a number of cells or squares that is too small or too large, or a
            design without relief.
    """
    _check("cells", cells, _FEWEST, _MOST, CELLS)
    _check("pieces", pieces, 0, PLACES, PIECES)
    _check("side", side, *_SIDES, SIDE)
    design = open_design(source, masks)
    camera, height = design.camera, design.level_map.height_m
    if pieces and side > min(height.shape):
        cure = "Ask for smaller squares, or for 0."
        raise InputError("side", f"squares must fit into the design of {min(height.shape)} cells", side, cure)
    rows = cut_rows(height, camera.grid, camera.opening, cells)
    if not rows:
        cure = "Certify a design with relief."
        raise InputError(design.name, "must not be flat where rows are cut out", "a flat plate", cure)
    with results_folder(out, design.name, design.folder, level_map_sha256=design.level_map.digest) as folder:
        wavelengths = tuple(dict.fromkeys(line.wavelength_m for line in camera.lines))
        with meter("rows", len(rows) * len(wavelengths)) as progress:
            done = count(1)
            certified = certify_rows(rows, camera, wavelengths, lambda: progress.advance(next(done)))
        certified_pieces: tuple[CertifiedPiece, ...] = ()
        if squares := cut_pieces(height, camera.grid, camera.opening, side, pieces, cells=cells):
            with meter("squares", len(squares) * len(wavelengths)) as progress:
                squares_done = count(1)
                certified_pieces = certify_pieces(
                    squares, camera, wavelengths, lambda: progress.advance(next(squares_done))
                )
        elif pieces:
            log.info("no squares: all are flat where they are cut out")
        thin, walls = HeightOptic.of(camera, height), with_edges(height, camera, depths_m=design.depths_m)
        with meter("PSFs", 2 * len(design.depths_m) * len(camera.lines)) as progress:
            done = count(1)
            scalar, edges = (
                psf(optic, depths=design.depths_m, on_psf=lambda: progress.advance(next(done)))
                for optic in (thin, walls)
            )
        both = [zeroth_order(optic) for optic in (thin, walls)]
        orders = {
            (colour.name, wavelength): tuple(float(order[wavelengths.index(wavelength)]) for order in both)
            for colour in camera.colours
            for wavelength in colour.wavelengths_m
        }
        found = Certificate(certified, orders, scalar, edges, certified_pieces)  # type: ignore[arg-type]
        for words in in_words(found):
            log.info(words)
        if folder is not None:
            (folder / "certificate.json").write_bytes(canonical_json(_record(found)))
            save(plot_certificate(found.rows, design.name, pieces=found.pieces), folder / "certificate.png")
    return found


def _check(name: str, value: int, lowest: int, highest: int, usual: int) -> None:
    if not lowest <= value <= highest:
        raise InputError(name, f"must lie from {lowest} to {highest}", value, f"{usual} are usual.")


def in_words(found: Certificate) -> list[str]:
    """The verdict, a line per statement."""
    lines = [_errors_in_words("rows", found, "rows")]
    if found.pieces:
        ny, nx = found.pieces[0].piece.height_m.shape
        lines.append(_errors_in_words(f"squares of {ny} x {nx} cells", found, "pieces"))
    for (colour, wavelength), (thin, edges) in found.orders.items():
        parts = [f"scalar {100 * thin:.2f} %, with edges {100 * edges:.2f} %"]
        means_of = {"cut-outs": found.cut_orders(wavelength), "squares": found.cut_orders(wavelength, "pieces")}
        for name, means in means_of.items():
            if means:
                own = ", ".join(f"{word} {100 * means[kind]:.2f} %" for kind, word in zip(_KINDS, _NAMES, strict=True))
                parts.append(f"on the {name} {own}")
        lines.append(f"0th order, {colour} {wavelength * 1e9:.0f} nm: {'; '.join(parts)}")
    changes = [row["difference"] for row in found.changes()]
    lines.append(f"PSFs with edges differ from scalar ones by {100 * min(changes):.1f} to {100 * max(changes):.1f} %")
    return lines


def _errors_in_words(name: str, found: Certificate, cut: Literal["rows", "pieces"]) -> str:
    unsettled = max(float(one.unsettled.max()) for one in getattr(found, cut))
    return (
        f"{name} against Maxwell's equations: thin off by up to {100 * found.worst('scalar', cut):.1f} %, "
        f"with edges {100 * found.worst('edges', cut):.2f} % (rigorous orders settled to {100 * unsettled:.2g} %)"
    )


def _record(found: Certificate) -> dict[str, Any]:
    rows = [
        {
            "axis": one.row.axis,
            "order": one.orders.number.tolist(),
            **_solved_record(one, one.row, p),
            "polarisation": polarisation,
        }
        for one in found.rows
        for p, polarisation in enumerate(POLARISATIONS)
    ]
    pieces = [
        {**_solved_record(one, one.piece, p), "polarisation": polarisation}
        for one in found.pieces
        for p, polarisation in enumerate(CROSSED_POLARISATIONS)
    ]
    whole = [
        {
            "colour": colour,
            "wavelength_m": wavelength,
            "zeroth_order_scalar": thin,
            "zeroth_order_edges": edges,
            "rows": found.cut_orders(wavelength),
            "pieces": found.cut_orders(wavelength, "pieces"),
        }
        for (colour, wavelength), (thin, edges) in found.orders.items()
    ]
    verdict = in_words(found)
    return {"rows": rows, "pieces": pieces, "whole": whole, "psfs": found.changes(), "verdict": verdict}


def _solved_record(one: CertifiedRow | CertifiedPiece, cut: Row | Piece, p: int) -> dict[str, Any]:
    """Keys that rows and squares share, for polarisation number `p`; the 0th order lies in the middle."""
    orders = one.orders
    return {
        "centre_y_m": cut.centre_m[0],
        "centre_x_m": cut.centre_m[1],
        "height_m": cut.height_m.tolist(),
        "wavelength_m": one.wavelength_m,
        "scalar": orders.scalar.tolist(),
        "edges": orders.edges[p].tolist(),
        "rigorous": orders.rigorous[p].tolist(),
        "energy": float(orders.energy[p]),
        "error_scalar": float(orders.error(orders.scalar)[p]),
        "error_edges": float(orders.error(orders.edges)[p]),
        "unsettled": float(one.unsettled[p]),
    }
