"""What light does with what is made.

Reading order, from the substance to the picture:

    material    refractive index of the DOE substrate, and its Fresnel loss
    aperture    the clear aperture: how much of each DOE cell is open
    camera      lens and sensor; the wave a source sends into the aperture
    pixel       integration of a sampled intensity over square sensor pixels
    pupil       the field behind the DOE
    farfield    pupil -> pixel energies, the default path (eqs. 7-9 of the paper)
    hankel      the same for rotationally symmetric pupils
    fresnel     the direct path (eq. 5): reference for the other two
    surface     the DOE as a process with errors makes it (`as_fabricated`), its leaked and its diffracted light
    psf         PSF banks: every colour and depth of one height map
    transfer    MTF of lens, DOE and pixel
    frames      a camera's image files, whatever their format
    measured    measured PSFs from camera files
    light       sRGB and linear light
    scene       what a camera looks at: a background and obstructions before it
    obstruction fences, raindrops, dirt and masks of a user, drawn from physical parameters
    disc        the aperture's shadow disc on pixels
    convolve    linear convolution by real transforms, in one piece or in tiles
    shadow      the reference of obstructed light: one point's wave past an obstruction, through the plate
    occlusion   how an obstruction takes light from what is behind it, by four models
    formation   from a scene to the light on the sensor
    field       the same for full frames, with PSFs that vary over the field
    noise       fast Poisson counts, and noise that gradients pass through
    sensor      from light to raw numbers, and back to an image
    metrics     numbers read off a PSF: far-spot energy, ring:disc, 0th order, energy budget
    store       PSF banks, height maps and pictures as OpenEXR files

Conventions (pinned by tests/sim/test_conventions.py):

* SI units; arrays `[y, x]`, row 0 at the lowest y; PSF banks `[wavelength, depth, y, x]`.
* Grids are centred: coordinate (i - (n-1)/2) * pitch, so the axis lies between samples for even n.
* Fields vary as exp(+ikz); more optical path means more phase, exp(+i phi). A surface that
  thickens toward +y sends light to +y.
* A PSF carries energy: its sum over an unbounded sensor is the power transmitted per unit power
  incident on the clear aperture. Nothing is renormalised.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
