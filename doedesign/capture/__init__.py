"""Scenes photographed through a plate.

from_spec     a spec's obstruction, sensor and colours
images        pictures of a folder
image_files   captures as OpenEXR or PNG
camera        a scene through PSFs onto the sensor
scenes        the stream of scenes that simulation and training share
simulate      one scene through a plate, and through a flat one, onto the same sensor
folder        many of them into a folder
"""
