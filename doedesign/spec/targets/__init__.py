"""Tables that say where light should go, instead of objectives.

spots         spots and diffraction orders
arrangements  places of spots in a grid, in rings and on a circle
areas         areas of even light, lines, rings, pictures
focus         foci on the axis, an extended depth of focus
beside        rules for the tables beside any of them
"""
