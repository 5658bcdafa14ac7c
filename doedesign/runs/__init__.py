"""Designs on the disk.

folder        run folders: manifest, checkpoint, resume
level_maps    the level map of a run, of mask files, or of a map the user brings
psfs          PSFs of a run as optimised, as quantised and as drawn; fabricated those with process errors
certificate   rows and squares of a design against Maxwell's equations; verdict: its 0th orders for metrics and sheets
costs         time and memory that commands took
results       folders of results; journal: finished items of long work, kept one by one
"""
