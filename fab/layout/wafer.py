"""The wafer that a mask set is for: its glass, its mask blanks, and how it is filled."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from fab.errors import InputError
from fab.files import IF_ANY
from fab.units import MM, UM, format_length, number_of, numbers_of, told_length

# Primary flats of SEMI M1 by diameter, both in millimetres; larger wafers have a notch.
_FLATS = {50.8: 15.88, 76.2: 22.22, 100.0: 32.5, 125.0: 42.5, 150.0: 57.5}
_MOST_SPLITS = 32
_MOST_DIES = 100_000
_NOTCH_M, _NOTCHED_M = 1 * MM, 199 * MM
_FARTHEST_M = 100 * UM  # that an edge is moved


@dataclass(frozen=True)
class Wafer:
    """The glass, the mask blanks, and how the wafer is filled.

    Attributes:
        reading: how masks are to be made, on every wafer.
        diameter_m: diameter of the wafer, metres.
        thickness_m: its thickness, metres.
        blank_m: edge of the square mask blanks, metres; 5 inches for a wafer of 100 mm.
        dies: rows and columns of dies; as many as fit if None.
        pitch_m: distance of the dies, metres; the next whole millimetre that a die and a saw lane need if None.
        lane_m: width of the saw lanes between the dies, metres.
        edge_exclusion_m: width of the rim that is held, beaded or ground, and holds nothing, metres.
        chrome_to_edge: whether the chrome around the aperture reaches to the edges of the die.
        zero_layer: whether marks of chrome are made before the first etch.
        chrome: how the aperture's chrome is made.
        compensate: whether masks are drawn with their edges moved against the line-width bias that the process is
            known for (`Process.expected`).
        edge_moves_m: how far masks are drawn with the edges of etched areas moved outward instead, first mask first,
            metres.
        line_splits_m: for each entry some dies whose edges of etched areas are drawn so much further out, metres.
        order_control: whether some dies draw the planes in the opposite order of depths (`fab.layout.split`).

    Raises:
        InputError: a wafer that its blanks do not hold, no die as ordered, or a length that cannot be.
    """

    reading: ClassVar[str] = "right-reading chrome down"
    diameter_m: float = 100 * MM
    thickness_m: float = 0.5 * MM
    blank_m: float = 127 * MM
    dies: tuple[int, int] | None = None
    pitch_m: float | None = None
    lane_m: float = 200 * UM
    edge_exclusion_m: float = 4 * MM
    chrome_to_edge: bool = True
    zero_layer: bool = False
    chrome: Literal["liftoff", "etch"] = "liftoff"
    compensate: bool = False
    line_splits_m: tuple[float, ...] = ()
    order_control: bool = False
    edge_moves_m: tuple[float, ...] = field(default=(), metadata=IF_ANY)

    def __post_init__(self) -> None:
        for name in ("diameter_m", "thickness_m", "blank_m"):
            if not 0 < number_of(value := getattr(self, name)) < 1:
                got = told_length(value)
                raise InputError(f"wafer: {name}", "must be positive and below 1 m", got, "Check its unit.")
        if self.pitch_m is not None and not 0 < number_of(self.pitch_m) < 1:
            rule, got = "must be positive and below 1 m", told_length(self.pitch_m)
            raise InputError("wafer: pitch_m", rule, got, "Check its unit, or leave it out.")
        # Another word would change the tone of its photomask.
        if not isinstance(self.chrome, str) or self.chrome not in ("liftoff", "etch"):
            raise InputError("wafer: chrome", 'must be "liftoff" or "etch"', repr(self.chrome), "Choose one of them.")
        if self.blank_m < self.diameter_m:
            rule = f"must hold the wafer of {format_length(self.diameter_m)}"
            raise InputError("wafer: blank_m", rule, format_length(self.blank_m), "Choose a larger mask blank.")
        if self.dies is not None:
            dies = numbers_of(self.dies)
            if len(dies) != 2 or not all(n >= 1 and n.is_integer() for n in dies):
                rule = "must be 1 or more rows and columns"
                raise InputError("wafer: dies", rule, repr(self.dies), "For example (3, 3).")
            object.__setattr__(self, "dies", tuple(int(n) for n in dies))  # of numpy, they would not go into JSON
        if self.dies is not None and self.dies[0] * self.dies[1] > _MOST_DIES:
            rule = f"must be at most {_MOST_DIES} altogether"
            raise InputError("wafer: dies", rule, self.dies, "Let the wafer be filled.")
        for name in ("line_splits_m", "edge_moves_m"):
            moves = numbers_of(given := getattr(self, name))
            if any(map(math.isnan, moves)):
                cure = "For example (0.2e-6, -0.2e-6)."
                raise InputError(f"wafer: {name}", "must be several numbers of metres", repr(given), cure)
            object.__setattr__(self, name, moves)
        if len(self.line_splits_m) > _MOST_SPLITS:
            rule, got = f"must be at most {_MOST_SPLITS}", len(self.line_splits_m)
            raise InputError("wafer: line splits", rule, got, "Take fewer, since each is a drawing of its own.")
        if any(not 1e-9 <= abs(move) <= _FARTHEST_M for move in self.line_splits_m):
            got = ", ".join(format_length(move) for move in self.line_splits_m)
            raise InputError("wafer: line splits", "must lie from 1 nm to 100 um, out or in", got, "Check their unit.")
        if any(not abs(move) <= _FARTHEST_M for move in self.edge_moves_m):
            got = ", ".join(map(format_length, self.edge_moves_m))
            raise InputError("wafer: edge moves", "must be at most 100 um, out or in", got, "Check their unit.")
        if self.edge_moves_m and self.compensate:
            cure = "Leave one of them out."
            raise InputError("wafer: edge moves", "edges are moved by these lengths, or against the bias", "both", cure)
        for name, most_m in (("lane_m", 10 * MM), ("edge_exclusion_m", self.diameter_m / 4)):
            if not 0 <= number_of(value := getattr(self, name)) <= most_m:
                rule = f"must lie from 0 to {format_length(most_m)}"
                raise InputError(f"wafer: {name}", rule, told_length(value), "Check its unit.")
        if self.dies is not None:
            self.require_room(self.dies[0] * self.dies[1])

    def require_room(self, dies: int) -> None:
        """Check that splits leave a die as ordered of so many."""
        split = len(self.line_splits_m) + self.order_control
        if split >= dies:
            rule = "must leave one die or more as ordered"
            got = f"{split} of {dies} dies"
            raise InputError("wafer: line splits", rule, got, "Take fewer splits, or more dies.")

    @property
    def flat_y_m(self) -> float:
        """How far the flat, or the rim where there is none, lies below the middle, metres."""
        return math.sqrt((self.diameter_m / 2) ** 2 - (self.usual_flat_m / 2) ** 2)

    @property
    def notch_m(self) -> float:
        """Depth of the notch that wafers of this diameter usually have, metres; 0 where it is a flat, or nothing."""
        return _NOTCH_M if self.diameter_m >= _NOTCHED_M else 0.0

    @property
    def usual_flat_m(self) -> float:
        """Length of the primary flat that wafers of this diameter usually have, metres; 0 for other diameters."""
        return next((flat * MM for size, flat in _FLATS.items() if abs(self.diameter_m / MM - size) <= 0.5), 0.0)
