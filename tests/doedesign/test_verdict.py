"""The verdict of a certificate: in the metrics of a run, on the sheet of its order, and nowhere else."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import doedesign.lab.order as lab
from doedesign.runs.level_maps import open_design
from doedesign.runs.verdict import certified_orders, verdict_in_words, with_verdict
from fab.errors import InputError
from fab.files import canonical_json
from fab.order.order import Light
from fab.order.request import order_from, request_of
from fab.runsheet.tables import CertifiedOrder, SheetPrediction
from tests.doedesign.small_runs import SPEC, call, finished_run
from tests.fab.sheets import predictions

ORDER = CertifiedOrder("green", 550e-9, 0.1, 0.12, 0.2, 0.23, 0.24)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with its certificate."""
    run = finished_run(tmp_path_factory.mktemp("verdict"), SPEC)
    code, _, said = call("certify", run, "--cells", 4, "--pieces", 0)
    assert code == 0, said
    return run


def digest_of(run: Path) -> str:
    return open_design(run, False).level_map.digest


def record_of(run: Path) -> dict:
    return json.loads((run / "certificate" / "certificate.json").read_text())


def test_the_verdict_is_that_of_the_certificate(run: Path):
    (one,), (whole,) = certified_orders(run, digest_of(run)), record_of(run)["whole"]
    assert (one.colour, one.wavelength_m) == (whole["colour"], whole["wavelength_m"])
    assert (one.scalar, one.edges) == (whole["zeroth_order_scalar"], whole["zeroth_order_edges"])
    assert (one.cut_scalar, one.cut_edges, one.cut_rigorous) == tuple(
        whole["rows"][kind] for kind in ("scalar", "edges", "rigorous")
    )
    # Every number is one of its own.
    assert len({one.scalar, one.edges, one.cut_scalar, one.cut_edges, one.cut_rigorous}) == 5


def test_there_is_none_for_another_map_or_without_a_certificate(run: Path, tmp_path: Path):
    assert certified_orders(run, "0" * 64) == ()
    assert certified_orders(tmp_path, digest_of(run)) == ()
    assert certified_orders(None, digest_of(run)) == ()


@pytest.mark.slow
def test_psf_puts_it_into_the_metrics(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    code, _, said = call("psf", run)
    assert code == 0, said
    metrics = json.loads((run / "psf" / "metrics.json").read_text())
    wanted = certified_orders(run, digest_of(run))
    assert all(row["certified"] == [one._asdict() for one in wanted] for row in metrics["quantised"])
    assert all("certified" not in row for row in metrics["continuous"])
    assert verdict_in_words(wanted)[0] in said


@pytest.mark.slow
def test_the_run_sheet_of_an_order_has_it(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    code, _, said = call("masks", run, "--out", tmp_path / "order")
    assert code == 0, said
    (sheet,) = (tmp_path / "order").glob("*RUNSHEET.json")
    (row,), (one,) = json.loads(sheet.read_text())["predicted"]["certified"], certified_orders(run, digest_of(run))
    assert row["colour"] == one.colour
    # The sheet has six digits.
    assert [row[key] for key in one._fields[1:]] == pytest.approx(one[1:], rel=1e-5)
    code, _, said = call("verify", tmp_path / "order")
    assert code == 0, said


@pytest.mark.parametrize("levels", [None, 2])
def test_sheets_speak_of_the_map_that_was_certified(run: Path, levels: int | None, monkeypatch: pytest.MonkeyPatch):
    """Drawn with other levels, it is another map. Nothing is written here; the sheet's other numbers are planted."""
    asked: dict[str, Any] = {}
    monkeypatch.setattr(lab, "write_planned", lambda out, order, predict: asked.update(order=order, predict=predict))
    monkeypatch.setattr(lab, "predict_sheet", lambda *_: SheetPrediction(predictions(), lambda: b""))
    lab.write_masks(run, levels=levels)
    seen = asked["predict"](asked["order"]).predictions
    wanted = certified_orders(run, digest_of(run)) if levels is None else ()
    assert seen == replace(predictions(), certified=wanted)
    assert asked["order"].material == "fused silica"
    # A manifest records it, and what it recorded before there were certificates can still be read.
    order = replace(asked["order"], light=Light(seen, "0" * 64))
    request = json.loads(canonical_json(request_of(order)))
    assert order_from(request, order.level_map.level, "manifest").light == order.light
    assert ("certified" in request["light"]["predictions"]) == (levels is None)


def test_a_certificate_that_was_changed_is_refused(run: Path, tmp_path: Path):
    copy = tmp_path / "run" / "certificate"
    copy.mkdir(parents=True)
    for name in ("certificate.json", "manifest.json"):
        (copy / name).write_bytes((run / "certificate" / name).read_bytes())
    file, manifest, digest = copy / "certificate.json", copy / "manifest.json", digest_of(run)
    assert len(certified_orders(tmp_path / "run", digest)) == 1
    file.write_text(file.read_text().replace("scalar", "skalar", 1))
    with pytest.raises(InputError, match="must be the file that certify wrote, but got a changed file"):
        certified_orders(tmp_path / "run", digest)
    listed = json.loads(manifest.read_text())
    del listed["level_map_sha256"]
    manifest.write_text(json.dumps(listed))
    with pytest.raises(InputError, match=r"certificate: level_map_sha256.*doedesign certify"):
        certified_orders(tmp_path / "run", digest)
    manifest.write_text("{")
    with pytest.raises(InputError, match="the file must be JSON"):
        certified_orders(tmp_path / "run", digest)


def test_rows_get_the_orders_of_their_colour():
    rows = [{"colour": "green"}, {"colour": "red"}]
    found = with_verdict(rows, [ORDER])
    assert found == [{"colour": "green", "certified": [ORDER._asdict()]}, {"colour": "red", "certified": []}]
    assert with_verdict([{"colour": "green"}], []) == [{"colour": "green"}]


def test_words_of_an_order():
    assert verdict_in_words([ORDER]) == [
        "0th order, green 550 nm: scalar 10.00 %, with edges 12.00 %; on cut-outs scalar 20.00 %, "
        "with edges 23.00 %, rigorous 24.00 %"
    ]
