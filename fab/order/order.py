"""A mask order in numbers, before it becomes files: what is drawn, for whom, and what everything is called."""

import logging
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

from fab.errors import InputError
from fab.files import IF_ANY, canonical_json, sha256_bytes
from fab.layout.compensation import edge_moves
from fab.layout.geometry import Chrome, pixel_edges
from fab.layout.lettering import Job
from fab.layout.marks import faint_marks
from fab.layout.part import Photomask, photomasks_of
from fab.layout.split import DieSplit, splits_of
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.order.formats import Formats
from fab.order.terms import UNSIZED, OrderTerms
from fab.process import Process
from fab.rules.check import Rules, RulesReport, check
from fab.rules.repair import Repair, repaired
from fab.runsheet.tables import SILICA, Predictions
from fab.solids.patch import Patch
from fab.stock import STOCK, process_from
from fab.units import NM, UM, format_length, require_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")

OnViolation = Literal["warn", "fail", "fix"]

# Of names of files and cells, and of the endings of cells other than those of masks ("_ORDER_DIE").
_LONGEST_NAME, _LONGEST_ENDING = 32, 10
_FEMTO = 10**15
_FARTHEST = 2**31 - 1  # coordinate of a drawing, database units
_DEEP = 0.1  # of the wafer, from where on a depth is more likely a mistake in its unit


@dataclass(frozen=True)
class Light:
    """Predictions of the light for the run sheet, and the digest of the PNG of the PSFs that goes with them."""

    predictions: Predictions
    picture_sha256: str


@dataclass(frozen=True, eq=False)
class Order:
    """A mask order in numbers, before it becomes files.

    All files follow from it, so that `fab.order.verify` can say from the manifest what each of them has to hold.

    Attributes:
        rules: the level map to draw, checked against what the process prints.
        process: in which order the masks are etched, and what their polygons are on the photomasks.
        wafer: what the masks are filled with.
        chrome: how the chrome is drawn.
        source: where the level map came from, for the manifest; JSON values only.
        patch: a window that is wanted as a solid at full resolution, if any.
        repair: how the level map was changed for the process to print it, if it was.
        terms: what is asked of the mask shop besides the drawing.
        direct_write: whether files for direct-write and greyscale exposure come with the masks.
        papers: whether a run sheet and pictures of the wafer, its marks and broken rules come with the masks.
        light: what the run sheet says of the light, if anything.
        formats: in which formats it is written.
        material: what the wafer is made of, in words, for the run sheet.

    Raises:
        InputError: floors as deep as the wafer is thick, or a mask blank that 32-bit coordinates do not reach across.
    """

    rules: RulesReport
    process: Process
    wafer: Wafer
    chrome: Chrome
    source: Mapping[str, Any] = field(default_factory=dict)
    patch: Patch | None = None
    repair: Repair | None = None
    terms: OrderTerms = field(default_factory=OrderTerms)
    direct_write: bool = False
    papers: bool = False
    light: Light | None = None
    formats: Formats = field(default_factory=Formats)
    material: str = field(default=SILICA, metadata=IF_ANY)

    def __post_init__(self) -> None:
        """Raise an InputError for floors that leave no glass below them, and for a blank that cannot be drawn."""
        deep_m, glass_m = self.level_map.levels.total_m, self.wafer.thickness_m
        if deep_m >= glass_m:
            rule = f"must be thicker than the deepest floor, {format_length(deep_m)}"
            cure = "Check the unit of the height of a level, or give the thickness of the wafer."
            raise InputError("wafer: thickness", rule, format_length(glass_m), cure)
        most_m = 2 * _FARTHEST * self.dbu_m
        if self.wafer.blank_m > most_m:
            unit, most = format_length(self.dbu_m), format_length(most_m)
            rule = f"must be at most {most} in 32-bit coordinates of {unit}, the database unit of this pitch"
            cure = "Choose a smaller mask blank, or a pitch of whole nanometres."
            raise InputError("wafer: blank_m", rule, format_length(self.wafer.blank_m), cure)

    @property
    def level_map(self) -> LevelMap:
        """The DOE as it is drawn."""
        return self.rules.level_map

    @cached_property
    def photomasks(self) -> tuple[Photomask, ...]:
        """The masks in the order in which they are used."""
        process, wafer = self.process, self.wafer
        return photomasks_of(self.level_map.levels, process.order, process.tone, wafer.chrome, wafer.zero_layer)

    def edge_moves(self) -> tuple[int, ...]:
        """Return how far the edges of every mask are moved outward, database units.

        Raises:
            InputError: lengths that are not one per mask.
        """
        if given := self.wafer.edge_moves_m:
            if len(given) != self.process.masks:
                rule = f"must be one length per mask, {self.process.masks}"
                raise InputError("wafer: edge moves", rule, len(given), "Add or remove lengths.")
            return tuple(round(move / self.dbu_m) for move in given)
        if not self.wafer.compensate:
            return (0,) * self.process.masks
        return edge_moves(self._biases_m, self.dbu_m)

    @property
    def _biases_m(self) -> list[float]:
        """How much wider than drawn the process prints, by mask: outward of every edge."""
        usual = self.process.expected()
        return [float(usual.common_cd_bias_m + own) for own in usual.cd_bias_m or (0.0,) * self.process.masks]

    def narrowed(self) -> tuple[str, ...]:
        """One sentence for every mask whose moved edges leave a line or a space too narrow for the process to print."""
        found, biases_m = [], self._biases_m
        for split in self.splits:
            for mask, (bit, move) in enumerate(zip(split.bits, split.moves, strict=True)):
                plane, grown_m = self.rules.planes[bit], move * self.dbu_m + biases_m[mask]
                for what, widths, sign in (("line", plane.line, 1), ("space", plane.space, -1)):
                    least = widths.minimum_m
                    if not move or widths.smallest_m is None or widths.smallest_m < least:
                        continue  # not moved, or said already
                    printed = widths.smallest_m + 2 * sign * grown_m
                    if printed < least - self.dbu_m - 1e-12:  # moves are whole units, on both sides
                        where = f" ({split.words})" if split.words else ""
                        found.append(
                            f"mask {mask + 1}{where}: its edges are moved so far that its narrowest {what} prints "
                            f"{format_length(max(printed, 0.0))} wide, below the {format_length(least)} of the process"
                        )
        return tuple(found)

    @property
    def dbu_m(self) -> float:
        """Database unit of the drawing, metres."""
        return pixel_edges(self.level_map.grid).dbu_m

    @property
    def splits(self) -> tuple[DieSplit, ...]:
        """The ways in which the dies draw the DOE, as ordered first."""
        return splits_of(self.wafer, self.level_map.levels, self.edge_moves(), self.dbu_m)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw heights, chrome and every etch mask (`fab.plots.masks.plot_masks`)."""
        from fab.plots.masks import plot_masks

        title = f"{self.stem}: {self.level_map.levels}, level map {self.level_map.digest[:12]}"
        chrome = self.chrome.opening(self.level_map.relief), self.chrome.rim_m(self.level_map)
        return plot_masks(self.level_map, chrome, title, ax)

    def photomask_stem(self, photomask: Photomask) -> str:
        """Return the name of a mask's file (without suffix) and top cell."""
        if photomask.bit is not None:
            return self.mask_stem(photomask.bit)
        return f"{self.stem}_{'ZERO' if photomask.makes == 'zero layer' else 'CHROME'}"

    def plate_file(self, stem: str) -> str:
        """Return the name of the file of a photomask from that of its top cell."""
        return f"{stem}.{self.formats.plates}"

    @property
    def combined_gds(self) -> str | None:
        """Name of the combined layout as GDSII, if it is wanted."""
        return f"{self.stem}_ALL.gds" if self.formats.combined_gds else None

    @property
    def job(self) -> Job:
        """Identity of the job, as its labels tell it."""
        return Job(self.stem, self.terms.revision, self.level_map.grid.pitch_m, self.geometry)

    @cached_property
    def geometry(self) -> str:
        """SHA-256 of all that the drawing is made from: level map, pixels, depths, chrome, wafer and process."""
        level_map, process, levels = self.level_map, self.process, self.level_map.levels
        drawn = {
            "level map": level_map.digest,
            "shape": level_map.grid.shape,
            "pitch": level_map.grid.pitch_m,
            "aperture": level_map.relief.record(),
            "depths": level_map.levels.depths_m,
            # Planes are counted from the top level down; of other counts than powers of two the depths do not tell it.
            **({} if levels.count == 2**levels.bits else {"levels": levels.count}),
            "chrome": asdict(self.chrome),
            # Moves of edges, asked for or against the bias, stand with the process.
            "wafer": {name: value for name, value in asdict(self.wafer).items() if name != "edge_moves_m"},
            "process": (process.order, process.tone, process.minimum_line_m, self.edge_moves()),
        }
        return sha256_bytes(canonical_json(_whole(drawn)))

    @cached_property
    def stem(self) -> str:
        """Identity of the job, with which all names begin: name, revision, pitch (micrometres), digest of geometry."""
        pitch = f"{self.level_map.grid.pitch_m / UM:.4g}".replace(".", "P")
        ending = f"_{self.terms.revision}_{pitch}_{self.geometry[:4].upper()}"
        masks = (len(self._mask_ending(bit)) for bit in range(self.process.masks))
        room = _LONGEST_NAME - len(ending) - max(_LONGEST_ENDING, *masks)
        return plain_name(self.level_map.name)[:room].rstrip("_") + ending

    def mask_stem(self, bit: int) -> str:
        """Return the name of an etch mask's file (without suffix) and cell."""
        return f"{self.stem}{self._mask_ending(bit)}"

    def _mask_ending(self, bit: int) -> str:
        depth_m = self.level_map.levels.etch_depth_m(bit)
        depth = f"{depth_m / NM:.1f}".removesuffix(".0") + "NM" if depth_m < 10 * UM else f"{depth_m / UM:.4g}UM"
        return f"_M{bit + 1}_{depth.replace('.', 'P')}"


def plan_order(
    level_map: LevelMap,
    *,
    process: Process | str | None = None,
    wafer: Wafer | None = None,
    chrome: Chrome | None = None,
    patch: Patch | None = None,
    terms: OrderTerms | None = None,
    direct_write: bool = False,
    source: Mapping[str, Any] | None = None,
    on_violation: OnViolation = "warn",
    waves_per_metre: float | None = None,
    papers: bool = False,
    formats: Formats | None = None,
    material: str = SILICA,
    one_to_one: bool = False,
) -> Order:
    """Check a level map against a process, and repair it on request; see `fab.order.write.write_order` and `Order`.

    Raises:
        InputError: what `Order` refuses, an unknown `on_violation`, a process of another staircase, one that takes no
            plates at 1:1 unless those are asked for, or masks that it cannot print where that is to fail.
    """
    if on_violation not in get_args(OnViolation):
        rule = f"must be one of {', '.join(get_args(OnViolation))}"
        raise InputError("on_violation", rule, repr(on_violation), "Choose one of these.")
    require_kind("level_map", level_map, LevelMap, "A design has one: design.level_map.")
    for name, value, kind in (("wafer", wafer, Wafer), ("chrome", chrome, Chrome), ("patch", patch, Patch)):
        require_kind(name, value, kind if value is not None else type(None), f"Give a fab.{kind.__name__}.")
    made_by = process_from(process, level_map.levels)
    if made_by.reduction > 1 and not one_to_one:
        rule = "must print plates at 1:1 by contact, a whole wafer at a time, which is what is drawn"
        got = f'"{made_by.name}", whose reticles hold one die, {made_by.reduction} times as large'
        cure = (
            'Choose another process, such as "contact_aligner", or take plates at 1:1 by `one_to_one` and have the '
            "mask shop enlarge the cell of a die."
        )
        raise InputError("process", rule, got, cure)
    if lost := [c for c in level_map.name if c.isalnum() and not c.isascii()]:
        said = (
            "mask shops take A-Z, digits and _ alone: of %s the names of files and cells leave out %s and begin with %s"
        )
        log.warning(said, level_map.name, "".join(dict.fromkeys(lost)), plain_name(level_map.name))
    wafer, terms = wafer or Wafer(), terms or OrderTerms()
    terms = terms if terms.sizing else replace(terms, sizing=UNSIZED)
    report = check(level_map, Rules.from_process(made_by, terms.address_grid_m))
    inside = level_map.level[level_map.relief.inside(level_map.grid)]
    if inside.size and inside.min() == inside.max():
        log.warning("every pixel of %s has level %d: it does to light what flat glass does", level_map.name, inside[0])
    for headline in report.headlines():
        log.warning(headline)
    if on_violation == "fail" and not report.printable:
        cure = "Design with a coarser pitch or fewer levels, choose another process, or have the level map repaired."
        raise InputError("masks", "the process must be able to print them", report.headlines()[0], cure)
    asked: dict[str, Any] = {"patch": patch, "terms": terms, "papers": papers, "direct_write": direct_write}
    asked |= {"formats": formats or Formats(), "material": material}
    _require_one_wafer(made_by, wafer)
    order = Order(report, made_by, wafer, chrome or Chrome(), source or {}, **asked)
    if made_by.name in STOCK and (said := STOCK[made_by.name].not_drawn) and not direct_write:
        log.warning("process %s: %s", made_by.name, said)
    off, address = report.off_grid, terms.address_grid_m
    if address is not None and off.edges:
        grid, worst = format_length(address), format_length(off.worst_m)
        said = "%d of %d lines of pixels lie off the mask writer's grid of %s, which will move them by up to %s"
        log.warning(said, off.edges, off.of, grid, worst)
    if warning := faint_marks(order.photomasks):
        log.warning(warning)
    deep_m = level_map.levels.total_m
    if deep_m > _DEEP * order.wafer.thickness_m:
        thick = format_length(order.wafer.thickness_m)
        log.warning("the deepest floor lies %s below the face of a wafer of %s", format_length(deep_m), thick)
    if on_violation == "fix" and not report.clean:
        log.info("repairing the level map")
        repair = repaired(report, waves_per_metre)
        source = {**order.source, "repair": asdict(repair.cost)}
        order = replace(order, rules=repair.rules, repair=repair, source=source)
        log.info("repaired: %s", repair.cost)
    if narrowed := order.narrowed():
        if on_violation == "fail":
            cure = "Move edges less, or choose another process."
            raise InputError("masks", "the process must be able to print them", narrowed[0], cure)
        for sentence in narrowed:
            log.warning(sentence)
    if patch is not None:
        patch.require(order.level_map)
    return order


def _require_one_wafer(process: Process, wafer: Wafer) -> None:
    """Check that the process, whose depths differ over the wafer, has its DOE on the wafer that is ordered."""
    if any(process.die_m) and abs(2 * process.wafer_radius_m - wafer.diameter_m) > 1 * UM:
        rule = f"must be half of the diameter of the wafer that is ordered, {format_length(wafer.diameter_m)}"
        cure = "Say where on this wafer the DOE lies, or order the wafer of the process."
        raise InputError("process: wafer_radius_m", rule, format_length(process.wafer_radius_m), cure)


def plain_name(name: str) -> str:
    """Turn a name into what mask shops accept in file and cell names: capitals, digits and _."""
    plain = re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")
    if not plain:
        raise InputError("mask order name", "must hold a letter A-Z or a digit", repr(name), "Choose another name.")
    return plain


def _whole(value: Any) -> Any:
    """Replace every length in nested values, metres, by whole femtometres, which last digits do not change."""
    if isinstance(value, Mapping):
        return {key: _whole(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_whole(item) for item in value]
    if isinstance(value, float):
        return round(value * _FEMTO) if math.isfinite(value) else str(value)
    return value
