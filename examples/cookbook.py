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
# # A plate for every task
#
# Every template of `doedesign new`, made small and fast, and what it does to light. Run it from the root of the
# repository, in JupyterLab or VS Code as a notebook (jupytext), or as it is. It takes about two minutes on two cores,
# most of it spent compiling. The templates as they are, and what they reach, are in the documentation under *Tasks*.

# %%
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image
from skimage import data

import doedesign as dd
import sim
from doedesign.areas.shape import areas_of_design
from doedesign.focus.depth import focus_of_design
from doedesign.spots.design import orders_of_design
from doedesign.templates import template_names, template_summary, template_text

for name in template_names():
    print(f"{name:12} {template_summary(name)}")


# %%
def designed(name: str, **changes: Any) -> dd.Design:
    """Design a template, with some keys of its spec changed."""
    with TemporaryDirectory() as folder:
        spec = Path(folder) / f"{name}.toml"
        spec.write_text(template_text(name))
        return dd.optimize(dd.load_spec(spec, **changes))


# %% [markdown]
# ## Spots on a sensor: `splitter`
#
# Five by five spots, 250 um apart behind a lens of 20 mm, and the light of each.

# %%
splitter = designed("splitter", steps=40)
orders_of_design(splitter, splitter.as_optic())[0].plot()
# %% [markdown]
# ## Orders of a unit cell: `fan_out`
#
# Angles follow from the period alone; smaller here than the template, 3 x 3 orders.

# %%
fan_out = designed("fan_out", steps=20, spots__count=[3, 3])
orders_of_design(fan_out, fan_out.as_optic())[0].plot()
# %% [markdown]
# ## Even light: `diffuser`, `top_hat`, `colours`
#
# A square of even light from a flat beam. A smaller plate than the template's, and fewer steps: less even, too.
# `top_hat` is the same for a Gaussian beam, `colours` has an area for each of three lasers.

# %%
diffuser = designed("diffuser", doe__samples=256, doe__aperture="0.512 mm", steps=30)
areas_of_design(diffuser, diffuser.as_optic())[0].plot()
# %% [markdown]
# ## Lenses: `lens`, `bifocal`, `edof`
#
# A flat lens is a classic plate: it needs no steps. Two foci, or a long one, are found ring by ring.

# %%
lens = designed("lens", steps=0)
sim.psf(lens)

# %%
bifocal = designed("bifocal", doe__samples=500, doe__aperture="1 mm", steps=60)
focus_of_design(bifocal, bifocal.as_optic()).plot()
# %% [markdown]
# ## Classic plates: `vortex`, `axicon`, `lens_array`

# %%
sim.psf(designed("vortex", steps=0))

# %%
sim.psf(designed("axicon", steps=0))

# %%
sim.psf(designed("lens_array", steps=0))

# %% [markdown]
# ## A plate to see past dirt: `see_through`
#
# Far light stays in a spot, near light is spread over the window.

# %%
see_through = designed("see_through", steps=60)
see_through

# %%
sim.psf(see_through, depths=["6 mm", "1.2 m"])

# %% [markdown]
# A picture photographed through dirt. Which share of the light dirt takes away has to be said: `reciprocal` is the
# most faithful model.

# %%
Image.fromarray(data.chelsea()).save("cat.png")
shot = dd.simulate("cat.png", see_through, obstruction="dirt", occlusion="reciprocal")
shot

# %% [markdown]
# What the released network makes of it. It was trained for another plate; PSFs are inputs, so it takes those of this
# one.

# %%
dd.Model.released().reconstruct(shot)
