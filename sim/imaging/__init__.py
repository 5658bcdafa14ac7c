"""From a scene to the light on the sensor.

scene       a background and obstructions before it
disc        the aperture's shadow disc on pixels
convolve    linear convolution by real transforms, in one piece or in tiles
occlusion   how an obstruction takes light from what is behind it, by four models
common      the part of a far PSF that every part of the aperture sends alike
formation   the light on the sensor
parts       obstructed light through a wide aperture, part by part
filtering   how well one filter undoes the blur of all depths
field       the same for full frames, with PSFs that vary over the field
glare       veiling glare of a real lens, for PSFs
shadow      the wave-optics reference of obstructed light
"""
