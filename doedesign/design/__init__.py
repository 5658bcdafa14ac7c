"""Design of a height map: parameters, objectives, optimisation.

parametrize   free parameters -> heights the process can make
quantisation  ways to round to levels in the loop
patterns      target images: spots, areas, pictures
starts        baseline designs by name: flat, random, fresnel, ring
objectives    what a design is judged by
etch_depths   etch depths that suit a design
problem       spec -> loss of one step, ready to differentiate
optimize      the loop
descent       moves of cells by a level that lower the loss, when the loop is done
design        the result: a level map, the camera it is for, and how it was found
metrics       the table of numbers every design gets
"""
