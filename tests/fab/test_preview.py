import io

import numpy as np
import pytest
from PIL import Image

from fab.levels import Levels
from fab.order.preview import _blocks, preview_png
from fab.units import NM, UM
from tests.fab.maps import level_map_from


@pytest.mark.parametrize(("count", "shape"), [(2, (3, 5)), (64, (70, 64))])
def test_the_picture_is_a_png_whose_bytes_depend_on_the_masks_alone(count, shape):
    level = np.random.default_rng(1).integers(0, count, shape)
    level_map = level_map_from(level, Levels(count, 75 * NM), UM, 3 * UM)

    def draw():
        return preview_png("DOE", level_map, (UM, 600 * UM))

    picture = draw()
    assert picture == draw()
    with Image.open(io.BytesIO(picture), formats=["PNG"]) as image:
        assert min(image.size) > 800
        assert "Software" not in image.info
        assert len(np.unique(np.asarray(image.convert("L")))) > 10


def test_an_overview_shows_the_mean_of_its_blocks():
    values = np.random.default_rng(1).integers(0, 16, (1200, 900)).astype(np.uint8)
    overview = _blocks(values)
    assert overview.shape == (400, 450)
    assert overview[0, 0] == pytest.approx(values[:3, :2].mean())
    # float32 means of small whole numbers.
    assert overview.mean() == pytest.approx(values.mean(), rel=1e-5)
