"""The picture of a mask plate."""

import numpy as np
from PIL import Image

from doedesign.report.wafer import draw_wafer
from fab.layout.frame import draw_frame
from fab.layout.part import photomasks_of
from fab.layout.split import splits_of
from fab.layout.wafer import Wafer
from fab.levels import Levels


def drawn(path, wafer):
    levels = Levels(4, 300e-9)
    frame = draw_frame(
        wafer,
        photomasks_of(levels, (0, 1), "clear", wafer.chrome, wafer.zero_layer),
        levels,
        splits=splits_of(wafer, levels, (0,) * levels.bits, 1e-9),
        stem="A",
        digest="0" * 64,
        pitch_m=2e-6,
        minimum_line_m=1e-6,
        chrome_m=8e-3,
        aperture_m=4e-3,
        dbu_m=1e-9,
    )
    draw_wafer(path, wafer, frame, 4e-3, 1e-9, "plate")
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def test_every_clear_aperture_is_there_and_the_bytes_repeat(tmp_path):
    nine = drawn(tmp_path / "a.png", Wafer())
    four = drawn(tmp_path / "b.png", Wafer(dies=(2, 2)))
    grey = [int((np.abs(p - [0x8C, 0x8F, 0x94]).sum(axis=2) < 12).sum()) for p in (nine, four)]
    # Nine discs against four; rims and the frames of dies blur it by a few per cent.
    assert 2.0 < grey[0] / grey[1] < 2.5
    drawn(tmp_path / "c.png", Wafer())
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "c.png").read_bytes()
