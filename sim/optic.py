"""Optics: whatever images a point source onto a camera's pixels.

`Optic` answers for one wavelength, source and field. The host prepares, in double precision, a plan of the propagation
and the source's phase (`plan`, `source`); `energy` turns both into pixel energies and may be traced by jax.
"""

# Abstract fields become fields, or properties, of subclasses.
# pyright: reportIncompatibleVariableOverride=false

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from fab.errors import InputError
from fab.height import HeightMap, refuse_where, require_filled
from fab.level_map import LevelMap
from fab.units import require_kind
from sim.aperture import open_cells
from sim.camera import Camera, SpectralLine, require_same_grid
from sim.propagation.farfield import FarField, plan_far_field
from sim.propagation.fresnel import DirectPath, plan_direct
from sim.propagation.hankel import Hankel, plan_hankel, radial_profile, revolve, ring_count, ring_source_waves
from sim.propagation.pupil import DoeRows, SourceColumns, cis, doe_field
from sim.source import LitSource, SeparableSource, SourceMap, View, ViewedSource, depth_on_axis_m, light_of
from sim.tracing import is_traced

if TYPE_CHECKING:  # to a type checker, what subclasses define is no argument of a constructor here
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Propagation = Literal["far_field", "fresnel", "angular_spectrum"]
CellSource = SourceMap | SeparableSource | LitSource | ViewedSource
ON_AXIS = (0.0, 0.0)
_HIGHEST_M = 1e-3  # no thin element is so high: a map that reaches higher is not in metres


class Optic(eqx.Module):
    """Something that images point sources.

    Attributes:
        camera: lens, sensor and substrate; None where only PSFs are known.
        colours: names of the colour channels.
        pixel_m: pixel pitch, metres.
        lines: wavelengths of all colours, colour by colour.
    """

    camera: AbstractVar[Camera | None]
    colours: AbstractVar[tuple[str, ...]]
    pixel_m: AbstractVar[float]
    lines: AbstractVar[tuple[SpectralLine, ...]]

    @abstractmethod
    def plan(
        self,
        line: SpectralLine,
        depth_m: float,
        propagation: Propagation | None = None,
        sampling: float | None = None,
        field_rad: tuple[float, float] = ON_AXIS,
    ) -> Any:
        """Operators of one wavelength and source depth (metres), made on the host.

        Args:
            line: the wavelength.
            depth_m: source depth.
            propagation: far field, or one of the direct kernels (for DOEs of cells); that of the camera if left out.
            sampling: intensity samples per lambda d / D (far field only); see `plan_far_field`.
            field_rad: field angles (y, x); they matter to near sources, and to lenses that do not image sines
                (`Camera.mapping`).

        Raises:
            InputError: a direct path where eq. 6 does not hold, or light too far aslant where there is no lens.
        """

    @abstractmethod
    def source(self, line: SpectralLine, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> Any:
        """A point source at a depth (metres) and field angles (y, x), its phase wrapped in double precision."""

    @abstractmethod
    def energy(self, line: SpectralLine, plan: Any, source: Any) -> Float[Array, "v u"]:
        """Energy `[y, x]` in every pixel, per unit power on the clear aperture and without `line.factor`; traceable."""

    def as_optic(self) -> "Optic":
        """Return it as it is."""
        return self

    def prepared_for(self, depths_m: Sequence[float]) -> "Optic":
        """The same, ready for sources at some depths, metres."""
        return self


class CameraOptic(Optic):
    """An optic that is computed for a camera."""

    camera: AbstractVar[Camera]

    @property
    def colours(self) -> tuple[str, ...]:
        """Names of the colour channels."""
        return tuple(colour.name for colour in self.camera.colours)

    @property
    def pixel_m(self) -> float:
        """Pixel pitch, metres."""
        return self.camera.pixel_m

    @property
    def lines(self) -> tuple[SpectralLine, ...]:
        """Wavelengths of all colours."""
        return self.camera.lines


class CellOptic(CameraOptic):
    """A DOE of square cells behind a camera's clear aperture.

    Attributes:
        coverage: `[y, x]` open share of every cell of the camera's grid.
        source_kind: how sources are described (`sim.source`).
        wavelengths_m: different wavelengths.
        means: `[wavelength, y, x]` mean transmission of every cell.
    """

    camera: AbstractVar[Camera]
    coverage: AbstractVar[Float[Array, "y x"]]
    source_kind: AbstractVar[type[SourceMap] | type[SeparableSource]]
    wavelengths_m: AbstractVar[tuple[float, ...]]
    means: AbstractVar[Complex[Array, "w y x"]]

    @abstractmethod
    def cells(self, line: SpectralLine, source: CellSource) -> tuple[Array | None, Array | None]:
        """Height in metres and transmission besides it, both `[y, x]`; None where there is none."""

    def plan(
        self,
        line: SpectralLine,
        depth_m: float,
        propagation: Propagation | None = None,
        sampling: float | None = None,
        field_rad: tuple[float, float] = ON_AXIS,
    ) -> FarField | DirectPath:
        """Operators of the far field, or of a direct kernel (which serves every depth)."""
        self.camera.require_upright(field_rad)
        self.camera.require_image(field_rad)
        propagation = propagation or self.camera.propagation
        if propagation == "far_field":
            return plan_far_field(
                self.camera,
                line.wavelength_m,
                depth_m=depth_on_axis_m(depth_m, field_rad),
                sampling=sampling,
                field_rad=self.camera.chief_rad(field_rad) if self.camera.sees_field else ON_AXIS,
            )
        if propagation not in get_args(Propagation):
            raise ValueError(f"`propagation` must be one of {get_args(Propagation)}, but got {propagation!r}")
        return plan_direct(self.camera, line.wavelength_m, propagation, depth_m=depth_m)

    def source(self, line: SpectralLine, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> CellSource:
        """The path to every cell, and the beam on it; the window follows the chief ray."""
        path = self.source_kind.at(self.camera, line.wavelength_m, depth_m, field_rad)
        light = self.camera.incident(line)
        return path if light is None else LitSource(path, jnp.asarray(light))

    def rows(self, line: SpectralLine, source: CellSource) -> tuple[DoeRows, SourceColumns]:
        """The two arguments of `doe_field`."""
        rows, columns = source.over(self.camera.grid)
        return DoeRows(self.coverage, *self.cells(line, source), rows, light_of(source)), columns

    def energy(self, line: SpectralLine, plan: FarField | DirectPath, source: CellSource) -> Float[Array, "v u"]:
        """Energy in every pixel."""
        return plan.energy(doe_field, *self.rows(line, source))

    def with_camera(self, camera: Camera) -> "CellOptic":
        """The same DOE before another lens or sensor; a ValueError for another aperture, substrate or kind of light."""
        own = self.camera
        wanted, got = (f"{each.opening} of {each.material}, {each.light} light" for each in (own, camera))
        if (camera.opening, camera.material, camera.light) != (own.opening, own.material, own.light):
            raise ValueError(f"`camera` must have the DOE's aperture, substrate and light, {wanted}, but got {got}")
        return replace(self, camera=replace(camera, grid=own.grid))

    def field(self, line: SpectralLine, depth_m: float = np.inf) -> Complex[Array, "y x"]:
        """The whole field behind the DOE for a source on the axis, `[y, x]`, unit amplitude where open."""
        return _whole_field(*self.rows(line, self.source(line, depth_m)))


class ViewedOptic(CellOptic):
    """A DOE whose cells have other values from other depths: what is finer than a cell looks different aslant.

    Attributes:
        transmission: `[view, y, x]` transmission of every cell for light along the axis.
        views: wavelength and depths of sources for which each transmission holds, the farthest of a wavelength first.
    """

    transmission: AbstractVar[Complex[Array, "view y x"]]
    views: AbstractVar[tuple[View, ...]]

    @property
    @abstractmethod
    def drawn_m(self) -> Float[Array, "v u"]:
        """Height as drawn, metres, of every cell of the DOE, which may be several here along each axis."""

    def view(self, wavelength_m: float, depth_m: float = np.inf) -> int:
        """Which of the views is that from a source depth, or the nearest to it; a ValueError for another wavelength."""
        own = [k for k, view in enumerate(self.views) if view.wavelength_m == wavelength_m]
        if not own:
            raise ValueError(f"`wavelength_m` must be one of {self.wavelengths_m}, but got {wavelength_m}")
        # The farthest comes first.
        return next((k for k in own if depth_m >= self.views[k].nearest_m * (1 - 1e-6)), own[-1])

    def at(self, wavelength_m: float, depth_m: float = np.inf) -> Complex[Array, "y x"]:
        """Transmission at one of the wavelengths for a source depth; a ValueError for another wavelength."""
        return self.transmission[self.view(wavelength_m, depth_m)]

    def source(self, line: SpectralLine, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> ViewedSource:
        """The path to every cell, and the view from there or from the nearest depth that there is a view for."""
        view = jnp.int32(self.view(line.wavelength_m, depth_m))
        path: Any = super().source(line, depth_m, field_rad)
        if not any(field_rad):
            return ViewedSource(path, view)
        aslant, straight = (self.camera.waves_per_metre(line.wavelength_m, field) for field in (field_rad, ON_AXIS))
        return ViewedSource(path, view, jnp.float32(aslant - straight))

    def cells(self, line: SpectralLine, source: Any) -> tuple[Array | None, Array | None]:
        """Transmission in the source's view.

        From a field angle glass delays light more. What errors and walls add to that is a few per cent of it.
        """
        seen = self.transmission[source.view]
        if source.more_waves_per_metre is None:
            return None, seen
        waves, parts = self.drawn_m * source.more_waves_per_metre, seen.shape[0] // self.drawn_m.shape[0]
        return None, seen * cis(waves.repeat(parts, axis=0).repeat(parts, axis=1))

    def from_afar(self, wavelengths_m: Sequence[float]) -> Complex[Array, "w y x"]:
        """Transmission for the farthest depths, at some of the wavelengths."""
        return self.transmission[np.array([self.view(wavelength) for wavelength in wavelengths_m])]


_whole_field = jax.jit(doe_field)


@jax.jit
def height_transmission(height_m: Float[Array, "y x"], waves_per_metre: Float[Array, ""]) -> Complex[Array, "y x"]:
    """Transmission exp(2 pi i height * waves_per_metre) of a height map."""
    return cis(height_m * waves_per_metre)


@jax.jit
def height_deviation(
    transmission: Complex[Array, "y x"], height_m: Float[Array, "y x"], waves_per_metre: Float[Array, ""] | float
) -> Complex[Array, "y x"]:
    """Transmission of a DOE as fabricated over that of heights as drawn, metres (`HeightOptic.deviation`)."""
    return transmission * jnp.conj(cis(height_m * waves_per_metre))


def heights_on(camera: Camera, height_m: Any) -> Float[Array, "y x"]:
    """Heights `[y, x]` of the cells of a camera's grid, metres, in single precision; traced ones are taken as they are.

    A height map and a level map of `fab` have theirs.

    Raises:
        ValueError: another shape than the grid's.
        InputError: a map of `fab` on another grid, masked values, something other than real numbers, a height that is
            not finite, or one of more than 1 mm, which is in other units.
    """
    if isinstance(height_m, HeightMap | LevelMap):
        require_same_grid(camera, height_m.grid)
        height_m = height_m.height_m
    if not is_traced(height_m):
        require_filled(height_m, "height_m")
        kind = np.asarray(height_m).dtype
        if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
            rule = "must be real numbers, metres, [y, x]"
            raise InputError("height_m", rule, f"{type(height_m).__name__} of {kind}", "Give an array of floats.")
    height = jnp.asarray(height_m, jnp.float32)
    if height.shape != camera.grid.shape:
        raise ValueError(f"`height_m` must have the grid's shape {camera.grid.shape}, but got {height.shape}")
    if not is_traced(height) and not np.max(np.abs(found := np.asarray(height))) <= _HIGHEST_M:  # so NaN is seen, too
        rule, cure = "every height must be a finite number", "Fill the holes of the map."
        refuse_where(found, ~np.isfinite(found), "height_m", rule, cure)
        rule, cure = "heights are metres, at most 1 mm", "Multiply a map in other units by its unit, such as 1e-9."
        refuse_where(found, np.abs(found) > _HIGHEST_M, "height_m", rule, cure)
    return height


class HeightOptic(CellOptic):
    """A DOE given by its height map, as a thin element.

    Attributes:
        camera: lens, sensor and substrate.
        coverage: `[y, x]` open share of every cell; None where `deviation` has the chrome.
        height_m: `[y, x]` DOE height, metres; None where `deviation` holds all.
        deviation: by wavelength, transmission `[y, x]` of a DOE as fabricated over that of its heights, or None. An
            array each: out of one for all, a compiled step would copy what it needs.
        source_kind: how sources are described; `SeparableSource` where a compiled step takes many of them.
    """

    camera: Camera = eqx.field(static=True)
    coverage: Float[Array, "y x"] | None
    height_m: Float[Array, "y x"] | None = None
    deviation: dict[float, Complex[Array, "y x"]] | None = None
    source_kind: type[SourceMap] | type[SeparableSource] = eqx.field(static=True, default=SourceMap)

    @classmethod
    def of(cls, camera: Camera, height_m: Any = None) -> "HeightOptic":
        """A height map `[y, x]` on `camera.grid`, metres (numpy or jax, perhaps traced); flat for the bare lens.

        A height map or a level map of `fab` will do, too.

        Errors are those of `heights_on`.
        """
        require_kind("camera", camera, Camera, "A design has one: design.camera.")
        # A flat map shares its compiled programs with every other.
        height = heights_on(camera, np.zeros(camera.grid.shape, np.float32) if height_m is None else height_m)
        return cls(camera, jnp.asarray(open_cells(camera.grid, camera.opening)), height)

    def cells(self, line: SpectralLine, source: CellSource | None = None) -> tuple[Array | None, Array | None]:
        """Heights, and what a DOE as fabricated does besides."""
        return self.height_m, None if self.deviation is None else self.deviation[line.wavelength_m]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the heights."""
        return self.camera.grid.shape

    @property
    def wavelengths_m(self) -> tuple[float, ...]:
        """Different wavelengths of the camera."""
        return tuple(dict.fromkeys(line.wavelength_m for line in self.lines))

    @property
    def means(self) -> Complex[Array, "w y x"]:
        """Transmission of every cell."""
        found = []
        for line in {line.wavelength_m: line for line in self.lines}.values():
            height, deviation = self.cells(line)
            rate = jnp.float32(self.camera.waves_per_metre(line.wavelength_m))
            wave = jnp.ones(self.shape, jnp.complex64) if height is None else height_transmission(height, rate)
            found.append(wave if deviation is None else wave * deviation)
        return jnp.stack(found)

    def with_heights(self, height_m: Float[Array, "y x"]) -> "HeightOptic":
        """The same with other heights."""
        return replace(self, height_m=height_m)

    def made_as(self, doe: ViewedOptic, height_m: Float[Array, "y x"]) -> "HeightOptic":
        """The same for heights (metres) near these, with all that a DOE made of them does besides, seen from afar."""
        rates = {wavelength: self.camera.waves_per_metre(wavelength) for wavelength in self.wavelengths_m}
        deviation = {each: height_deviation(doe.at(each), height_m, rate) for each, rate in rates.items()}
        # The DOE's transmission has the chrome already.
        return replace(self, deviation=deviation, coverage=None)

    def raster(self, height_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
        """Heights of the cells."""
        return height_m

    def heights_of(self, map_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"] | None:
        """The heights that `with_heights` takes of a map on the grid."""
        return map_m


class RingOptic(CameraOptic):
    """Rings drawn as rings, seen on the axis; each is as wide as a cell.

    `profile_m` is the height of every ring, metres (`sim.propagation.hankel.ring_count` of them).
    """

    camera: Camera = eqx.field(static=True)
    profile_m: Float[Array, " ring"]

    def plan(
        self,
        line: SpectralLine,
        depth_m: float,
        propagation: Propagation | None = None,
        sampling: float | None = None,
        field_rad: tuple[float, float] = ON_AXIS,
    ) -> Hankel:
        """Operators of the Hankel transform, for every depth."""
        propagation = propagation or self.camera.propagation
        if propagation != "far_field":
            raise ValueError(f"`propagation` must be 'far_field' for rings, but got {propagation!r}")
        return plan_hankel(self.camera, line.wavelength_m)

    def source(self, line: SpectralLine, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> SourceMap:
        """The path to every sub-ring, from the axis only."""
        if any(field_rad):
            raise ValueError(f"`field_rad` must be (0, 0) for rings, but got {field_rad}")
        if self.camera.incident(line) is not None:
            raise ValueError("`camera` must be lit evenly for rings, but got a beam; draw them on the grid (`raster`)")
        waves = ring_source_waves(self.camera, depth_m, line.wavelength_m)
        return SourceMap(jnp.asarray(waves), jnp.float32(self.camera.waves_per_metre(line.wavelength_m)))

    def energy(self, line: SpectralLine, plan: Hankel, source: SourceMap) -> Float[Array, "v u"]:
        """Energy in every pixel."""
        return plan.energy(self.profile_m, source.source_waves, source.waves_per_metre)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the heights."""
        return (ring_count(self.camera),)

    def with_heights(self, height_m: Float[Array, " ring"]) -> "RingOptic":
        """The same with another profile."""
        return replace(self, profile_m=height_m)

    def raster(self, height_m: Float[np.ndarray, " ring"]) -> Float[np.ndarray, "y x"]:
        """Heights of the cells that draw a profile."""
        return revolve(height_m, self.camera.grid)

    def heights_of(self, map_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, " ring"] | None:
        """The profile whose raster a map is, or None if it is none."""
        profile = radial_profile(map_m, self.camera.grid)
        return None if profile is None else profile[: ring_count(self.camera)]


def colour_energies(optic: Optic, plans: Sequence[Any], sources: Sequence[Any]) -> Float[Array, "c y x"]:
    """PSF of every colour from the plans and sources of `optic.lines`; for use in a compiled function."""
    images: list[list[Array]] = [[] for _ in optic.colours]
    for line, plan, source in zip(optic.lines, plans, sources, strict=True):
        images[line.colour].append(line.factor * optic.energy(line, plan, source))
    return jnp.stack([jnp.sum(jnp.stack(parts), axis=0) for parts in images])
