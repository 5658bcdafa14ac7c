"""PSFs: the image of a point source for every colour of an optic and every depth."""

# Abstract fields become fields, or properties, of subclasses.
# pyright: reportIncompatibleVariableOverride=false

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from fab.units import metres, number_of, require_kind
from sim.camera import Camera, SpectralLine
from sim.metrics import METRICS, MetricInputs, encircled_energy, near_and_far, participation
from sim.optic import ON_AXIS, CellOptic, Optic, Propagation
from sim.propagation.farfield import FarField
from sim.rigorous.edge_optic import optic_as_drawn
from sim.threads import at_once
from sim.tracing import compiled_quickly, in_jit, is_traced, on_host, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

Table = Float[np.ndarray, "w d"] | Float[Array, "w d"]
Length = float | str
Depths = Length | Sequence[Length] | np.ndarray | Array
WIDEST_RAD = np.pi / 3  # of a field angle
if TYPE_CHECKING:  # numpy and jax arrays serve alike
    Energies = Any
else:
    Energies = Float[np.ndarray, "w d y x"] | Float[Array, "w d y x"]


class PsfBank(eqx.Module):
    """PSFs of one optical system, on one field angle.

    Attributes:
        energy: `[colour, depth, y, x]` energy per pixel per unit power incident on the clear aperture; numpy, or
            jax where it is traced.
        colours: name of each entry of the first axis.
        depths_m: source depth of each entry of the second axis, metres.
        pixel_m: pixel pitch, metres, or a direction sine where there is no sensor (`Camera.in_angles`). The chief ray
            is at the centre of the window.
        field_rad: field angles (y, x).
        camera: the camera they were computed for, if it is known.
        sines: whether `pixel_m` is a direction sine, where no camera tells.

    Raises:
        InputError: energies that have not one entry for each colour and depth, or depths or pixels that are not
            positive.
    """

    energy: Energies
    colours: tuple[str, ...] = eqx.field(static=True)
    depths_m: tuple[float, ...] = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    field_rad: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.0))
    camera: Camera | None = eqx.field(static=True, default=None)
    sines: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        """Refuse energies that belong to other colours or depths."""
        for name, example in (("colours", '("green",)'), ("depths_m", "(0.05, np.inf)")):
            if not isinstance(getattr(self, name), tuple | list):
                raise InputError(name, "must be one for each PSF", repr(getattr(self, name)), f"For example {example}.")
        wanted, shape = (len(self.colours), len(self.depths_m)), np.shape(self.energy)
        if len(shape) != 4 or shape[:2] != wanted:
            rule = f"must be [colour, depth, y, x] for {wanted[0]} colours and {wanted[1]} depths"
            raise InputError("energy", rule, f"shape {shape}", "Name every colour and depth of the array.")
        if not 0 < number_of(self.pixel_m) < np.inf:
            raise InputError("pixel_m", "must be a positive number of metres", repr(self.pixel_m), "For example 2e-6.")
        if not all(number_of(depth) > 0 for depth in self.depths_m):
            raise InputError("depths_m", "must be positive, metres", str(self.depths_m), "For example (0.05, np.inf).")

    @property
    def in_angles(self) -> bool:
        """Whether pixels are directions of light (`Camera.in_angles`)."""
        return self.sines if self.camera is None else self.camera.in_angles

    def with_camera(self, camera: Camera) -> "PsfBank":
        """The same PSFs with the camera they were computed for or measured with, which metrics and pictures need."""
        require_kind("camera", camera, Camera, "A design has one: design.camera.")
        return replace(self, camera=camera)

    def metric_inputs(
        self,
        near_m: Sequence[float] = (),
        doe: CellOptic | None = None,
        nominal: CellOptic | None = None,
        lens: "PsfBank | None" = None,
        aimed: Mapping[str, float] | None = None,
    ) -> MetricInputs:
        """These PSFs for metrics, with the DOE that makes them, as it is and as drawn, and those of the bare lens.

        `aimed` are numbers of what the DOE should draw (`sim.metrics.METRICS`).

        An InputError where the camera is not known.
        """
        if self.camera is None:
            rule, cure = "`bank.camera` must be known for metrics", "Give it by bank.with_camera(camera)."
            raise InputError("camera", rule, "None", cure)
        return MetricInputs(self.energy, self.depths_m, self.camera, near_m, doe, nominal, lens and lens.energy, aimed)

    def metric(self, name: str) -> Table:
        """A metric of `sim.metrics.METRICS` that needs nothing but PSFs and their camera, `[colour, depth]`.

        A ValueError for another one.
        """
        known = [key for key, metric in METRICS.items() if metric.needs == "psf" and not metric.aimed]
        if name not in known:
            raise ValueError(f"`name` must be one of {', '.join(known)}, but got {name!r}")
        inputs, of = self.metric_inputs(), METRICS[name].of
        depths = range(len(self.depths_m))
        return stacked([stacked([of(inputs, c, d) for d in depths]) for c in range(len(self.colours))])

    def throughput(self) -> Table:
        """Energy in the window, `[colour, depth]`."""
        if self.camera is None:
            traced, sides = is_traced(self.energy), (-2, -1)
            return jnp.sum(self.energy, sides) if traced else np.asarray(np.sum(self.energy, sides, np.float64))
        return self.metric("throughput")

    def far_spot(self) -> Table:
        """Energy in the far spot (`sim.metrics.spot_radius_m`), `[colour, depth]`."""
        return self.metric("far_spot")

    def ring_to_disc(self) -> Table:
        """Energy outside over energy inside the geometric defocus disc, `[colour, depth]`."""
        return self.metric("ring_to_disc")

    def participation(self) -> Float[Array, "w d"]:
        """Sum of squared pixel energies, `[colour, depth]`."""
        return participation(self.energy)

    def encircled_energy(self, radii_m: Sequence[float]) -> Float[np.ndarray, "w d r"] | Float[Array, "w d r"]:
        """Energy within centred discs of some radii (metres), `[colour, depth, radius]`."""
        return encircled_energy(self.energy, self.pixel_m, radii_m)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the PSFs, near depths (a defocus disc beyond the far spot) and far ones each on a scale of their own.

        Without a camera, as PSFs that were measured, all have one scale, and no marks of a lens.
        """
        from sim.plots.psfs import plot_measured, plot_psfs

        if self.camera is None:
            return plot_measured(self, ax)
        near, far = near_and_far(self.camera, self.depths_m)
        return plot_psfs(self, self.camera, near, far, ax)

    def _repr_html_(self) -> str:
        """Table and picture for notebooks."""
        from fab.figure import html_of, length_text
        from sim.plots.places import size_text

        y, x = self.energy.shape[-2:]
        rows = {
            "colours": ", ".join(self.colours),
            "depths": ", ".join(length_text(z) for z in self.depths_m),
            "pixels": f"{x} x {y} of {size_text(self.in_angles, self.pixel_m)}",
        }
        if self.camera is None:
            values = self.throughput()
            rows["light in the window"] = f"{np.nanmin(values):.3g} to {np.nanmax(values):.3g}"
            return html_of("PSFs", rows, self.plot())
        rows["lens"] = self.camera.lens_text
        near, far = near_and_far(self.camera, self.depths_m)
        for name in ("throughput", "far_spot", "ring_to_disc"):
            meant = {"near": near, "far": far, "all": self.depths_m}[METRICS[name].depths]
            if not meant:
                continue
            values = np.asarray(self.metric(name))[:, [depth in meant for depth in self.depths_m]]
            rows[METRICS[name].label] = f"{np.nanmin(values):.3g} to {np.nanmax(values):.3g}"
        return html_of("PSFs", rows, self.plot())

    def as_optic(self) -> "BankOptic":
        """An optic that mixes these PSFs linearly in 1/z."""
        order = np.argsort([1 / depth for depth in self.depths_m])
        inverse = np.array([1 / self.depths_m[k] for k in order], np.float32)
        energy = jnp.asarray(self.energy[:, order].swapaxes(0, 1))
        own = self.colours, self.pixel_m, self.camera, self.field_rad, self.sines
        return BankOptic(energy, jnp.asarray(inverse), *own)

    def at(self, depth_m: float | str) -> Float[np.ndarray, "c y x"] | Float[Array, "c y x"]:
        """PSFs of every colour at a depth, metres or with a unit ("5 cm", "inf"), mixed linearly in 1/z.

        An InputError for a depth beyond the bank's.
        """
        depth_m = metres(depth_m, "depth", infinite=True)
        order = np.argsort([1 / depth for depth in self.depths_m])
        curvatures = np.array([1 / self.depths_m[d] for d in order])
        # The slack lets a depth through that was rounded on its way; it is far below any change of a PSF.
        wanted, slack = 1 / depth_m if depth_m else np.inf, 1e-6 * curvatures[-1]
        if not curvatures[0] - slack <= wanted <= curvatures[-1] + slack:
            depths = sorted(self.depths_m)
            rule = f"must lie within the depths of the PSF bank, {depths[0]:g} to {depths[-1]:g} m"
            raise InputError("depth", rule, f"{depth_m:g} m", "Compute the bank for this depth too.")
        place = float(np.interp(wanted, curvatures, np.arange(len(order))))
        low = min(int(place), len(order) - 1)
        share = np.float32(place - low)
        lower = self.energy[:, order[low]]
        return lower if share == 0 else (1 - share) * lower + share * self.energy[:, order[low + 1]]


class BankOptic(Optic):
    """Known PSFs, mixed linearly in 1/z; beyond the outermost as there.

    Attributes:
        energies: `[depth, c, y, x]` energy per pixel, the farthest depth first.
        inverse_depths: `[depth]` 1/z of the depths, per metre.
        colours: names of the colour channels.
        pixel_m: distance of the pixels, metres.
        camera: lens and sensor, where they are known.
        field_rad: field angles (y, x) of the PSFs.
        sines: whether pixels are direction sines.
    """

    energies: Float[Array, "d c y x"]
    inverse_depths: Float[Array, " d"]
    colours: tuple[str, ...] = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    camera: Camera | None = eqx.field(static=True, default=None)
    field_rad: tuple[float, float] = eqx.field(static=True, default=ON_AXIS)
    sines: bool = eqx.field(static=True, default=False)

    @property
    def lines(self) -> tuple[SpectralLine, ...]:
        """One line per colour, without a wavelength of its own."""
        return tuple(SpectralLine(number, 0.0, 1.0) for number in range(len(self.colours)))

    def plan(
        self,
        line: SpectralLine,
        depth_m: float,
        propagation: Propagation | None = None,
        sampling: float | None = None,
        field_rad: tuple[float, float] = ON_AXIS,
    ) -> None:
        """Nothing is propagated; a ValueError for another field than that of the PSFs, unless none is asked for."""
        if any(field_rad) and not np.allclose(field_rad, self.field_rad):
            raise ValueError(f"`field_rad` must be that of the bank, {self.field_rad}, but got {field_rad}")

    def source(self, line: SpectralLine, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> np.ndarray:
        """The source's curvature, 1/m; all have the bank's field angle."""
        return np.asarray(1 / depth_m, np.float32)

    def energy(self, line: SpectralLine, plan: None, source: Float[Array, ""] | np.ndarray) -> Float[Array, "y x"]:
        """Energy in every pixel."""
        place = jnp.interp(source, self.inverse_depths, jnp.arange(len(self.inverse_depths), dtype=jnp.float32))
        low = jnp.clip(place.astype(jnp.int32), 0, max(len(self.inverse_depths) - 2, 0))
        share = place - low
        known = self.energies[:, line.colour]
        return (1 - share) * known[low] + share * known[low + 1]


def optic_of(optic: Any, camera: Camera | None = None, depths_m: Sequence[float] = (np.inf,)) -> Optic:
    """The optic of something that carries one, or of a bare height map `[y, x]` (metres) and a camera.

    It is ready for sources at some depths, metres.

    An InputError for something other than a camera in its place, or heights that `sim.optic.heights_on` refuses; a
    ValueError for a map without a camera or of another shape than its grid, or a camera of another aperture, substrate
    or kind of light than the optic's, which keeps its own grid; a TypeError for a camera beside an optic that is not
    made of cells.
    """
    if camera is not None and not isinstance(camera, Camera):
        cure = "A design has one: design.camera."
        raise InputError("camera", "must be a sim.Camera", f"a {type(camera).__name__}", cure)
    if hasattr(optic, "as_optic"):
        found: Optic = optic.as_optic()
        if camera is None:
            return found.prepared_for(depths_m)
        if not isinstance(found, CellOptic):
            raise TypeError(f"`camera` must be left out for a {type(found).__name__}, which has its own")
        return found.with_camera(camera).prepared_for(depths_m)
    if camera is None:
        rule, cure = "a height map needs a `camera`", "Give lens, sensor and substrate, a sim.Camera."
        raise InputError("camera", rule, f"{type(optic).__name__} alone", cure)
    return optic_as_drawn(camera, optic, depths_m=depths_m)


def depths_from(depths: Depths) -> tuple[float, ...]:
    """One depth or several, positive, in metres or with a unit ("5 mm", "inf"), in metres.

    Raises:
        InputError: none, one that is not positive, something other than depths, or depths that jax is tracing.
    """
    if is_traced(depths):
        rule, got = "must be known before a program is compiled", "depths that jax traces"
        raise InputError("depths", rule, got, "Leave them out of grad, jit and vmap; heights may be traced.")
    given: Any = depths.tolist() if isinstance(depths, np.ndarray | np.generic | jax.Array) else depths
    given = given if isinstance(given, Iterable) and not isinstance(given, str) else [given]
    found = tuple(metres(depth, "depth", infinite=True) for depth in given)
    if not found or not all(depth > 0 for depth in found):
        raise InputError("depths", "must be positive, at least one", str(given), 'For example "5 cm", or inf.')
    return found


def field_from(field_rad: Any) -> tuple[float, float]:
    """Field angles (y, x), radians, as two floats.

    Raises:
        InputError: something other than two numbers, or an angle beyond 60 degrees.
    """
    try:
        # "12" would be the two angles 1 and 2.
        found = () if any(isinstance(angle, str) for angle in field_rad) else tuple(map(float, field_rad))
    except (TypeError, ValueError):  # no sequence, or no numbers; jax raises the former for what it traces
        found = ()
    if len(found) != 2 or not all(abs(angle) <= WIDEST_RAD for angle in found):
        rule = f"must be two angles (y, x) within {WIDEST_RAD:.4g} radians, 60 degrees"
        raise InputError("field_rad", rule, str(field_rad), "A thin lens says nothing beyond. For example (0.0, 0.1).")
    return found


def psf(
    optic: Any,
    camera: Camera | None = None,
    depths: Depths = np.inf,
    *,
    field_rad: tuple[float, float] = ON_AXIS,
    propagation: Propagation | None = None,
    sampling: float | None = None,
    on_psf: Callable[[], None] = lambda: None,
) -> PsfBank:
    """PSFs for every colour and depth.

    The PSFs are differentiable in the arrays of the optic: `jax.grad`, `jit` and `vmap` go through.

    Args:
        optic: an `Optic`, anything that carries one (a design, a DOE as fabricated, a bank), or a height map `[y, x]`
            in metres on `camera.grid`, also as a `fab.HeightMap` or a `fab.LevelMap`; None for the bare lens.
        camera: lens, sensor, substrate and DOE grid of a bare height map; another lens or sensor for an optic of cells.
        depths: one source depth or several, in metres or with a unit; "inf" for a star.
        field_rad: field angles (y, x), radians, positive where light travels toward +y or +x; the window follows the
            chief ray.
        propagation: far field, or one of the direct kernels; by default the one that the camera needs.
        sampling: intensity samples per lambda d / D (far field only); see `sim.propagation.farfield.plan_far_field`.
        on_psf: called after every single PSF, for progress.

    Returns:
        the bank, Fresnel loss of the substrate included.

    Raises:
        ValueError: a height map that does not match its camera, or what the optic cannot do.
        InputError: heights that are not finite or not in metres, a wavelength outside the material's range, eq. 6
            violated on a direct path, or depths or field angles that cannot be used.
    """
    depths_m, field_rad = depths_from(depths), field_from(field_rad)
    chosen = optic_of(optic, camera, depths_m)
    traced = is_traced(chosen) or in_jit()

    def light(asked: tuple[float, SpectralLine]) -> Any:
        """Energy of a line at a depth."""
        depth_m, line = asked
        plan = chosen.plan(line, depth_m, propagation, sampling, field_rad)
        source = chosen.source(line, depth_m, field_rad)
        if traced:
            return _compiled(chosen, line, plan, source)
        # A loop takes as long as what compiles in three times the time.
        return on_host(_compiled_quickly()(chosen, line, plan.looped if isinstance(plan, FarField) else plan, source))

    asked = [(depth_m, line) for depth_m in depths_m for line in chosen.lines]
    found = map(light, asked) if traced else at_once(light, asked)
    rows = []
    for _ in depths_m:
        images: list[Any] = [0.0] * len(chosen.colours)
        for line in chosen.lines:
            images[line.colour] = images[line.colour] + line.factor * next(found)
            on_psf()
        rows.append(stacked(images))
    known = isinstance(chosen, BankOptic)
    seen, sines = (chosen.field_rad, chosen.sines) if known else (field_rad, False)
    return PsfBank(stacked(rows, 1), chosen.colours, depths_m, chosen.pixel_m, seen, chosen.camera, sines)


def _energy(optic: Optic, line: SpectralLine, plan: Any, source: Any) -> Array:
    return optic.energy(line, plan, source)


# Compiled once per wavelength and shape, whatever the depth.
_compiled = eqx.filter_jit(_energy)


@lru_cache(maxsize=1)
def _compiled_quickly() -> Callable[..., Array]:
    """The same, which a trace cannot hold.

    On a CPU the work is in transforms and products that come compiled: at the lowest level of optimisation the rest is
    as fast, to the same bits, and compiles in two thirds of the time.
    """
    return eqx.filter_jit(_energy, compiler_options=compiled_quickly())  # pyright: ignore[reportCallIssue]
