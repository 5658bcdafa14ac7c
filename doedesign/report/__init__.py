"""What a person looks at: pictures of a plate, of the light behind it, and of how the design came about.

Reading order, from what they share to the single picture:

    pictures    every `draw_...` by name; the door to the files below
    canvas      the house look: a figure that becomes a PNG file, scale bars, colours, shrinking of large maps
    height      the plate: whole map, two windows of single cells, share of area per height
    psfs        point spread functions of every colour and depth
    curves      MTF and encircled energy over colours and depths, and the history of an optimisation
    pattern     a target pattern beside what the plate draws
    calibration measured images beside the model's, errors with their uncertainty
    family      what would explain a measured ring:disc ratio
    sheet       rows of pictures below each other: contact (simulated captures), training (held-out scenes, and curves)
    tolerance   what a process makes of a design: histograms, yield, which errors matter and how large they may be

Conventions: SI units in every argument, human units on the axes; up in a picture is +y. The same input gives the
same bytes: no time, no version and no setting of the user's drawing library enters a file. Importing these modules
is cheap; matplotlib is loaded by the first picture.
"""
