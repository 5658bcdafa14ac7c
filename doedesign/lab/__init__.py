"""Mask orders, predictions of what a lab should see, and what it measured.

predictions   the numbers of a run sheet: what light does after every etch
as_built      the plate that a filled run sheet describes, and its prediction
order         the mask order of a design, with its run sheet
"""
