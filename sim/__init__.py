"""The light behind the things that `fab` makes.

Reading order, from the substance to the picture:

    material    refractive index of the DOE substrate, and its Fresnel loss
    aperture    the clear aperture: how much of each DOE cell is open
    illumination beams that light the DOE
    lens        where the light of a direction lands: sine or tangent, distortion
    camera      lens and sensor, and the light that arrives
    source      the path from a source to the cells, for one wavelength, depth and field angle
    propagation pupil -> pixel energies: the far field (eqs. 7-9 of the paper), for rings, and the direct path (eq. 5)
    optic       whatever images a point source: height maps and rings
    rigorous    Maxwell's equations for rows of cells, and height maps with the light of their walls (`with_edges`)
    surface     the DOE as a process with errors makes it (`as_fabricated`), its leaked and its diffracted light
    psf_bank    PSFs: every colour and depth of one optic (`psf`)
    metrics     numbers read off a PSF or a DOE: far-spot energy, ring:disc, 0th order, Strehl ratio, energy budget
    transfer    MTF of lens, DOE and pixel
    frames      a camera's image files, whatever their format
    measured    measured PSFs from camera files
    light       sRGB and linear light
    obstruction fences, raindrops, dirt and masks of a user, drawn from physical parameters
    imaging     from a scene to the light on the sensor
    sensor      from light to raw numbers, and back to an image; noise that gradients pass through
    tracing     sums and stacks of arrays that jax may be tracing
    store       PSF banks, height maps and pictures as OpenEXR files
    plots       pictures of all this

Conventions (pinned by tests/sim/test_conventions.py):

* SI units; arrays `[y, x]`, row 0 at the lowest y; PSF banks `[colour, depth, y, x]`.
* Grids are centred: coordinate (i - (n-1)/2) * pitch, so the axis lies between samples for even n.
* Fields vary as exp(+ikz); more optical path means more phase, exp(+i phi). A surface that
  thickens toward +y sends light to +y.
* A PSF carries energy: its sum over an unbounded sensor is the power transmitted per unit power
  incident on the clear aperture. Nothing is renormalised.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
