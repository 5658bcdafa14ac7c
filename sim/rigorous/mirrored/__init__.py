"""Light of relief that repeats and has mirrors, in cosines and sines: one layer, and what squares of cells need.

At normal incidence through a layer without loss that is its own mirror image along x, the field divides into two parts
that do not know of each other, and light along x or y excites one. In cosines and sines instead of exponentials its
equations are real. So this needs half of the unknowns of `crossed_orders`, a quarter where there is a mirror along y,
too, and real arithmetic, and no modes: with the transverse fields h = (Hx, Hy) and e = (-Ey, Ex), Maxwell's equations
in Fourier orders are h' = i G e, e' = i B h, and cos(sqrt(G B) d) and sin(sqrt(G B) d) / sqrt(G B) of a layer d thick
are found by doubling, in products of matrices. The gradient is that of the adjoint field: one more solution of the same
system, and an integral over the depth.

    layer       one layer between two half-spaces, its orders, and their gradient: for refinement
    basis       cosines and sines of a symmetry, half-spaces, and the equations of a layer
    sectors     the functions, and matrices of multiplication between them
    directions  directions along walls
    waves       cosines and sines of matrices, and fields that they carry
"""

from sim.rigorous.mirrored.layer import MirroredLayer

__all__ = ["MirroredLayer"]
