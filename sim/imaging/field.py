"""Full frames through PSFs that vary over the field.

PSFs are known at nodes, a grid of field angles. Between nodes the light of every point of the *scene* is shared out
among the four around it, bilinearly, and each share spreads by its node's PSF. That keeps the energy of every point,
whatever the PSFs, and is exact at the nodes and for PSFs that change linearly across the field.

A frame is worked off in overlap-save tiles (`sim.imaging.convolve`), one colour after the other: a tile with its margin
is weighted, transformed and multiplied for each node that reaches it, and transformed back once. Its memory is that of
the nodes' transforms for one colour, plus the frame.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.grid import Grid
from sim.camera import Camera
from sim.imaging.common import with_common
from sim.imaging.convolve import (
    Border,
    Otf,
    Tile,
    Window,
    convolve_tiled,
    landed,
    plan_otf,
    spectrum,
    tile_length,
    tiles,
)
from sim.imaging.formation import Optics, check_layers, shadow_discs, shadow_px
from sim.imaging.occlusion import Layers, Light, Model, Outside, check_names, compose, follows_light
from sim.imaging.scene import Scene
from sim.psf_bank import PsfBank


class FieldOptics(NamedTuple):
    """PSFs of every layer at a grid of field angles, and the camera.

    Attributes:
        psf: `[gy, gx, layer, c, y, x]` PSFs; the background's layer first.
        y_m: increasing positions of the nodes on the sensor along y, metres from the axis.
        x_m: along x.
        axis: what holds for every field angle; its PSFs are those of the node nearest to the axis.
    """

    psf: Float[np.ndarray, "gy gx layer c ky kx"]
    y_m: Float[np.ndarray, " gy"]
    x_m: Float[np.ndarray, " gx"]
    axis: Optics

    @classmethod
    def of(cls, banks: Sequence[Sequence[PsfBank]], camera: Camera, depths_m: Sequence[float]) -> "FieldOptics":
        """From banks at field angles, depths (background first, metres) mixed linearly in 1/z.

        Args:
            banks: `banks[j][i]` has the angles (y_j, x_i), an increasing grid (else a ValueError).
            camera: the camera they were made for.
            depths_m: depth of every layer; an InputError for one beyond a bank's.
        """
        angles = np.array([[bank.field_rad for bank in row] for row in banks])
        y, x = angles[:, 0, 0], angles[0, :, 1]
        grid = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1)
        if not np.array_equal(grid, angles) or (np.diff(y) <= 0).any() or (np.diff(x) <= 0).any():
            raise ValueError(f"`banks` must be an increasing grid of field angles, but got {angles.tolist()}")
        psf = np.stack([[np.stack([bank.at(depth) for depth in depths_m]) for bank in row] for row in banks])
        middle = psf[np.abs(y).argmin(), np.abs(x).argmin()]
        distance, pixel = camera.sensor_distance_m, banks[0][0].pixel_m
        axis = Optics(middle, camera.aperture_m, distance, pixel)
        if camera.is_sine:  # places of a picture are those of its perspective, which is only the lens's near the axis
            return cls(psf, distance * np.tan(y), distance * np.tan(x), axis)
        # Along the two axes: a distortion bends the grid of nodes, by less than matters to how PSFs are mixed.
        return cls(psf, camera.image_m(np.sin(y), 0 * y)[0], camera.image_m(0 * x, np.sin(x))[1], axis)


def node_weights(positions: Float[np.ndarray, " p"], nodes: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n p"]:
    """Share of the light at every position that goes to each node along one axis; the outermost keep what is beyond."""
    return np.stack([np.interp(positions, nodes, unit) for unit in np.eye(len(nodes))]).astype(np.float32)


def capture_frame(
    scene: Scene,
    optics: FieldOptics,
    model: Model,
    *,
    border: Border = "reflect",
    outside: Outside = "scene",
    length: Window | None = None,
) -> Float[np.ndarray, "c y x"]:
    """`sim.imaging.formation.capture` of a whole frame, its middle on the axis, in numpy.

    The shadow discs do not depend on the field: aperture and obstruction lie in parallel planes.

    Args:
        scene: background and obstructions as numpy arrays, with depths as numbers.
        optics: PSFs over the field.
        model: how layers are put together.
        border: what lies beyond the frame; `reflect` or `edge`.
        outside: what I_obs holds where there is no obstruction (paper's models).
        length: samples (y, x) of a tile with its margins; `tile_length` by default.

    Returns:
        `[c, y, x]` light, no noise.

    Raises:
        ValueError: an unknown model or border, or a scene of other colours or depths than the optics.
    """
    check_names(model, outside)
    check_layers(scene, *optics.psf.shape[2:4])
    if border == "own":
        raise ValueError("`border` must be 'reflect' or 'edge' for a frame, but got 'own'")
    shape = (scene.background.shape[1], scene.background.shape[2])
    masks = tuple(np.asarray(near.mask) for near in scene.obstructions)
    discs: tuple[np.ndarray, ...] = ()
    if follows_light(model):
        discs = tuple(np.asarray(d) for d in shadow_discs(scene, optics.axis, shadow_px(scene, optics.axis)))
    kept = [1 - convolve_tiled(mask, disc, border) for mask, disc in zip(masks, discs, strict=bool(discs))]

    def shaded(number: int, light: Light) -> np.ndarray:
        return convolve_tiled(np.asarray(light), discs[number][0], border)

    frame = np.empty(scene.background.shape, np.float32)
    for colour in range(len(frame)):
        imaging = _FramePlan.of(optics, colour, shape, border, length, discs if model == "reciprocal" else ())
        radiances = tuple(np.asarray(near.radiance[colour]) for near in scene.obstructions)
        layers = Layers(np.asarray(scene.background[colour]), masks, radiances)
        frame[colour] = compose(layers, kept, shaded, imaging, model, outside)
    return frame


class _FramePlan(NamedTuple):
    """`Imaging` of a frame in one colour: transforms `[gy][gx]` and sums of the nodes' PSFs, for tiles of one size."""

    otf: tuple[tuple[Otf, ...], ...]
    energy: Float[np.ndarray, "gy gx layer"]
    tiles: tuple[Tile, ...]
    optics: FieldOptics
    shape: Window

    @classmethod
    def of(
        cls,
        optics: FieldOptics,
        colour: int,
        shape: Window,
        border: Border,
        length: Window | None,
        discs: Sequence[np.ndarray],
    ) -> "_FramePlan":
        """Transform the PSFs of one colour, with the layers of `with_common` where shadow discs are given."""
        psf = optics.psf[:, :, :, colour]
        if discs:
            psf = np.stack([[np.asarray(with_common(node, discs)) for node in row] for row in psf])
        window = (psf.shape[-2], psf.shape[-1])
        pieces = tuple(tiles(shape, window, border, length or tile_length(shape, window, border)))
        needed = (len(pieces[0].rows), len(pieces[0].columns))
        otf = tuple(tuple(plan_otf(node, needed, "own") for node in row) for row in psf)
        energy = psf.sum(axis=(-2, -1), dtype=np.float64).astype(np.float32)
        return cls(otf, energy, pieces, optics, shape)

    def one(self, layer: int, light: Light, unit: bool) -> np.ndarray:
        return self._landed((layer, layer + 1), [np.asarray(light)], unit)

    def total(self, lights: Sequence[Light]) -> np.ndarray:
        return self._landed((0, len(lights)), [np.asarray(light) for light in lights], unit=False)

    def _landed(self, layers: tuple[int, int], lights: list[np.ndarray], unit: bool) -> np.ndarray:
        """Light of the layers from the first to before the second of `layers`, added up."""
        out = np.empty(self.shape, np.float32)
        scale = (1 / self.energy if unit else np.ones_like(self.energy))[:, :, slice(*layers), None]
        for tile in self.tiles:
            patch = jnp.asarray(np.stack([light[np.ix_(tile.rows, tile.columns)] for light in lights]))
            along_y, along_x = (
                node_weights(self._positions(axis, tile.corner[axis], patch.shape[axis + 1]), nodes)
                for axis, nodes in enumerate((self.optics.y_m, self.optics.x_m))
            )
            total = jnp.zeros(self.otf[0][0].transfer.shape[-2:], jnp.complex64)
            for j in np.flatnonzero(along_y.any(axis=1)):
                for i in np.flatnonzero(along_x.any(axis=1)):
                    shares = along_y[j], scale[j, i] * along_x[i]
                    total = _added(total, patch, shares, self.otf[j][i], layers)
            out[tile.out] = _tile_landed(total, self.otf[0][0])
        return out

    def _positions(self, axis: int, first: int, count: int) -> np.ndarray:
        """Where samples of a tile lie on the sensor, metres; those beyond the frame belong to its edge."""
        centres = Grid(self.shape, self.optics.axis.pixel_m).axis_m("x" if axis else "y")
        return centres[np.clip(np.arange(first, first + count), 0, len(centres) - 1)]


@partial(jax.jit, static_argnames="layers", donate_argnames="total")
def _added(total: Array, patch: Array, shares: tuple[Light, Light], otf: Otf, layers: tuple[int, int]) -> Array:
    """A tile's spectrum with one node's shares of the light, `[y]` times `[layer, x]`."""
    light = patch * shares[0][:, None] * shares[1][:, None, :]
    return total + jnp.sum(spectrum(light, otf) * otf.transfer[slice(*layers)], axis=0)


_tile_landed = jax.jit(landed)
