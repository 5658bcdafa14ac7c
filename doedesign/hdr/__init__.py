"""Lamps beyond a sensor's full well, read from the weak copies that a nearly flat plate throws beside them.

scenes    backgrounds with lamps many times brighter than white, by seed
capture   spectral PSFs with glare, and what a sensor that fills up makes of a scene
solver    the lamps' light from their copies and halos, one solver for every camera
network   a network that goes on from the solver's estimate, the same for every camera
learning  its training
study     both cameras before the same scenes, under several errors
scores    PSNR on a logarithmic scale where the scene saturates, in display values elsewhere
"""
