"""Reconstruction: a network that turns the captures of a camera with its plate back into pictures.

conv, wiener    layers: convolutions, filters that undo a PSF
blocks          blocks of these
global_light    veil and gain from the whole picture
network         the network
baselines       deconvolution without training
weights, model  a network's file, and the folder that it shares with the PSFs of its plate
tiles, photos   captures of any size, from and to picture files
reconstruction  the result, and files: many captures into a folder
"""
