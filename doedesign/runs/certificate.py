"""Certificate of a design: what light does at its walls, proved on rows against Maxwell's equations."""

import logging
import math
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

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
from sim.rigorous.certificate import CertifiedRow, certify_rows, cut_rows
from sim.rigorous.edge_optic import with_edges
from sim.rigorous.rows import POLARISATIONS

CELLS = 24  # of a row
_KINDS, _NAMES = ("scalar", "edges", "rigorous"), ("scalar", "with edges", "rigorous")
_FEWEST, _MOST = 4, 64

log = logging.getLogger("doedesign")


class Certificate(NamedTuple):
    """A design as a thin element, with the light of its walls, and by Maxwell's equations.

    Attributes:
        rows: cut-outs at every wavelength, per polarisation.
        orders: 0th order of the whole DOE, by name of the colour and vacuum wavelength (metres): as a thin element, and
            with edges in unpolarised light.
        scalar: PSFs of the thin element, energy per pixel per unit power incident on the clear aperture.
        edges: PSFs with the light of its walls, unpolarised.
    """

    rows: tuple[CertifiedRow, ...]
    orders: dict[tuple[str, float], tuple[float, float]]
    scalar: PsfBank
    edges: PsfBank

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

    def worst(self, kind: str) -> float:
        """Largest relative error (L2) of the orders of a row, as "scalar" light or with "edges"."""
        return max(float(one.orders.error(getattr(one.orders, kind)).max()) for one in self.rows)


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def certify(
    source: Design | Run | str | Path,
    masks: str | Path | None = None,
    *,
    cells: int = CELLS,
    out: str | Path | None = None,
) -> Certificate:
    """Compare what a design does as a thin element, with edges and by Maxwell's equations.

    Rows of cells are cut out of it, on the axis and at four radii, and solved rigorously in both polarisations as
    gratings that repeat. The whole design is computed as a thin element and with edges, which the rows prove.

    Args:
        source: a design, a finished run or its folder.
        masks: mask order of the run, whose files are read; `masks/NAME` if there is one, else the run's own map.
        cells: cells of a row, 4 to 64; time grows with their third power.
        out: folder for the certificate (JSON, SI units) and its picture.

    Raises:
        InputError: something that cannot be read, a number of cells that is too small or too large, or a design without
            relief.
    """
    if not _FEWEST <= cells <= _MOST:
        raise InputError("cells", f"must lie from {_FEWEST} to {_MOST}", cells, f"{CELLS} are usual.")
    design = open_design(source, masks)
    camera, height = design.camera, design.level_map.height_m
    rows = cut_rows(height, camera.grid, camera.aperture_m, min(cells, height.shape[0]))
    if not rows:
        cure = "Certify a design with relief."
        raise InputError(design.name, "must not be flat where rows are cut out", "a flat plate", cure)
    with results_folder(out, design.name, design.folder, level_map_sha256=design.level_map.digest) as folder:
        wavelengths = tuple(dict.fromkeys(line.wavelength_m for line in camera.lines))
        with meter("rows", len(rows) * len(wavelengths)) as progress:
            done = count(1)
            certified = certify_rows(rows, camera, wavelengths, lambda: progress.advance(next(done)))
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
        found = Certificate(certified, orders, scalar, edges)  # type: ignore[arg-type]
        for words in in_words(found):
            log.info(words)
        if folder is not None:
            (folder / "certificate.json").write_bytes(canonical_json(_record(found)))
            save(plot_certificate(found.rows, design.name), folder / "certificate.png")
    return found


def in_words(found: Certificate) -> list[str]:
    """The verdict, a line per statement."""
    unsettled = max(float(one.unsettled.max()) for one in found.rows)
    lines = [
        f"rows against Maxwell's equations: thin off by up to {100 * found.worst('scalar'):.1f} %, "
        f"with edges {100 * found.worst('edges'):.2f} % (rigorous orders settled to {100 * unsettled:.2g} %)"
    ]
    for (colour, wavelength), (thin, edges) in found.orders.items():
        own = [one.orders for one in found.rows if one.wavelength_m == wavelength]
        means = [np.mean([np.mean(o.zeroth(getattr(o, kind))) for o in own]) for kind in _KINDS]
        parts = ", ".join(f"{name} {100 * mean:.2f} %" for name, mean in zip(_NAMES, means, strict=True))
        whole = f"scalar {100 * thin:.2f} %, with edges {100 * edges:.2f} %"
        lines.append(f"0th order, {colour} {wavelength * 1e9:.0f} nm: {whole}; on the cut-outs {parts}")
    changes = [row["difference"] for row in found.changes()]
    lines.append(f"PSFs with edges differ from scalar ones by {100 * min(changes):.1f} to {100 * max(changes):.1f} %")
    return lines


def _record(found: Certificate) -> dict[str, Any]:
    rows = []
    for one in found.rows:
        orders = one.orders
        for p, polarisation in enumerate(POLARISATIONS):
            thin, edges = orders.error(orders.scalar)[p], orders.error(orders.edges)[p]
            rows.append(
                {
                    "axis": one.row.axis,
                    "centre_y_m": one.row.centre_m[0],
                    "centre_x_m": one.row.centre_m[1],
                    "height_m": one.row.height_m.tolist(),
                    "wavelength_m": one.wavelength_m,
                    "polarisation": polarisation,
                    "order": orders.number.tolist(),
                    "scalar": orders.scalar.tolist(),
                    "edges": orders.edges[p].tolist(),
                    "rigorous": orders.rigorous[p].tolist(),
                    "energy": float(orders.energy[p]),
                    "error_scalar": float(thin),
                    "error_edges": float(edges),
                    "unsettled": float(one.unsettled[p]),
                }
            )
    whole = [
        {"colour": colour, "wavelength_m": wavelength, "zeroth_order_scalar": thin, "zeroth_order_edges": edges}
        for (colour, wavelength), (thin, edges) in found.orders.items()
    ]
    return {"rows": rows, "whole": whole, "psfs": found.changes(), "verdict": in_words(found)}
