"""Drawings of the photomasks, in integer database units.

geometry      Layer, Shapes, Cell, Layout; pixel edges, names, circles
polygons      bitmap <-> rectangles (numba), circles as annulus sectors
compensation  planes grown or shrunk against a line-width bias
doe           the cell of a DOE: its planes as they are drawn, and its chrome
split         DieSplit: dies that draw the DOE differently on purpose
part          Part: things drawn about their own origin, and the photomasks they are drawn for
lettering, marks, structures  polygon text, alignment marks, test structures
wafer         Wafer: the glass, its mask blanks, and how it is filled
frame         dies, sites, test structures and labels around a DOE
"""
