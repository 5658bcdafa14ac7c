"""Reconstruction: a network that turns the captures of a camera with its plate back into pictures.

data        scenes for training: pictures, crops and obstructions, seeded, resumable, prepared ahead
"""
