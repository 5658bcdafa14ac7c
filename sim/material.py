"""Refractive indices of DOE substrates and resists, and what their faces reflect.

Every entry is a dispersion formula with its published coefficients, range and citation. A wavelength
outside the range is refused, never extrapolated. For other materials an index of one's own stands in place of a name:

- "n=1.52", the same at every wavelength;
- "n=1.586,V=29.9", that of the yellow helium line (587.56 nm) and the Abbe number, as in catalogues of glass;
- "n=1.575,B=0.00785,C=0.0002", Cauchy's n + B / l^2 + C / l^4, l in micrometres, as in data sheets of resists.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fab.errors import InputError
from fab.units import number_of


def _sellmeier(wavelength_um: float, terms: tuple[tuple[float, float], ...]) -> float:
    """Index from n^2 - 1 = sum B l^2 / (l^2 - C), C in square micrometres."""
    square = wavelength_um**2
    return (1.0 + sum(b * square / (square - c) for b, c in terms)) ** 0.5


def _cauchy(wavelength_um: float, terms: tuple[tuple[float, float], ...]) -> float:
    """Index from n = sum A l^p."""
    return sum(a * wavelength_um**p for a, p in terms)


@dataclass(frozen=True)
class Material:
    """A transparent material at room temperature."""

    name: str
    title: str  # as people write it
    range_m: tuple[float, float]  # shortest and longest vacuum wavelength the formula was fitted for, metres
    # Index as a function of the wavelength in micrometres and `terms`
    formula: Callable[[float, tuple[tuple[float, float], ...]], float]
    terms: tuple[tuple[float, float], ...]
    citation: str  # where the coefficients were published

    def index(self, wavelength_m: float) -> float:
        """Refractive index n at a vacuum wavelength in metres; an InputError outside the range of the published fit."""
        low, high = self.range_m
        try:
            inside = bool(low <= wavelength_m <= high)
        except (TypeError, ValueError) as error:  # text, or several
            rule, cure = "the wavelength must be a number of metres", "Give 550e-9 for 550 nm."
            raise InputError(f"material {self.name}", rule, repr(wavelength_m), cure) from error
        if not inside:
            rule = f"the wavelength must lie in {low * 1e9:.0f}-{high * 1e9:.0f} nm, the range of its published fit"
            cure = "Choose a wavelength inside the range or another material."
            raise InputError(f"material {self.name}", rule, f"{wavelength_m * 1e9:.6g} nm", cure)
        return self.formula(wavelength_m * 1e6, self.terms)


MATERIALS: dict[str, Material] = {
    m.name: m
    for m in (
        Material(
            "fused_silica",
            "fused silica",
            (0.21e-6, 6.7e-6),
            _sellmeier,
            ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
            "I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965); range confirmed by C. Z. Tan (1998)",
        ),
        Material(
            "n_bk7",
            "N-BK7",
            (0.3e-6, 2.5e-6),
            _sellmeier,
            ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
            "SCHOTT optical glass catalogue, 2017-01-20",
        ),
        Material(
            "p_bk7",
            "P-BK7",
            (0.31e-6, 2.5e-6),
            _sellmeier,
            ((1.18318503, 0.00722141956), (0.0871756426, 0.0268216805), (1.03133701, 101.702362)),
            "SCHOTT optical glass catalogue, 2017-01-20 (precision moulding)",
        ),
        Material(
            "pmma",
            "PMMA",
            (0.4368e-6, 1.052e-6),
            _sellmeier,
            ((1.1819, 0.011313),),
            "N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009)",
        ),
        Material(
            "pmma_resist",
            "PMMA resist",
            (0.2e-6, 1.1e-6),
            _cauchy,
            ((1.488, 0), (0.002898, -2), (0.0001579, -4)),
            "MicroChem 950 PMMA data sheet (2001)",
        ),
        Material(
            "su8",
            "SU-8",
            (0.32e-6, 0.80e-6),
            _cauchy,
            ((1.566, 0), (0.00796, -2), (0.00014, -4)),
            "MicroChem SU-8 2000 data sheet (2011), uncured film",
        ),
        Material(
            "calcium_fluoride",
            "calcium fluoride",
            (0.23e-6, 9.7e-6),
            _sellmeier,
            ((0.5675888, 0.050263605**2), (0.4710914, 0.1003909**2), (3.8484723, 34.649040**2)),
            "I. H. Malitson, Appl. Opt. 2, 1103 (1963)",
        ),
        Material(
            "zinc_selenide",
            "zinc selenide",
            (0.54e-6, 18.2e-6),
            _sellmeier,
            ((4.45813734, 0.200859853**2), (0.467216334, 0.391371166**2), (2.89566290, 47.1362108**2)),
            "B. Tatian, Appl. Opt. 23, 4477 (1984), of data by J. Connolly et al., Proc. SPIE 181, 141 (1979)",
        ),
        Material(
            "silicon",
            "silicon",
            (1.36e-6, 11e-6),
            _sellmeier,
            ((10.6684293, 0.301516485**2), (0.0030434748, 1.13475115**2), (1.54133408, 1104.0**2)),
            "C. D. Salzberg, J. J. Villa, J. Opt. Soc. Am. 47, 244 (1957); formula: B. Tatian (1984)",
        ),
        Material(
            "germanium",
            "germanium",
            (2.5e-6, 12e-6),
            _sellmeier,
            ((8.28156, 0.0), (6.72880, 0.44105), (0.21307, 3870.1)),
            "N. P. Barnes, M. S. Piltch, J. Opt. Soc. Am. 69, 178 (1979)",
        ),
    )
}
_NUMBER = r"(\d+\.\d+|\d+)"
_OWN_INDEX = re.compile(rf"n={_NUMBER}(?:,V={_NUMBER}|,B=(-?){_NUMBER}(?:,C=(-?){_NUMBER})?)?")
_LEAST_INDEX, _MOST_INDEX = 1.05, 6.0  # of a substrate
_LEAST_ABBE, _MOST_ABBE = 10.0, 150.0
# Fraunhofer's lines, micrometres, and where formulas of so few numbers are taken for good, metres.
_BLUE_UM, _YELLOW_UM, _RED_UM = 0.4861327, 0.5875618, 0.6562725
_ABBE_M, _CAUCHY_M = (0.36e-6, 0.85e-6), (0.3e-6, 2e-6)


def material(name: str) -> Material:
    """The material of that name, or that of an index of one's own; see the top of this file.

    Raises:
        InputError: neither; it lists the names that there are.
    """
    if isinstance(name, str) and name in MATERIALS:
        return MATERIALS[name]
    if (own := _own_material(name)) is not None:
        return own
    rule = (
        f"must be one of {', '.join(MATERIALS)}, or an index from {_LEAST_INDEX:g} to {_MOST_INDEX:g} as n=1.52, "
        "n=1.586,V=29.9 (with its Abbe number) or n=1.575,B=0.00785,C=0.0002 (Cauchy, micrometres)"
    )
    raise InputError("material", rule, repr(name), "Pick one of these names, or give the index.")


def _own_material(name: str) -> Material | None:
    """A material by its index; None where the text does not say one, or none that a substrate can have."""
    found = _OWN_INDEX.fullmatch(name) if isinstance(name, str) else None
    if found is None:
        return None
    index, abbe, b_sign, b, c_sign, c = found.groups()
    told, n = f"a material of index {float(index):g}", float(index)
    if abbe is not None:
        if not _LEAST_ABBE <= float(abbe) <= _MOST_ABBE:
            return None
        # Cauchy's formula of two terms through both numbers.
        second = (n - 1.0) / float(abbe) / (_BLUE_UM**-2 - _RED_UM**-2)
        range_m, terms = _ABBE_M, ((n - second * _YELLOW_UM**-2, 0), (second, -2))
        told += f" and Abbe number {float(abbe):g}"
    elif b is not None:
        range_m, terms = _CAUCHY_M, ((n, 0), (float(b_sign + b), -2), (float(c_sign + c) if c else 0.0, -4))
        told = f"a material of {name}"
    else:
        range_m, terms = (0.0, math.inf), ((n, 0),)
    ends = [_cauchy(1e6 * end, terms) for end in range_m] if len(terms) > 1 else [n]
    if not all(_LEAST_INDEX <= one <= _MOST_INDEX for one in ends):
        return None
    return Material(name, told, range_m, _cauchy, terms, "")


def is_material(name: str) -> bool:
    """Whether `material` takes a name."""
    try:
        material(name)
    except InputError:
        return False
    return True


def refractive_index(name: str, wavelength_m: float) -> float:
    """Refractive index of the material `name` at a vacuum wavelength `wavelength_m`, metres."""
    return material(name).index(wavelength_m)


def fresnel_transmission(index: float) -> float:
    """Power that passes both uncoated faces of a plate of a refractive index at normal incidence, 0-1.

    One face passes T = 4n/(n+1)^2 (M. Born and E. Wolf, *Principles of Optics*, §1.5); for a substrate much thicker
    than the coherence length the two multiply, and light reflected twice or more counts as lost.

    Raises:
        InputError: an index that is no number of 1 or more.
    """
    if not 1 <= number_of(index) < np.inf:
        cure = 'That of a material is sim.refractive_index("fused_silica", 550e-9).'
        raise InputError("index", "must be a number of 1 or more", repr(index), cure)
    return (4.0 * index / (index + 1.0) ** 2) ** 2


def full_wave_height_m(name: str, wavelength_m: float) -> float:
    """Height, metres, of the material `name` whose optical path in air is one wave: `wavelength_m` / (n - 1)."""
    return wavelength_m / (refractive_index(name, wavelength_m) - 1.0)


def waves_per_metre(name: str, wavelength_m: float, square_sine: float = 0.0) -> float:
    """Waves by which a metre of the material `name` delays light more than a metre of air does.

    (n - 1) / lambda along the axis; for light whose direction sine is s, (sqrt(n^2 - s^2) - sqrt(1 - s^2)) / lambda,
    the path difference of a thin element.

    Args:
        name: the material.
        wavelength_m: vacuum wavelength, metres.
        square_sine: s^2.
    """
    index = refractive_index(name, wavelength_m)
    return (np.sqrt(index**2 - square_sine) - np.sqrt(1.0 - square_sine)) / wavelength_m


def full_wave_wavelength_m(name: str, height_m: float) -> float:
    """The wavelength, metres, that `height_m` of the material delays by exactly one wave: lambda = (n(lambda) - 1) h.

    16 levels of 75 nm in fused silica give 552 nm. An InputError where no wavelength in the range does.
    """
    from scipy.optimize import brentq

    low, high = material(name).range_m
    if math.isinf(high):  # an index that no wavelength changes
        return height_m * (material(name).index(1.0) - 1.0)

    def excess(wavelength_m: float) -> float:
        return full_wave_height_m(name, wavelength_m) - height_m

    if excess(low) > 0 or excess(high) < 0:
        least, most = full_wave_height_m(name, low), full_wave_height_m(name, high)
        rule = f"a height of one wave must lie in {least:.3g}-{most:.3g} m"
        got = f"{height_m:.4g} m"
        raise InputError(f"material {name}", rule, got, "Change the number of levels or the height of one.")
    return float(np.asarray(brentq(excess, low, high, xtol=1e-15)))
