"""Drawings of the photomasks, in integer database units.

geometry      Layer, Shapes, Cell, Layout; pixel edges, names, chrome
polygons      bitmap <-> rectangles (numba), chrome as sectors of an annulus
compensation  planes grown or shrunk against a line-width bias
arrays        a relief that repeats, as arrays of one cell
doe           the cell of a DOE: its planes as they are drawn, and its chrome
split         DieSplit: dies that draw the DOE differently on purpose
part          Part: things drawn about their own origin, and the photomasks they are drawn for
lettering, marks, structures  polygon text, alignment marks, test structures
wafer         Wafer: the glass, its mask blanks, and how it is filled
frame         dies, sites, test structures and labels around a DOE
"""
