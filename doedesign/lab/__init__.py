"""What a lab should see, and what it measured.

predictions   the numbers of a run sheet: what light does after every etch
as_built      the plate that a filled run sheet describes
"""
