"""Tolerance analysis: yield of a design under process errors, sensitivities, and how large errors may be.

    result = dd.tolerance(design, errors={"overlay_x": "0.5 um"}, limits=["zeroth_order <= 5 %"], draws=64)
    result.yield_, result.plot()
    asked = dd.study(design, errors={"overlay_x": "0.5 um"}, limits=["zeroth_order <= 5 %"])    # one question at a time
    print(asked.budget("overlay_x", 0.9, draws=64))

Reading order (`fab.draws` says which draws there are; each has a key from which it can be made again alone):

    pool          draws as items of work
    journal       lines of finished draws on the disk
    analysis      statistics, limits, yield
    sensitivity   which errors matter
    budget        how large an error may be
    studies       questions to one design and one process
    results       the usual questions behind one function
    result_files  its files; plots draws its pictures

Nothing is imported here: a worker that imports `pool` must set up its threads before jax is loaded.
"""
