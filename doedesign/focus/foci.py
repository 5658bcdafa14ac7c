"""Distances at which light should come to a focus, and how small."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from doedesign.spec.targets.focus import AIRY_WIDTH, FocusSpec
from fab.errors import InputError
from fab.units import UM
from sim.camera import Camera

_STEP = 0.25  # of planes, over width² / wavelength: within it the focus keeps its width
_MOST = 4000  # planes
_ROOM = 1.15  # of the usual width over that of an ideal lens, which more than one focus cannot quite have
_SHOWN = 60  # planes of a report from one distance to another


class Foci(NamedTuple):
    """Foci on the axis behind a DOE, each of one colour.

    Attributes:
        distance_m: distance behind the DOE, metres.
        width_m: full width at half maximum that is wanted at most, metres.
        weight: of its logarithm of light, all together 1.
        colour: number of the colour.
    """

    distance_m: Float[np.ndarray, " focus"]
    width_m: Float[np.ndarray, " focus"]
    weight: Float[np.ndarray, " focus"]
    colour: Int[np.ndarray, " focus"]

    @classmethod
    def wanted(cls, spec: FocusSpec, camera: Camera) -> "Foci":
        """All foci that a design is made for; where light should be in focus all the way, as many as tell its end.

        Raises:
            InputError: more planes than can be designed for.
        """
        if not spec.through:
            return cls._each(spec, camera)
        near, far = spec.distances_m
        shortest = min(line.wavelength_m for line in camera.lines)
        fine = np.geomspace(near, far, 10_000)
        dense = shortest / (_STEP * np.square(_widths(spec, camera, fine, shortest)))
        number = np.concatenate([[0.0], np.cumsum((dense[1:] + dense[:-1]) / 2 * np.diff(fine))])
        count = max(2, int(np.ceil(number[-1])) + 1)
        if count > _MOST:
            rule = f"at most {_MOST} planes can be designed for at once"
            cure = f"Allow foci {np.sqrt(count / _MOST):.2g} times as wide, or a shorter way."
            raise InputError("focus.widths", rule, f"{count}, width² / (4 wavelength) apart", cure)
        # Far from the DOE a focus is long, but the way there is too: no fewer planes than are shown.
        far_apart = np.interp(np.linspace(0, number[-1], count), number, fine)
        return cls._through(spec, camera, np.union1d(far_apart, np.geomspace(near, far, 2 * _SHOWN)))

    @classmethod
    def shown(cls, spec: FocusSpec, camera: Camera) -> "Foci":
        """The foci of a report: a few of those where light should be in focus all the way."""
        if not spec.through:
            return cls._each(spec, camera)
        return cls._through(spec, camera, np.geomspace(spec.distances_m[0], spec.distances_m[1], _SHOWN))

    @classmethod
    def _through(cls, spec: FocusSpec, camera: Camera, distance_m: Float[np.ndarray, " plane"]) -> "Foci":
        # Every logarithm of distance counts alike, however many planes it takes.
        weight = np.gradient(np.log(distance_m))
        parts = []
        for number, colour in enumerate(camera.colours):
            width = _widths(spec, camera, distance_m, float(np.mean(colour.wavelengths_m)))
            parts.append((distance_m, width, weight, np.full(len(distance_m), number)))
        return cls._normalised(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    @classmethod
    def _each(cls, spec: FocusSpec, camera: Camera) -> "Foci":
        names, count = [colour.name for colour in camera.colours], len(spec.distances_m)
        rows = []
        for index, distance in enumerate(spec.distances_m):
            own = range(len(names)) if spec.colours is None else [names.index(spec.colours[index])]
            for number in own:
                usual = _usual_width(camera, distance, float(np.mean(camera.colours[number].wavelengths_m)))
                width = usual if spec.widths_m is None else spec.widths_m[index]
                rows.append((distance, width, (spec.weights or (1.0,) * count)[index], number))
        distance, width, weight, number = map(np.array, zip(*rows, strict=True))
        return cls._normalised(distance, width, weight, number)

    @classmethod
    def _normalised(cls, distance_m: np.ndarray, width_m: np.ndarray, weight: np.ndarray, colour: np.ndarray) -> "Foci":
        return cls(distance_m, width_m, weight / weight.sum(), colour.astype(int))

    def words(self, index: int, camera: Camera) -> str:
        """Distance of one, and its colour where there are several."""
        colour = f" {camera.colours[self.colour[index]].name}" if len(camera.colours) > 1 else ""
        return f"{self.distance_m[index] * 1e3:.5g} mm{colour}"


def _usual_width(camera: Camera, distance_m: float, wavelength_m: float) -> float:
    """Usual width: a little more than that of an ideal lens's focus, and no finer than cells can make it."""
    aperture = AIRY_WIDTH * wavelength_m * np.hypot(distance_m, camera.aperture_m / 2) / camera.aperture_m
    return _ROOM * float(max(aperture, 2 * AIRY_WIDTH * camera.grid.pitch_m, 0.1 * UM))


def _widths(
    spec: FocusSpec, camera: Camera, distance_m: Float[np.ndarray, " plane"], wavelength_m: float
) -> Float[np.ndarray, " plane"]:
    """Widths wanted between two distances, a power of the distance."""
    near, far = spec.distances_m
    ends = spec.widths_m or tuple(_usual_width(camera, distance, wavelength_m) for distance in (near, far))
    return ends[0] * (distance_m / near) ** (np.log(ends[1] / ends[0]) / np.log(far / near))
