"""Light as Maxwell has it: rigorous solutions of rows and squares of cells, and the widths of edges taken from them.

rows             coupled waves of a row that repeats
crossed          Fourier modes of a square that repeats along both axes (fmmax)
mirrored         one layer with a mirror, and the gradient of its orders
mirrored_squares squares of cells with two mirrors
edge_widths      what the wall between two heights adds to a thin element: a line of light and a dipole
width_tables     the same by height, shipped or computed once
corner_light     what a corner adds where walls of both axes meet
walls            the light of upright walls, its derivatives, and its share in the cells around
cells_and_walls  the light of a plate of cells, walls and corners, with its gradient
edge_optic       a DOE with that light: `with_edges`
comparison       a row as a thin element, with edges and by Maxwell's equations
pieces           a square, the same three ways
certificate      rows and squares cut out of a design, and compared
"""

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
from sim.rigorous.edge_widths import edge_dipoles, edge_widths
from sim.rigorous.mirrored import MirroredLayer
from sim.rigorous.mirrored_squares import mirrored_orders, with_mirrors
from sim.rigorous.pieces import PieceComparison, compare_piece, thin_piece_amplitudes
from sim.rigorous.rows import Orders, Slab, orders_of, row_slabs
from sim.rigorous.slab_cell import SlabCell

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
    "SlabCell",
    "certify_pieces",
    "certify_rows",
    "compare_piece",
    "compare_row",
    "crossed_orders",
    "cut_pieces",
    "cut_rows",
    "edge_dipoles",
    "edge_widths",
    "mirrored_orders",
    "orders_of",
    "row_slabs",
    "thin_amplitudes",
    "thin_piece_amplitudes",
    "with_mirrors",
]
