"""Spectral responses: quadrature against closed forms, what a file may look like, and how it becomes part of a spec."""

from pathlib import Path

import numpy as np
import pytest

from doedesign.spec import load_spec, spec_digest, spec_to_toml
from doedesign.spec.response import Response, lines_of, read_responses
from fab.errors import InputError

ROOT = Path(__file__).parents[2]
AUTOMOTIVE = ROOT / "examples" / "automotive.toml"
SHARED = ROOT.parent / "shared" / "data" / "optics_reference" / "spectral_response"

CURVES = """# a made-up camera
wavelength_nm,red_qe,green_qe,blue_qe
400,0,0,0
450,0,0,60
500,0,30,10
550,0,80,0
600,50,10,0
650,20,0,0
700,0,0,0
"""


def even(low_m: float = 500e-9, high_m: float = 600e-9) -> Response:
    return Response("even", np.array([low_m, high_m]), np.ones(2))


@pytest.fixture
def spec_file(tmp_path: Path) -> Path:
    """The automotive spec, seen by the made-up camera."""
    (tmp_path / "camera.csv").write_text(CURVES)
    text = AUTOMOTIVE.read_text("utf-8")
    old = 'wavelengths = ["656 nm", "589 nm", "486 nm"]'
    assert text.count(old) == 1
    path = tmp_path / "spec.toml"
    path.write_text(text.replace(old, 'spectral_response = "camera.csv"'), "utf-8")
    return path


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_an_even_response_gives_gauss_legendre(count: int):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    lines, shares = lines_of(even(), count)
    # Rounding of float64, enlarged a little by the recurrence.
    assert lines[::-1] == pytest.approx(550e-9 + 50e-9 * nodes, rel=1e-12)
    assert shares[::-1] == pytest.approx(weights / 2, rel=1e-11)


def test_moments_of_a_response_are_kept():
    x = np.linspace(420e-9, 680e-9, 53)
    response = Response("bump", x, np.exp(-(((x - 530e-9) / 40e-9) ** 2)) + 0.1)
    fine = np.linspace(x[0], x[-1], 400_001)
    density = np.interp(fine, response.wavelengths_m, response.values)
    lines, shares = lines_of(response, 4)
    assert shares.sum() == pytest.approx(1, abs=1e-12)
    assert np.all(shares > 0)
    for power in range(8):  # 2 n - 1
        wanted = np.sum(density * ((fine - 550e-9) / 1e-7) ** power) / density.sum()
        # The sum on the right steps by 0.65 pm.
        assert np.sum(shares * ((lines - 550e-9) / 1e-7) ** power) == pytest.approx(wanted, abs=1e-5)


def test_one_line_lies_at_the_centroid_of_the_signal(tmp_path: Path):
    """A quantum efficiency is per photon, of which equal energy holds more at long wavelengths."""
    (tmp_path / "a.csv").write_text("nm,one\n500,1\n600,1\n")
    (tmp_path / "b.csv").write_text("nm,one_qe\n500,1\n600,1\n")
    (by_energy,), (by_photon,) = (read_responses(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert (by_energy.name, by_photon.name) == ("one", "one")
    assert lines_of(by_energy, 1)[0] == pytest.approx(550e-9, rel=1e-9)
    # Integral of w^2 over that of w, from 500 to 600 nm.
    assert lines_of(by_photon, 1)[0] == pytest.approx((600**3 - 500**3) / (600**2 - 500**2) * 2 / 3 * 1e-9, rel=1e-12)


def test_a_spec_takes_its_colours_from_a_response(spec_file: Path):
    spec = load_spec(spec_file, ["optics.lines_per_colour=3"])
    assert [colour.name for colour in spec.optics.colours] == ["red", "green", "blue"]
    assert [len(colour.wavelengths_m) for colour in spec.optics.colours] == [3, 3, 3]
    means = [np.dot(c.wavelengths_m, c.weights) for c in spec.optics.colours]
    assert means[0] > means[1] > means[2]
    assert len(load_spec(spec_file).optics.colours[0].wavelengths_m) == 5
    # What comes out holds the lines and needs the file no more.
    copy = spec_file.with_name("copy.toml")
    copy.write_text(spec_to_toml(spec), "utf-8")
    (spec_file.parent / "camera.csv").unlink()
    assert spec_digest(load_spec(copy)) == spec_digest(spec)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["optics.spectral_response=none.csv"], ["none.csv", "must exist"]),
        (["optics.spectral_response=3"], ["optics.spectral_response", "in quotes"]),
        (["optics.lines_per_colour=0"], ["optics.lines_per_colour", "from 1 to 16"]),
        (["optics.lines_per_colour=true"], ["optics.lines_per_colour"]),
        (['optics.wavelengths=["500 nm"]'], ["optics.wavelengths", "stated once", "spectral_response"]),
        (["optics.spectral_respons=camera.csv"], ["spectral_respons", "Did you mean `spectral_response`?"]),
    ],
)
def test_keys_that_make_no_sense(spec_file: Path, overrides: list[str], words: list[str]):
    with pytest.raises(InputError) as caught:
        load_spec(spec_file, overrides)
    for word in words:
        assert word in str(caught.value)


def test_lines_without_a_response_are_refused():
    with pytest.raises(InputError, match="spectral_response"):
        load_spec(AUTOMOTIVE, ["optics.lines_per_colour=3"])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "no line with numbers"),
        ("# only a remark\n", "no line with numbers"),
        ("550,1,1,1\n", "at least two wavelengths"),
        ("550\n560\n", "one colour"),
        ("550,1\n560,1,2\n", "line 2"),
        ("550,1\n560,bright\n", "line 2"),
        ("550,1\n560,nan\n", "line 2"),
        ("550,1\n550,1\n", "occur once"),
        ("550,0\n560,0\n", "somewhere above"),
        ("550,-1\n560,1\n", "at least 0"),
        ("nm,red,green\n550,1\n560,1\n", "names"),
        (b"\xff\xfe550", "foreign byte"),
        ('"wave\nlength",red\n550,1\n560,bright\n', "line 4"),
        ('550,1\n560,"1\n', "unexpected end"),
    ],
)
def test_files_that_hold_no_response(tmp_path: Path, content: str | bytes, words: str):
    path = tmp_path / "camera.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=words) as caught:
        read_responses(path)
    assert str(path) in str(caught.value)


def test_columns_without_names(tmp_path: Path):
    path = tmp_path / "camera.csv"
    path.write_text("#Camera:one\n600,1,0.5,-0.001\n500,0,1,1\n")
    responses = read_responses(path)
    assert [one.name for one in responses] == ["red", "green", "blue"]
    assert responses[2].wavelengths_m == pytest.approx([500e-9, 600e-9])
    assert responses[2].values.min() == 0  # what a measurement leaves below zero


def test_a_mark_of_the_encoding_and_names_over_two_lines(tmp_path: Path):
    path = tmp_path / "camera.csv"
    path.write_text('"wavelength\n(nm)",one\n500,1\n600,2\n', "utf-8-sig")
    (response,) = read_responses(path)
    assert response.name == "one"
    assert list(response.values) == [1, 2]
    path.write_text("500,1\n600,2\n", "utf-8-sig")
    assert list(read_responses(path)[0].values) == [1, 2]


@pytest.mark.skipif(not SHARED.is_dir(), reason="the measured cameras are not at hand")
def test_measured_cameras():
    files = [SHARED / "IMX219_qe_percent.csv", *sorted((SHARED / "ssf-data").glob("*.csv"))]
    assert len(files) > 20
    for path in files:
        means = []
        for response in read_responses(path):
            lines, shares = lines_of(response, 5)
            assert np.all(shares > 0)
            assert np.all((lines > 380e-9) & (lines < 730e-9))
            means.append(float(np.dot(lines, shares)))
        assert means == sorted(means, reverse=True), path.name  # red, green, blue
