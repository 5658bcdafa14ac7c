"""What is made: from a height map to the mask files a fab lab writes, and back. Knows no light.

Map of the package, in the order the work flows:

    errors    InputError (the user's mistake, exit 2) and CheckFailed (a proof that failed, exit 1)
    units     text with a unit -> SI number, and back; the only border of the package
    files     atomic files and folders, digests, canonical JSON
    pictures  PNG, TIFF and other pictures: the one place that decodes and encodes them
    grid      Grid: the pixel raster of a plate
    height    HeightMap, and the reader of maps a user brings (.npy, .tif, .png)
    levels    Levels: height <-> level number
    masks     level map <-> bit planes, one plane per etch mask
    process   Process, Variation: what a lab does and how far it strays; one plate's errors
    figure    house style, layout, PNG files and notebook HTML of all pictures
    sampling  draws of a process: Monte-Carlo, corners, Sobol, one at a time
    stock     numbers of named processes, each with its source
    polygons  bitmap <-> rectangles (numba), circles as annulus sectors
    layout    Layer, Shapes, Cell, Layout: the geometry of a mask set in integer database units

  what a process can print

    rules     narrow lines and spaces, touching corners, density (bits, widths: how they are found)
    repair    a level map changed until the process prints it (moves: how)
    compensation  planes grown or shrunk against a line-width bias
    doe       the cell of a DOE: its planes as they are drawn, and its chrome

  what stands beside the DOE

    part      Part, Plate: things drawn about their own origin, and the plates they are drawn for
    lettering, marks, structures  polygon text, alignment marks, test structures
    split     Split: dies that draw the DOE differently on purpose
    wafer     Wafer: the glass, its mask blanks, and how it is filled
    frame     dies, sites, test structures and labels around a DOE

  files

    stream    GDSII and OASIS files
    walker    this package's own GDSII reader
    solid, step      STEP: glass, chrome, wafers; and its reader
    rings, patch     maps that are rings, as exact circles; a window at full resolution
    cells, mesh, meshfile  the relief as a closed mesh in 3MF, GLB and STL
    relief    height maps for other programs
    models, modelcheck  the solids and height maps of an order, and their proof
    sheet, recipe, runsheet  what the lab does step by step, as a page and as JSON
    asbuilt   the same JSON with measured numbers filled in
    manifest  what every file of a mask order is
    inventory what the manifest says of a cell
    entries   what the manifest says of an order
    preview   the picture of a mask set
    order     a mask order in numbers, before it becomes files
    job       the folder that goes to the lab, with its manifest
    readback  the same files read by a library that had no part in the writing
    compare   what was read against what should be there
    receipt   what a mask shop looks at whatever is drawn
    verify    the proof of such a folder

Units and axes. Everything inside is SI and the unit stands in the name (``pitch_m``). Arrays are
``[y, x]``; row 0 is the lowest y and +y is up, so the row index grows with y in the drawing as well.
Heights are measured from the deepest etched floor, so ``height_m >= 0``. Level l of L stands
``l * step`` high; bit k of ``L - 1 - l`` set means that mask k opens there and etches ``2**k * step``
(or any other depth, see ``levels``).
A polygon in an etch layer means "etched here", a polygon in the chrome layer "chrome here".
Mask bit k is drawn on layer k + 1. Importing this package imports nothing heavy.
"""
