"""Spots and diffraction orders: where light should go, the level map that sends it there, and the table of orders.

spots          where spots lie and how much light each should have
superposition  weighted Gerchberg-Saxton, levels in the loop
problem        a DOE to be designed: from plane waves to levels, and on to light, in one colour or several
shared_levels  the level of a cell that suits several colours
search         phases of the spots, by many starts at once
exchange       single cells of a small unit cell, changed one by one
plates         spots of many plates as fabricated, kept equal by exchange
plate_sums     their sums over cells and walls
design         spec -> design, step by step
orders         the table of orders that a DOE makes, and its ceiling
"""
