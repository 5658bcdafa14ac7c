"""Designs on the disk.

folder        run folders: manifest, checkpoint, resume
level_maps    the level map of a run, of mask files, or of a map the user brings
psfs          PSFs of a run as optimised, as quantised and as drawn; fabricated those with process errors
results       folders of results
"""
