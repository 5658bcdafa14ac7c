"""The verdict of a certificate on 0th orders, as far as it belongs to a design."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_json, sha256_file
from fab.runsheet.tables import CertifiedOrder
from fab.units import NM

CERTIFICATE, CERTIFICATE_FILE = "certificate", "certificate.json"

log = logging.getLogger("doedesign")


class _CutOuts(BaseModel):
    scalar: float
    edges: float
    rigorous: float


class _Whole(BaseModel):
    colour: str
    wavelength_m: float
    zeroth_order_scalar: float
    zeroth_order_edges: float
    rows: _CutOuts


class _Record(BaseModel):
    """Keys of a certificate that are relied upon."""

    whole: list[_Whole]


class _Listed(BaseModel):
    """Keys of its manifest that are."""

    level_map_sha256: str
    results_sha256: dict[str, str]


def certified_orders(folder: Path | None, level_map_sha256: str) -> tuple[CertifiedOrder, ...]:
    """Return the 0th orders of the certificate in a run's folder, per colour and wavelength.

    There are none without a folder, without a certificate in it, and where that is of another level map than the one of
    the digest; the latter is said.

    Raises:
        InputError: a certificate that cannot be read, or was changed since.
    """
    if folder is None or not (folder / CERTIFICATE / MANIFEST_NAME).is_file():
        return ()
    file, manifest = folder / CERTIFICATE / CERTIFICATE_FILE, folder / CERTIFICATE / MANIFEST_NAME
    cure = f"Make it again (doedesign certify {folder}), or remove {file.parent}."
    try:
        listed = _Listed.model_validate(read_json(manifest))
        if listed.level_map_sha256 != level_map_sha256:
            log.info(f"{file.parent} is the certificate of another level map and is left aside")
            return ()
        if sha256_file(file) != listed.results_sha256.get(CERTIFICATE_FILE):
            raise InputError(str(file), "must be the file that certify wrote", "a changed file", cure)
        whole = _Record.model_validate(read_json(file)).whole
    except ValidationError as error:
        found = error.errors(include_url=False)[0]
        key = ".".join(map(str, found["loc"]))
        raise InputError(f"{file.parent}: {key}", found["msg"], repr(found["input"])[:60], cure) from error
    return tuple(
        CertifiedOrder(
            one.colour,
            one.wavelength_m,
            one.zeroth_order_scalar,
            one.zeroth_order_edges,
            one.rows.scalar,
            one.rows.edges,
            one.rows.rigorous,
        )
        for one in whole
    )


def with_verdict(rows: Sequence[dict[str, Any]], orders: Sequence[CertifiedOrder]) -> list[dict[str, Any]]:
    """Return rows of metrics, of one colour each, with the certified 0th orders of their colour under "certified"."""
    return [
        {**row, "certified": [one._asdict() for one in orders if one.colour == row["colour"]]} if orders else row
        for row in rows
    ]


def verdict_in_words(orders: Sequence[CertifiedOrder]) -> list[str]:
    """One line per 0th order."""
    return [
        f"0th order, {one.colour} {one.wavelength_m / NM:.0f} nm: scalar {100 * one.scalar:.2f} %, with edges "
        f"{100 * one.edges:.2f} %; on cut-outs scalar {100 * one.cut_scalar:.2f} %, with edges "
        f"{100 * one.cut_edges:.2f} %, rigorous {100 * one.cut_rigorous:.2f} %"
        for one in orders
    ]
