"""Terms of a mask order: everything asked of a mask shop besides the drawing."""

import re
from dataclasses import dataclass, field, fields

from fab.errors import InputError
from fab.files import IF_ANY
from fab.units import is_whole, number_of, told_length

_REVISION = re.compile(r"[A-Z0-9]{1,3}")
_LONGEST_TEXT = 200
# Moves of edges against what a process does are drawn, and twice would be once too often.
UNSIZED = "none: lines on the plate as wide as in the data"


@dataclass(frozen=True)
class OrderTerms:
    """The terms of a mask order, after the fields of SEMI P10; None is a blank that is filled in by hand.

    Attributes:
        revision: of this order, one to three capitals or digits; it stands in all names and on the masks.
        contact: who answers questions: name, telephone, e-mail.
        company: who orders.
        purchase_order: its number.
        ship_to: address that the masks are sent to.
        quantity: copies of each mask.
        glass: of the mask blanks, such as "soda lime" or "fused silica".
        blank_thickness_m: thickness of the mask blanks, metres.
        blank_flatness_m: their flatness, metres.
        chrome: on the mask blanks, such as "low reflective, optical density 3".
        address_grid_m: address grid of the mask writer, metres.
        cd_tolerance_m: largest error of a line width, metres.
        registration_m: largest error of a place, metres.
        defect_class: of the mask shop.
        defect_size_m: smallest defect that counts, metres.
        defects_per_cm2: how many of them are accepted.
        pellicle: its kind, or "none".
        remarks: anything else.
        sizing: whether the mask shop moves edges of the data; None in orders whose form does not say.

    Raises:
        InputError: an impossible value, named by its attribute.
    """

    revision: str = "A"
    contact: str | None = None
    company: str | None = None
    purchase_order: str | None = None
    ship_to: str | None = None
    quantity: int | None = None
    glass: str | None = None
    blank_thickness_m: float | None = None
    blank_flatness_m: float | None = None
    chrome: str | None = None
    address_grid_m: float | None = None
    cd_tolerance_m: float | None = None
    registration_m: float | None = None
    defect_class: str | None = None
    defect_size_m: float | None = None
    defects_per_cm2: float | None = None
    pellicle: str | None = None
    remarks: str | None = None
    sizing: str | None = field(default=None, metadata=IF_ANY)

    def __post_init__(self) -> None:
        for one in fields(self):
            value, where = getattr(self, one.name), f"order: {one.name}"
            if isinstance(value, str) and not (value.isprintable() and 0 < len(value.strip()) <= _LONGEST_TEXT):
                rule = f"must be one line of 1 to {_LONGEST_TEXT} characters"
                raise InputError(where, rule, repr(value)[:60], "Shorten it, or leave it out.")
            if one.name.endswith("_m") and value is not None and not 0 < number_of(value) < 0.1:
                rule = "must be metres, positive and below 100 mm"
                raise InputError(where, rule, told_length(value), "Check its unit.")
            if "str" in str(one.type) and value is not None and not isinstance(value, str):
                raise InputError(where, "must be text", repr(value), "Leave it out if it is open.")
        if not _REVISION.fullmatch(self.revision):
            rule = "must be one to three capitals A-Z or digits"
            raise InputError("order: revision", rule, repr(self.revision), 'For example "A" or "02".')
        if self.quantity is not None and not is_whole(self.quantity, 1):
            raise InputError(
                "order: quantity", "must be a whole number, 1 or more", self.quantity, "Leave it out if it is open."
            )
        if self.quantity is not None:
            object.__setattr__(self, "quantity", int(self.quantity))  # of numpy, it would not go into JSON
        if self.defects_per_cm2 is not None and not 0 <= number_of(self.defects_per_cm2) < 1e6:
            got = repr(self.defects_per_cm2)
            raise InputError("order: defects_per_cm2", "must be 0 or more, below a million", got, "Check it.")
