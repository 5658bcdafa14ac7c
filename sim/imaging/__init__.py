"""From a scene to the light on the sensor.

scene       a background and obstructions before it
disc        the aperture's shadow disc on pixels
convolve    linear convolution by real transforms, in one piece or in tiles
occlusion   how an obstruction takes light from what is behind it, by four models
common      the part of a far PSF that every part of the aperture sends alike
formation   the light on the sensor
field       the same for full frames, with PSFs that vary over the field
shadow      the wave-optics reference of obstructed light
"""
