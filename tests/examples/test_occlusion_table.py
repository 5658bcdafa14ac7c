"""The reference of the table of occlusion models against the package's own wave optics, and rows of the table."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab.grid import Grid
from sim.camera import Camera
from sim.imaging.shadow import shadowed_psf

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from obstructed_light import Obstacle, Rig, picture  # pyright: ignore[reportMissingImports]
from occlusion_table import camera, judge, main  # pyright: ignore[reportMissingImports]

# The rig of the table with half its cells: shadow discs of 16 pixels.
RIG = Rig(160, 1.85e-6, 0.296e-3, 1e-3, 1.85e-6, 10e-3, 160)
VIEW = 41
NOTHING = Obstacle(np.zeros((VIEW, VIEW)))


def half_camera() -> Camera:
    return replace(camera(), grid=Grid((160, 160), RIG.pitch_m), aperture=RIG.aperture_m)


def rough_m() -> np.ndarray:
    """Random squares of four cells, metres."""
    return np.kron(np.random.default_rng(0).uniform(0, 1e-6, (40, 40)), np.ones((4, 4)))


def point(row: int, column: int, view: int) -> np.ndarray:
    light = np.zeros((1, view, view))
    light[0, view // 2 + row, view // 2 + column] = 1.0
    return light


def places(view: int) -> np.ndarray:
    return np.mgrid[:view, :view] - view // 2


def test_the_wavelength_is_that_of_the_table():
    """Half the cells with the same pitch have the same Fourier transform to the same window."""
    assert RIG.wavelength_m == camera().colours[0].wavelengths_m[0]
    assert RIG.moved == 10


@pytest.mark.parametrize(
    ("kind", "tolerance"),
    # 5e-4 was found, and 0.8 % for dots, which go on for ever in one and end with the view in the other.
    [("nothing", 2e-3), ("edge", 2e-3), ("disc", 2e-3), ("dots", 0.02)],
)
def test_points_past_an_obstruction_as_the_package_has_them(kind: str, tolerance: float):
    """Other shadows (Fresnel integrals there, a raster here), other transforms, other pixels."""
    # What goes on for ever must do so for long where it ends with the view.
    view = 261 if kind in ("edge", "dots") else 61
    y, x = places(view)
    masks = {
        "nothing": 0 * x,
        "edge": x >= 2,
        "disc": np.hypot(y - 2, x + 3) <= 6,
        "dots": np.hypot((y + 6) % 12 - 6, (x + 6) % 12 - 6) <= 4,
    }
    obstacle = Obstacle(masks[kind].astype(float), kind == "edge", 12 if kind == "dots" else 0)
    own, height = half_camera(), rough_m()
    at = (3, -4)
    delay = height * own.waves_per_metre(RIG.wavelength_m)
    found = RIG.psf(np.exp(2j * np.pi * delay) * obstacle.before(obstacle.wave(RIG), at, RIG))[1:, 1:]
    border = "edge" if obstacle.upright else "zero"
    middle = (view // 2 + at[0], view // 2 + at[1])
    wanted = shadowed_psf(own, height, obstacle.mask, RIG.depth_m, np.inf, middle, border)[0]
    wanted = wanted / own.transmission(RIG.wavelength_m)
    assert np.linalg.norm(found - wanted) < tolerance * np.linalg.norm(wanted)
    assert (wanted.sum() < 0.8) == (kind != "nothing")


def test_a_picture_is_the_sum_of_its_points():
    """Two points beside an edge, the picture cut from the PSFs by hand."""
    judged = 5
    view = judged + RIG.window
    edge = Obstacle((places(view)[1] >= 0).astype(float), upright=True)
    scenes = 2.0 * point(1, -5, view) + 0.5 * point(-20, 30, view)
    (found,) = picture(RIG, np.zeros((160, 160)), edge, scenes, judged)
    wanted = np.zeros((judged, judged))
    for (row, column), light in (((1, -5), 2.0), ((-20, 30), 0.5)):
        image = RIG.psf(edge.before(edge.wave(RIG), (row, column), RIG))
        y, x = (80 + np.arange(-2, 3) - place for place in (row, column))
        wanted += light * image[np.ix_(y, x)]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_lengths_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="even number of cells"):
        _ = Rig(160, 1.85e-6, 0.296e-3, 1e-3, 1.85e-6, 10.5e-3, 160).moved
    with pytest.raises(ValueError, match="`window` must be at least"):
        Rig(400, 1.85e-6, 0.296e-3, 1e-3, 1.85e-6, 10e-3, 160).psf(np.ones((400, 400), complex))
    with pytest.raises(ValueError, match="`scenes` must be"):
        picture(RIG, np.zeros((160, 160)), NOTHING, np.zeros((1, VIEW, VIEW)), 21)


@pytest.mark.slow
def test_rows_of_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """No plate, and no central spot, makes `reciprocal` worse than `radiometric`; eq. 10 fails behind rings."""
    main(["--out", str(tmp_path), "--plates", "rings", "blazed rings", "--obstructions", "edge"])
    assert "blazed rings" in capsys.readouterr().out
    assert (tmp_path / "occlusion.png").stat().st_size > 20_000
    rings, blazed = (row["error"] for row in json.loads((tmp_path / "occlusion.json").read_text())["rows"])
    for error in (rings, blazed):
        for scene, found in error["reciprocal"].items():
            assert found < 1.02 * error["radiometric"][scene], scene
    # As measured, in a tenth of it; the plates have no chance in them that another machine draws otherwise.
    assert rings["reciprocal"] == pytest.approx({"coarse": 0.0016, "photograph": 0.0095, "points": 0.051}, rel=0.1)
    assert blazed["reciprocal"] == pytest.approx({"coarse": 0.0077, "photograph": 0.057, "points": 0.088}, rel=0.1)
    assert blazed["radiometric"]["coarse"] == pytest.approx(0.1, rel=0.1)
    assert rings["paper"]["photograph"] == pytest.approx(0.157, rel=0.1)


@pytest.mark.slow
def test_a_straight_grating_has_no_central_spot_and_needs_none():
    (row,) = judge("straight grating", ["bar"])
    for scene in ("coarse", "photograph", "points"):
        assert row.error["reciprocal"][scene] < 1.02 * row.error["radiometric"][scene]
    assert row.error["reciprocal"]["photograph"] < 0.05
