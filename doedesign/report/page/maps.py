"""The level map of a run as a pyramid with a view for heights, levels and every etch mask, and its broken rules."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from doedesign.build import process_from_spec
from doedesign.report.page import tiles
from doedesign.report.page.blocks import MapBlock, PageSection, TableBlock, section
from doedesign.report.page.files import RunFiles
from doedesign.report.page.numbers import length, number, percent
from doedesign.runs.folder import LEVEL_MAP
from fab.figure import CHROME
from fab.level_map import LevelMap, read_level_map
from fab.units import NM, UM

_OUTSIDE = 255  # number of the colour of the chrome
_SHADES = 32  # of the means in reduced copies
_GLASS, _ETCHED = (0xEE, 0xF3, 0xF7), (0x14, 0x50, 0x7A)
# Seven colours of matplotlib's viridis, evenly spaced.
_VIRIDIS = ("#440154", "#443983", "#31688e", "#21918c", "#35b779", "#90d743", "#fde725")


def level_map_section(files: RunFiles) -> PageSection | None:
    """Maps of a finished run, and the rules that its masks break.

    Args:
        files: the run.
    """
    if files.run is None:
        return None
    level_map = read_level_map(files.run.path(LEVEL_MAP))
    rules = rules_of(files, level_map)
    block = map_block(level_map, rules)
    return section("map", "Maps", [block, _rules_table(rules), _levels_table(level_map)])


def rules_of(files: RunFiles, level_map: LevelMap) -> Mapping[str, Any]:
    """Rules of the run's process checked on its masks, as an order records them; those of its order if it has one.

    Args:
        files: the run.
        level_map: its level map.
    """
    if files.order is not None:
        return files.order.rules
    from fab.rules.check import Rules, check  # slow to import

    return check(level_map, Rules.from_process(process_from_spec(files.spec.process))).as_record()


class MapView(NamedTuple):
    """A view of a map.

    Attributes:
        name: of the view.
        mean: `[y, x]` values from 0 to 1 that reduced copies are the means of.
        colours: of the numbers of the whole map.
        shades: of reduced copies, from the least to the largest mean.
    """

    name: str
    mean: NDArray[Any]
    colours: NDArray[np.uint8]
    shades: NDArray[np.uint8]


def map_block(level_map: LevelMap, rules: Mapping[str, Any]) -> MapBlock:
    """The map for the viewer, with a view for heights, levels and every mask.

    Args:
        level_map: the level map.
        rules: record of its rules (`fab.rules.check.RulesReport.as_record`).
    """
    levels, planes = level_map.levels, level_map.planes()
    views = [_height_view(level_map)]
    if not levels.is_binary:  # the numbers of the levels are no order of height
        greys = [np.rint(np.linspace(20, 250, count))[:, None].repeat(3, axis=1) for count in (levels.count, _SHADES)]
        colours, shades = (one.astype(np.uint8) for one in greys)
        views.append(MapView("level", level_map.level / (levels.count - 1), colours, shades))
    codes = [levels.count - 1 - level for level in range(levels.count)]
    for bit in range(levels.bits):
        colours = np.array([_ETCHED if code >> bit & 1 else _GLASS for code in codes], np.uint8)
        shades = _between(_GLASS, _ETCHED)
        views.append(MapView(f"mask {bit + 1}", planes[bit], colours, shades))
    places = _places(rules, level_map.shape, level_map.grid.pitch_m)
    heights = [round(float(height) / NM, 3) for height in levels.heights_m()]
    data = _map_data(level_map, level_map.level, views) | {"places": places, "heights_nm": heights}
    ny, nx = level_map.shape
    note = (
        f"{nx} × {ny} pixels of {length(level_map.grid.pitch_m)}, +y up. Drag to move; wheel, pinch, or + and - zoom "
        "down to single pixels, arrow keys move, 0 shows all. Reduced copies show means. Grey is chrome."
    )
    rows = tuple(
        (f"mask {one['mask']}", one["what"], f"{one['size_um']:g}" if one["size_um"] else "–",
         f"{one['x_um']:.2f}", f"{one['y_um']:.2f}") for one in places
    )  # fmt: skip
    return MapBlock("Height, levels and masks", data, tuple(view.name for view in views), rows, note)


def height_block(title: str, level_map: LevelMap) -> MapBlock:
    """Heights alone, moving with the other maps of a comparison.

    Args:
        title: whose heights.
        level_map: the level map.
    """
    view = _height_view(level_map)
    heights = [round(float(height) / NM, 3) for height in level_map.levels.heights_m()]
    data = _map_data(level_map, level_map.level, [view]) | {"places": [], "heights_nm": heights}
    return MapBlock(title, data, (view.name,), linked=True)


def difference_block(title: str, first: LevelMap, other: LevelMap) -> MapBlock:
    """Heights of another level map less those of the first, of the same raster, moving with the other maps.

    Args:
        title: what is less what.
        first: the first level map.
        other: the other one.
    """
    off = np.asarray(other.height_m, np.float64) - first.height_m
    most = float(np.abs(off).max()) or NM
    share = (off / most + 1) / 2
    steps = np.linspace(-1, 1, 2 * _SHADES + 1)
    numbers = np.rint(share * (len(steps) - 1)).astype(np.uint8)
    view = MapView("difference", share, _sides(steps), _sides(np.linspace(-1, 1, _SHADES)))
    data = _map_data(first, numbers, [view]) | {"places": [], "heights_nm": []}
    changed = float((off != 0)[first.relief.inside(first.grid)].mean())
    data["views"][0]["legend"] = (
        f"Blue: lower, white: the same, red: higher, up to {length(most)}; {percent(changed)} of the pixels differ."
    )
    return MapBlock(title, data, (view.name,), linked=True)


def _height_view(level_map: LevelMap) -> MapView:
    heights = np.asarray(level_map.levels.heights_m())
    top = max(float(heights.max()), 1e-12)
    return MapView("height", level_map.height_m / top, _ramp(heights / top), _ramp(np.linspace(0, 1, _SHADES)))


def _map_data(level_map: LevelMap, numbers: NDArray[np.uint8], views: Sequence[MapView]) -> dict[str, Any]:
    """Pyramid of a raster, whose numbers of colours are shared by all views."""
    grid = level_map.grid
    factors = tiles.reductions_of(grid.shape)
    inside = level_map.relief.inside(grid)[::-1]  # from the top, where the squares of reductions begin, too
    covered = dict(tiles.reduced(inside, factors))
    whole = np.where(inside, numbers[::-1], np.uint8(_OUTSIDE))
    return {
        "width": grid.shape[1],
        "height": grid.shape[0],
        "tile": tiles.TILE,
        "pitch_um": round(grid.pitch_m / UM, 9),
        "reductions": list(factors),
        "heads": tiles.heads(grid.shape, factors),
        "whole": tiles.tile_rows(np.ascontiguousarray(whole)),
        "views": [
            {
                "name": view.name,
                "colours": tiles.palette(_with_chrome(view.colours)),
                "shades": tiles.palette(_with_chrome(view.shades)),
                "reduced": _reduced_tiles(view.mean[::-1], inside, covered, factors),
            }
            for view in views
        ],
    }


def _with_chrome(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A palette of 256 colours, the last one that of the chrome."""
    full = np.zeros((256, 3), np.uint8)
    full[: len(colours)] = colours
    full[_OUTSIDE] = _rgb(CHROME)
    return full


def _rgb(text: str) -> tuple[int, int, int]:
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


def _ramp(at: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Colours of viridis at shares 0 to 1."""
    places = np.linspace(0, 1, len(_VIRIDIS))
    channels = [np.interp(at, places, [_rgb(stop)[k] for stop in _VIRIDIS]) for k in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def _between(first: tuple[int, int, int], last: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Colours from one to another."""
    steps = np.linspace(0, 1, _SHADES)[:, None]
    return np.rint(np.array(first) + steps * (np.array(last) - np.array(first))).astype(np.uint8)


def _sides(at: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Blue below 0, white at 0, red above, for values from -1 to 1."""
    faint = 1 - np.abs(at)
    red, blue = np.where(at < 0, faint, 1.0), np.where(at > 0, faint, 1.0)
    return np.rint(255 * np.stack([red, faint, blue], axis=1)).astype(np.uint8)


def _reduced_tiles(
    values: NDArray[Any],
    inside: NDArray[np.bool_],
    covered: Mapping[int, NDArray[np.float32]],
    factors: tuple[int, ...],
) -> dict[str, list[list[str]]]:
    """Tiles of the means of values from 0 to 1 over the relief, for every reduction; first rows are on top."""
    found = {}
    for factor, mean in tiles.reduced(np.where(inside, values, 0), factors):
        share = covered[factor]
        shades = np.rint(np.clip(mean / np.maximum(share, 1e-3), 0, 1) * (_SHADES - 1)).astype(np.uint8)
        shown = np.where(share >= 0.5, shades, np.uint8(_OUTSIDE))
        found[str(factor)] = tiles.tile_rows(np.ascontiguousarray(shown))
    return found


def _places(rules: Mapping[str, Any], shape: tuple[int, int], pitch_m: float) -> list[dict[str, Any]]:
    """Places that break a rule: in pixels from the left and the top, and in micrometres from the centre."""
    found = []
    for plane in rules["planes"]:
        for one in plane["places"]:
            wide, long = one["size_m"] / pitch_m, one["length_m"] / pitch_m
            found.append(
                {
                    "mask": plane["mask"],
                    "what": f"narrow {one['what']}" if one["size_m"] else one["what"],
                    "size_um": round(one["size_m"] / UM, 3),
                    "x_um": round(one["x_m"] / UM, 3),
                    "y_um": round(one["y_m"] / UM, 3),
                    "x_px": round(one["x_m"] / pitch_m + shape[1] / 2, 3),
                    "y_px": round(shape[0] / 2 - one["y_m"] / pitch_m, 3),
                    "reach_px": round(max(wide, long, 1.0), 3),
                }
            )
    return found


def _rules_table(rules: Mapping[str, Any]) -> TableBlock:
    smallest = rules["rules"]
    line, space = (length(smallest[f"minimum_{name}_m"]) for name in ("line", "space"))
    rows = []
    for plane in rules["planes"]:
        widths = [plane["line"], plane["space"]]
        rows.append(
            (
                f"mask {plane['mask']}",
                *(number(one["narrow"]) for one in widths),
                *(percent(one["narrow_share"]) for one in widths),
                number(plane["line"]["slivers"] + plane["space"]["slivers"]),
                f"{plane['kissing']}",
                percent(plane["density"]),
                f"{percent(plane['emptiest'])} to {percent(plane['fullest'])}",
            )
        )
    head = ("mask", "narrow lines", "narrow spaces", "of all lines", "of all spaces", "slivers", "touching corners",
            "etched", "etched in windows")  # fmt: skip
    fine = not (smallest["minimum_line_m"] or smallest["minimum_space_m"])
    limits = (
        "The process has no narrowest line or space." if fine else f"It prints lines from {line}, spaces from {space}."
    )
    found = "No mask breaks a rule." if rules["clean"] else " ".join(f"{words}." for words in rules["headlines"])
    note = f"{limits} {found}"
    return TableBlock("Rules of the process", head, tuple(rows), note)


def _levels_table(level_map: LevelMap) -> TableBlock:
    levels = level_map.levels
    inside = level_map.level[level_map.relief.inside(level_map.grid)]
    counts = np.bincount(inside, minlength=levels.count) / max(inside.size, 1)
    heights = levels.heights_m()
    rows = tuple(
        (str(level), f"{heights[level] / NM:.4g}", percent(float(counts[level])),
         " ".join(str(bit + 1) for bit in range(levels.bits) if levels.count - 1 - level >> bit & 1) or "none")
        for level in range(levels.count)
    )  # fmt: skip
    return TableBlock(
        "Levels", ("level", "height (nm)", "share of the relief", "masks that are open"), rows, folded=True
    )
