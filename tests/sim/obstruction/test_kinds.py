"""What holds for every kind of obstruction."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fab.errors import InputError
from sim.obstruction import (
    OBSTRUCTIONS,
    CameraView,
    Dirt,
    DirtRaindrop,
    DirtRaindropFence,
    Fence,
    MaskFolder,
    ObstructionKind,
    Raindrop,
)

# Frames as wide as those of the paper's two tasks, with four times fewer pixels each way.
AUTOMOTIVE = CameraView((128, 128), 14.8e-6, 8e-3)
DSLR = CameraView((128, 128), 51.6e-6, 50e-3)

# Depth, and mean share of the frame that 16 draws cover: what the defaults give, and as much again either way.
EXPECTED = {
    "fence": (DSLR, (0.4, 0.8), (0.1, 0.32)),
    "raindrop": (AUTOMOTIVE, (0.05, 0.12), (0.03, 0.16)),
    "dirt": (AUTOMOTIVE, (0.05, 0.12), (0.15, 0.28)),
    "dirt_raindrop": (AUTOMOTIVE, (0.05, 0.12), (0.06, 0.25)),
    "dirt_raindrop_fence": (AUTOMOTIVE, (0.05, 0.8), (0.08, 0.3)),
    "release_fence": (DSLR, (0.4, 0.8), (0.1, 0.35)),
    "release_raindrop": (AUTOMOTIVE, (0.05, 0.12), (0.01, 0.06)),
    "release_dirt": (AUTOMOTIVE, (0.05, 0.12), (0.2, 0.4)),
    "folder": (AUTOMOTIVE, (0.05, 0.12), (0.05, 0.5)),
}


def made(name: str, folder: Path) -> ObstructionKind:
    if name != "folder":
        return OBSTRUCTIONS[name]()
    Image.fromarray(np.pad(np.full((40, 60), 255, np.uint8), 10)).save(folder / "patch.png")
    return MaskFolder(folder, width_m=0.01)


@pytest.fixture
def background(rng: np.random.Generator) -> np.ndarray:
    coarse = rng.uniform(0, 1, (3, 16, 16)).astype(np.float32)
    return np.kron(coarse, np.ones((8, 8), np.float32))


def test_every_name_is_known():
    assert set(OBSTRUCTIONS) == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_draws_are_physical_repeatable_and_cover_a_usual_share(name: str, background: np.ndarray, tmp_path: Path):
    view, depths_m, band = EXPECTED[name]
    kind = made(name, tmp_path)
    before = background.copy()
    shares, seen = [], set()
    for seed in range(16):
        drawn = kind.draw(np.random.default_rng(seed), view, background)
        mask, radiance = np.asarray(drawn.mask), np.asarray(drawn.radiance)
        assert mask.dtype == radiance.dtype == np.float32
        assert mask.shape == view.shape
        assert radiance.shape == background.shape
        assert 0 <= mask.min() <= mask.max() <= 1
        assert 0 <= radiance.min() <= radiance.max() <= 1
        assert isinstance(drawn.depth_m, float)
        assert depths_m[0] <= drawn.depth_m <= depths_m[1]
        assert mask.max() > 0
        shares.append(mask.mean())
        again = kind.draw(np.random.default_rng(seed), view, background)
        assert (mask.tobytes(), radiance.tobytes()) == (np.asarray(again.mask).tobytes(), again.radiance.tobytes())
        assert drawn.depth_m == again.depth_m
        seen.add((mask.tobytes(), radiance.tobytes()))
    assert len(seen) == 16
    assert band[0] < np.mean(shares) < band[1]
    np.testing.assert_array_equal(background, before)


@pytest.mark.parametrize("name", EXPECTED)
def test_a_background_of_another_size_is_refused(name: str, tmp_path: Path):
    with pytest.raises(ValueError, match="`background` must have the shape"):
        made(name, tmp_path).draw(np.random.default_rng(0), AUTOMOTIVE, np.zeros((3, 64, 128), np.float32))


@pytest.mark.parametrize("name", EXPECTED)
def test_frames_need_not_be_square(name: str, tmp_path: Path):
    view = CameraView((60, 90), 30e-6, 8e-3)
    drawn = made(name, tmp_path).draw(np.random.default_rng(0), view, np.full((3, 60, 90), 0.3, np.float32))
    assert drawn.mask.shape == (60, 90)


def test_the_coin_falls_on_either_side(background: np.ndarray):
    def first(kind: ObstructionKind, seed: int) -> bytes:
        return np.asarray(kind.draw(np.random.default_rng(seed), AUTOMOTIVE, background).mask).tobytes()

    both = DirtRaindrop()
    dirty = [both.draw(np.random.default_rng(s), AUTOMOTIVE, background).radiance.max() < 0.5 for s in range(20)]
    assert 4 <= sum(dirty) <= 16
    never, always = DirtRaindrop(dirt_share=0.0), DirtRaindrop(dirt_share=1.0)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rng.uniform()
        state = rng.bit_generator.state
        expected = Dirt().draw(rng, AUTOMOTIVE, background)
        assert first(always, seed) == np.asarray(expected.mask).tobytes()
        rng.bit_generator.state = state
        expected = Raindrop().draw(rng, AUTOMOTIVE, background)
        assert first(never, seed) == np.asarray(expected.mask).tobytes()


def test_lots_fall_on_all_three(background: np.ndarray):
    """One lot, then what that kind would draw by itself."""
    three = DirtRaindropFence(dirt_share=0.5, raindrop_share=0.25)
    counts = {Dirt: 0, Raindrop: 0, Fence: 0}
    for seed in range(40):
        rng = np.random.default_rng(seed)
        lot = rng.uniform()
        kind = Dirt() if lot < 0.5 else Raindrop() if lot < 0.75 else Fence()
        counts[type(kind)] += 1
        expected = kind.draw(rng, AUTOMOTIVE, background)
        found = three.draw(np.random.default_rng(seed), AUTOMOTIVE, background)
        np.testing.assert_array_equal(found.mask, expected.mask)
        assert found.depth_m == expected.depth_m
    assert min(counts.values()) >= 4
    with pytest.raises(InputError, match="shares must add up to at most 1"):
        DirtRaindropFence(dirt_share=0.7, raindrop_share=0.4)


@pytest.mark.parametrize("kind", [Dirt, Fence, Raindrop])
def test_shares_end_at_one(kind: Any):
    shares = [name for name, (low, high) in kind.limits.items() if (low, high) == (0.0, 1.0)]
    assert {"light", "persistence", "opacity", "ambient", "colour_jitter", "grain"} & set(kind.limits) <= set(shares)
    for name in shares:
        with pytest.raises(InputError, match=f"{name}"):
            kind(**{name: 1.01 if np.ndim(getattr(kind(), name)) == 0 else (1.01, 1.01)})


@pytest.mark.parametrize("kind", [kind for name, kind in OBSTRUCTIONS.items() if name != "folder"])
@pytest.mark.usefixtures("annotations_unchecked")
def test_a_parameter_is_of_its_kind(kind: Any):
    """A range is no number, a number is no range, and neither is text, NaN or what no float holds."""
    usual = kind()
    for name in kind.limits:
        given = getattr(usual, name)
        middle = float(np.mean(given))
        wrong: list[Any] = [middle, (middle,)] if isinstance(given, tuple) else [(middle, middle)]
        if isinstance(given, int):
            wrong.append(given + 0.5)
        for value in (*wrong, "1", None, True, np.nan, (np.nan, np.nan), 10**400, (0, 10**400)):
            with pytest.raises(InputError, match=f"{kind.name}: {name}: must be (two|a whole|a) number"):
                kind(**{name: value})


@pytest.mark.parametrize("patterns", [3, "bars", (), (["bars"],), ("chain",)])
@pytest.mark.usefixtures("annotations_unchecked")
def test_patterns_are_a_list_of_names(patterns: Any):
    with pytest.raises(InputError, match="fence: patterns: must be a list of patterns"):
        Fence(patterns=patterns)


def test_a_fence_hangs_and_bends_by_a_tenth_of_a_metre_at_most():
    with pytest.raises(InputError, match="sag_m"):
        Fence(sag_m=(0.0, 0.11))
    with pytest.raises(InputError, match="bend_m"):
        Fence(bend_m=(0.0, 0.11))


def test_no_fence_shines_by_itself():
    """Its light is a share, from 0 to 1, of that of a white surface in its place."""
    view = CameraView((24, 24), 10e-6, 10e-3)
    for seed in range(60):
        drawn = Fence().draw(np.random.default_rng(seed), view, np.ones((3, 24, 24), np.float32))
        light = np.asarray(drawn.radiance)
        assert light.min() >= 0
        assert light.max() <= 1
