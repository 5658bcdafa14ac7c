"""Certificate of a design: rows and squares cut out of it, as thin elements, with edges, and by Maxwell's equations."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from fab.aperture import Aperture
from fab.grid import Grid
from sim.camera import Camera
from sim.material import refractive_index
from sim.rigorous.comparison import RowComparison, compare_row
from sim.rigorous.crossed import travelling_terms
from sim.rigorous.mirrored_squares import with_mirrors
from sim.rigorous.pieces import PieceComparison, compare_piece
from sim.threads import cores

# Shares of the way from the axis to the rim at which rows are cut out.
SHARES = (0.0, 0.25, 0.5, 0.75, 0.9)
PLACES = 1 + 3 * 4  # one in the middle, and three at every other share
# Orders of the rigorous solutions over those that travel in glass: the finer is believed, the other tells how far.
_WAVES = (1.5, 2.0)
# Highest wave number of the terms of a square over that which travels in glass, by its side in cells; the coarser
# solution has three quarters of the terms. A square takes time with the sixth power.
_PIECE_WAVES, _COARSE = {2: 2.2, 3: 1.3, 4: 1.1}, 0.75


class Row(NamedTuple):
    """Cells side by side, cut out of a height map.

    Attributes:
        axis: along which they lie.
        centre_m: where the middle of the row lies (y, x), metres from the middle of the DOE.
        height_m: of every cell.
    """

    axis: Literal["x", "y"]
    centre_m: tuple[float, float]
    height_m: Float[np.ndarray, " cell"]


class CertifiedRow(NamedTuple):
    """A row at one wavelength.

    Attributes:
        row: the cells.
        wavelength_m: vacuum wavelength.
        orders: thin, with edges and rigorous.
        unsettled: relative change of the rigorous orders from three quarters of the waves, for TE and TM.
    """

    row: Row
    wavelength_m: float
    orders: RowComparison
    unsettled: Float[np.ndarray, "2"]


class Piece(NamedTuple):
    """A square of cells, cut out of a height map.

    Attributes:
        centre_m: where its middle lies (y, x), metres from the middle of the DOE.
        height_m: of every cell.
    """

    centre_m: tuple[float, float]
    height_m: Float[np.ndarray, "y x"]

    @property
    def repeated_m(self) -> Float[np.ndarray, "v u"]:
        """The square that is solved: continued by mirrors through the middle of the outer cells, it repeats."""
        return with_mirrors(self.height_m)


class CertifiedPiece(NamedTuple):
    """A square at one wavelength.

    Attributes:
        piece: the cells.
        wavelength_m: vacuum wavelength.
        orders: thin, with edges and rigorous.
        unsettled: relative change of the rigorous orders from three quarters of the terms, for light along x and y.
    """

    piece: Piece
    wavelength_m: float
    orders: PieceComparison
    unsettled: Float[np.ndarray, "2"]


def cut_rows(
    height_m: Float[np.ndarray, "y x"], grid: Grid, aperture: Aperture, cells: int, shares: Sequence[float] = SHARES
) -> list[Row]:
    """Cut rows of `cells` cells: along x on the x axis, along y on the y axis, and along x on the diagonal.

    On the axes of a design of rings they cross the rings, where walls stand closest. Rows without relief are left out,
    and parts of rows beyond the aperture; rows are at most as long as the plate.
    """
    found = []
    for axis, centre_m in _places(shares, aperture):
        row, column = _cell_at(grid, centre_m)
        line, middle = (height_m[row], column) if axis == "x" else (height_m[:, column], row)
        across_m = grid.axis_m("y")[row] if axis == "x" else grid.axis_m("x")[column]
        count = min(cells, len(line))
        start = int(np.clip(middle - count // 2, 0, len(line) - count))
        along_m = grid.axis_m(axis)[start : start + count]
        at_m = (np.full(1, across_m), along_m) if axis == "x" else (along_m, np.full(1, across_m))
        inside = aperture.contains(*at_m)
        part = np.asarray(line[start : start + count], np.float64)[inside]
        if len(part) > 1 and np.ptp(part) > 0:
            own, other = float(along_m[inside].mean()), float(across_m)
            found.append(Row(axis, (own, other) if axis == "y" else (other, own), part))
    return found


def _places(shares: Sequence[float], aperture: Aperture) -> Iterator[tuple[Literal["x", "y"], tuple[float, float]]]:
    """Yield the direction in which to cut, and where (y, x), metres."""
    for share in shares:
        reach_y, reach_x = (share * side_m / 2 for side_m in aperture.extent_m)
        yield "x", (0.0, reach_x)
        if share:
            yield "y", (reach_y, 0.0)
            yield "x", (reach_y / np.sqrt(2), reach_x / np.sqrt(2))


def _cell_at(grid: Grid, place_m: tuple[float, float]) -> tuple[int, int]:
    y_m, x_m = place_m
    return int(np.argmin(np.abs(grid.axis_m("y") - y_m))), int(np.argmin(np.abs(grid.axis_m("x") - x_m)))


def cut_pieces(
    height_m: Float[np.ndarray, "y x"],
    grid: Grid,
    aperture: Aperture,
    side: int,
    count: int,
    *,
    cells: int,
    shares: Sequence[float] = SHARES,
) -> list[Piece]:
    """Cut squares of `side` cells and side where rows of `cells` cells are cut, at `count` of their places.

    The places are spread over radii and directions, the outermost first. Of the squares along a row the one with the
    highest walls is taken, which is the hardest for a thin element; none where all are flat or beyond the aperture.
    """
    places, found = list(_places(shares, aperture)), []
    for chosen in np.linspace(len(places) - 1, 0, count).round().astype(int):
        axis, centre_m = places[chosen]
        row, column = _cell_at(grid, centre_m)
        reach = (0, cells // 2) if axis == "x" else (cells // 2, 0)
        squares = []
        for y in range(row - reach[0], row + reach[0] + 1):
            for x in range(column - reach[1], column + reach[1] + 1):
                if min(y, x) < 0 or y + side > height_m.shape[0] or x + side > height_m.shape[1]:
                    continue
                y_m, x_m = grid.axis_m("y")[y : y + side], grid.axis_m("x")[x : x + side]
                if aperture.contains(y_m[:, None], x_m[None, :]).all():
                    part = np.asarray(height_m[y : y + side, x : x + side], np.float64)
                    squares.append(Piece((float(y_m.mean()), float(x_m.mean())), part))
        if squares and _wall_heights(hardest := max(squares, key=_wall_heights)) > 0:
            found.append(hardest)
    return found


def _wall_heights(piece: Piece) -> float:
    """Sum of the heights of all walls of a square that repeats; of equal ones the first is the highest."""
    return float(sum(np.abs(piece.height_m - np.roll(piece.height_m, 1, axis)).sum() for axis in (0, 1)))


def certify_rows(
    rows: Sequence[Row], camera: Camera, wavelengths_m: Sequence[float], on_row: Callable[[], None] = lambda: None
) -> tuple[CertifiedRow, ...]:
    """Solve rows that repeat, lit from the air at normal incidence, at every wavelength.

    Args:
        rows: of `cut_rows`.
        camera: pitch and substrate.
        wavelengths_m: vacuum wavelengths.
        on_row: called after every one, for progress.
    """

    def solved(wavelength_m: float, row: Row) -> CertifiedRow:
        index = refractive_index(camera.material, wavelength_m)
        coarse, fine = (
            compare_row(row.height_m, camera.grid.pitch_m, wavelength_m, index, waves=waves) for waves in _WAVES
        )
        return CertifiedRow(row, wavelength_m, fine, fine.error(coarse.rigorous))

    found = []
    # Several threads make one of these matrices slower: twice with nothing else to do, and twenty times beside others.
    with threadpool_limits(1), ThreadPoolExecutor(cores()) as pool:
        for one in pool.map(solved, *zip(*itertools.product(wavelengths_m, rows), strict=True)):
            found.append(one)
            on_row()
    return tuple(found)


def certify_pieces(
    pieces: Sequence[Piece], camera: Camera, wavelengths_m: Sequence[float], on_piece: Callable[[], None] = lambda: None
) -> tuple[CertifiedPiece, ...]:
    """Solve squares that are continued by mirrors, lit from the air at normal incidence, at every wavelength.

    Args:
        pieces: of `cut_pieces`.
        camera: pitch and substrate.
        wavelengths_m: vacuum wavelengths.
        on_piece: called after every one, for progress.
    """
    pitch_m = camera.grid.pitch_m

    def solved(wavelength_m: float, piece: Piece) -> CertifiedPiece:
        given = pitch_m, wavelength_m, refractive_index(camera.material, wavelength_m)
        square, waves = piece.repeated_m, _PIECE_WAVES.get(len(piece.height_m), min(_PIECE_WAVES.values()))
        terms = travelling_terms(square.shape, *given, waves)
        coarse, fine = (compare_piece(square, *given, count) for count in (round(_COARSE * terms), terms))
        return CertifiedPiece(piece, wavelength_m, fine, fine.error(coarse.rigorous))

    found = []
    with threadpool_limits(1), ThreadPoolExecutor(cores()) as pool:
        for one in pool.map(solved, *zip(*itertools.product(wavelengths_m, pieces), strict=True)):
            found.append(one)
            on_piece()
    return tuple(found)
