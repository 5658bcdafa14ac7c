"""The session of docs/notebooks.md, as a user types it, with the quick spec; every value draws itself."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from skimage import data

import doedesign as dd
import fab
import sim

EXAMPLES = Path(__file__).parents[1] / "examples"
QUICK = EXAMPLES / "quick.toml"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> dd.Design:
    """The quick design after a few steps; nothing is written where the tests run."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("session"))
    try:
        return dd.optimize(dd.load_spec(QUICK, steps=6))
    finally:
        os.chdir(before)


def shown(value: object) -> str:
    """Draw a value, and what a notebook shows of it."""
    drawn = value.plot()  # type: ignore[attr-defined]
    assert isinstance(drawn, Figure | Axes) or all(isinstance(one, Axes) for one in np.ravel(drawn))
    html = value._repr_html_()  # type: ignore[attr-defined]
    assert "<table" in html
    assert "data:image/png;base64," in html
    return html


def test_one_object_carries_the_design(design: dd.Design):
    assert isinstance(design.level_map, fab.LevelMap)
    assert design.height_m.shape == design.camera.grid.shape == (320, 320)
    assert len(design.history) == 6
    assert design.history[-1]["loss"] < design.history[0]["loss"]
    assert "quick" in shown(design)


def test_psfs_of_a_design(design: dd.Design):
    bank = sim.psf(design, depths=["5 mm", "inf"])
    assert bank.energy.shape == (3, 2, 128, 128)
    assert bank.depths_m == (5e-3, np.inf)
    shown(bank)


def test_the_gradient_goes_through(design: dd.Design):
    """Against a finite difference along a random direction."""

    def energy(height_m: jax.Array) -> jax.Array:
        return sim.psf(height_m, design.camera, ["5 mm"]).energy.sum()

    height = jnp.asarray(design.height_m)
    gradient = jax.grad(energy)(height)
    assert gradient.shape == height.shape
    direction = jnp.asarray(np.random.default_rng(0).normal(size=height.shape), jnp.float32)
    step = 2e-9
    difference = (energy(height + step * direction) - energy(height - step * direction)) / (2 * step)
    # Sums of 5e4 pixels in single precision leave 1e-6 of the energy; the slope is 1e-2 per nanometre.
    assert float(jnp.vdot(gradient, direction)) == pytest.approx(float(difference), rel=0.03)


def test_rules_orders_and_their_proof(design: dd.Design, tmp_path: Path):
    rules = fab.check(design.level_map, "contact_aligner")
    assert not rules.clean
    shown(rules)
    order = fab.write_order(tmp_path / "quick", design.level_map, process="contact_aligner")
    report = fab.verify(order)
    assert report.passed
    assert "<table" in report._repr_html_()
    assert (tmp_path / "quick" / "manifest.json").is_file()


def test_a_plate_as_fabricated(design: dd.Design):
    plate = design.fabricated("contact_aligner", seed=0)
    ratio = sim.psf(plate, depths="5 mm").ring_to_disc()
    as_drawn = sim.psf(design, depths="5 mm").ring_to_disc()
    assert np.shape(ratio) == np.shape(as_drawn)
    assert (np.asarray(ratio) != np.asarray(as_drawn)).all()


def test_tolerances(design: dd.Design):
    study = dd.tolerance(design, process="ideal", errors={"overlay_x": "0.5 um"}, limits=["strehl >= 0.6"], draws=4)
    assert study.yield_ is not None
    assert 0 <= study.yield_.share <= 1
    shown(study)


def test_a_capture_and_its_reconstruction(design: dd.Design, tmp_path: Path):
    Image.fromarray(data.chelsea()).save(tmp_path / "cat.png")
    shot = dd.simulate(tmp_path / "cat.png", design, obstruction="dirt", occlusion="reciprocal")
    shown(shot)
    picture = dd.Model.released().reconstruct(shot)
    assert np.isfinite(np.asarray(picture.light)).all()
    picture.plot()
