"""Tables that say where light should go, instead of objectives.

spots   spots and diffraction orders
areas   areas of even light, lines, rings, pictures
beside  rules for the tables beside either of them
"""
