"""Captures behind dirt of several kinds: what is compared, and that a flat plate gains nothing."""

import sys
from pathlib import Path

import numpy as np
import pytest

import doedesign as dd
from doedesign.capture.images import sample_files
from doedesign.spec import load_spec
from sim.imaging.scene import Obstruction, Scene
from sim.light import linear_from_srgb

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import heavier_dirt  # pyright: ignore[reportMissingImports]

SPEC = Path(__file__).parents[2] / "examples" / "automotive_cpu.toml"


def test_display_values_stand_for_light():
    shown = np.random.default_rng(3).random((3, 4, 4)).astype(np.float32)
    light = np.asarray(linear_from_srgb(shown), np.float32)
    mask = np.eye(4, dtype=np.float32)
    found = heavier_dirt.in_display_values(Scene(light, np.inf, (Obstruction(mask, light[::-1], 0.1),)))
    # Single precision, by way of a power of 2.4 and back.
    np.testing.assert_allclose(found.background, shown, atol=2e-6)
    np.testing.assert_allclose(found.obstructions[0].radiance, shown[::-1], atol=2e-6)
    assert (found.background_depth_m, found.obstructions[0].depth_m) == (np.inf, 0.1)
    assert found.obstructions[0].mask is mask


def test_the_dirt_of_the_table_is_that_of_the_spec():
    own = load_spec(SPEC).obstruction
    kind, options = heavier_dirt.DIRT["that of the table"]
    asked = load_spec(SPEC, [f'obstruction.kind="{kind}"', f"obstruction.options={{ {options} }}"]).obstruction
    assert asked == own


@pytest.mark.slow
def test_a_flat_plate_gains_nothing(tmp_path: Path):
    """But for its faces, which take as much from flat glass: both cameras have one."""
    small = ["doe.samples=120", 'doe.aperture="444 um"', "optimize.steps=0", 'optimize.start="flat"', "limit=[]"]
    dd.optimize(load_spec(SPEC, [*small, "train.size=64"]), tmp_path / "run")
    for display in (False, True):
        row = heavier_dirt.compare(tmp_path / "run", sample_files()[:2], "covers half", 4, display=display)
        assert (row.gain, row.gain_low, row.gain_high) == (0.0, 0.0, 0.0)
        assert (row.conventional, row.conventional_full) == (row.plate, row.plate_full)
        assert 0.3 < row.covered < 0.7
        # What dirt covers is worse than the rest.
        assert row.conventional < row.conventional_full
