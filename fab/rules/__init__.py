"""Lithography rules: what a process can print, and a level map changed until it can.

check         narrow lines and spaces, touching corners, density, address grid
bitplanes     a plane as 64-pixel words, and runs of them (numba)
widths        how narrow runs are found and counted
repair        the level map nearest to a given one that the process prints, and one that follows another and stays so
repair_moves  the single changes that a repair tries
strokes       cells of two heights that repeat, made of what the process prints
"""
