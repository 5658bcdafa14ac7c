"""The [order] table: text with units into the terms of an order, and blanks that stay blanks."""

from pathlib import Path

import pytest

from doedesign.build import terms_from_spec
from doedesign.spec import load_order, load_spec, spec_digest, spec_from_json, spec_to_json
from fab.errors import InputError
from fab.order.terms import OrderTerms

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
GIVEN = (
    'revision = "B2"\ncontact = "A. Nyberg, +1 555 0100"\nquantity = 2\ncd_tolerance = "0.15 um"\npellicle = "none"\n'
)


def test_a_spec_without_the_table_asks_for_revision_a_and_leaves_blanks():
    spec = load_spec(QUICK)
    assert terms_from_spec(spec.order) == OrderTerms()
    assert "order" not in spec_to_json(spec)


def test_the_table_becomes_terms_and_part_of_the_spec(tmp_path):
    (tmp_path / "spec.toml").write_text(f"{QUICK.read_text()}\n[order]\n{GIVEN}")
    (tmp_path / "terms.toml").write_text(f"[order]\n{GIVEN}")
    wanted = OrderTerms("B2", "A. Nyberg, +1 555 0100", quantity=2, cd_tolerance_m=150e-9, pellicle="none")
    spec = load_spec(tmp_path / "spec.toml")
    assert terms_from_spec(spec.order) == terms_from_spec(load_order(tmp_path / "terms.toml")) == wanted
    assert spec_from_json(spec_to_json(spec), "again") == spec
    assert spec_digest(spec) != spec_digest(load_spec(QUICK))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('revision = "b"', "order.revision: must be one to three capitals"),
        ('contact = ""', "order.contact: must be one line"),
        ("quantity = 0", "order.quantity: must be at least 1"),
        ("cd_tolerance = 0.15", "order.cd_tolerance: "),
        ('cd_tolerance = "15 mm"', "order.cd_tolerance: must lie between"),
        ('colour = "red"', "order.colour: "),
    ],
)
def test_mistakes_are_told_with_their_key(tmp_path, line, words):
    (tmp_path / "terms.toml").write_text(f"[order]\n{line}\n")
    with pytest.raises(InputError, match=words):
        load_order(tmp_path / "terms.toml")
