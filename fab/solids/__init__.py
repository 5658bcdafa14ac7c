"""The plate as solids, meshes and height maps for other programs.

substrate     glass, chrome and wafer as STEP faces
rings         radial maps as exact circles
patch         a window at full resolution
step          the STEP file, and its reader
columns       level map -> columns of a block-reduced relief
mesh          columns -> a closed mesh
meshfile      3MF, GLB and STL files, and their readers
height_files  TIFF, NPY, grid sag and greyscale heights, and their proof
model         the DOE that they all show, and the kinds of their files
step_files    the STEP files of an order, and their proof
mesh_files    its meshes, and their proof
write         all of them for one order: the list of kinds
"""
