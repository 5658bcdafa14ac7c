"""Foci on the axis: a lens, several at once, or light in focus all the way from one distance to another.

foci     where light should come to a focus, and how small
problem  light of rings on the axis and beside it, and its merit
design   spec -> design: L-BFGS on the heights of rings, then level by level
depth    width of the focus of a DOE through the distances
"""
