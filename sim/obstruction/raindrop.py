"""Raindrops on a windshield or cover glass: small lenses that show the whole surroundings, inverted.

The paper (section 3.2): a half disc joined to half an oval along the airflow, showing a larger and higher region of the
scene as a fish-eye lens does, at 5 to 12 cm, in random number and place. Here a drop is a water lens on tilted glass:

* A drop's outside is a spherical cap with the given contact angle, drawn out to the oval along the airflow.
* A ray from the camera passes the plane glass unturned, enters the water and leaves it at the cap, refracted by Snell's
  law in vector form; rays across one drop are taken parallel. Without tilt, at the height r s of the cap's sphere of
  radius r, that is asin(n s) - asin(s) towards the axis: the image is inverted and spans asin(n sin t) - t to either
  side for a contact angle t. (K. Garg and S. Nayar, "Photometric model of a rain drop", 2003, for a falling drop.)
* Glass that leans back, as a windshield does, throws steep rays at the upper part back into the drop, which is dark
  there, and the lower part looks upwards: at 60 degrees half of a drop is left, and looks 5 to 12 degrees up.
* The cap passes the share of light that Fresnel's equations give; the rest, and all of it beyond the critical angle, is
  light from elsewhere, which is taken as a share (`rim`) of the picture's mean.

A camera sees a few degrees and a drop the whole front: the picture stands in for the surroundings, stretched evenly to
`surroundings_rad` and mirrored at its edges. Air drag, sagging and the absorption of water are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, pi, radians, sin
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from sim.imaging.scene import Obstruction
from sim.obstruction.dirt import Dirt
from sim.obstruction.parameters import DEPTHS_M, ObstructionKind, Range, WithLimits, draw_from
from sim.obstruction.view import CameraView

Pixels = Float[np.ndarray, "n m"]
_WATER = 1.333
_MOST_DROPS = 10_000


@dataclass(frozen=True)
class Raindrop(WithLimits):
    """Drops on one glass. Lengths are those of the drops themselves, in metres; a range is drawn from uniformly.

    Attributes:
        depth_m: distance of the glass; the paper's 5 to 12 cm.
        radius_m: radius of a drop's round half; the 1 to 3 mm of the public release.
        elongation: half axis of the oval half over the radius; 1 is a disc.
        per_m2: drops per area of glass. (The release's 6 drops in the 28 mm wide frame at 12 cm are 7400.) Drops that
            would touch an earlier one are left out, and every frame has at least one drop's middle.
        airflow_rad: direction of the oval half, from +x to +y; up, as air flows over a windshield.
        contact_rad: contact angle of water on the glass, of every drop (an estimate: 25 to 55 degrees on glass that is
            neither fresh nor waxed).
        tilt_rad: how far the glass leans back from square to the axis: 30 to 60 degrees for windshields (an estimate),
            0 for a cover glass.
        rim: light of internal reflections over the mean of the picture; above 1 for rims lit by a bright sky.
        contrast: contrast of what a drop shows about the picture's mean; 1 is as refracted.
        surroundings_rad: width of the world that the picture stands in for.
    """

    depth_m: Range = (0.05, 0.12)
    radius_m: Range = (1e-3, 3e-3)
    elongation: Range = (1.0, 1.5)
    per_m2: Range = (4e3, 9e3)
    airflow_rad: Range = (radians(75), radians(105))
    contact_rad: Range = (radians(25), radians(55))
    tilt_rad: Range = (radians(30), radians(60))
    rim: Range = (0.05, 0.4)
    contrast: Range = (0.9, 1.1)
    surroundings_rad: float = radians(60)

    name: ClassVar[str] = "raindrop"
    limits: ClassVar[Mapping[str, Range]] = {
        "depth_m": DEPTHS_M,
        "radius_m": (1e-5, 0.02),
        "elongation": (0.2, 5.0),
        "per_m2": (0.0, 1e7),
        "airflow_rad": (-2 * pi, 2 * pi),
        "contact_rad": (0.02, 1.55),
        "tilt_rad": (0.0, 1.2),
        "rim": (0.0, 10.0),
        "contrast": (0.0, 3.0),
        "surroundings_rad": (0.01, pi),
    }

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw a glass with drops."""
        view.require(background)
        depth_m, tilt, airflow = (draw_from(rng, given) for given in (self.depth_m, self.tilt_rad, self.airflow_rad))
        contrast = draw_from(rng, self.contrast)
        mean = background.mean((1, 2), dtype=np.float64).astype(np.float32)[:, None, None]
        mask = np.zeros(view.shape, np.float32)
        radiance = np.zeros(background.shape, np.float32)
        for drop in self.drops(rng, view, depth_m, airflow):
            contact, rim = draw_from(rng, self.contact_rad), draw_from(rng, self.rim)
            window = drop.window(view)
            along, across = drop.coordinates(window)
            cover = drop.cover(along, across)
            rays = refracted(*drop.cap(along, across, contact), tilt, drop.slope(view))
            shown = self.surroundings(background, rays, contact / drop.radius)
            light = rays.passed * (mean + contrast * (shown - mean)) + (1 - rays.passed) * (rim * mean)
            radiance[:, *window] = np.where(cover > 0, np.clip(light, 0, 1), radiance[:, *window])
            mask[window] = np.maximum(mask[window], cover)
        return Obstruction(mask, radiance, depth_m)

    def drops(self, rng: np.random.Generator, view: CameraView, depth_m: float, airflow: float) -> "list[Drop]":
        """Draw drops that reach into the frame and do not touch."""
        pixel_m = view.pixel_at_m(depth_m)
        reach = self.radius_m[1] * max(1.0, self.elongation[1]) / pixel_m
        sides = np.array(view.shape) + 2 * reach
        found: list[Drop] = []
        for number in range(int(rng.poisson(draw_from(rng, self.per_m2) * pixel_m**2 * sides.prod()))):
            if number == _MOST_DROPS:
                break
            y, x = rng.uniform(0, 1, 2) * sides - reach - 0.5
            drop = self.drop(rng, float(y), float(x), pixel_m, airflow)
            seen = all(part.start < part.stop for part in drop.window(view))
            if seen and not any(drop.touches(old) for old in found):
                found.append(drop)
        if not any(drop.centred(view) for drop in found):
            y, x = rng.uniform(-0.5, np.array(view.shape) - 0.5)
            own = self.drop(rng, float(y), float(x), pixel_m, airflow)
            found = [own, *(drop for drop in found if not drop.touches(own))]
        return found

    def drop(self, rng: np.random.Generator, y: float, x: float, pixel_m: float, airflow: float) -> "Drop":
        """Draw the size of a drop at a place given in pixels."""
        radius = draw_from(rng, self.radius_m) / pixel_m
        return Drop(y, x, radius, radius * draw_from(rng, self.elongation), airflow)

    def surroundings(
        self, background: Float[np.ndarray, "c y x"], rays: "Rays", turn_per_pixel: float
    ) -> Float[np.ndarray, "c n m"]:
        """Light of the surroundings, for which the background stands in, along refracted rays.

        The turn of the cap's normal from pixel to pixel says how much a drop shrinks them, and what a pixel averages.
        """
        from skimage.transform import downscale_local_mean

        per_rad = background.shape[2] / self.surroundings_rad
        shrink = max(1, min(int((_WATER - 1) * turn_per_pixel * per_rad), *background.shape[1:]))
        _, height, width = (n // shrink * shrink for n in background.shape)
        picture = background[:, :height, :width]
        if shrink > 1:
            picture = downscale_local_mean(picture, (1, shrink, shrink)).astype(np.float32)
        at = [
            (n - 1) / 2 + angle * (per_rad / shrink)
            for n, angle in zip(picture.shape[1:], (rays.elevation, rays.azimuth), strict=True)
        ]
        return np.stack([map_coordinates(colour, at, order=1, mode="mirror", prefilter=False) for colour in picture])


class Drop(NamedTuple):
    """Outline of one drop, in pixels of the frame.

    Its middle, the radius of its round half and the half axis of its oval half, whose direction `airflow` runs from +x
    to +y.
    """

    y: float
    x: float
    radius: float
    length: float
    airflow: float

    def window(self, view: CameraView) -> tuple[slice, slice]:
        """Rows and columns of the frame that it may reach."""
        reach = max(self.radius, self.length) + 1
        rows, columns = (
            slice(min(max(int(at - reach), 0), n), max(min(int(at + reach) + 2, n), 0))
            for at, n in zip((self.y, self.x), view.shape, strict=True)
        )
        return rows, columns

    def centred(self, view: CameraView) -> bool:
        """Whether its middle lies in the frame."""
        return all(-0.5 <= at <= n - 0.5 for at, n in zip((self.y, self.x), view.shape, strict=True))

    def coordinates(self, window: tuple[slice, slice]) -> tuple[Pixels, Pixels]:
        """Pixels from its middle, along the airflow and across it."""
        y, x = (np.arange(s.start, s.stop, dtype=np.float32) for s in window)
        up, right = (y - np.float32(self.y))[:, None], (x - np.float32(self.x))[None, :]
        c, s = np.float32(cos(self.airflow)), np.float32(sin(self.airflow))
        return c * right + s * up, c * up - s * right

    def _half_axis(self, along: Pixels) -> Pixels:
        return np.where(along > 0, np.float32(self.length), np.float32(self.radius))

    def _share(self, along: Pixels, across: Pixels) -> Pixels:
        return np.hypot(along / self._half_axis(along), across / np.float32(self.radius))

    def cover(self, along: Pixels, across: Pixels) -> Pixels:
        """Share of every pixel inside the outline, float32."""
        share = self._share(along, across)
        growth = np.hypot(along / self._half_axis(along) ** 2, across / np.float32(self.radius**2))
        # The distance to the outline, to first order; on the round half, exactly.
        inward = share * (1 - share) / np.maximum(growth, np.float32(1e-9))
        return np.where(share < 0.5, 1, np.clip(inward + 0.5, 0, 1)).astype(np.float32)

    def cap(self, along: Pixels, across: Pixels, contact_rad: float) -> tuple[Pixels, Pixels]:
        """Tangents (y, x) of the angles between the cap's normal and the glass's."""
        share = np.minimum(self._share(along, across), 1)
        height = np.sqrt(np.float32(1 / sin(contact_rad) ** 2) - share**2)
        with_flow = along * np.float32(self.radius) / (self._half_axis(along) ** 2 * height)
        beside = across / (np.float32(self.radius) * height)
        c, s = np.float32(cos(self.airflow)), np.float32(sin(self.airflow))
        return s * with_flow + c * beside, c * with_flow - s * beside

    def slope(self, view: CameraView) -> tuple[float, float]:
        """Tangents (y, x) of its direction."""
        y, x = (
            (at - (n - 1) / 2) * view.pixel_m / view.focal_m for at, n in zip((self.y, self.x), view.shape, strict=True)
        )
        return y, x

    def touches(self, other: "Drop") -> bool:
        """Whether two drops may touch."""
        near = max(self.radius, self.length) + max(other.radius, other.length)
        return (self.y - other.y) ** 2 + (self.x - other.x) ** 2 < near**2


class Rays(NamedTuple):
    """Where each pixel's light comes from, radians above the axis and towards +x, and the share the cap passes."""

    elevation: Pixels
    azimuth: Pixels
    passed: Pixels


def refracted(tangent_y: Pixels, tangent_x: Pixels, tilt_rad: float, slope: tuple[float, float] = (0.0, 0.0)) -> Rays:
    """Follow rays with tangents `slope` (y, x) from the camera through glass that leans back and water into the open.

    The tangents are those of the angle between the cap's normal and the glass's, up along the glass and along x.
    """
    c, s = cos(tilt_rad), sin(tilt_rad)
    # Vectors are (y, x, z), z away from the camera. The glass's normal points out and up; `up` lies in the glass.
    out, up = np.array([s, 0.0, c]), np.array([c, 0.0, -s])
    ray = np.array([*slope, 1.0])
    ray = _refract(ray / np.linalg.norm(ray), out, 1 / _WATER)
    size = np.sqrt(1 + tangent_y**2 + tangent_x**2)
    normal = [(up[i] * tangent_y + out[i]) / size for i in range(3)]
    normal[1] = tangent_x / size
    before = sum(normal[i] * np.float32(ray[i]) for i in range(3))
    square = 1 - np.float32(_WATER**2) * (1 - before**2)
    after = np.sqrt(np.maximum(square, 0))
    y, x, z = (np.float32(_WATER * ray[i]) + (after - _WATER * before) * normal[i] for i in range(3))
    upright = ((_WATER * before - after) / (_WATER * before + after)) ** 2
    parallel = ((before - _WATER * after) / (before + _WATER * after)) ** 2
    passed = np.where((square > 0) & (before > 0), 1 - (upright + parallel) / 2, 0)
    return Rays(*(a.astype(np.float32) for a in (np.arctan2(y, z), np.arctan2(x, z), passed)))


def _refract(ray: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], ratio: float) -> Float[np.ndarray, "3"]:
    """Snell's law for one unit ray; `ratio` is the index before over the index behind."""
    cosine = float(ray @ normal)
    return ratio * ray + (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal


@dataclass(frozen=True)
class DirtRaindrop(WithLimits):
    """Dirt or raindrops, as the paper's network for windshields was trained."""

    dirt: Dirt = field(default_factory=Dirt)  # the dirt
    raindrop: Raindrop = field(default_factory=Raindrop)  # the drops
    dirt_share: float = 0.5  # how often it is dirt

    name: ClassVar[str] = "dirt_raindrop"
    limits: ClassVar[Mapping[str, Range]] = {"dirt_share": (0.0, 1.0)}

    @property
    def parts(self) -> tuple[tuple[float, ObstructionKind], ...]:
        """The kinds that it is by lot, each with how often."""
        return (self.dirt_share, self.dirt), (1 - self.dirt_share, self.raindrop)

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Toss the coin and draw."""
        kind = self.dirt if rng.uniform() < self.dirt_share else self.raindrop
        return kind.draw(rng, view, background)
