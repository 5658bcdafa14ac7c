"""Classic designs by their formulas: phase in waves at places (y, x), metres, positive where light is late.

A slope of the phase of s waves per metre sends light of the wavelength w into the direction sine s w. A lens or an
axicon that makes light converge is thinner toward its rim.
"""

import numpy as np
from jaxtyping import Float

Waves = Float[np.ndarray, "*s"]
Places = Float[np.ndarray, "*s"]


def axicon(radius_m: Places, angle_rad: float, wavelength_m: float) -> Waves:
    """Cone that bends light toward the axis by an angle: a Bessel beam behind it, a ring in the focus of a lens.

    J. H. McLeod, J. Opt. Soc. Am. 44, 592 (1954).
    """
    return -radius_m * np.sin(angle_rad) / wavelength_m


def vortex(y_m: Places, x_m: Places, charge: int) -> Waves:
    """Spiral of `charge` waves per turn, counterclockwise: a dark core in the focus of a lens."""
    return charge * np.arctan2(y_m, x_m) / (2 * np.pi)


def blazed(y_m: Places, x_m: Places, period_m: float, azimuth_rad: float) -> Waves:
    """Sawtooth that sends light toward an azimuth, from +x toward +y, by a direction sine of wavelength / period."""
    return (x_m * np.cos(azimuth_rad) + y_m * np.sin(azimuth_rad)) / period_m


def lens_array(y_m: Places, x_m: Places, pitch_m: float, focal_length_m: float, wavelength_m: float) -> Waves:
    """Square lenses side by side, one of them in the middle."""
    y, x = (at - pitch_m * np.rint(at / pitch_m) for at in (y_m, x_m))
    return -(y**2 + x**2) / (2 * focal_length_m * wavelength_m)


def cubic(y_m: Places, x_m: Places, waves: float, radius_m: float) -> Waves:
    """Cubic phase, so many waves at the rim on each axis: a PSF that stays alike out of focus.

    E. R. Dowski and W. T. Cathey, Appl. Opt. 34, 1859 (1995).
    """
    return waves * ((y_m / radius_m) ** 3 + (x_m / radius_m) ** 3)


def quartic(radius_m: Places, waves: float, rim_m: float) -> Waves:
    """Spherical aberration with as much defocus against it, so many waves of each: zones focus on both sides.

    It is a lens whose power changes evenly with the area, from one on the axis to its opposite at the rim: `waves` of
    defocus on either side bring some zone into focus. S. Mezouari and A. R. Harvey, Opt. Lett. 28, 771 (2003).
    """
    square = (radius_m / rim_m) ** 2
    return waves * (square**2 - square)


def axilens(radius_m: Places, near_m: float, far_m: float, rim_m: float, wavelength_m: float) -> Waves:
    """Lens whose focal length grows with the square of the radius, from the first on the axis to the second at the rim.

    N. Davidson, A. A. Friesem and E. Hasman, Opt. Lett. 16, 523 (1991).
    """
    focal = near_m + (far_m - near_m) * (radius_m / rim_m) ** 2
    return -(radius_m**2) / (2 * focal * wavelength_m)


def logarithmic_asphere(radius_m: Places, near_m: float, far_m: float, rim_m: float, wavelength_m: float) -> Waves:
    """Lens whose zones of equal area focus at equally spaced distances, from the first to the second at the rim.

    W. Chi and N. George, Opt. Lett. 26, 875 (2001), for small angles: the slope at a radius r is r / (wavelength f(r)).
    """
    growth = (far_m - near_m) / rim_m**2
    return -np.log1p(growth * radius_m**2 / near_m) / (2 * growth * wavelength_m)
