"""What is released: a wheel and a source distribution, and how to cite them."""

import hashlib
import os
import re
import resource
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

import doedesign
from doedesign.templates import EXAMPLES, template_names

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
# What a build leaves in its files must not depend on when it ran.
EPOCH = "1700000000"


def test_the_citation_has_what_its_format_requires():
    """Required keys and allowed values of the Citation File Format 1.2.0."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    required = {"cff-version", "message", "title", "authors"}
    assert required <= citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation["license"] == PROJECT["project"]["license"]
    assert citation["title"] == PROJECT["project"]["name"]
    assert citation["abstract"] == PROJECT["project"]["description"]
    assert citation["keywords"] == PROJECT["project"]["keywords"]
    # One place has the version: doedesign/__init__.py.
    assert "version" not in citation
    assert "version" in PROJECT["project"]["dynamic"]
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= reference.keys()
        assert re.fullmatch(r"10\.\d{4,9}/\S+", reference["doi"])
    for author in (author for entry in (citation, *citation["references"]) for author in entry["authors"]):
        assert author.keys() in ({"name"}, {"given-names", "family-names"})


def test_specs_of_the_examples_are_templates_in_a_wheel():
    included = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {f"examples/{name}.toml": f"doedesign/templates/{name}.toml" for name in EXAMPLES}
    assert {path.stem for path in (ROOT / "examples").glob("*.toml")} == set(EXAMPLES) <= set(template_names())


class Release(NamedTuple):
    """The two files of a release, built twice in two places."""

    wheel: Path
    sdist: Path
    again: tuple[Path, Path]


def tracked_files() -> list[str]:
    """Files of the project: those that git knows, or in an unpacked source distribution all."""
    if not (ROOT / ".git").exists():
        return [str(path.relative_to(ROOT)) for path in ROOT.rglob("*") if path.is_file()]
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    return [name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]


def built(folder: Path, *targets: str) -> tuple[Path, Path]:
    """Wheel and source distribution of a clean copy of the project below a folder."""
    for name in tracked_files():
        (folder / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / "copy" / name)
    # What lies about in a folder that is worked in.
    for litter in ("runs/a/manifest.json", "masks/a/manifest.json", "doedesign/__pycache__/cli.cpython-311.pyc"):
        (folder / "copy" / litter).parent.mkdir(parents=True, exist_ok=True)
        (folder / "copy" / litter).write_text("{}")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), *targets, "copy"]
    environment = os.environ | {"SOURCE_DATE_EPOCH": EPOCH}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,), (sdist,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Release:
    # By default the wheel is built from the source distribution; here also from the files themselves.
    first = built(tmp_path_factory.mktemp("first"))
    second = built(tmp_path_factory.mktemp("second"), "--sdist", "--wheel")
    return Release(*first, second)


@pytest.mark.slow
def test_the_same_files_make_the_same_release(release: Release):
    for one, other in zip((release.wheel, release.sdist), release.again, strict=True):
        assert one.name == other.name
        assert one.name.startswith(f"doedesign-{doedesign.__version__}")
        assert hashlib.sha256(one.read_bytes()).digest() == hashlib.sha256(other.read_bytes()).digest()


@pytest.mark.slow
def test_a_wheel_holds_the_packages_and_nothing_else(release: Release):
    with zipfile.ZipFile(release.wheel) as wheel:
        names, contents = wheel.namelist(), {name: wheel.read(name) for name in wheel.namelist()}
    about = f"doedesign-{doedesign.__version__}.dist-info"
    packages = {name for name in tracked_files() if name.startswith(("doedesign/", "fab/", "sim/"))}
    assert {name for name in names if not name.startswith(about)} == packages | {
        f"doedesign/templates/{name}.toml" for name in EXAMPLES
    }
    assert {"doedesign/py.typed", "fab/py.typed", "sim/py.typed"} <= packages
    for pattern in PROJECT["project"]["license-files"]:
        licences = [str(path.relative_to(ROOT)) for path in ROOT.glob(pattern)]
        assert licences, pattern
        assert {f"{about}/licenses/{name}" for name in licences} <= set(names)
    metadata = contents[f"{about}/METADATA"].decode()
    assert f"\nVersion: {doedesign.__version__}\n" in metadata
    for place in (str(ROOT), str(Path.home()) + "/", "/tmp/"):
        assert [name for name, content in contents.items() if place.encode() in content] == []
    # Measured: 0.9 MB; what is served with a page is more, and data of tests or masks would be much more.
    assert release.wheel.stat().st_size < 12e6


@pytest.mark.slow
def test_a_source_distribution_holds_what_builds_and_tests_it(release: Release):
    with tarfile.open(release.sdist) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
        owners = {(member.uid, member.gid, member.uname, member.mtime) for member in sdist.getmembers()}
    assert names == {*tracked_files(), "PKG-INFO"}
    assert owners == {(0, 0, "", int(EPOCH))}


class Installed(NamedTuple):
    """An environment that has the wheel and the libraries it needs, and nothing of the repository."""

    python: Path
    doedesign: Path

    def run(self, folder: Path, *command: str | Path) -> str:
        """Run a command in a folder, without what these tests keep for others, and return what it printed."""
        kept = ("PYTHON", "PIP_", "JAX_", "XLA_")
        environment = {name: value for name, value in os.environ.items() if not name.startswith(kept)}
        environment["PATH"] = f"{self.doedesign.parent}{os.pathsep}{environment['PATH']}"
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def installed(release: Release, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    venv = tmp_path_factory.mktemp("venv")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    places = {"base": str(venv), "platbase": str(venv)}
    site, scripts = (Path(sysconfig.get_path(name, "venv", places)) for name in ("purelib", "scripts"))
    # The libraries of the environment that runs the tests. Its own .pth files, one of which leads to the repository,
    # are not followed from there.
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    python = scripts / "python"
    pip = [sys.executable, "-m", "pip", "--isolated", "--python", str(python), "install", "--no-index", "--quiet"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    # The repository itself is installed beside the libraries, which must not count as this wheel.
    command = [*pip, "--ignore-installed", "--no-deps", str(release.wheel)]
    subprocess.run(command, env=environment, check=True, cwd=venv)
    return Installed(python, scripts / "doedesign")


@pytest.mark.slow
def test_the_installed_package_needs_what_it_says(installed: Installed, tmp_path: Path):
    """Every requirement without an extra is met, and nothing of the repository is imported."""
    script = """
import importlib.metadata as metadata
from packaging.requirements import Requirement
import doedesign, fab, sim
print(*(module.__file__ for module in (doedesign, fab, sim)), sep="\\n")
needs = [Requirement(text) for text in metadata.requires("doedesign")]
for need in needs:
    if need.marker is None or need.marker.evaluate({"extra": ""}):
        assert need.specifier.contains(metadata.version(need.name)), need
"""
    for line in installed.run(tmp_path, installed.python, "-c", script).split():
        assert Path(line).is_relative_to(installed.python.parents[1])
    assert installed.run(tmp_path, "doedesign", "--version").strip() == doedesign.__version__
    offered = installed.run(tmp_path, "doedesign", "new")
    assert [line.split()[0] for line in offered.splitlines()] == template_names()
    installed.run(tmp_path, "doedesign", "new", "quick")
    assert (tmp_path / "quick.toml").read_bytes() == (ROOT / "examples" / "quick.toml").read_bytes()


def processor_time_s() -> float:
    """Processor time of all processes that were started and waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.study
def test_the_first_order_from_an_empty_folder(installed: Installed, tmp_path: Path):
    """The script of the first screen, by the installed command, from the new spec to the report of the order."""
    script = (ROOT / "examples" / "first_order.sh").read_text("utf-8")
    (tmp_path / "first_order.sh").write_text(script)
    before = processor_time_s()
    printed = installed.run(tmp_path, "sh", "first_order.sh")
    # Whoever reads the first screen has the order in five minutes, on a single core even. Measured without the report:
    # 68 s of processor time, of which `optimize` takes 30, `masks` 26 and `verify` 11.
    assert processor_time_s() - before < 300
    commands = re.findall(r"(?m)^doedesign (\w+)", script)
    assert commands == ["new", "optimize", "masks", "verify", "report"]
    for made in ("splitter.toml", "runs/splitter/metrics.json", "masks/splitter/manifest.json"):
        assert (tmp_path / made).is_file()
    assert "splitter.toml\nruns/splitter\nmasks/splitter\n" in printed
    assert "runs/splitter/report.html\n" in printed
    assert (tmp_path / "runs/splitter/report.html").stat().st_size < 6e6
