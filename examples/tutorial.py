# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a first design to a second wafer
#
# The tutorial of the documentation in Python. Run it from the root of the repository: in JupyterLab or VS Code as a
# notebook (jupytext), or as it is, `python examples/tutorial.py`. It takes a quarter of the quick example's cells, so
# that the whole way takes about two minutes on two cores, much of it spent compiling. Lengths given to functions are SI
# numbers, or text with a unit; those of a spec are text with a unit, as in its TOML file.

# %%
import sys
from pathlib import Path

import jax

import doedesign as dd
import fab
import sim

sys.path.insert(0, "examples")
from measure_psfs import measure  # photographs of a simulated plate

# %% [markdown]
# ## The spec, and the design
#
# A design is a level map, the camera it is for, and the history of its loss. With `out` it is kept in a run folder
# and can be resumed; without, it stays in memory.

# %%
spec = dd.load_spec(
    "examples/quick.toml", steps=60, name="tutorial", doe__samples=160, doe__aperture="0.296 mm", sensor__window=96
)
design = dd.optimize(spec, "runs/tutorial")
design

# %%
design.level_map, design.height_m.shape, design.camera.aperture_m

# %% [markdown]
# ## Light
#
# PSFs for every colour and distance of the source. The sum of one is the power that arrives in the window.

# %%
bank = sim.psf(design, depths=["5 mm", "inf"])
bank

# %% [markdown]
# Gradients go through PSFs, plates as fabricated, occlusion models, sensor and metrics.

# %%
g = jax.grad(lambda h: sim.psf(h, design.camera, ["5 mm"]).energy.sum())(design.height_m)
g.shape

# %% [markdown]
# ## Masks and their proof
#
# What the process cannot print, the order, and its proof from the files alone.

# %%
fab.check(design.level_map, "contact_aligner")

# %%
order = dd.write_masks(design, "masks/tutorial")
order

# %%
fab.verify("masks/tutorial")

# %% [markdown]
# ## A plate as a process makes it
#
# One plate, and what many such plates would be like.

# %%
plate = design.fabricated("contact_aligner", seed=0)
sim.psf(plate, depths="5 mm").ring_to_disc(), sim.psf(design, depths="5 mm").ring_to_disc()

# %%
study = dd.tolerance(design, process="ideal", errors={"overlay_x": "0.5 um"}, limits=["strehl >= 0.6"], draws=32)
study

# %% [markdown]
# ## The plate that came back
#
# Photographs of a point source through a plate whose errors nobody knows. Until there are real ones, they are
# simulated, with noise, offset and a limited range; the truth is in `hidden.toml`.

# %%
measurement = measure(Path("runs/tutorial"), Path("runs/tutorial/measurement"))
found = dd.calibrate(design, measurement, out="runs/tutorial/calibration")
found

# %%
print(Path("runs/tutorial/measurement/hidden.toml").read_text())

# %% [markdown]
# ## The second wafer
#
# The depths to command and the edges to draw with which this process makes the design. Overlay is drawn anew for
# every wafer, so it is left out. The new run aims at the same plate.

# %%
second = dd.precompensate(
    "runs/tutorial",
    "runs/tutorial_v2",
    process="runs/tutorial/calibration/process-estimate.toml",
    random=["overlay"],
    evaluations=20,
)
print(Path("runs/tutorial_v2/precompensation.csv").read_text())

# %%
dd.write_masks(second, "masks/tutorial_v2")
