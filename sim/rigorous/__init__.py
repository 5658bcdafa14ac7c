"""Light as Maxwell has it: rigorous solutions of small reliefs, and the widths of edges taken from them."""

from sim.rigorous.certificate import CertifiedRow, Row, certify_rows, cut_rows
from sim.rigorous.comparison import RowComparison, compare_row, thin_amplitudes
from sim.rigorous.edge_widths import edge_widths
from sim.rigorous.rows import Orders, Slab, orders_of, row_slabs

__all__ = [
    "CertifiedRow",
    "Orders",
    "Row",
    "RowComparison",
    "Slab",
    "certify_rows",
    "compare_row",
    "cut_rows",
    "edge_widths",
    "orders_of",
    "row_slabs",
    "thin_amplitudes",
]
