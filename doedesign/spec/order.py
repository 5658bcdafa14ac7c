"""Table of what a mask shop is asked for; a key that is left out is a blank on the order form."""

from typing import Annotated

from pydantic import Field

from doedesign.spec.values import Count, NotNegative, accepted, length
from doedesign.spec.values.table import SpecTable, optional
from fab.units import MM, NM

Small = Annotated[float, length(0.1 * NM, 1 * MM)]
Thickness = Annotated[float, length(0.1 * MM, 50 * MM)]
Text = Annotated[
    str,
    Field(strict=True),
    accepted(
        lambda text: text.isprintable() and text.strip() and len(text) <= 200, "must be one line of 1 to 200 characters"
    ),
]
Revision = Annotated[
    str,
    accepted(
        lambda text: text.isascii() and text.isalnum() and text == text.upper() and len(text) <= 3,
        "must be one to three capitals A-Z or digits",
    ),
]


class OrderSpec(SpecTable, frozen=True):
    """Terms of a mask order; see `fab.order.terms.OrderTerms`.

    Attributes:
        revision: revision of the order, in all names and on the masks.
        contact: who answers questions.
        company: who orders.
        purchase_order: number of the purchase order.
        ship_to: address that the masks are sent to.
        quantity: copies of each mask.
        glass: glass of the mask blanks.
        blank_thickness_m: thickness of the mask blanks.
        blank_flatness_m: flatness of the mask blanks.
        chrome: chrome on the mask blanks.
        address_grid_m: address grid of the mask writer.
        cd_tolerance_m: largest error of a line width.
        registration_m: largest error of a place.
        defect_class: class of defects, in the mask shop's terms.
        defect_size_m: smallest defect that counts.
        defects_per_cm2: defects per cm² that are accepted.
        pellicle: kind of the pellicle, or "none".
        remarks: anything else.
        sizing: whether the mask shop moves edges of the data; by default it does not.
    """

    revision: Revision = optional("A")
    contact: Text | None = optional(example='"A. Person, +00 000 0000"')
    company: Text | None = optional(example='"Example Optics"')
    purchase_order: Text | None = optional(example='"PO-1234"')
    ship_to: Text | None = optional(example='"1 Example Street"')
    quantity: Count | None = optional(example="1")
    glass: Text | None = optional(example='"quartz"')
    blank_thickness_m: Thickness | None = optional(example='"2.3 mm"')
    blank_flatness_m: Small | None = optional(example='"2 um"')
    chrome: Text | None = optional(example='"100 nm, anti-reflective"')
    address_grid_m: Small | None = optional(example='"5 nm"')
    cd_tolerance_m: Small | None = optional(example='"0.1 um"')
    registration_m: Small | None = optional(example='"0.1 um"')
    defect_class: Text | None = optional(example='"A"')
    defect_size_m: Small | None = optional(example='"1 um"')
    defects_per_cm2: NotNegative | None = optional(example="0.1")
    pellicle: Text | None = optional(example='"none"')
    remarks: Text | None = optional(example='"send in one box"')
    sizing: Text | None = optional(example='"0.1 um inward, all edges"')


class OrderFile(SpecTable, frozen=True):
    """TOML file of the terms of an order."""

    order: OrderSpec
