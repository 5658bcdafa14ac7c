"""Lamps read from what their light does to pixels that are not full: copies of a plate, halo and glare of a lens.

With the PSF K, the light z of a scene makes the picture y = K z. Where the sensor is full, z = x is unknown; elsewhere
it follows from y for any x, by a few steps of a fixed point, u <- u + (y - K (u + x)) / k0 with the energy k0 of the
PSF's middle. If x is right, u is a photograph without a veil; if not, copies of the lamps stay in it, bright or dark.
Photographs have few edges, so

    x = argmin  sum rho(D O u(x)) + inside sum |D x| + prior sum (x - usual)^2

with differences D between neighbours, Huber's rho, and colours O turned into brightness and two colour differences,
which have weaker edges in photographs; a copy, which lies elsewhere in every colour, has strong ones. It is solved by
weighted least squares (iteratively reweighted, conjugate gradients), a problem of unknowns where the sensor is full
alone. A full pixel whose x turns out darker than a full pixel's light was filled by the halo of a lamp beside it; what
lies there is drowned in it, and taken from the pixels around. Nothing in it knows of a plate: a plain lens is given the
same.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.ndimage
from jaxtyping import Bool, Float

from doedesign.hdr.capture import LampCapture
from fab.errors import InputError

Picture = Float[np.ndarray, "c y x"]
Mask = Bool[np.ndarray, "c y x"]
Steps = Float[np.ndarray, "_ _ _"]  # differences, one fewer than pixels along one axis
Between = Bool[np.ndarray, "_ _ _"]
_FIXED_POINTS = 3
_AROUND_PX = 1.5  # standard deviation of the bell by which a drowned pixel is taken from those around
_MIDDLE = 1  # pixels around a PSF's middle that count as its middle


class LampEstimate(NamedTuple):
    """A scene as a solver sees it.

    Attributes:
        light: `[c, y, x]` light, white 1.
        residual: the objective of the last round over that of the first; 1 where nothing was found.
    """

    light: Picture
    residual: float


@dataclass(frozen=True)
class LampSolver:
    """Estimate the light of lamps that fill a sensor. One set of numbers serves every camera.

    Attributes:
        edge: difference between neighbours, relative to white, from which an edge counts by its height and no longer
            by its square.
        chroma: the same of colour differences, over that of brightness.
        inside: weight of edges within lamps.
        edge_inside: difference within lamps from which it counts by its height, white 1.
        prior: weight of the squared distance to the usual brightness; little, for lamps of which nothing is seen.
        usual: that brightness, white 1.
        rounds: times that edges are weighted anew.
        iterations: steps of conjugate gradients in a round.
    """

    edge: float = 0.01
    chroma: float = 0.4
    inside: float = 3e-4
    edge_inside: float = 1.0
    prior: float = 1e-6
    usual: float = 80.0
    rounds: int = 6
    iterations: int = 20

    def __post_init__(self) -> None:
        """Raise an InputError for a number that is not positive."""
        for name in self.__dataclass_fields__:
            if not getattr(self, name) > 0:
                raise InputError(f"solver.{name}", "must be positive", f"{getattr(self, name):g}", "Correct it.")

    def solve(self, capture: LampCapture, psf: Picture) -> LampEstimate:
        """Light of a scene, lamps included.

        Args:
            capture: what the camera saw.
            psf: `[c, v, u]` PSFs of white light as they are known, in an odd window: those of the design, with glare.

        Raises:
            ValueError: unlike numbers of colours, or an even window.
        """
        if psf.shape[0] != len(capture.light) or psf.shape[-1] % 2 == 0:
            got = f"{psf.shape} for {capture.light.shape}"
            raise ValueError(f"`psf` must have the capture's colours and an odd window, but got {got}")
        problem = _Problem.of(capture, psf, self)
        lamps = np.where(capture.full, np.float32(self.usual), np.float32(0))
        behind = problem.behind(np.where(capture.full, 0, capture.light) / problem.middle, lamps, 2 * _FIXED_POINTS)
        first = last = 0.0
        for number in range(self.rounds if capture.full.any() else 0):
            step, last = problem.step(behind, lamps)
            first = first if number else last
            lamps = np.where(capture.full, np.maximum(lamps + step, 0), 0).astype(np.float32)
            behind = problem.behind(behind, lamps, _FIXED_POINTS)
        return LampEstimate(_filled(behind + lamps, capture), last / first if first else 1.0)


def _filled(light: Picture, capture: LampCapture) -> Picture:
    """Light in which drowned pixels, which are full but found dark, are like those around that are seen."""
    drowned = capture.full & (light < capture.light)
    known = (~capture.full).astype(np.float64)
    bell = (0.0, _AROUND_PX, _AROUND_PX)
    # A bell of so few pixels has lost nothing of its far side where lamps lie close.
    around, share = (scipy.ndimage.gaussian_filter(one, bell, truncate=12.0) for one in (light * known, known))
    return np.where(drowned & (share > 0), around / np.maximum(share, 1e-300), light).astype(np.float32)


class _Spread:
    """Convolution with a PSF: of light that ends with the frame, and of light that goes on beyond it."""

    def __init__(self, psf: Picture, shape: tuple[int, int]) -> None:
        self.half, self.shape = psf.shape[-1] // 2, shape
        self.short = [int(scipy.fft.next_fast_len(n + self.half, real=True)) for n in shape]  # pyright: ignore
        self.long = [int(scipy.fft.next_fast_len(n + 2 * self.half, real=True)) for n in shape]  # pyright: ignore
        self.of_lamps, self.of_scene = (self._transform(psf, size) for size in (self.short, self.long))

    def _transform(self, psf: Picture, size: list[int]) -> np.ndarray:
        """Transform with the PSF's middle at the first sample; what does not fit is cut off."""
        reach = [min(self.half, n // 2 - 1) for n in size]
        kernel = np.zeros((len(psf), *size), np.float32)
        y, x = (np.arange(-r, r + 1) for r in reach)
        kernel[:, y[:, None], x] = psf[:, y[:, None] + self.half, x + self.half]
        return np.asarray(scipy.fft.rfft2(kernel))

    def lamps(self, light: Picture, turned: bool = False) -> Picture:
        """Light of the frame alone, spread; `turned` is the adjoint."""
        transfer = self.of_lamps.conj() if turned else self.of_lamps
        product = scipy.fft.rfft2(light, self.short) * transfer
        return np.asarray(scipy.fft.irfft2(product, self.short))[:, : self.shape[0], : self.shape[1]]

    def scene(self, light: Picture) -> Picture:
        """Light that is mirrored beyond the frame, spread."""
        h = self.half
        wide = np.pad(light, [(0, 0), (h, h), (h, h)], mode="symmetric")
        spread = np.asarray(scipy.fft.irfft2(scipy.fft.rfft2(wide, self.long) * self.of_scene, self.long))
        return spread[:, h : h + self.shape[0], h : h + self.shape[1]]


# Brightness, and two differences of colours; orthonormal, so that noise stays what it is.
_OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [-0.5, 1, -0.5]])
_OPPONENT = (_OPPONENT / np.linalg.norm(_OPPONENT, axis=1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Least squares of one capture."""

    seen: Picture
    full: Mask
    spread: _Spread
    middle: Float[np.ndarray, "c 1 1"]
    colours: Float[np.ndarray, "c c"]
    apart: tuple[Between, Between]  # whether both neighbours along y and along x are seen
    inner: tuple[Between, Between]  # whether both are full
    solver: LampSolver

    @classmethod
    def of(cls, capture: LampCapture, psf: Picture, solver: LampSolver) -> "_Problem":
        light, full = capture.light.astype(np.float32), capture.full
        half = psf.shape[-1] // 2
        core = slice(half - _MIDDLE, half + _MIDDLE + 1)
        middle = psf[:, core, core].sum(axis=(1, 2))[:, None, None].astype(np.float32)
        colours = _OPPONENT if len(light) == 3 else np.eye(len(light), dtype=np.float32)
        # A colour difference is known where all colours are.
        seen = np.broadcast_to(~full.any(axis=0), light.shape)
        apart = (seen[:, 1:] & seen[:, :-1], seen[:, :, 1:] & seen[:, :, :-1])
        inner = (full[:, 1:] & full[:, :-1], full[:, :, 1:] & full[:, :, :-1])
        spread = _Spread(psf.astype(np.float32), (light.shape[1], light.shape[2]))
        return cls(light, full, spread, middle, colours, apart, inner, solver)

    def behind(self, light: Picture, lamps: Picture, times: int) -> Picture:
        """The scene where it is seen, for lamps of this light."""
        veiled = self.seen - self.spread.lamps(lamps)
        for _ in range(times):
            light = np.where(self.full, 0, light + (veiled - self.spread.scene(light)) / self.middle)
        return light.astype(np.float32)

    def step(self, behind: Picture, lamps: Picture) -> tuple[Picture, float]:
        """Change of the lamps that lowers the objective, and the objective before it."""
        s = self.solver
        turned = self._turn(behind)
        limits = (s.edge * np.array([1.0, *[s.chroma] * (len(turned) - 1)], np.float32))[:, None, None]
        outside = [np.where(ok, _weight(d, limits), 0) for d, ok in zip(_differences(turned), self.apart, strict=True)]
        within = [
            np.where(ok, s.inside * _weight(d, np.float32(s.edge_inside)), 0)
            for d, ok in zip(_differences(lamps), self.inner, strict=True)
        ]

        def curved(x: Picture) -> Picture:
            veil = self._veil(x)
            back = self._veil_turned(_sums([w * d for w, d in zip(outside, _differences(veil), strict=True)]))
            smooth = _sums([w * d for w, d in zip(within, _differences(x), strict=True)])
            return np.where(self.full, back + smooth + s.prior * x, 0)

        slopes = [w * d for w, d in zip(outside, _differences(turned), strict=True)]
        rough = [w * d for w, d in zip(within, _differences(lamps), strict=True)]
        right = self._veil_turned(_sums(slopes)) - _sums(rough) - s.prior * (lamps - s.usual)
        value = sum(float(np.sum(a * d)) for a, d in zip(slopes, _differences(turned), strict=True))
        return _conjugate_gradients(curved, np.where(self.full, right, 0), s.iterations), value

    def _turn(self, light: Picture) -> Picture:
        return np.einsum("oc,cyx->oyx", self.colours, light)

    def _veil(self, lamps: Picture) -> Picture:
        """Light that lamps take from the scene that is seen, in turned colours."""
        return self._turn(np.where(self.full, 0, self.spread.lamps(lamps) / self.middle))

    def _veil_turned(self, light: Picture) -> Picture:
        """Its adjoint."""
        colours = np.einsum("oc,oyx->cyx", self.colours, light)
        return self.spread.lamps(np.where(self.full, 0, colours / self.middle), turned=True)


def _differences(light: Picture) -> tuple[Steps, Steps]:
    return light[:, 1:] - light[:, :-1], light[:, :, 1:] - light[:, :, :-1]


def _sums(steps: list[Steps]) -> Steps:
    """The adjoint of `_differences`."""
    along_y, along_x = steps
    c, ny, nx = along_y.shape[0], along_x.shape[1], along_y.shape[2]
    found = np.zeros((c, ny, nx), np.float32)
    found[:, 1:] += along_y
    found[:, :-1] -= along_y
    found[:, :, 1:] += along_x
    found[:, :, :-1] -= along_x
    return found


def _weight(difference: Steps, limit: Float[np.ndarray, "_ 1 1"] | np.float32) -> Steps:
    return 1 / np.maximum(np.abs(difference), limit)


def _conjugate_gradients(curved: Callable[[Picture], Picture], right: Picture, iterations: int) -> Picture:
    found, rest = np.zeros_like(right), right
    along, size = rest, float(np.vdot(rest, rest))
    for _ in range(iterations):
        if size == 0:
            break
        bent = curved(along)
        length = size / float(np.vdot(along, bent))
        found, rest = found + length * along, rest - length * bent
        size, before = float(np.vdot(rest, rest)), size
        along = rest + (size / before) * along
    return found
