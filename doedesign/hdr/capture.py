"""Captures of scenes with lamps: spectral PSFs, glare, blooming, a sensor that fills up.

Every line of a colour channel has a PSF of its own (`LampCamera.psf`), so that copies are drawn out into spectra as
they are, and a lamp whose spectrum differs from white draws other ones. A solver is given the PSFs of white light.

Plates as fabricated differ little from the plate as drawn, so their PSFs are those of the drawn plate plus a difference
(`PlateSeries`), for which light sampled at its Nyquist rate is enough: errors of the sampling, 0.2 % of the copies,
cancel to 0.006 %, in a tenth of the time.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Bool, Float

from doedesign.hdr.scenes import LampScene
from fab.errors import InputError
from sim.camera import Camera, Colour
from sim.imaging.glare import Glare
from sim.psf_bank import psf
from sim.sensor import Sensor, developed, expose
from sim.sensor.blooming import bloomed

_FULL = 0.98  # of the brightest light that raw numbers stand for; beyond, noise is cut off


class LinePsfs(NamedTuple):
    """PSFs of every line of every colour channel.

    Attributes:
        energy: `[c, line, y, x]` energy per pixel per unit power on the aperture, in an odd window.
        weights: `[c, line]` shares of the lines in white light, sum 1.
    """

    energy: Float[np.ndarray, "c l y x"]
    weights: Float[np.ndarray, "c l"]

    def white(self) -> Float[np.ndarray, "c y x"]:
        """PSFs of white light."""
        return np.einsum("cl,clyx->cyx", self.weights, self.energy).astype(np.float32)

    def with_glare(self, glare: Glare) -> "LinePsfs":
        """The same behind a lens with glare."""
        return self._replace(energy=glare.scattered(self.energy))


class LampCapture(NamedTuple):
    """A capture as its camera gives it.

    Attributes:
        light: `[c, y, x]` light that raw numbers stand for, white 1, cut off at the full well.
        full: `[c, y, x]` whether a pixel is full.
    """

    light: Float[np.ndarray, "c y x"]
    full: Bool[np.ndarray, "c y x"]


@dataclass(frozen=True)
class LampCamera:
    """A camera before scenes with lamps, whatever stands in its aperture.

    Attributes:
        camera: lens, pixels and lines of every colour, the same number for each.
        sensor: the sensor, without a mosaic.
        spilled: share of the charge beyond the full well that blooms (`sim.sensor.blooming`).
    """

    camera: Camera
    sensor: Sensor
    spilled: float = 0.0

    def __post_init__(self) -> None:
        """Raise an InputError for unlike numbers of lines, an even window, or a mosaic."""
        counts = {len(colour.wavelengths_m) for colour in self.camera.colours}
        if len(counts) > 1:
            cure = "Give every colour as many wavelengths."
            raise InputError("optics.colours", "must have equal numbers of lines", f"{sorted(counts)}", cure)
        if self.camera.window % 2 == 0:
            rule = "must be odd, so that copies and pixels match"
            raise InputError("sensor.window", rule, f"{self.camera.window}", "Add 1.")
        if self.sensor.pattern is not None:
            got = self.sensor.pattern
            raise InputError(
                "sensor.bayer", "lamps are read colour by colour", got, "Choose a sensor without a mosaic."
            )

    @property
    def weights(self) -> Float[np.ndarray, "c l"]:
        """Shares of the lines in white light, `[c, line]`."""
        return np.array([colour.weights for colour in self.camera.colours])

    @property
    def held(self) -> Float[np.ndarray, "c 1 1"]:
        """Light, white 1, that a pixel of every colour holds beside what heat frees: the full well, or full scale."""
        sensor, colours = self.sensor, len(self.camera.colours)
        if not sensor.counts_photons:
            return np.ones((colours, 1, 1), np.float32)
        return (sensor.full_well_e - sensor.dark_e) / sensor.white_e(colours)

    def psf(self, optic: Any, sampling: float | None = None) -> LinePsfs:
        """PSFs of a star for every line.

        Args:
            optic: a design, a plate as fabricated, or heights `[y, x]` in metres (zeros for the plain lens).
            sampling: samples of the light per wavelength x distance / aperture; enough for a pixel by default.

        Raises:
            InputError, ValueError: as `sim.psf`.
        """
        colours = self.camera.colours
        apart = tuple(
            Colour(f"{colour.name} {number}", (wavelength,), (1.0,))
            for colour in colours
            for number, wavelength in enumerate(colour.wavelengths_m)
        )
        energy = np.asarray(psf(optic, replace(self.camera, colours=apart), np.inf, sampling=sampling).energy[:, 0])
        return LinePsfs(energy.reshape(len(colours), -1, *energy.shape[1:]), self.weights)

    def light_of(self, scene: LampScene, psfs: LinePsfs) -> Float[np.ndarray, "c y x"]:
        """Light on the sensor in the frame of a scene, before it fills up.

        Args:
            scene: the scene; its margin must reach as far as the PSFs.
            psfs: PSFs, glare included.

        Raises:
            InputError: PSFs that reach farther than the scene.
        """
        window, margin = psfs.energy.shape[-1], scene.margin_px
        if window // 2 > margin:
            cure = f"Draw scenes with a margin of {window // 2} pixels."
            raise InputError("margin_px", f"PSFs reach {window // 2} pixels", f"{margin}", cure)
        canvas, (ny, nx) = scene.lines(psfs.weights), (n - 2 * margin for n in scene.background.shape[1:])
        # What wraps around stays outside the frame.
        size = [int(scipy.fft.next_fast_len(n, real=True)) for n in canvas.shape[-2:]]  # pyright: ignore
        total: Any = 0.0
        for line in range(canvas.shape[1]):
            total = total + np.fft.rfft2(canvas[:, line], size) * np.fft.rfft2(psfs.energy[:, line], size)
        first = margin + window // 2
        found = np.fft.irfft2(total, size)
        rows, columns = ((first + np.arange(n)) for n in (ny, nx))
        return np.maximum(found[:, rows[:, None] % size[0], columns % size[1]], 0.0).astype(np.float32)

    def capture(self, scene: LampScene, psfs: LinePsfs, seed: int) -> LampCapture:
        """Photograph a scene.

        Args:
            scene: the scene.
            psfs: PSFs of what stands in the aperture, glare included.
            seed: of the noise.
        """
        light = self.light_of(scene, psfs)
        # White fills less of the well in colours that the sensor sees badly, so wells overflow by electrons.
        sensor, white_e = self.sensor, self.sensor.white_e(len(light))
        most_e = sensor.full_well_e - sensor.dark_e if sensor.counts_photons else white_e
        spread = bloomed(light * white_e, most_e, self.spilled) / white_e
        raw = expose(spread if self.spilled else jnp.asarray(light), self.sensor, jax.random.key(seed))
        found = np.asarray(developed(raw, self.sensor))
        return LampCapture(found, found >= _FULL * self.held)

    def saturated(self, scene: LampScene) -> Bool[np.ndarray, "c y x"]:
        """Where the scene itself is brighter than a pixel holds, whatever stands in the aperture."""
        return scene.light() > self.held


_NYQUIST = 2.0  # samples of the light per wavelength x distance / aperture


@dataclass(frozen=True, eq=False)
class PlateSeries:
    """Plates as fabricated of one design.

    Attributes:
        camera: the camera.
        exact: PSFs of the design as drawn.
        sparse: the same from light at its Nyquist rate.
    """

    camera: LampCamera
    exact: LinePsfs
    sparse: LinePsfs

    @classmethod
    def of(cls, camera: LampCamera, design: Any) -> "PlateSeries":
        """The series of a design.

        Args:
            camera: the camera.
            design: the design as drawn.
        """
        return cls(camera, camera.psf(design), camera.psf(design, _NYQUIST))

    def psf(self, plate: Any) -> LinePsfs:
        """PSFs of a plate.

        Args:
            plate: a plate of the design as fabricated.
        """
        change = self.camera.psf(plate, _NYQUIST).energy - self.sparse.energy
        return self.exact._replace(energy=np.maximum(self.exact.energy + change, 0.0))
