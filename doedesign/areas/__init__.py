"""Areas of light: what should be lit, the level map that lights it, and how well it does.

target     the area on a lattice of directions
transport  the phase that carries a beam to an area as rays would
problem    light of a phase on that lattice, and its gradient
design     spec -> design, step by step
shape      efficiency, evenness, sizes and edges of the light that a DOE makes
"""
