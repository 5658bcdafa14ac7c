"""The DOE as the solids, meshes and height maps of an order show it, and the kinds of their files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.records import ModelEntry
from fab.solids.columns import BASE_M, Columns, PixelWindow, reduced_cells, window_cells
from fab.solids.mesh import Mesh, closed_volume_m3, relief_mesh
from fab.solids.patch import Patch
from fab.solids.step import Body
from fab.units import MM, format_length


@dataclass(frozen=True, eq=False)
class MeshedRelief:
    """Columns of a relief, what they show in words, and the window they were cut from, if any."""

    cells: Columns
    about: str
    window: PixelWindow | None = None

    @cached_property
    def mesh(self) -> Mesh:
        """Their skin; CheckFailed if it is not closed."""
        mesh = relief_mesh(self.cells, BASE_M)
        closed_volume_m3(mesh)
        return mesh


@dataclass(frozen=True, eq=False)
class DoeModel:
    """A DOE on its glass, as all models show it: chrome, edge of its die and middles of the dies on the wafer, metres.

    Where the chrome reaches to the edge of a die, `bare_m` are the boxes x0, y0, x1, y1 that it leaves around marks. A
    `patch` is the window that is wanted at full resolution, if any; `direct_write` whether files for direct-write and
    greyscale exposure are wanted; the mesh of the whole relief has at most `mesh_cells` columns either way.
    """

    level_map: LevelMap
    chrome: Chrome
    wafer: Wafer
    die_m: float
    dies: Sequence[tuple[float, float]]
    bare_m: Sequence[tuple[float, float, float, float]] = ()
    patch: Patch | None = None
    direct_write: bool = False
    mesh_cells: int = 200

    @cached_property
    def relief(self) -> MeshedRelief:
        """The whole relief, block-reduced where it is large."""
        cells = reduced_cells(self.level_map, self.mesh_cells)
        blocks = f"mean height of {cells.block} x {cells.block} pixels"
        return MeshedRelief(cells, f"relief on {format_length(BASE_M)} of glass, {blocks}")

    @cached_property
    def detail(self) -> MeshedRelief | None:
        """The patch at full resolution; None if none is wanted."""
        if self.patch is None:
            return None
        grid, window = self.level_map.grid, self.patch.window(self.level_map.grid)
        middle = ", ".join(format_length(value) for value in window.centre_m(grid))
        about = (
            f"{window.rows} x {window.columns} pixels of {format_length(grid.pitch_m)} about {middle} of the DOE, "
            f"on {format_length(BASE_M)} of glass"
        )
        return MeshedRelief(window_cells(self.level_map, window), about, window)


def model_entry(
    path: Path,
    content: str,
    bodies: Mapping[str, Body] = MappingProxyType({}),
    relative_error: float = 0.0,
    metres_per_count: float | None = None,
    window: PixelWindow | None = None,
) -> ModelEntry:
    """Return the manifest's entry of a model's file."""
    volumes = {name: body.volume_m3 / MM**3 for name, body in bodies.items()}
    centres = {name: [value / MM for value in body.centre_m] for name, body in bodies.items()}
    pixels = None if window is None else list(astuple(window))
    return ModelEntry(path.name, content, volumes, centres, relative_error, metres_per_count, pixels)


@dataclass(frozen=True)
class ModelKind:
    """One kind of file that an order holds besides its masks, whose names end with `ending`, such as "_HEIGHT.tif".

    `entry` says what the manifest states of the file, before there is one; None if this DOE has no such file. `write`
    writes it. `problems` reads it back and returns one sentence per difference from its entry and the DOE.
    """

    ending: str
    entry: Callable[[Path, DoeModel], ModelEntry | None]
    write: Callable[[Path, DoeModel], object]
    problems: Callable[[Path, ModelEntry, DoeModel], list[str]]


def window_of(entry: ModelEntry) -> PixelWindow | None:
    """Return the window that a file shows; None for the whole map."""
    return None if entry.window_px is None else PixelWindow(*entry.window_px)
