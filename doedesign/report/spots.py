"""The picture of tables of orders: a bar for every spot, and a map of them."""

from typing import TYPE_CHECKING

import numpy as np

from doedesign.spec.targets.spots import ONE_OF_THE_SPOTS
from fab.figure import FAINT, INK, LINE, MARK, panels
from sim.plots.places import label_places

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.spots.orders import OrderTable

_LABELLED = 40  # bars that still have room for their numbers


def plot_orders(table: "OrderTable", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the light of every spot as bars beside what it should be, and the spots where they lie on the sensor."""
    with panels(ax, (8.6, 4.4), _title(table), _note(table)) as figure:
        _draw(table, figure)
    return figure


def plot_colours(tables: "Sequence[OrderTable]", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the spots of several colours below each other, as `plot_orders` does each."""
    with panels(ax, (8.6, 4.1 * len(tables) + 0.35), "Spots of every colour", _note(*tables)) as figure:
        parts = figure.subfigures(len(tables), 1, squeeze=False)[:, 0]
        for table, part in zip(tables, parts, strict=True):
            part.suptitle(f"{table.colour}: {_title(table)}", x=0.01, ha="left", parse_math=False)
            _draw(table, part)
    return figure


def _title(table: "OrderTable") -> str:
    """Light and uniformity error of spots."""
    return (
        f"{table.spots.count} spots with {100 * table.total:.2f} % of the light, uniformity error "
        f"{100 * table.uniformity_error:.2f} %"
    )


def _note(*tables: "OrderTable") -> str:
    """The note under a picture: of which light the shares are, and the ceiling."""
    bound = tables[0].ceiling
    ceiling = "No ceiling is known."
    if bound.efficiency is not None:
        ceiling = f"Ceiling {100 * bound.efficiency:.1f} %: {bound.source}."
    least, most = (f"{100 * (1 - side(one.fresnel for one in tables)):.1f}" for side in (max, min))
    lost = f"{least}{'' if least == most else f' to {most}'} % that faces reflect"
    return f"Shares of the incident light; {lost} are left out. {ceiling}"


def _draw(table: "OrderTable", figure: "FigureBase") -> None:
    """Draw bars and places side by side."""
    from matplotlib.ticker import MaxNLocator

    spots, wanted = table.spots, table.spots.shares * table.total
    zeroth = f"0th order ({ONE_OF_THE_SPOTS})" if table.zeroth_order_wanted else "0th order"
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    at = np.arange(spots.count)
    left.bar(at, 100 * table.efficiency, 0.8, color=LINE, label="reached")
    left.step(np.append(at - 0.5, at[-1] + 0.5), 100 * np.append(wanted, wanted[-1]), where="post", color=MARK,
              lw=1, label="wanted share of the total")  # fmt: skip
    left.axhline(100 * table.zeroth_order, color=INK, lw=0.8, ls=":", label=zeroth)
    if table.strongest_stray is not None:
        left.axhline(100 * table.strongest_stray, color=FAINT, lw=0.8, ls="--", label="strongest stray order")
    left.set(xlim=(-0.7, spots.count - 0.3), ylim=(0, 128 * table.efficiency.max()), ylabel="efficiency (%)")
    left.legend(loc="upper left", ncols=2)
    if spots.orders is not None and spots.count <= _LABELLED:
        rows = bool(np.ptp(spots.orders[:, 0]))
        names = [f"{x:d}, {y:d}" if rows else f"{x:d}" for y, x in spots.orders]
        left.set_xticks(at, names, rotation=90 if rows else 0)
        left.set_xlabel("order (x, y)" if rows else "order")
    else:
        left.xaxis.set_major_locator(MaxNLocator(integer=True))
        left.set_xlabel("spot")
    y, x = table.places_m.T / table.unit.scale
    over = 100 * (table.efficiency / wanted - 1)
    reach = max(float(np.abs(over).max()), 1e-3)
    dots = right.scatter(x, y, c=over, cmap="coolwarm", vmin=-reach, vmax=reach, s=42, edgecolors=INK, lw=0.4)
    right.plot(0, 0, "+", color=FAINT)
    right.set_aspect("equal", adjustable="datalim")
    label_places(right, table.unit)
    right.margins(0.15)
    figure.colorbar(dots, ax=right, label="over its wanted share (%)", shrink=0.8)
