import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from fab.errors import CheckFailed, InputError
from fab.files import canonical_json, sha256_bytes, sha256_file
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.geometry import Cell, Layer, Layout, Shapes, pixel_edges
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.verify import verify
from fab.verification.files import read_drawn_levels
from tests.fab.maps import SMALL

MASKS = [
    f"{SMALL}_ALL.gds",
    f"{SMALL}_ALL.oas",
    f"{SMALL}_CHROME.gds",
    f"{SMALL}_M1_75NM.gds",
    f"{SMALL}_M2_150NM.gds",
    f"{SMALL}_M3_300NM.gds",
    f"{SMALL}_M4_600NM.gds",
]


def problems_of(folder, file, question=""):
    found = [c for c in verify(folder).checks if c.file == file and question in c.question]
    return [problem for check in found for problem in check.problems]


def flip(path, place, mask=0x01):
    data = bytearray(path.read_bytes())
    data[place] ^= mask
    path.write_bytes(data)


def redraw(folder, file, change):
    """Write a mask file again with other shapes."""
    layout = read_gds(folder / file)
    doe, *around = layout.cells
    write_gds(folder / file, Layout(layout.dbu_m, (replace(doe, shapes=change(doe.shapes)), *around)))


def test_a_whole_order_passes_every_question(written_order):
    report = verify(written_order)
    assert report.passed
    assert report.differences == ()
    report.require()
    asked = {(check.file, check.question) for check in report.checks}
    for file in MASKS:
        assert (file, "bytes as in the manifest") in asked
        assert (file, "gdstk, every pixel") in asked
        assert file.endswith(".oas") or (file, "own reader, every pixel") in asked


@pytest.mark.parametrize(
    ("file", "where"),
    [(file, 0.05 + 0.11 * i) for i, file in enumerate([*MASKS, f"{SMALL}_LEVELS.npy", f"{SMALL}_PREVIEW.png"])],
)
def test_one_flipped_byte_fails_and_names_the_file(order_folder, file, where):
    path = order_folder / file
    flip(path, int(where * path.stat().st_size), 0x10)
    report = verify(order_folder)
    assert not report.passed
    assert all(difference.startswith(file) for difference in report.differences)
    with pytest.raises(CheckFailed, match=file):
        report.require()


@pytest.mark.parametrize("where", [0.0, 0.1, 0.37, 0.5, 0.63, 0.9, 0.9999])
def test_one_flipped_byte_in_every_file_names_them_all(order_folder, where):
    files = [*MASKS, f"{SMALL}_PREVIEW.png"]
    for file in files:
        flip(order_folder / file, int(where * (order_folder / file).stat().st_size), 0x10)
    assert {difference.partition(":")[0] for difference in verify(order_folder).differences} == set(files)


@pytest.mark.slow
def test_every_single_byte_of_a_mask_file_counts(order_folder):
    path = order_folder / MASKS[3]
    whole = path.read_bytes()
    # The opening and the first cell densely, the rest wherever it falls.
    places = {*range(0, 700, 41), *np.linspace(700, len(whole) - 1, 20).astype(int).tolist()}
    for place in sorted(places):
        flip(path, place, 0x40)
        assert any(MASKS[3] in difference for difference in verify(order_folder).differences)
        path.write_bytes(whole)


@pytest.mark.slow
@pytest.mark.parametrize("file", [MASKS[0], MASKS[4]])
def test_a_missing_pixel_is_located_by_both_readers(order_folder, file):
    gone = []

    def without_last(shapes):
        layer = Layer(2)
        gone.extend(shapes[layer].rectangles[-1].tolist())
        return {**shapes, layer: Shapes(shapes[layer].rectangles[:-1], shapes[layer].polygons)}

    redraw(order_folder, file, without_last)
    manifest = read_manifest(order_folder)
    edges = pixel_edges(manifest.grid())
    row, column = int(np.searchsorted(edges.y, gone[1])), int(np.searchsorted(edges.x, gone[0]))
    pixels = (gone[2] - gone[0]) * (gone[3] - gone[1]) // 1850**2
    told = f"layer 2/0: {pixels} pixel"
    place = f"from the level map, the first at row {row}, column {column}"
    for question in ("own reader", "gdstk"):
        problems = problems_of(order_folder, file, question)
        assert any(problem.startswith(told) and problem.endswith(place) for problem in problems), problems
    assert any("bytes instead of" in problem for problem in problems_of(order_folder, file, "bytes"))


def test_overlaps_strays_other_shapes_and_other_layers_are_named(order_folder):
    def spoil(shapes):
        layer = Layer(1)
        rects = shapes[layer].rectangles
        stray = rects[:1] + np.array([[1, 0, 1, 0]], dtype=np.int32)
        pentagon = np.array([[0, 0], [1850, 0], [1850, 1850], [900, 2000], [0, 1850]], dtype=np.int32)
        spoiled = Shapes(np.concatenate([rects, rects[:1], stray]), (pentagon,))
        return {layer: spoiled, Layer(9): Shapes(rects[:2])}

    redraw(order_folder, MASKS[3], spoil)
    own = " ".join(problems_of(order_folder, MASKS[3], "own reader"))
    other = " ".join(problems_of(order_folder, MASKS[3], "gdstk"))
    for words in ("covered more than once", "shapes are no rectangles"):
        assert words in own
        assert words in other
    assert "layer 9/0: 2 shapes on a layer that should be empty" in own
    assert "1 rectangles are off the pixel raster" in own
    assert "3 polygons more or less" in own


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p[:-1], "chrome polygons instead of"),
        (lambda p: (p[0] + 3, *p[1:]), "lie on neither of the two circles"),
        (lambda p: (p[0], p[0], *p[2:]), "leaves its circle by"),
        (lambda p: (np.concatenate([p[0][:1], p[0][-1:], p[0][1:-1]]), *p[1:]), "chrome area is off"),
    ],
    ids=["missing", "moved", "doubled", "crossed"],
)
def test_a_chrome_that_is_no_annulus_is_told(order_folder, change, words):
    redraw(order_folder, MASKS[2], lambda s: {Layer(5): Shapes(s[Layer(5)].rectangles, change(s[Layer(5)].polygons))})
    for question in ("own reader", "gdstk"):
        assert any(words in problem for problem in problems_of(order_folder, MASKS[2], question))


def around(layout, name, change):
    """The layout with one of the cells around the DOE changed."""
    cells = (replace(cell, **change(cell)) if cell.name == f"{SMALL}{name}" else cell for cell in layout.cells)
    return replace(layout, cells=tuple(cells))


def mirrored(cell):
    flipped = {}
    for layer, shapes in cell.shapes.items():
        rects = shapes.rectangles[:, [2, 1, 0, 3]] * np.array([-1, 1, -1, 1], dtype=np.int32)
        flipped[layer] = Shapes(rects, shapes.polygons)
    return {"shapes": flipped}


def one_moved(cell):
    layer, shapes = next(iter(cell.shapes.items()))
    rects = shapes.rectangles.copy()
    rects[0] += 1
    return {"shapes": {**cell.shapes, layer: Shapes(rects, shapes.polygons)}}


def relayered(cell):
    return {"shapes": {Layer(layer.number, 9): shapes for layer, shapes in cell.shapes.items()}}


def shifted(cell):
    return {"references": tuple(replace(reference, x=reference.x + 1) for reference in cell.references)}


@pytest.mark.parametrize(
    ("cell", "change", "words"),
    [
        ("_SITE", mirrored, f"cell {SMALL}_SITE: layer 1/1"),
        ("_SITE", one_moved, "or elsewhere"),
        ("_DIE", relayered, "is missing"),
        ("_WAFER", shifted, f"cell {SMALL}_WAFER: it places other cells, or elsewhere"),
        ("_DIE", shifted, f"cell {SMALL}_DIE: it places other cells, or elsewhere"),
        ("_TEST", lambda cell: {"name": "OTHER"}, "OTHER"),
    ],
    ids=["mirrored marks", "a nanometre", "another datatype", "dies elsewhere", "DOE off its die", "another name"],
)
def test_whatever_changes_around_the_doe_is_told_by_both_readers(order_folder, cell, change, words):
    layout = around(read_gds(order_folder / MASKS[0]), cell, change)
    if words == "OTHER":
        wafer = layout.cell(f"{SMALL}_WAFER")
        assert wafer is not None
        renamed = tuple(replace(r, cell="OTHER") if r.cell == f"{SMALL}_TEST" else r for r in wafer.references)
        layout = around(layout, "_WAFER", lambda _: {"references": renamed})
    write_gds(order_folder / MASKS[0], layout)
    for question in ("own reader", "gdstk"):
        assert any(words in problem for problem in problems_of(order_folder, MASKS[0], question))


def test_an_altered_oasis_file_that_still_parses_is_compared_pixel_by_pixel(order_folder, tmp_path):
    import klayout.db as kdb

    layout = kdb.Layout()
    layout.read(str(order_folder / MASKS[1]))
    shapes = layout.cell(f"{SMALL}_DOE").shapes(layout.find_layer(3, 0))
    shapes.clear()
    options = kdb.SaveLayoutOptions()
    options.format = "OASIS"
    layout.write(str(order_folder / MASKS[1]), options)
    problems = problems_of(order_folder, MASKS[1])
    assert any(problem.startswith("layer 3/0:") and "from the level map" in problem for problem in problems)


def test_another_cell_name_or_unit_is_told(order_folder):
    layout = read_gds(order_folder / MASKS[3])
    write_gds(order_folder / MASKS[3], Layout(2e-9, (*layout.cells[:-1], replace(layout.top, name="OTHER"))))
    problems = " ".join(problems_of(order_folder, MASKS[3]))
    assert f"named 'OTHER' instead of '{SMALL}_M1_75NM'" in problems
    assert "database unit is 2 nm instead of 1 nm" in problems


def test_a_swapped_mask_file_fails(order_folder):
    shutil.copy(order_folder / MASKS[3], order_folder / MASKS[4])
    problems = " ".join(problems_of(order_folder, MASKS[4]))
    assert "layer 1/0" in problems
    assert "layer 2/0" in problems


def test_missing_cut_and_unlisted_files_are_named(order_folder):
    (order_folder / MASKS[3]).unlink()
    (order_folder / MASKS[4]).write_bytes((order_folder / MASKS[4]).read_bytes()[:500])
    shutil.copy(order_folder / MASKS[5], order_folder / "EXTRA.GDS")
    differences = verify(order_folder).differences
    assert f"{MASKS[3]}: bytes as in the manifest: the file is missing" in differences
    assert any(d.startswith(MASKS[4]) and "cannot be read" in d for d in differences)
    assert any(d.startswith("EXTRA.GDS") for d in differences)


def seal(folder, file):
    """State the size and digest of a changed file in the manifest, and the digest of that."""
    manifest = json.loads((folder / "manifest.json").read_text())
    (entry,) = [one for one in manifest["files"] if one["file"] == file]
    entry |= {"bytes": (folder / file).stat().st_size, "sha256": sha256_file(folder / file)}
    del manifest["sha256"]
    manifest["sha256"] = sha256_bytes(canonical_json(manifest))
    (folder / "manifest.json").write_bytes(canonical_json(manifest))


@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_oasis_file_whose_digest_matches_crashes_nothing(order_folder, seed, capfd):
    """Nearly every changed byte of a packed cell crashes gdstk."""
    rng, path = np.random.default_rng(seed), order_folder / f"{SMALL}_ALL.oas"
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data) // 4, len(data) // 2)] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    seal(order_folder, path.name)
    differences = verify(order_folder).differences
    assert differences
    assert {difference.split(":")[0] for difference in differences} == {path.name}
    assert capfd.readouterr() == ("", "")


def test_a_damaged_level_map_does_not_put_the_blame_on_the_masks(order_folder):
    flip(order_folder / f"{SMALL}_LEVELS.npy", -1)
    assert {d.split(":")[0] for d in verify(order_folder).differences} == {f"{SMALL}_LEVELS.npy"}
    (order_folder / f"{SMALL}_LEVELS.npy").write_bytes(b"ruin")
    assert {d.split(":")[0] for d in verify(order_folder).differences} == {f"{SMALL}_LEVELS.npy"}


def test_without_any_level_map_there_is_nothing_to_compare_with(order_folder):
    (order_folder / f"{SMALL}_LEVELS.npy").write_bytes(b"ruin")
    (order_folder / MASKS[3]).write_bytes(b"ruin")
    with pytest.raises(CheckFailed, match=r"LEVELS\.npy"):
        verify(order_folder)


def test_a_damaged_map_and_a_damaged_mask_are_both_told(order_folder):
    flip(order_folder / f"{SMALL}_LEVELS.npy", -1)
    redraw(order_folder, MASKS[0], lambda s: {**s, Layer(1): Shapes(s[Layer(1)].rectangles[1:])})
    files = {d.split(":")[0] for d in verify(order_folder).differences}
    assert {f"{SMALL}_LEVELS.npy", MASKS[0]} <= files


def test_verifying_changes_nothing(order_folder):
    before = {path.name: sha256_file(path) for path in order_folder.iterdir()}
    verify(order_folder)
    assert {path.name: sha256_file(path) for path in order_folder.iterdir()} == before


def test_what_is_no_order_is_refused(tmp_path):
    with pytest.raises(InputError, match="must exist"):
        verify(tmp_path)
    with pytest.raises(InputError, match="must exist"):
        verify(tmp_path / "missing")


def test_a_level_map_is_rebuilt_only_from_separate_pixels(tmp_path):
    levels, edges = Levels(4, 75e-9), pixel_edges(Grid((2, 2), 1e-6))
    rects = np.array([[-1000, -1000, 0, 0], [-1000, -1000, 1000, 0]], dtype=np.int32)
    write_gds(
        tmp_path / "a.gds", Layout(1e-9, (Cell("TOP", {Layer(1): Shapes(rects[:1]), Layer(2): Shapes(rects[1:])}),))
    )
    assert read_drawn_levels([tmp_path / "a.gds"], levels, edges, "TOP").tolist() == [[0, 1], [3, 3]]
    write_gds(tmp_path / "a.gds", Layout(1e-9, (Cell("TOP", {Layer(1): Shapes(rects)}),)))
    with pytest.raises(InputError, match=r"a\.gds: layer 1/0 .*1 pixels covered twice"):
        read_drawn_levels([tmp_path / "a.gds"], levels, edges, "TOP")
