"""Pages of the reference: every public name, key, number and file has its entry, and files are those that there are."""

import re
import tomllib
from pathlib import Path

import pytest

from doedesign.calibration.measurement import load_measurement
from doedesign.reference.files import FOLDERS, described, folder_of
from doedesign.reference.keys import every_key, tables_of_files
from doedesign.reference.numbers import METRICS_GROUPS
from doedesign.reference.other_numbers import OTHER_GROUPS
from doedesign.reference.pages import grouped, pages, public_names
from doedesign.spec import load_variation
from fab.solids.write import KINDS as SOLIDS

ROOT = Path(__file__).parents[2]
KINDS = ("raindrop", "fence", "all")


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    return pages()


def test_every_spec_key_has_its_heading(texts: dict[str, str]) -> None:
    headings = re.findall(r"^#+ `(.*)` \{ #([\w-]+) \}$", texts["reference/spec.md"], re.MULTILINE)
    anchors = [anchor for _, anchor in headings]
    assert len(anchors) == len(set(anchors))
    assert {key.replace(".", "-") for key in every_key()} <= set(anchors)
    links = re.findall(r"\]\(#([\w-]+)\)", texts["reference/spec.md"])
    assert set(links) <= set(anchors)


def test_keys_of_other_files_say_what_they_are(texts: dict[str, str]) -> None:
    page = texts["reference/other-keys.md"]
    for tables in tables_of_files().values():
        for one in (key for table in tables for key in table.keys):
            assert f"#### `{one.key}` {{ #" in page
            assert len(one.description) > 5, one.key
            assert one.description.endswith((".", ")")), one.key
            assert tomllib.loads(one.example).keys() == {one.name}, one.key


def test_examples_of_other_files_are_accepted(tmp_path: Path) -> None:
    """All of them together are a file of that kind; dark frames stand in for a black level."""
    for name, read in (("measurement", load_measurement), ("variation", load_variation)):
        text = "".join(
            f"{table.header}\n" + "".join(f"{key.example}\n" for key in table.keys if key.name != "black_level")
            for table in tables_of_files()[name]
        )
        (tmp_path / f"{name}.toml").write_text(text)
        assert read(tmp_path / f"{name}.toml")


def test_every_number_has_its_row(texts: dict[str, str]) -> None:
    for group in (*METRICS_GROUPS, *OTHER_GROUPS):
        part = texts["reference/metrics.md"].partition(f"\n## {group.title}\n")[2].partition("\n## ")[0]
        assert re.findall(r"^\| `(\w+)` \|", part, re.MULTILINE) == list(group.numbers)


def test_every_file_has_its_row(texts: dict[str, str]) -> None:
    for folder in FOLDERS:
        part = texts["reference/files.md"].partition(f"\n## `{folder.path}`\n")[2].partition("\n## ")[0]
        assert re.findall(r"^\| `(.+?)` \|", part, re.MULTILINE) == [one.name for one in folder.files]


@pytest.mark.parametrize("package", ["doedesign", "sim", "fab"])
def test_every_public_name_has_its_entry(package: str, texts: dict[str, str]) -> None:
    names = public_names(package)
    assert len(names) > 30
    entries = re.findall(r"^::: ([\w.]+)$", texts[f"reference/api/{package}.md"], re.MULTILINE)
    assert sorted(entries) == sorted(f"{package}.{module}.{name}" for name, module in names.items())
    assert "Others" not in grouped(package)


def test_tables_have_no_open_cells(texts: dict[str, str]) -> None:
    """A bar within a cell would open another one."""
    for text in texts.values():
        for table in re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE):
            assert len({len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}) == 1, table[:200]


@pytest.mark.parametrize(
    "folder",
    [
        *(f"masks/{design}" for design in ("automotive-2400", "automotive-robust-2400", "dslr-2800", "released")),
        *(f"masks/released-{kind}" for kind in KINDS),
    ],
)
def test_files_of_released_folders_are_described(folder: str) -> None:
    entry = next(one for one in FOLDERS if f"{folder}/" in one.path)
    names = [path.name for path in (ROOT / folder).iterdir()]
    assert [name for name in names if described(entry, name) is None] == []


def test_files_of_an_order_are_described() -> None:
    entry = folder_of("masks/example")
    assert entry is not None
    names = [path.name for path in (ROOT / "masks" / "example").iterdir()]
    names += [f"EXAMPLE_A_1P85_3253{kind.ending}" for kind in SOLIDS]  # those, too, that have to be asked for
    assert [name for name in names if described(entry, name) is None] == []


@pytest.mark.parametrize(
    ("path", "known"),
    [
        ("runs/quick", "runs/NAME/"),
        ("runs/quick/psf", "RUN/psf/"),
        ("masks/quick", "masks/NAME/"),
        ("masks/released-raindrop", "masks/released/, " + ", ".join(f"masks/released-{kind}/" for kind in KINDS)),
        ("runs/quick/x", ""),
    ],
)
def test_folders_are_found_by_their_place(path: str, known: str) -> None:
    found = folder_of(path)
    assert ("" if found is None else found.path) == known
