"""Which depths a step of the optimisation looks at, and where the image lies."""

from collections import Counter

import numpy as np

from doedesign.design.problem import SeenSource, SourceSet

# Two lines, three near depths and two far ones; a number stands for the waves of each.
NEAR = tuple(tuple(SeenSource(np.float32(10 * line + depth)) for depth in range(3)) for line in range(2))
FAR = tuple(tuple(SeenSource(np.float32(100 + 10 * line + depth)) for depth in range(2)) for line in range(2))
LENS = np.arange(6, dtype=np.float32).reshape(2, 3)
DISC_RADIUS_M = np.array([3e-4, 2e-4, 1e-4], np.float32)
SOURCES = SourceSet(NEAR, FAR, LENS, DISC_RADIUS_M, 1e-6)


def test_the_first_look_is_at_the_first_depths_on_the_axis():
    found = SOURCES.first_look()
    assert found.near == ((SeenSource(0.0),), (SeenSource(10.0),))
    assert found.far == ((SeenSource(100.0),), (SeenSource(110.0),))
    assert np.asarray(found.lens).tolist() == [[0.0], [3.0]]
    assert np.asarray(found.disc_radius_m).tolist() == DISC_RADIUS_M[:1].tolist()
    assert found.offset_m is None


def test_every_depth_is_seen_equally_often_by_all_lines():
    looks = [SOURCES.look(5, step) for step in range(12)]
    assert set(Counter(look.near[0][0] for look in looks).values()) == {4}
    assert set(Counter(look.far[0][0] for look in looks).values()) == {6}
    for look in looks:
        assert look.near[1][0].wave == look.near[0][0].wave + 10
        assert look.far[1][0].wave == look.far[0][0].wave + 10
        assert np.asarray(look.lens)[:, 0].tolist() == LENS[:, int(look.near[0][0].wave)].tolist()
        assert np.asarray(look.disc_radius_m).tolist() == [DISC_RADIUS_M[int(look.near[0][0].wave)]]


def test_a_step_is_the_same_again_and_others_differ():
    first, again, other = (SOURCES.look(5, step).offset_m for step in (3, 3, 4))
    assert first is not None
    assert again is not None
    assert other is not None
    assert first.tolist() == again.tolist() != other.tolist()
    offsets = np.array([look.offset_m for look in (SOURCES.look(1, step) for step in range(200))])
    # Even over a square of a micrometre to either side: two hundred come within a tenth of its edges.
    assert np.abs(offsets).max() <= 1e-6
    assert (offsets.max(0) > 0.9e-6).all()
    assert (offsets.min(0) < -0.9e-6).all()


def test_where_depths_are_compared_a_step_looks_at_all_of_them():
    whole = SOURCES._replace(whole=True)
    for found in (whole.first_look(), whole.look(5, 3)):
        assert found.near == NEAR
        assert found.far == FAR
        assert np.asarray(found.lens).tolist() == LENS.tolist()


def test_without_near_depths_or_displacement():
    found = SourceSet(((), ()), FAR, LENS[:, :0], DISC_RADIUS_M[:0], 0.0)
    for look in (found.first_look(), found.look(0, 7)):
        assert look.near == ((), ())
        assert look.offset_m is None
        assert np.asarray(look.lens).shape == (2, 0)
