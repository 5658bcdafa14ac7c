"""Fabrication of DOEs: from a level map to the mask files for a fab lab, and back.

The public names are those of `dir(fab)`; each is imported on its first use. The packages, in the order of the work:

    grid, aperture, height, levels, level_map    the pixel raster, outlines on it, heights, the staircase and its masks,
                                             the DOE itself
    process, deviations, stock, draws        what a lab does, its errors, ordinary processes with sources, random errors
    rules/         what a process can print, and a level map changed until it can
    layout/        the drawing: the DOE, its chrome, marks, test structures, dies, wafer
    gds/           GDSII and OASIS files, written once and read by two independent readers
    solids/        STEP, meshes and height maps for other programs
    runsheet/      what the lab does step by step, and what it measured
    manifest/      what every file of a mask order is
    verification/  the proof of an order from its files alone
    order/         the folder that goes to the lab
    plots/, figure, pictures                 pictures of all of it, and picture files
    units, errors, files, archive            lengths with units, the two errors, files that appear whole or not at all

Units and axes. Everything inside is SI and the unit stands in the name (``pitch_m``). Arrays are ``[y, x]``; row 0 is
the lowest y and +y is up, so the row index grows with y in the drawing as well. Heights are measured from the deepest
etched floor, so ``height_m >= 0``. Level l of L stands ``l * step`` high; bit k of ``L - 1 - l`` set means that mask k
opens there and etches ``2**k * step`` (or any other depth, see `Levels`). Mask bit k is drawn on layer k + 1. A polygon
in an etch layer means "etched here", a polygon in the chrome layer "chrome here".
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
