"""The sensor: from light on it to raw numbers, and back to an image.

    light ──> electrons ──> counted, with shot noise ──> full well ──> + read noise ──> raw numbers, rounded

Light is relative to a white of the scene through a lossless lens of the same aperture (`sim.imaging.formation`); a
plate that loses light makes a darker and noisier capture at the same exposure. Electrons are those behind the quantum
efficiency: white fills the share `exposure` of the full well in the colour that the sensor sees best, and less in
others. A raw number is the black level and a number of steps of full well / (2^bits - 1 - black level) electrons.

Noise models by name:

* "physical": Poisson for photons and dark current together, saturation at the full well, Gaussian read noise.
* "tseng": x/a ~ Poisson with a = 4e-5, plus a Gaussian of 1e-5, clipped to [0, 1], on light where white is 1 (the
  public Neural Nano-Optics code, the nearest there is to Tseng 2021b, which the paper cites).
* "release": evenly distributed noise of +-0.008, clipped to [0, 1] (the paper's public code).
* "none": what "physical" is the mean of.

With "tseng" and "release" white is full scale; exposure, full well, quantum efficiency, dark current and read noise
play no part. Gradients go through noise by reparametrisation (`sim.sensor.noise`), through rounding unchanged, and
through clipping between its bounds only, so a saturated pixel has none.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fab.errors import InputError
from sim.sensor.noise import RELEASE_WIDTH, TSENG_SCALE, TSENG_SIGMA, clipped, photon_noise, rounded, uniform_noise

NoiseModel = Literal["physical", "tseng", "release", "none"]
Pattern = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
Interpolation = Literal["bilinear", "malvar2004", "menon2007"]

_MOST_BITS = 24  # what single precision holds


_USUAL_BLACK = 64  # raw numbers per one of the usual black level


@dataclass(frozen=True)
class Sensor:
    """A sensor, which turns light into numbers. Hashable: it may be a static argument of `jit`.

    Attributes:
        full_well_e: electrons that a pixel holds.
        exposure: share of the full well that scene white fills, in the colour of the highest quantum efficiency.
        quantum_efficiency: electrons per photon, one for all colours or one per colour.
        read_noise_e: standard deviation of a reading, electrons.
        dark_e: mean number of electrons that heat sets free during the exposure.
        black_level: raw number of a pixel without electrons; it keeps the negative half of the read noise. None is
            what is usual: a 64th of all raw numbers (64 of 12 bits) where electrons have noise, and 0 elsewhere.
        bits: bits of a raw number; None for numbers between 0 and 1 that are not rounded.
        pattern: colours of the four upper left photosites of the picture, row by row, where the sensor has a Bayer
            mosaic; None for a sensor that sees every colour at every pixel.
        noise: noise model.
    """

    full_well_e: float = 10000.0
    exposure: float = 0.8
    quantum_efficiency: tuple[float, ...] = (0.6,)
    read_noise_e: float = 2.5
    dark_e: float = 0.0
    black_level: float | None = None
    bits: int | None = 12
    pattern: Pattern | None = None
    noise: NoiseModel = "physical"

    def __post_init__(self) -> None:
        """Raise a ValueError for a number out of range or an unknown name."""
        for name in ("full_well_e", "exposure"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"`{name}` must be positive, but got {getattr(self, name)}")
        for name in ("read_noise_e", "dark_e"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"`{name}` must be at least 0, but got {getattr(self, name)}")
        if self.counts_photons and self.dark_e >= self.full_well_e:
            raise ValueError(f"`dark_e` must lie below the full well, {self.full_well_e:g}, but got {self.dark_e}")
        if not self.quantum_efficiency or not all(0 < q <= 1 for q in self.quantum_efficiency):
            raise ValueError(f"`quantum_efficiency` must lie between 0 and 1, but got {self.quantum_efficiency}")
        if self.bits is not None and not 1 <= self.bits <= _MOST_BITS:
            raise ValueError(f"`bits` must lie from 1 to {_MOST_BITS}, but got {self.bits}")
        if not 0 <= self.zero_raw < self.top:
            raise ValueError(f"`black_level` must lie below {self.top:g}, but got {self.black_level}")
        for name, kind in (("noise", NoiseModel), ("pattern", Pattern)):
            value = getattr(self, name)
            if value not in get_args(kind) and not (name == "pattern" and value is None):
                raise ValueError(f"`{name}` must be one of {', '.join(get_args(kind))}, but got {value!r}")

    @property
    def top(self) -> float:
        """The largest raw number."""
        return 1.0 if self.bits is None else 2.0**self.bits - 1

    @property
    def zero_raw(self) -> float:
        """Raw number of a pixel without electrons."""
        if self.black_level is not None:
            return self.black_level
        every = 1.0 if self.bits is None else 2.0**self.bits
        usual = every / _USUAL_BLACK if self.noise == "physical" else 0.0
        return usual if self.bits is None else float(int(usual))

    @property
    def counts_photons(self) -> bool:
        """Whether electrons are counted, or noise is put on light where white is full scale."""
        return self.noise in ("physical", "none")

    @property
    def white_photons(self) -> float:
        """Photons that a white of the scene sends into a pixel."""
        return self.exposure * self.full_well_e / max(self.quantum_efficiency)

    def white_e(self, colours: int) -> Float[np.ndarray, "c 1 1"]:
        """Electrons of a white of the scene in every colour; there is one quantum efficiency, or one per colour."""
        given = len(self.quantum_efficiency)
        if given not in (1, colours):
            raise ValueError(f"`quantum_efficiency` must have 1 or {colours} entries, but got {given}")
        efficiency = np.broadcast_to(np.asarray(self.quantum_efficiency, np.float64), (colours,))
        return (self.white_photons * efficiency).astype(np.float32)[:, None, None]

    def white_raw(self, colours: int) -> Float[np.ndarray, "c 1 1"]:
        """Raw numbers of white above black, in every colour."""
        steps = np.float32(self.top - self.zero_raw)
        if not self.counts_photons:
            return np.full((colours, 1, 1), steps, np.float32)
        return self.white_e(colours) * (steps / np.float32(self.full_well_e))

    def most_light(self, colours: int) -> float:
        """The brightest light, relative to white, that raw numbers can stand for."""
        return float((self.top - self.black_raw) / self.white_raw(colours).min())

    @property
    def black_raw(self) -> float:
        """Mean raw number of a pixel without light."""
        dark = self.dark_e / self.full_well_e if self.counts_photons else 0.0
        return self.zero_raw + dark * (self.top - self.zero_raw)


@eqx.filter_jit
def expose(light: Float[Array, "*batch c y x"], sensor: Sensor, key: Key[Array, ""]) -> Float[Array, "*batch _ y x"]:
    """Raw numbers of light on a sensor, whole ones where the sensor has bits.

    Args:
        light: `[c, y, x]` light relative to white; what is below 0 counts as 0.
        sensor: the sensor.
        key: random key.

    Returns:
        `[c, y, x]`, or `[1, y, x]` for a mosaic, which takes three colours.
    """
    light = jnp.maximum(light, 0.0)
    signal = light * sensor.white_e(light.shape[-3]) + sensor.dark_e if sensor.counts_photons else light
    # A photosite behind a filter draws its own noise, so the mosaic comes first.
    seen = mosaic(signal, sensor.pattern) if sensor.pattern else signal
    share = _noisy(seen, sensor, key)
    steps = sensor.top - sensor.zero_raw
    raw = clipped(sensor.zero_raw + share * steps, 0.0, sensor.top)
    return raw if sensor.bits is None else rounded(raw)


def _noisy(seen: Array, sensor: Sensor, key: Array) -> Array:
    """Signal with noise, 1 where the full well is full."""
    if sensor.noise == "physical":
        return photon_noise(key, seen, sensor.read_noise_e, most=sensor.full_well_e) / sensor.full_well_e
    if sensor.noise == "tseng":
        return clipped(photon_noise(key, seen, TSENG_SIGMA, scale=TSENG_SCALE), 0.0, 1.0)
    if sensor.noise == "release":
        return clipped(uniform_noise(key, seen, RELEASE_WIDTH), 0.0, 1.0)
    return clipped(seen / sensor.full_well_e, 0.0, 1.0)


def mosaic(values: Float[Array, "*batch c y x"], pattern: Pattern) -> Float[Array, "*batch 1 y x"]:
    """Keep of red, green and blue `[c, y, x]` (row 0 at the lowest y) at every pixel the one that its filter passes.

    `pattern` names the colours of the four upper left photosites of the picture. A ValueError for other than three
    colours.
    """
    if values.shape[-3] != 3:
        raise ValueError(f"a mosaic needs red, green and blue, but got {values.shape[-3]} colours")
    filters = _filters(pattern, (values.shape[-2], values.shape[-1]))
    return jnp.sum(jnp.where(filters, values, 0.0), axis=-3, keepdims=True)


def _filters(pattern: Pattern, shape: tuple[int, int]) -> np.ndarray:
    """`[c, y, x]` where a colour is seen, row 0 at the lowest y."""
    letters = np.array(list(pattern)).reshape(2, 2)
    tiled = np.tile(letters, (shape[0] // 2 + 1, shape[1] // 2 + 1))[: shape[0], : shape[1]]
    return np.stack([tiled[::-1] == letter for letter in "RGB"])


def developed(
    raw: Float[Array, "*batch c y x"] | Float[np.ndarray, "*batch c y x"], sensor: Sensor
) -> Float[Array, "*batch c y x"]:
    """Light relative to white that raw numbers stand for: black level and dark current off, colours balanced.

    Args:
        raw: `[..., c, y, x]` numbers of `expose`, or of `demosaiced` for a sensor with a mosaic.
        sensor: the sensor.

    Returns:
        light, white 1, its noise below 0 included; differentiable.
    """
    return (jnp.asarray(raw) - np.float32(sensor.black_raw)) / sensor.white_raw(raw.shape[-3])


def demosaiced(
    raw: Float[np.ndarray, "1 y x"] | Float[Array, "1 y x"], sensor: Sensor, interpolation: Interpolation = "malvar2004"
) -> Float[np.ndarray, "3 y x"]:
    """Fill in the colours that a mosaic does not see, by the library colour-demosaicing; not differentiable.

    Colours are balanced for it, and taken back afterwards: interpolation across colours needs grey to be grey.

    Args:
        raw: `[1, y, x]` numbers of `expose`.
        sensor: a sensor with a mosaic; a ValueError for one without.
        interpolation: the method of the library; an InputError where that is not installed.

    Returns:
        raw numbers of red, green and blue, for `developed`.
    """
    if sensor.pattern is None:
        raise ValueError("`sensor` must have a mosaic, but its pattern is None")
    method = _library(interpolation)
    plane = np.asarray(raw, np.float64)[0]
    white = sensor.white_raw(3).astype(np.float64)
    gain = np.sum(np.where(_filters(sensor.pattern, plane.shape), 1 / white, 0.0), axis=0)
    # The library counts rows from the top, as the pattern does.
    light = method(((plane - sensor.black_raw) * gain)[::-1], sensor.pattern)[::-1]
    return (np.moveaxis(light, -1, 0) * white + sensor.black_raw).astype(np.float32)


def _library(interpolation: Interpolation) -> Callable[[np.ndarray, str], np.ndarray]:
    import importlib
    import warnings

    names = {"bilinear": "bilinear", "malvar2004": "Malvar2004", "menon2007": "Menon2007"}
    # Importing it changes how numpy prints numbers, and meets a name that SciPy is about to drop.
    with np.printoptions(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            package = importlib.import_module("colour_demosaicing")
        except ImportError as error:
            cure = "pip install 'doedesign[bayer]', or choose a sensor without a mosaic."
            raise InputError("sensor.pattern", "a mosaic needs colour-demosaicing", "no such package", cure) from error
    return getattr(package, f"demosaicing_CFA_Bayer_{names[interpolation]}")
