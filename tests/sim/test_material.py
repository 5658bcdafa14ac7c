"""Refractive indices against published values and, where it is present, against the public database's own records."""

import math
from pathlib import Path

import pytest

from fab.errors import InputError
from sim.material import (
    MATERIALS,
    fresnel_transmission,
    full_wave_height_m,
    full_wave_wavelength_m,
    is_material,
    material,
    refractive_index,
)

DATABASE = Path(__file__).parents[2].parent / "shared" / "data" / "optics_reference" / "refractive_index"
RECORDS = {
    "fused_silica": "SiO2_Malitson.yml",
    "n_bk7": "schott_N-BK7.yml",
    "p_bk7": "schott_P-BK7.yml",
    "pmma": "PMMA_Sultanova.yml",
    "pmma_resist": "resist_Microchem_950_specs.yml",
    "su8": "resist_Microchem_SU-8_2000_specs.yml",
}


@pytest.mark.parametrize(
    ("wavelength_nm", "index"), [(656, 1.45637), (589, 1.45841), (550, 1.45991), (520, 1.46128), (486, 1.46313)]
)
def test_fused_silica_at_the_papers_wavelengths(wavelength_nm: int, index: float):
    # Malitson's table is given to 1e-5, so half of that is all a comparison can show.
    assert refractive_index("fused_silica", wavelength_nm * 1e-9) == pytest.approx(index, abs=5e-6)


@pytest.mark.parametrize(
    ("name", "wavelength_nm", "index"),
    [("n_bk7", 587.5618, 1.51680), ("p_bk7", 587.5618, 1.51640)],
)
def test_catalogue_values(name: str, wavelength_nm: float, index: float):
    assert refractive_index(name, wavelength_nm * 1e-9) == pytest.approx(index, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "wavelength_um", "index", "error"),
    [
        # Measured values of prisms at room temperature, with what the fits of the same authors miss of them.
        ("calcium_fluoride", 0.5876, 1.43384, 1e-5),
        ("zinc_selenide", 10.6, 2.4028, 2e-4),
        ("zinc_selenide", 0.6328, 2.591, 1e-3),
        ("silicon", 3.0, 3.4320, 1e-3),
        ("silicon", 10.0, 3.4179, 5e-4),
        ("germanium", 4.0, 4.0245, 1e-3),
        ("germanium", 10.6, 4.0039, 1e-3),
    ],
)
def test_infrared_materials(name: str, wavelength_um: float, index: float, error: float):
    assert refractive_index(name, wavelength_um * 1e-6) == pytest.approx(index, abs=error)


def test_an_index_of_ones_own_stands_for_a_name():
    assert [refractive_index("n=1.52", wavelength) for wavelength in (2e-7, 1e-5)] == [1.52, 1.52]
    assert full_wave_height_m("n=1.5", 600e-9) == pytest.approx(1.2e-6, rel=1e-12)
    assert full_wave_wavelength_m("n=1.5", 1.2e-6) == pytest.approx(600e-9, rel=1e-12)
    assert material("n=2").title == "a material of index 2"
    assert is_material("n=1.05")
    for text in (
        "n=1,V=30",
        "n=1.5,V=9",
        "n=1.5,V=-30",
        "n=1.5,V=",
        "n=1.5,B=1",
        "n=1.5,C=0.1",
        "n=1.5,B=0.1,V=30",
        "n=1.5, V=30",
    ):
        assert not is_material(text), text
    for text in ("n=1", "n=6.01", "n=12.5", "n=-1.5", "n=1.5e0", "n=nan", "n = 1.5", "1.5", "n=", "n=1.5\n"):
        assert not is_material(text)
        with pytest.raises(InputError, match=r"or an index from 1.05 to 6 as n=1\.52, n=1\.586,V=29\.9"):
            material(text)


@pytest.mark.parametrize(("name", "nd", "abbe"), [("n_bk7", 1.5168, 64.17), ("fused_silica", 1.4585, 67.82)])
def test_an_abbe_number_gives_the_dispersion_of_the_visible(name: str, nd: float, abbe: float):
    """The two numbers of catalogues against the published formula: what two terms of Cauchy leave is 0.0004 at most."""
    own = f"n={nd},V={abbe}"
    for wavelength_nm in (400, 440, 486, 550, 620, 656, 700, 780):
        there = refractive_index(name, wavelength_nm * 1e-9)
        assert refractive_index(own, wavelength_nm * 1e-9) == pytest.approx(there, abs=4e-4)
    blue, yellow, red = (refractive_index(own, w * 1e-6) for w in (0.4861327, 0.5875618, 0.6562725))
    assert (yellow, (yellow - 1) / (blue - red)) == pytest.approx((nd, abbe), rel=1e-9)
    with pytest.raises(InputError, match="360-850 nm"):
        refractive_index(own, 1.06e-6)


def test_coefficients_of_cauchy_are_those_of_a_data_sheet():
    own = "n=1.566,B=0.00796,C=0.00014"
    for wavelength in (350e-9, 405e-9, 633e-9):
        assert refractive_index(own, wavelength) == pytest.approx(refractive_index("su8", wavelength), rel=1e-12)
    assert refractive_index("n=1.5,B=-0.001", 500e-9) == pytest.approx(1.496, rel=1e-12)
    assert full_wave_wavelength_m(own, full_wave_height_m(own, 532e-9)) == pytest.approx(532e-9, rel=1e-9)


def record(path: Path) -> tuple[int, list[float], tuple[float, float]]:
    """Formula number, coefficients and range (micrometres) of a database record."""
    lines = [line.strip().removeprefix("- ") for line in path.read_text("utf-8").splitlines()]
    start = next(i for i, line in enumerate(lines) if line.startswith("type: formula"))
    values = dict(line.split(": ", 1) for line in lines[start : start + 3] if ": " in line)
    low, high = (float(text) for text in values["wavelength_range"].split())
    return int(values["type"].split()[-1]), [float(text) for text in values["coefficients"].split()], (low, high)


def index_of_record(formula: int, c: list[float], wavelength_um: float) -> float:
    pairs = list(zip(c[1::2], c[2::2], strict=True))
    if formula == 1:
        return math.sqrt(1 + c[0] + sum(b * wavelength_um**2 / (wavelength_um**2 - x**2) for b, x in pairs))
    if formula == 2:
        return math.sqrt(1 + c[0] + sum(b * wavelength_um**2 / (wavelength_um**2 - x) for b, x in pairs))
    assert formula == 5, formula
    return c[0] + sum(a * wavelength_um**p for a, p in pairs)


@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_formula_and_range_agree_with_the_database(name: str):
    path = DATABASE / RECORDS.get(name, f"{name}.yml")
    if not path.is_file():
        pytest.skip("the refractive-index records are not beside this checkout")
    formula, coefficients, (low, high) = record(path)
    entry = material(name)
    # A range may be narrower than the record's, never wider.
    assert entry.range_m[0] >= low * 1e-6 * (1 - 1e-12)
    assert entry.range_m[1] <= high * 1e-6 * (1 + 1e-12)
    for part in (0.0, 0.1, 0.4, 0.9, 1.0):
        wavelength_m = entry.range_m[0] + part * (entry.range_m[1] - entry.range_m[0])
        # The same coefficients, so only rounding separates the two.
        assert entry.index(wavelength_m) == pytest.approx(
            index_of_record(formula, coefficients, wavelength_m * 1e6), rel=1e-9
        )


@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_dispersion_is_normal_and_nothing_is_extrapolated(name: str):
    low, high = material(name).range_m
    # In the visible, or at the short end of what is transparent in the infrared alone.
    seen = (486e-9, 589e-9, 656e-9) if low < 486e-9 else (low, 1.2 * low, 1.4 * low)
    falling = [refractive_index(name, wavelength) for wavelength in seen]
    assert falling[0] > falling[1] > falling[2] > 1.4
    for outside in (low * 0.999, high * 1.001, -1.0, float("nan")):
        with pytest.raises(InputError, match=f"material {name}: the wavelength must lie in"):
            refractive_index(name, outside)


def test_unknown_material_lists_the_known_ones():
    with pytest.raises(InputError, match="fused_silica, n_bk7"):
        refractive_index("glass", 5e-7)


def test_sixteen_levels_of_75_nm_are_one_wave_at_552_nm():
    wavelength_m = full_wave_wavelength_m("fused_silica", 16 * 75e-9)
    assert wavelength_m == pytest.approx(552e-9, abs=0.5e-9)
    assert full_wave_height_m("fused_silica", wavelength_m) == pytest.approx(1.2e-6, rel=1e-9)


@pytest.mark.parametrize("height_m", [1e-9, 1e-3])
def test_a_height_of_no_wave_is_refused(height_m: float):
    with pytest.raises(InputError, match="a height of one wave must lie in"):
        full_wave_wavelength_m("fused_silica", height_m)


def test_two_faces_of_fused_silica_reflect_seven_percent():
    # ((n - 1) / (n + 1))^2 = 3.4705 % per face at n = 1.45841.
    assert fresnel_transmission(1.45841) == pytest.approx((1 - 0.034770) ** 2, abs=1e-4)
    assert fresnel_transmission(1.0) == 1.0
