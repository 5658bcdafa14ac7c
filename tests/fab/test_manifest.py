import json

import pytest

from fab.aperture import diameter_of
from fab.errors import InputError
from fab.files import canonical_json, sha256_bytes
from fab.manifest.records import read_manifest
from fab.order.verify import verify

# A few bytes that stand for gigabytes.
WIDE_MASK = {"shape": [20000, 20000], "pitch": 1e-3, "inset": 0, "rows": [[20000]]}


def rewrite(folder, change):
    """Change the manifest and sign it again, as a careless tool would."""
    path = folder / "manifest.json"
    data = json.loads(path.read_bytes())
    del data["sha256"]
    change(data)
    path.write_bytes(canonical_json({**data, "sha256": sha256_bytes(canonical_json(data))}))


def test_it_reads_back_to_the_same_bytes(written_order):
    assert read_manifest(written_order).to_json() == (written_order / "manifest.json").read_bytes()


def test_it_knows_its_staircase_raster_and_aperture(written_order, levels, grid):
    manifest = read_manifest(written_order)
    assert manifest.staircase() == levels
    assert manifest.grid() == grid
    assert diameter_of(manifest.relief) == pytest.approx(grid.extent_m[1], rel=1e-12)
    assert manifest.source == {"height_map": "a test"}


def test_any_change_by_hand_is_noticed(order_folder):
    path = order_folder / "manifest.json"
    path.write_text(path.read_text().replace('"depth_nm": 600.0', '"depth_nm": 900.0'))
    with pytest.raises(InputError, match="digest that it states"):
        read_manifest(order_folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="other"), 'the format must be "doedesign mask order 2"'),
        (lambda d: d.pop("chrome"), "'chrome'"),
        (lambda d: d.update(extra=1), "'extra'"),
        (lambda d: d["masks"][1].pop("bit"), r"masks\[1\].*'bit'"),
        (lambda d: d.update(pitch_um="1.85"), "pitch_um"),
        (lambda d: d.update(levels=True), "levels"),
        (lambda d: d.update(levels=65), "whole number from 2 to 64"),
        (lambda d: d.update(levels=8), "fit the levels"),
        (lambda d: d.update(shape=[3]), "fit the levels"),
        (lambda d: d.update(shape=[0, 3]), "grid"),
        (lambda d: d.update(aperture_mm=WIDE_MASK), "one of 20000 x 20000 cells for a raster of 21 x 16"),
        (lambda d: d.update(shape=[10**400, 40]), "finite"),
        (lambda d: d.update(shape=[10**200, 40]), "at most 268435456 pixels"),
        (lambda d: d.update(shape=[-(10**200), -(10**200)]), "pixel"),
        (lambda d: d.update(shape=[30_000, 30_000], pitch_um=0.01), "at most 268435456 pixels"),
        (lambda d: d["masks"][0].update(edge_move_nm=1e300), "moved by at most 200000 nm"),
        (lambda d: d["chrome"].update(outer_diameter_mm=10**400), "finite"),
        (lambda d: d.update(masks={}), "masks"),
        (lambda d: d.update(preview="../../etc/passwd"), "plain name"),
        (lambda d: d.update(preview="unlisted.png"), "plain name"),
    ],
)
def test_what_is_no_manifest_of_an_order_is_refused(order_folder, change, message):
    rewrite(order_folder, change)
    with pytest.raises(InputError, match=message):
        read_manifest(order_folder)


def test_a_missing_manifest_is_named(tmp_path):
    with pytest.raises(InputError, match=r"manifest\.json: the file must exist"):
        read_manifest(tmp_path)


def test_a_request_with_a_mask_of_another_raster_is_refused(order_folder):
    rewrite(order_folder, lambda d: d["request"]["level_map"].update(aperture_m=WIDE_MASK))
    with pytest.raises(InputError, match="one of 20000 x 20000 cells for a raster of 21 x 16"):
        verify(order_folder)
