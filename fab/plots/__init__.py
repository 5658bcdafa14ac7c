"""Pictures of what is made. Each function draws, returns what it drew on, and leaves writing to `fab.figure.save`.

maps    windows of a map, and where they lie in it
height  a height map: whole, cell by cell, and the share of area at every height
masks   heights, chrome and etch masks of a mask set
rules   where masks break the rules of a process
marks   marks and test structures, all masks over each other
wafer   a whole photomask
"""
