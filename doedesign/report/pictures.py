"""All pictures of a report. Each function takes the path of a PNG file first and writes it whole or not at all.

draw_height("height.png", height_m, levels, camera, "automotive")
draw_psfs("psf.png", camera, bank, near_m, far_m)
draw_mtf("mtf.png", camera, bank, near_m, far_m, lens_bank)
draw_histograms("histograms.png", camera, plates.table, nominal.table, limits)
"""

from doedesign.report.calibration import draw_check, draw_estimates, draw_fitted_psfs
from doedesign.report.contact import draw_contact
from doedesign.report.curves import draw_encircled, draw_history, draw_mtf
from doedesign.report.family import draw_family
from doedesign.report.height import draw_height
from doedesign.report.pattern import draw_pattern
from doedesign.report.plate import draw_split
from doedesign.report.psfs import draw_psfs
from doedesign.report.tolerance import draw_budget, draw_changes, draw_histograms, draw_shares, draw_yield

__all__ = [
    "draw_budget",
    "draw_changes",
    "draw_check",
    "draw_contact",
    "draw_encircled",
    "draw_estimates",
    "draw_family",
    "draw_fitted_psfs",
    "draw_height",
    "draw_histograms",
    "draw_history",
    "draw_mtf",
    "draw_pattern",
    "draw_psfs",
    "draw_shares",
    "draw_split",
    "draw_yield",
]
