"""All pictures of a report. Each function takes the path of a PNG file first and writes it whole or not at all.

draw_height("height.png", height_m, levels, camera, "automotive")
draw_psfs("psf.png", camera, bank, near_m, far_m)
draw_mtf("mtf.png", camera, bank, near_m, far_m, lens_bank)
"""

from doedesign.report.curves import draw_encircled, draw_history, draw_mtf
from doedesign.report.height import draw_height
from doedesign.report.pattern import draw_pattern
from doedesign.report.psfs import draw_psfs

__all__ = ["draw_encircled", "draw_height", "draw_history", "draw_mtf", "draw_pattern", "draw_psfs"]
