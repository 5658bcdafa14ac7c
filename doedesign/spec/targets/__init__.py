"""Tables that say where light should go, instead of objectives.

spots   spots and diffraction orders
areas   areas of even light, lines, rings, pictures
beside  what may stand beside either of them
"""
