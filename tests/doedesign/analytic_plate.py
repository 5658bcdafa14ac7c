"""A plate whose images are known in closed form, in the place of the one that light goes through.

An image is base + s(first error) A + second error B + motion · C, the camera's geometry included, with patterns of
random numbers, so every derivative, every least-squares fit and every covariance can be written down. `s` is the
identity, or climbs with waves on it, so that a search that only climbs stays behind the first of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from doedesign.calibration.estimate import Calibration
from doedesign.calibration.fit import search
from doedesign.calibration.forward_model import DoeImages, ForwardModel, Transmission
from doedesign.calibration.geometry import UPRIGHT, GeometryPrior
from doedesign.calibration.measurement import Measurement
from doedesign.calibration.objective import FitObjective
from doedesign.calibration.target import MeasuredImage, Target
from doedesign.calibration.uncertainty import posterior_of, readings
from doedesign.calibration.unknowns import Unknowns
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process
from sim.camera import Camera, Colour
from sim.measured import MeasuredPsf

SIDE = 18
NOISE = 0.01
SIGMA = np.array([2.0, 0.5])
NEAR_M = 13.5e-3  # blurs to 7.4 um, four pixels
_PROBE = Colour("probe", (520e-9,), (1.0,))
CAMERA = Camera(Grid((110, 110), 1.85e-6), 200e-6, "fused_silica", (_PROBE,), 1e-3, 1.85e-6, SIDE)
NUMERICS = 1e-9  # what the transform says of itself; the plate's own 0.4 % comes on top

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AnalyticModel(ForwardModel):
    """`patterns[image, pattern, y, x]` are base, A, B and seven of the motion; `asked` collects all plates' values."""

    patterns: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    waves: float = 0.0
    missed: NDArray[np.float64] | float = 0.0
    asked: list[Values] = field(default_factory=list)

    def first(self, value: float) -> tuple[float, float]:
        """s and its derivative."""
        return value + self.waves * np.sin(2 * value), 1 + 2 * self.waves * np.cos(2 * value)

    def plate(self, values: Values) -> "AnalyticImages":
        """The plate with some errors."""
        self.asked.append(np.array(values))
        nothing: Any = None
        return AnalyticImages(self, nothing, nothing, (), np.array(values))

    def plate_and_vjp(self, values: Values) -> tuple["AnalyticImages", Any]:
        """The plate, and its derivative backwards: the gradient with respect to s and the second error comes in."""
        slopes = np.array([self.first(values[0])[1], 1.0])
        return self.plate(values), lambda gradient: slopes * np.array(gradient)

    def finer(self, parts: int) -> "AnalyticModel":
        """The same with `missed` more in every image: what cells half as wide would show."""
        more = self.patterns.copy()
        more[:, 0] += self.missed
        return replace(self, patterns=more)

    def optic(self, index: int, grid: Any) -> Any:
        """What `search` asks for: the error of the transform."""
        return SimpleNamespace(plan=SimpleNamespace(expected_error=NUMERICS))


@dataclass(frozen=True, eq=False)
class AnalyticImages(DoeImages):
    """A plate with errors `values`."""

    model: AnalyticModel
    values: Values = field(default_factory=lambda: np.empty(0))

    def image(self, index: int, motion: Values) -> NDArray[np.float64]:
        """One image."""
        factors = [1.0, self.model.first(self.values[0])[0], self.values[1], *motion]
        return np.tensordot(factors, self.model.patterns[index], 1)

    def image_and_vjp(self, index: int, motion: Values) -> tuple[NDArray[np.float64], Any]:
        """One image and its derivative backwards."""

        def back(gradient: NDArray[np.float64]) -> tuple[Transmission, Values]:
            each = np.tensordot(self.model.patterns[index], gradient, 2)
            to_doe: Any = each[1:3]
            return to_doe, each[3:]

        return self.image(index, motion), back

    @property
    def parts(self) -> int:
        """Cells of a cell."""
        return 1

    def zeroth_order(self) -> float:
        """A curve, so that its difference over a step differs from its value."""
        return float(0.1 + 0.02 * self.values[0] + 0.05 * self.values[1])


def analytic_objective(
    truth: Values,
    *,
    images: int = 2,
    waves: float = 0.0,
    noise: float = NOISE,
    defocus_sigma: float = 0.0,
    gain_sigma: float | None = 0.03,
    noise_seed: int = 3,
    depths_m: tuple[float, ...] = (NEAR_M, np.inf),
    geometry: GeometryPrior = UPRIGHT,
    stood: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    **limits: Any,
) -> FitObjective:
    """Images of a plate with errors `truth`, with noise, and the model that made them; only the first may be blurred.

    The camera stood as `stood` says, of which `geometry` is known.

    `limits` replace attributes of the unknowns.
    """
    rng, noise_rng = np.random.default_rng(3), np.random.default_rng((noise_seed, 1))
    patterns = rng.normal(size=(images, 6, SIDE, SIDE)) * np.array([0.0, 0.1, 0.1, 0.05, 0.05, 0.05])[:, None, None]
    patterns[:, 0] = rng.uniform(0.5, 1.5, (images, SIDE, SIDE))
    turned = 0.1 * np.random.default_rng(4).normal(size=(images, 4, SIDE, SIDE))
    patterns = np.concatenate([patterns, turned], axis=1)
    ranges = {"mean": np.zeros(2), "root": np.diag(SIGMA), "low": -5 * SIGMA, "high": 5 * SIGMA, "start": np.zeros(2)}
    unseen: Any = None  # the drawing
    names = ("common_depth_scale", "common_cd_bias_m")
    unknowns = Unknowns(Process(Levels(4, 0.3e-6), name="analytic"), names, **{**ranges, **limits})
    model = AnalyticModel(unseen, CAMERA, unknowns, depths_m[:images], geometry, patterns=patterns, waves=waves)
    targets = []
    for i in range(images):
        light = model.plate(truth).image(i, np.append(np.zeros(3), stood)) + noise * noise_rng.normal(size=(SIDE, SIDE))
        floor = np.full((SIDE, SIDE), max(noise, 1e-6) ** 2)
        psf = MeasuredPsf(light, floor, np.zeros((SIDE, SIDE)), np.ones((SIDE, SIDE), bool))
        brightness = None if gain_sigma is None else (1.0, gain_sigma)
        image = MeasuredImage(f"image{i}", depths_m[i], psf, (0.0, 0.0), brightness, defocus_sigma if i == 0 else 0.0)
        targets.append(Target(image, psf, 1.0, (0.0, 0.0)))
    return FitObjective(model, tuple(targets))


def analytic_calibration(
    objective: FitObjective | None = None, rises: Sequence[float] = (1.0, 1.1), **posterior: Any
) -> Calibration:
    """A finished calibration of the plate; attributes of its posterior may be replaced."""
    fit = search(objective or analytic_objective(np.array([1.3, -0.4])))
    after = posterior_of(fit)._replace(**{"chi2_per_pixel": 1.0, **posterior})
    nothing: Any = None
    taken = Measurement(nothing, (), SIDE, {}, {})
    process = fit.at.objective.unknowns.process
    return Calibration(fit, after, process, [], readings(fit, after), list(rises), taken, 7)
