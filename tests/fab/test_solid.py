import math

import cadquery
import numpy as np
import pytest

from fab.aperture import RectangularAperture, RoundAperture
from fab.errors import InputError
from fab.solids.step import step_bodies
from fab.solids.substrate import (
    ChromeFilm,
    Rings,
    Substrate,
    substrate_bodies,
    substrate_step,
    wafer_bodies,
    wafer_step,
)
from fab.units import MM, NM, UM

DIE = Substrate("die", 10 * MM, 0.5 * MM)
WAFER = Substrate("wafer", 100 * MM, 0.5 * MM)
FLAT = Substrate("wafer", 100 * MM, 0.5 * MM, 32.5 * MM)
CHROME = ChromeFilm(RoundAperture(2 * 2.195 * MM), 3.7 * MM)
APERTURE = RoundAperture(4.4 * MM)
# The kernel integrates planes and cylinders in closed form; what is left is float64 of millimetres in text.
CLOSE = 1e-12


def volumes(bodies):
    return {name: body.volume_m3 for name, body in bodies.items()}


def some_rings(count=60, aperture_m=APERTURE.diameter_m):
    outer = np.arange(1, count + 1) * aperture_m / 2 / count
    return Rings(outer, np.random.default_rng(5).integers(0, 16, count) * 75 * NM, 1125 * NM)


def shapes_of(path):
    parts = {}
    for shape, name, place, _ in cadquery.Assembly.importStep(str(path)):
        parts.setdefault(name.split("/")[1], []).append(shape.located(place))
    return {name: cadquery.Compound.makeCompound(shapes) for name, shapes in parts.items()}


def sizes(shape):
    box = shape.BoundingBox(1e-9)
    return [box.xmin, box.xmax, box.ymin, box.ymax, box.zmin, box.zmax]


@pytest.mark.parametrize("substrate", [DIE, WAFER, FLAT], ids=["die", "wafer", "wafer with a flat"])
@pytest.mark.parametrize("rings", [None, some_rings()], ids=["flat", "radial"])
def test_a_plate_reads_back_with_the_volumes_of_closed_form(tmp_path, substrate, rings):
    substrate_step(tmp_path / "p.step", substrate, APERTURE, CHROME, rings)
    want = volumes(substrate_bodies(substrate, CHROME, rings))
    assert volumes(step_bodies(tmp_path / "p.step")) == pytest.approx(want, rel=CLOSE)
    assert want["CHROME"] == pytest.approx(math.pi * (3.7**2 - 2.195**2) * 1e-4 * 1e-9, rel=1e-14)


@pytest.mark.parametrize("opening", [RoundAperture(4 * MM), RectangularAperture((3 * MM, 2 * MM))])
def test_chrome_fills_a_square_but_for_its_opening_and_what_is_left_bare(tmp_path, opening):
    window = (-2 * MM, -4.9 * MM, 3 * MM, -4.5 * MM)
    film = ChromeFilm(opening, 3.7 * MM, edge_m=10 * MM, bare_m=(window,))
    substrate_step(tmp_path / "p.step", DIE, opening, film)
    body = substrate_bodies(DIE, film)["CHROME"]
    area = 100 - opening.area_m2 / MM**2 - 2.0
    assert body.volume_m3 == pytest.approx(area * 1e-4 * MM**3, rel=1e-14)
    # The window of 2 mm2 lies about 0.5, -4.7.
    assert body.centre_m == pytest.approx((-2 * 0.5 / area * MM, 2 * 4.7 / area * MM, 50 * NM), rel=1e-14)
    found = step_bodies(tmp_path / "p.step")["CHROME"]
    assert found.volume_m3 == pytest.approx(body.volume_m3, rel=CLOSE)
    assert found.centre_m == pytest.approx(body.centre_m, abs=1e-15)
    assert sizes(shapes_of(tmp_path / "p.step")["CHROME"]) == pytest.approx([-5, 5, -5, 5, 0, 1e-4], abs=1e-9)


def test_volumes_of_closed_form_by_hand():
    # Two rings of 1 and 2 mm, 1 um and 0.5 um deep.
    rings = Rings(np.array([1 * MM, 2 * MM]), np.array([0.0, 0.5 * UM]), 1 * UM)
    assert rings.removed.volume_m3 == pytest.approx(math.pi * (1 * 1e-3 + 3 * 0.5e-3) * 1e-9, rel=1e-14)
    assert volumes(substrate_bodies(DIE, None, rings)) == pytest.approx(
        {"SUBSTRATE": 50e-9 - rings.removed.volume_m3}, rel=1e-14
    )
    # The cut-off segment by its chord: half of the wafer if the flat is the diameter, almost.
    half = Substrate("wafer", 2 * MM, MM, 2 * MM * (1 - 1e-15))
    assert half.area_m2 == pytest.approx(math.pi / 2 * 1e-6, rel=1e-6)


def test_the_relief_is_measured_and_not_only_the_bulk(tmp_path):
    rings, bare = some_rings(), volumes(substrate_bodies(DIE))["SUBSTRATE"]
    substrate_step(tmp_path / "p.step", DIE, APERTURE, None, rings)
    removed = bare - volumes(step_bodies(tmp_path / "p.step"))["SUBSTRATE"]
    # The relief is 2e-4 of the glass, so it comes out with four digits less.
    assert removed == pytest.approx(rings.removed.volume_m3, rel=1e-8)


@pytest.mark.parametrize("substrate", [DIE, WAFER, FLAT], ids=["die", "wafer", "wafer with a flat"])
def test_every_part_has_its_centre_of_mass_where_closed_form_puts_it(tmp_path, substrate):
    for rings in (None, some_rings()):
        substrate_step(tmp_path / "p.step", substrate, APERTURE, CHROME, rings)
        found, want = step_bodies(tmp_path / "p.step"), substrate_bodies(substrate, CHROME, rings)
        for name, body in want.items():
            # A hundredth of a nanometre: the kernel keeps 1e-12 of what is 50 mm large.
            assert found[name].centre_m == pytest.approx(body.centre_m, abs=1e-11)
    # A semidisc lies 4 R / 3 pi off its diameter.
    half = Substrate("wafer", 2 * MM, MM, 2 * MM * (1 - 1e-15))
    assert half.body.centre_m[1] == pytest.approx(4 * MM / (3 * math.pi), rel=1e-6)
    # 100 um^2 of ring 1 um deep, taken from a cube of 1 mm: its middle sinks.
    rings = Rings(np.array([0.1 * MM]), np.array([0.0]), 1 * UM)
    cube, gone = Substrate("die", MM, MM), math.pi * 1e-8 * 1e-6
    want = (-0.5e-3 * 1e-9 + 0.5e-6 * gone) / (1e-9 - gone)
    assert substrate_bodies(cube, None, rings)["SUBSTRATE"].centre_m[2] == pytest.approx(want, rel=1e-15)


@pytest.mark.parametrize("wafer", [WAFER, FLAT], ids=["round", "with a flat"])
def test_a_wafer_carries_the_chrome_of_every_die(tmp_path, wafer):
    places = [(-10 * MM, 5 * MM), (0.0, 0.0), (20 * MM, -30 * MM)]
    wafer_step(tmp_path / "w.step", wafer, APERTURE, CHROME, places)
    found, want = step_bodies(tmp_path / "w.step"), wafer_bodies(wafer, CHROME, places)
    assert set(found) == set(want) == {"SUBSTRATE", "CHROME"}
    for name, body in want.items():
        assert found[name].volume_m3 == pytest.approx(body.volume_m3, rel=CLOSE)
        assert found[name].centre_m == pytest.approx(body.centre_m, abs=1e-11)
    shapes = shapes_of(tmp_path / "w.step")
    rings = [solid.Center().toTuple()[:2] for solid in shapes["CHROME"].Solids()]
    discs = [face.Center().toTuple()[:2] for face in shapes["DATUM_RELIEF"].Faces()]
    for got in (rings, discs):
        assert np.array(sorted(got)) == pytest.approx(np.array([(-10, 5), (0, 0), (20, -30)]), abs=1e-9)


@pytest.mark.parametrize("place", [(0.0, 46.5 * MM), (0.0, -43.8 * MM)], ids=["rim", "flat"])
def test_a_die_beyond_the_wafer_is_refused(tmp_path, place):
    size = rf"a chrome of {2e3 * CHROME.outer_m:g} mm at "
    with pytest.raises(InputError, match=f"the dies must lie on it, but got {size}"):
        wafer_step(tmp_path / "w.step", FLAT, APERTURE, CHROME, [place])
    assert not list(tmp_path.iterdir())


def test_parts_lie_at_the_datum(tmp_path):
    substrate_step(tmp_path / "p.step", DIE, APERTURE, CHROME, some_rings())
    shapes = shapes_of(tmp_path / "p.step")
    assert set(shapes) == {"SUBSTRATE", "CHROME", "DATUM_RELIEF"}
    # The kernel's boxes are wider than the shape by its tolerance, 1e-7 mm.
    assert sizes(shapes["SUBSTRATE"]) == pytest.approx([-5, 5, -5, 5, -0.5, 0], abs=1e-6)
    assert sizes(shapes["CHROME"]) == pytest.approx([-3.7, 3.7, -3.7, 3.7, 0, 1e-4], abs=1e-6)
    assert sizes(shapes["DATUM_RELIEF"]) == pytest.approx([-2.2, 2.2, -2.2, 2.2, 0, 0], abs=1e-6)
    assert shapes["DATUM_RELIEF"].Area() == pytest.approx(math.pi * 2.2**2, rel=CLOSE)
    substrate_step(tmp_path / "w.step", FLAT, APERTURE)
    low_y = -math.sqrt(50**2 - 16.25**2)
    assert sizes(shapes_of(tmp_path / "w.step")["SUBSTRATE"])[2:4] == pytest.approx([low_y, 50], abs=1e-6)


def test_a_flat_plate_has_the_relief_as_a_face(tmp_path):
    substrate_step(tmp_path / "p.step", DIE, APERTURE)
    areas = sorted(face.Area() for face in shapes_of(tmp_path / "p.step")["SUBSTRATE"].Faces())
    disc = math.pi * 2.2**2
    assert areas == pytest.approx([5, 5, 5, 5, disc, 100 - disc, 100], rel=CLOSE)


def test_every_ring_is_a_flat_face_at_its_height(tmp_path):
    heights = np.array([0, 0, 15, 3, 3, 0, 15, 7]) * 75 * NM
    rings = Rings(np.arange(1, 9) * 0.2 * MM, heights, 1125 * NM)
    substrate_step(tmp_path / "p.step", DIE, APERTURE, None, rings)
    faces = shapes_of(tmp_path / "p.step")["SUBSTRATE"].Faces()
    walls = [face for face in faces if face.geomType() == "CYLINDER"]
    # Rings of equal height are one face; the surface around the relief is the last one.
    radii = [(0, 2), (2, 3), (3, 5), (5, 6), (6, 7), (7, 8)]
    depths = [1125, 0, 900, 1125, 0, 600]
    areas = [math.pi * 0.04 * (b * b - a * a) for a, b in radii]
    rest = 100 - math.pi * 1.6**2
    flat = [face for face in faces if face.geomType() == "PLANE" and face.Center().z > -0.01]
    found = sorted((round(-face.Center().z * 1e6), face.Area()) for face in flat)
    want = sorted([*zip(depths, areas, strict=True), (0, rest)])
    assert [depth for depth, _ in found] == [depth for depth, _ in want]
    assert [area for _, area in found] == pytest.approx([area for _, area in want], rel=CLOSE)
    assert len(walls) == 6


@pytest.mark.parametrize("heights", [[15] * 4, [0] * 4, [15, 0, 15, 15], [0]], ids=str)
def test_awkward_profiles(tmp_path, heights):
    count = len(heights)
    rings = Rings(np.arange(1, count + 1) * 2.2 * MM / count, np.array(heights) * 75 * NM, 1125 * NM)
    substrate_step(tmp_path / "p.step", DIE, APERTURE, None, rings)
    assert volumes(step_bodies(tmp_path / "p.step")) == pytest.approx(
        volumes(substrate_bodies(DIE, None, rings)), rel=CLOSE
    )


def test_nanometre_rings_and_steps_survive(tmp_path):
    # Ten thousand times finer than the die is wide, and steps of 1 nm.
    rings = Rings(np.arange(1, 200) * 20 * NM, np.arange(1, 200) % 2 * NM, 1 * NM)
    substrate_step(tmp_path / "p.step", DIE, APERTURE, None, rings)
    removed = volumes(substrate_bodies(DIE))["SUBSTRATE"] - volumes(step_bodies(tmp_path / "p.step"))["SUBSTRATE"]
    # 2.5e-20 m3 of 5e-8 m3: less than the last digit of the volume of the glass.
    assert removed == pytest.approx(rings.removed.volume_m3, abs=5e-8 * 1e-14)
    planes = [f for f in shapes_of(tmp_path / "p.step")["SUBSTRATE"].Faces() if f.geomType() == "PLANE"]
    assert len(planes) == 6 + 199  # those of the die and one per ring


def test_the_same_plate_gives_the_same_bytes_whatever_was_written_before(tmp_path):
    for name in ("a", "b"):
        substrate_step(tmp_path / f"{name}.step", DIE, APERTURE, CHROME, some_rings(12))
        # The kernel counts its products from file to file.
        substrate_step(tmp_path / "other.step", WAFER, APERTURE, CHROME)
    content = (tmp_path / "a.step").read_bytes()
    assert content == (tmp_path / "b.step").read_bytes()
    header = content[: content.index(b"DATA;")].decode()
    assert "FILE_NAME('DOE','2000-01-01T00:00:00'" in header
    assert "Open CASCADE" not in header.replace("Open CASCADE Model", "")
    assert str(tmp_path) not in header
    assert b"SI_UNIT(.MILLI.,.METRE.)" in content


def test_writing_prints_nothing(tmp_path, capfd):
    substrate_step(tmp_path / "p.step", DIE, APERTURE)
    volumes(step_bodies(tmp_path / "p.step"))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Substrate("die", 0.0, MM), "substrate width"),
        (lambda: Substrate("die", MM, math.nan), "substrate thickness"),
        (lambda: Substrate("die", 10 * MM, MM, MM), "a die has none"),
        (lambda: Substrate("wafer", 10 * MM, MM, 10 * MM), "shorter than the diameter"),
        (lambda: ChromeFilm(RoundAperture(2 * 2 * MM), 2 * MM), "make a ring"),
        (lambda: ChromeFilm(RoundAperture(2 * 1 * MM), 2 * MM, 0.0), "make a ring"),
        (lambda: Rings(np.array([2.0, 1.0]) * MM, np.zeros(2), UM), "at least 0.3 nm wide"),
        (lambda: Rings(np.array([MM]), np.zeros(2), UM), "one length"),
        (lambda: Rings(np.array([MM]), np.array([2 * UM]), UM), "heights must lie"),
        (lambda: Rings(np.array([MM]), np.array([UM - 0.1 * NM]), UM), "at least 0.3 nm high"),
    ],
)
def test_impossible_parts_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.parametrize(
    ("substrate", "relief", "chrome", "rings", "words"),
    [
        (DIE, RoundAperture(10 * MM), None, None, "relief"),
        (DIE, RoundAperture(-MM), None, None, "relief"),
        (DIE, APERTURE, ChromeFilm(RoundAperture(2 * 2 * MM), 5.1 * MM), None, "chrome"),
        (Substrate("wafer", 10 * MM, MM, 8 * MM), APERTURE, CHROME, None, "circle of 6 mm"),
        (DIE, RoundAperture(4.3 * MM), None, some_rings(), "inside the relief"),
        (Substrate("die", 10 * MM, UM), APERTURE, None, some_rings(), "less deep"),
        # The corners of a rectangle decide, and rings need a circle.
        (Substrate("die", 4.9 * MM, MM), RectangularAperture((4 * MM, 3 * MM)), None, None, "relief"),
        (DIE, RectangularAperture((4 * MM, 4 * MM)), None, some_rings(), "must be round here"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, substrate, relief, chrome, rings, words):
    with pytest.raises(InputError, match=words):
        substrate_step(tmp_path / "p.step", substrate, relief, chrome, rings)
    assert not list(tmp_path.iterdir())


def test_damaged_and_missing_step_files_are_refused(tmp_path, capfd):
    path = tmp_path / "p.step"
    with pytest.raises(InputError, match="must exist"):
        volumes(step_bodies(path))
    path.write_bytes(b"ISO-10303-21;\nnothing of the kind\n")
    with pytest.raises(InputError, match="must be STEP"):
        volumes(step_bodies(path))
    assert capfd.readouterr() == ("", "")


def test_a_wrong_unit_in_the_file_is_found(tmp_path):
    path = tmp_path / "p.step"
    substrate_step(path, DIE, APERTURE, CHROME)
    path.write_bytes(path.read_bytes().replace(b"SI_UNIT(.MILLI.,.METRE.)", b"SI_UNIT(.CENTI.,.METRE.)"))
    want = {name: 1000 * volume for name, volume in volumes(substrate_bodies(DIE, CHROME)).items()}
    assert volumes(step_bodies(path)) == pytest.approx(want, rel=CLOSE)
