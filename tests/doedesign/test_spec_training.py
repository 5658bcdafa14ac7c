"""The tables [network] and [train]: left out, said, refused."""

from pathlib import Path

import pytest

from doedesign.spec import NetworkSpec, TrainSpec, load_spec, spec_digest, spec_from_json, spec_to_json, spec_to_toml
from fab.errors import InputError

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
# Without a stock process and a word on training, and with the objectives and the steps that it had then.
TERMS = 'objective=[{name = "far_spot"}, {name = "near_spread", weight = 2.0}, {name = "window_loss"}]'
STEPS = ("optimize.learning_rate=0.1", "optimize.steps=60", "optimize.colours=together")
BARE = ('process={levels = 16, level_step = "75 nm"}', "train={}", TERMS, *STEPS)
# SHA-256 of this spec before there were the two tables: what knows nothing of them stays what it was.
BEFORE = "01bbd08ce007c615eb99b30ca0af1bbfc7e03867b95ae97464f90fc875f1bd6d"


def refusal(*overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_spec(QUICK, overrides)
    return str(caught.value)


def test_a_spec_without_them_stays_what_it_was():
    spec = load_spec(QUICK, BARE)
    assert (spec.network, spec.train) == (NetworkSpec(), TrainSpec())
    assert not {"network", "train"} & spec_to_json(spec).keys()
    assert "[train]" not in spec_to_toml(spec)
    assert spec_digest(spec) == BEFORE
    # Saying the usual values is saying nothing.
    usual = ["train.steps=50000", "network.width=12", "train.average=0", "network.global_light=false"]
    assert load_spec(QUICK, [*BARE, *usual]) == spec


def test_what_is_said_reads_back(tmp_path: Path):
    changes = ["train.steps=7", "train.camera=conventional", "train.l1=0.5", "network.depth=2", "network.refine=false"]
    spec = load_spec(QUICK, changes)
    assert (spec.train.steps, spec.train.camera, spec.train.l1) == (7, "conventional", 0.5)
    assert (spec.network.depth, spec.network.refine) == (2, False)
    newer = {"zoom", "average", "global_light"}
    assert not newer & {*spec_to_json(spec)["train"], *spec_to_json(spec)["network"]}  # digests stay what they were
    spec = load_spec(QUICK, [*changes, "train.zoom=[0.4, 1]", "train.average=0.99", "network.global_light=true"])
    assert (spec.train.zoom, spec.train.average, spec.network.global_light) == ((0.4, 1.0), 0.99, True)
    (tmp_path / "again.toml").write_text(spec_to_toml(spec))
    assert load_spec(tmp_path / "again.toml") == spec == spec_from_json(spec_to_json(spec), "manifest.json")
    assert spec_digest(spec) != BEFORE


@pytest.mark.parametrize(
    ("changes", "network", "optics"),
    [
        ([], True, True),
        (["train.freeze=optics"], True, False),
        (["train.freeze=network"], False, True),
        (["train.camera=conventional"], True, False),
        (["train.optics_learning_rate=0.0"], True, False),
    ],
)
def test_what_moves(changes: list[str], network: bool, optics: bool):
    train = load_spec(QUICK, changes).train
    assert (train.moves_network, train.moves_optics) == (network, optics)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["train.size=100"], ["train.size", "multiple of 2^network.depth = 16", "100", "size = 96"]),
        (["train.size=16"], ["train.size", "at least twice", "size = 32"]),
        (["train.size=40", "network.depth=3"], []),
        (["train.freeze=network", "train.camera=conventional"], ["train.freeze", 'camera = "conventional"']),
        (["train.freeze=network", "train.optics_learning_rate=0"], ["train.freeze", "optics_learning_rate = 0"]),
        (["train.l1=0", "train.perceptual=0", "train.masked=0"], ["train.l1", "above 0"]),
        (["train.l1=-1"], ["train.l1", "at least 0"]),
        (["train.mode=both"], ["train.mode", "simultaneous, alternating", '"both"']),
        (["train.period=1"], ["train.period", "at least 2"]),
        (["train.batch=0"], ["train.batch", "at least 1"]),
        (["train.steps=1.5"], ["train.steps", "whole number"]),
        (["train.learning_rate=0"], ["train.learning_rate", "greater than 0"]),
        (["train.stepz=3"], ["train.stepz", "[train]", "`steps`"]),
        (["train=3"], ["train", "must be a table"]),
        (["network.depth=5"], ["network.depth", "at most 4"]),
        (["network.width=10"], ["network.width", "3 colours", "width = 9"]),
        (["network.features=false", "network.wiener=false"], ["network.features", "neither"]),
        (["network.variant=mine"], ["network.variant", "paper, release"]),
        (["network.variant=release", "network.global_light=true"], ["network.global_light", "no veil and gain"]),
        (["train.light_scenes=10"], ["train.light_scenes", "network.global_light = true"]),
        (
            ["train.light_scenes=10", "network.global_light=true", "train.freeze=network"],
            ["train.light_scenes", "nobody to teach"],
        ),
        (["train.zoom=[0.5, 0.4]"], ["train.zoom", "the smaller first", "zoom = [0.4, 0.5]"]),
        (["train.zoom=[0.5, 1.1]"], ["train.zoom", "at most 1"]),
        (["train.zoom=0.5"], ["train.zoom", "must be a list"]),
        (["train.average=1.0"], ["train.average", "less than 1"]),
    ],
)
def test_what_is_refused(changes: list[str], words: list[str]):
    if not words:
        assert load_spec(QUICK, changes)
        return
    message = refusal(*changes)
    for word in ("overrides", *words):
        assert word in message


def test_a_design_of_any_number_of_colours_needs_no_network():
    """Twelve features go into no five colours; a spec that says nothing of a network is none the worse for it."""
    five = 'optics.wavelengths=["656 nm", "620 nm", "589 nm", "520 nm", "486 nm"]'
    assert len(load_spec(QUICK, [five]).optics.colours) == 5
    assert "network.width" in refusal(five, "network.depth=3")
