"""Light as Maxwell has it: rigorous solutions of rows and squares of cells, and the widths of edges taken from them."""

from sim.rigorous.certificate import (
    CertifiedPiece,
    CertifiedRow,
    Piece,
    Row,
    certify_pieces,
    certify_rows,
    cut_pieces,
    cut_rows,
)
from sim.rigorous.comparison import RowComparison, compare_row, thin_amplitudes
from sim.rigorous.crossed import CrossedOrders, crossed_orders
from sim.rigorous.edge_widths import edge_widths
from sim.rigorous.mirrored import MirroredLayer
from sim.rigorous.pieces import PieceComparison, compare_piece, thin_piece_amplitudes
from sim.rigorous.rows import Orders, Slab, orders_of, row_slabs

__all__ = [
    "CertifiedPiece",
    "CertifiedRow",
    "CrossedOrders",
    "MirroredLayer",
    "Orders",
    "Piece",
    "PieceComparison",
    "Row",
    "RowComparison",
    "Slab",
    "certify_pieces",
    "certify_rows",
    "compare_piece",
    "compare_row",
    "crossed_orders",
    "cut_pieces",
    "cut_rows",
    "edge_widths",
    "orders_of",
    "row_slabs",
    "thin_amplitudes",
    "thin_piece_amplitudes",
]
