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
        revision: of the order; in all names and on the masks.
        contact: who answers questions.
        company: who orders.
        purchase_order: its number.
        ship_to: address that the masks are sent to.
        quantity: copies of each mask.
        glass: of the mask blanks.
        blank_thickness_m: thickness of the mask blanks.
        blank_flatness_m: their flatness.
        chrome: on the mask blanks.
        address_grid_m: address grid of the mask writer.
        cd_tolerance_m: largest error of a line width.
        registration_m: largest error of a place.
        defect_class: of the mask shop.
        defect_size_m: smallest defect that counts.
        defects_per_cm2: how many of them are accepted.
        pellicle: its kind, or "none".
        remarks: anything else.
    """

    revision: Revision = optional("A")
    contact: Text | None = optional()
    company: Text | None = optional()
    purchase_order: Text | None = optional()
    ship_to: Text | None = optional()
    quantity: Count | None = optional()
    glass: Text | None = optional()
    blank_thickness_m: Thickness | None = optional()
    blank_flatness_m: Small | None = optional()
    chrome: Text | None = optional()
    address_grid_m: Small | None = optional()
    cd_tolerance_m: Small | None = optional()
    registration_m: Small | None = optional()
    defect_class: Text | None = optional()
    defect_size_m: Small | None = optional()
    defects_per_cm2: NotNegative | None = optional()
    pellicle: Text | None = optional()
    remarks: Text | None = optional()


class OrderFile(SpecTable, frozen=True):
    """TOML file of the terms of an order."""

    order: OrderSpec
