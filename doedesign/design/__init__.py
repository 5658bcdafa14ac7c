"""Design of a height map: parameters, objectives, optimisation.

levels        free parameters -> heights that the process can make
patterns      target images: spots, areas, pictures
starts        baseline designs by name: flat, random, fresnel, ring
objectives    what a design is judged by
problem       spec -> loss of one step, ready to differentiate
optimize      the loop
robust        steps that look at plates as fabricated
descent       moves of cells by a level that lower the loss, when the loop is done
design        the result: a level map, the camera it is for, and how it was found
metrics       the table of numbers every design gets
"""
