"""Scenes with lamps: a photograph as background, and discs, bars and clusters many times brighter than white.

Light is linear, relative to a white of the scene. Lamps lie in the middle part of the canvas, the frame, in which a
camera sees; the background goes on beyond it, so that light that a PSF brings in from there is right. Every lamp has a
colour of its own, and a spectrum within each colour channel: the share of every line of the camera
(`sim.camera.Colour`), by default as a white has it.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from doedesign.capture.images import Pictures, crop, linear_light
from fab.errors import InputError

Spectrum = Literal["white", "narrow"]
_SPACE_PX = 10  # between the frame's edge and the middle of a lamp
_TINTED = 0.7  # share of lamps with a colour, the others are nearly white
_DIM = 0.03  # the darkest colour of a lamp, over its brightest
_MOST_FALLOFF = 0.5
_LINE_WIDTH = 0.35  # of a narrow spectrum, over the width of a channel's lines


@dataclass(frozen=True, eq=False)
class LampScene:
    """Light of a scene with lamps.

    Attributes:
        background: `[c, y, x]` light of the canvas without lamps, white 1.
        covered: `[lamp, y, x]` share of every pixel of the canvas that a lamp covers, times its profile's light.
        hidden: `[y, x]` share of the background that lamps hide.
        radiance: `[lamp, c]` light of every lamp, white 1.
        spectra: `[lamp, c, line]` shares of the lines of every colour channel in a lamp's light, sum 1; None where all
            have those of white.
        margin_px: pixels of the canvas on every side of the frame.
        name: of the background's picture.
    """

    background: Float[np.ndarray, "c y x"]
    covered: Float[np.ndarray, "k y x"]
    hidden: Float[np.ndarray, "y x"]
    radiance: Float[np.ndarray, "k c"]
    spectra: Float[np.ndarray, "k c l"] | None
    margin_px: int
    name: str

    def lines(self, weights: Float[np.ndarray, "c l"]) -> Float[np.ndarray, "c l y x"]:
        """Light of every line on the canvas, whose sum over lines is the light of the colour.

        Args:
            weights: `[c, line]` shares of the lines in white light.
        """
        shares = (
            np.broadcast_to(weights, (len(self.radiance), *weights.shape)) if self.spectra is None else self.spectra
        )
        behind = self.background[:, None] * (1 - self.hidden) * weights[..., None, None]
        lamps = np.einsum("kc,kcl,kyx->clyx", self.radiance, shares, self.covered, optimize=True)
        return (behind + lamps).astype(np.float32)

    def light(self) -> Float[np.ndarray, "c y x"]:
        """Light of the frame, `[c, y, x]`: what a reconstruction should find."""
        whole = self.background * (1 - self.hidden) + np.einsum("kc,kyx->cyx", self.radiance, self.covered)
        m = self.margin_px
        return whole[:, m : whole.shape[1] - m, m : whole.shape[2] - m].astype(np.float32)

    def without_lamps(self) -> "LampScene":
        """The background alone."""
        return replace(self, radiance=0 * self.radiance, hidden=0 * self.hidden)


@dataclass(frozen=True)
class Lamps:
    """Kinds of lamps, drawn by seed.

    Attributes:
        number: least and greatest number of lamps of a scene.
        radius_px: least and greatest radius of a lamp, pixels, drawn evenly; half of the width of a bar or cluster.
        brightness: least and greatest light of its brightest colour, white 1, drawn evenly in the logarithm.
        spectrum: "white" for lines as in white light, "narrow" for a bell of a third of the channel's width anywhere in
            it, as light-emitting diodes have.
    """

    number: tuple[int, int] = (2, 4)
    radius_px: tuple[float, float] = (4.0, 16.0)
    brightness: tuple[float, float] = (50.0, 200.0)
    spectrum: Spectrum = "white"

    def __post_init__(self) -> None:
        """Raise an InputError for ranges that do not rise from above 0, or an unknown spectrum."""
        for name in ("number", "radius_px", "brightness"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(f"lamps.{name}", "must rise from above 0", f"{(low, high)}", "Correct the range.")
        if self.spectrum not in get_args(Spectrum):
            rule = f"must be one of {', '.join(get_args(Spectrum))}"
            raise InputError("lamps.spectrum", rule, repr(self.spectrum), "Choose one of them.")

    def draw(
        self,
        rng: np.random.Generator,
        background: Float[np.ndarray, "c y x"],
        margin_px: int,
        weights: Float[np.ndarray, "c l"],
        name: str = "",
    ) -> LampScene:
        """Put lamps before a background.

        Args:
            rng: where they are drawn from.
            background: `[c, y, x]` light of the canvas.
            margin_px: pixels of the canvas around the frame, which has lamps.
            weights: `[c, line]` shares of lines in white light.
            name: of the background.
        """
        _, ny, nx = background.shape
        y, x = np.arange(ny)[:, None], np.arange(nx)[None, :]
        covered, radiance = [], []
        hidden = np.zeros((ny, nx))
        for _ in range(rng.integers(self.number[0], self.number[1] + 1)):
            low = margin_px + _SPACE_PX
            at = (rng.uniform(low, ny - low), rng.uniform(low, nx - low))
            shape = _shape(rng, rng.uniform(*self.radius_px), y - at[0], x - at[1])
            # The later lamp stands before the earlier ones.
            own = np.minimum(shape[0], 1.0)
            covered = [one * (1 - own) for one in covered] + [shape[0] * shape[1]]
            hidden = own + (1 - own) * hidden
            radiance.append(np.exp(rng.uniform(*np.log(self.brightness))) * _tint(rng, len(background)))
        spectra = None if self.spectrum == "white" else np.stack([_narrow(rng, weights) for _ in covered])
        return LampScene(
            background, np.stack(covered).astype(np.float32), hidden, np.stack(radiance), spectra, margin_px, name
        )


def _shape(
    rng: np.random.Generator, radius: float, y: Float[np.ndarray, "y 1"], x: Float[np.ndarray, "1 x"]
) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]]:
    """Share of every pixel that a lamp covers, and the light of its profile there, 1 in the middle."""
    kind, falloff, angle = rng.integers(3), rng.uniform(0, _MOST_FALLOFF), rng.uniform(0, np.pi)
    if kind == 0:
        distance = np.hypot(y, x)
        return np.clip(radius + 0.5 - distance, 0, 1), 1 - falloff * np.minimum(distance / radius, 1) ** 2
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    if kind == 1:
        half = max(radius * rng.uniform(0.2, 0.5), 1.5)
        inside = np.clip(radius + 0.5 - np.abs(along), 0, 1) * np.clip(half + 0.5 - np.abs(across), 0, 1)
        return inside, 1 - falloff * np.minimum(np.abs(along) / radius, 1) ** 2
    # Round points on a grid: the diodes of a headlight or a traffic light.
    point, step = max(radius / 4, 1.5), max(radius / 4, 1.5) * 2.6
    distance = np.hypot(*(np.abs((at + step / 2) % step - step / 2) for at in (along, across)))
    inside = np.clip(point + 0.5 - distance, 0, 1) * (np.maximum(np.abs(along), np.abs(across)) <= radius)
    return inside, np.ones_like(inside)


def _tint(rng: np.random.Generator, colours: int) -> Float[np.ndarray, " c"]:
    """Random colour, the brightest channel 1."""
    strength = rng.uniform(0.5, 1.0) if rng.uniform() < _TINTED else rng.uniform(0.0, 0.25)
    tint = _DIM ** (strength * rng.uniform(0, 1, colours))
    return tint / tint.max()


def _narrow(rng: np.random.Generator, weights: Float[np.ndarray, "c l"]) -> Float[np.ndarray, "c l"]:
    """Shares of lines of a bell somewhere in every channel."""
    lines = np.linspace(-1, 1, weights.shape[1])
    middle = rng.uniform(-0.7, 0.7, (len(weights), 1))
    bell = weights * np.exp(-(((lines - middle) / _LINE_WIDTH) ** 2))
    return bell / bell.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class LampScenes:
    """A stream of scenes: scene i is a pure function of the seed and i.

    Attributes:
        pictures: backgrounds, taken in turn.
        lamps: lamps before them.
        frame_px: pixels of the square frame.
        margin_px: pixels around it that PSFs reach.
        gain: least and greatest factor of the background's light, drawn evenly: a street by day, or at dusk.
        seed: seed of everything.
    """

    pictures: Pictures
    lamps: Lamps = field(default_factory=Lamps)
    frame_px: int = 256
    margin_px: int = 127
    gain: tuple[float, float] = (0.3, 1.0)
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise an InputError for a frame that has no place for a lamp."""
        if self.frame_px < 2 * _SPACE_PX:
            rule, cure = f"lamps keep {_SPACE_PX} pixels from the edge of the frame on every side", "Make it larger."
            raise InputError("frame_px", rule, self.frame_px, cure)

    def scene(self, number: int, weights: Float[np.ndarray, "c l"]) -> LampScene:
        """Scene of a number, for a camera with these shares `[c, line]` of lines in white light; 3 colours.

        Raises:
            InputError: no picture can be decoded.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        name, picture = self.pictures.following(number)
        size = self.frame_px + 2 * self.margin_px
        place = (float(rng.uniform()), float(rng.uniform()))
        background = linear_light(crop(picture, (size, size), place)) * np.float32(rng.uniform(*self.gain))
        return self.lamps.draw(rng, background, self.margin_px, weights, name)

    def with_lamps(self, lamps: Lamps) -> "LampScenes":
        """The same backgrounds with other lamps."""
        return replace(self, lamps=lamps)
