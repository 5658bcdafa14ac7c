"""Tolerance analysis: what a process that strays makes of a design, and how far it may stray.

    from doedesign.tolerancing import study

    plates = study("runs/automotive", errors={"overlay_x": "0.5 um"}, limits=["zeroth_order <= 5 %"])
    print(plates.monte_carlo(64).yield_)
    print(plates.budget("overlay_x", 0.9, draws=64))

Reading order:

    pool          plates on all cores of this machine
    cluster       plates on a Dask cluster
    journal       finished plates on the disk
    analysis      statistics, limits, yield
    sensitivity   which errors matter
    budget        how large an error may be
    studies       all of it behind one function
"""

from doedesign.tolerancing.analysis import QUANTITIES, PlateTable, Yield, limit_from_text, limit_text
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.sensitivity import Change, Index, Share, source_shares
from doedesign.tolerancing.studies import Plates, Study, study

__all__ = [
    "QUANTITIES",
    "Budget",
    "Change",
    "Index",
    "PlateTable",
    "Plates",
    "Share",
    "Study",
    "Yield",
    "limit_from_text",
    "limit_text",
    "source_shares",
    "study",
]
