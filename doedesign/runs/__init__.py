"""Designs on the disk.

    folder        run folders: manifest, checkpoint, resume
    level_maps    the level map of a run, of mask files, or of a map the user brings
"""
