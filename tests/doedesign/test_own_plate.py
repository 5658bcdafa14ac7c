"""A plate of one's own, from an array of heights and without a spec: what takes it, and what is said of slips."""

from typing import Any, cast

import numpy as np
import pytest

import doedesign as dd
import fab
import sim
from fab.errors import InputError

PITCH_M, SIDE = 2e-6, 32
GRID = fab.Grid((SIDE, SIDE), PITCH_M)
CAMERA = sim.Camera(GRID, 60e-6, "fused_silica", (sim.Colour("green", (550e-9,), (1.0,)),), 1e-3, 2e-6, 32)
STEP_M = sim.full_wave_height_m("fused_silica", 550e-9) / 4
LEVELS = fab.Levels(4, STEP_M)
AZIMUTH = np.arctan2(GRID.axis_m("y")[:, None], GRID.axis_m("x"))
HEIGHT = fab.HeightMap((AZIMUTH / (2 * np.pi) % 1.0) * 4 * STEP_M, GRID, 60e-6)  # a vortex
PLATE = fab.LevelMap.from_height(HEIGHT, LEVELS, "vortex", wrapped=True)
DESIGN = dd.Design(PLATE, CAMERA, (), (np.inf,))


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("variation", "told"),
    [
        (fab.Variation(overlay_x_m=cast(Any, 1e-6)), r"overlay_x_m: must have one value per mask, 2, but got 1e-06\. "),
        (fab.Variation(overlay_x_m=cast(Any, "1 um")), r"must have one value per mask.*For example \(1e-6, 0\.0\)"),
        (fab.Variation(overlay_x_m=cast(Any, ("1 um", 0.0))), "overlay_x_m: must be a number, metres, but got '1 um'"),
        (fab.Variation(common_depth_scale=cast(Any, "3 %")), "must be a number, a share, 0.03 for 3 %, but got '3 %'"),
        ({"overlay_x_m": (1e-6, 0.0)}, r"variation: must be a fab\.Variation or a TOML file, but got \{"),
    ],
)
def test_errors_of_a_plate_are_numbers_in_si_units(variation, told):
    with pytest.raises(InputError, match=told):
        DESIGN.fabricated(variation=variation)


@pytest.mark.usefixtures("annotations_unchecked")
def test_a_process_and_a_draw_of_another_kind_are_told():
    wrong = cast(Any, {"stock": "contact_aligner"})
    with pytest.raises(InputError, match=r"process: must be a process or the name of one, but got \{"):
        DESIGN.fabricated(wrong)
    with pytest.raises(InputError, match=r"process: must be a process or the name of one, but got \{"):
        fab.check(PLATE, wrong)
    with pytest.raises(InputError, match='draw: must be the key of a plate of this study, but got "3"'):
        DESIGN.fabricated("contact_aligner", seed=0, draw=cast(Any, 3))
    with pytest.raises(InputError, match=r"process: must be a Process, but got a str\. For example fab\.process_from"):
        sim.as_fabricated(PLATE, CAMERA, cast(Any, "contact_aligner"), fab.Variation())
    with pytest.raises(InputError, match="process: levels: must be a Levels, but got an int"):
        fab.Process(cast(Any, 4))
    with pytest.raises(InputError, match="minimum_line_m: must be finite and not negative, in metres, but got '1 um'"):
        fab.Process(LEVELS, minimum_line_m=cast(Any, "1 um"))
    for spread in ((0.0, 1e-6), 1e-6):
        with pytest.raises(InputError, match=r"must be a mean and a sigma in SI units, .*fab\.Normal"):
            fab.Process(LEVELS, spreads={"overlay_x_m[0]": cast(Any, spread)})
    with pytest.raises(InputError, match="mean and sigma must be finite numbers"):
        fab.Process(LEVELS, spreads={"overlay_x_m[0]": fab.Normal(cast(Any, "1 um"), 0.0)})


def test_a_level_map_is_fabricated_as_its_numbers_are():
    errors = fab.Variation(overlay_x_m=cast(Any, [0.2e-6, 0.0]), cd_bias_m=cast(Any, np.array([1e-7, 0.0])))
    assert errors.overlay_x_m == (0.2e-6, 0.0)
    assert hash(errors) == hash(fab.Variation(overlay_x_m=(0.2e-6, 0.0), cd_bias_m=(1e-7, 0.0)))
    made, same = (sim.as_fabricated(one, CAMERA, fab.Process(LEVELS), errors) for one in (PLATE, PLATE.level))
    np.testing.assert_array_equal(made.transmission, same.transmission)
