"""The report of a run: one HTML file that needs nothing else.

blocks      values that a page shows: tables, charts, bars, pictures, maps, PSFs, a model
files       the files of a run and of what lies beside it, checked against the digests of their manifests
numbers     numbers and names in words
reached     what was asked against what was reached
maps        the level map as tiles, and the rules that its masks break
tiles       pyramids of tiles for a viewer
light       orders, metrics, energy and error budget
psfs        PSFs by depth and colour
making      tolerances, calibration, the order and its run sheet
networks    captures, trainings, reconstructions, evaluation
provenance  versions, digests and the commands to repeat it
gather      a run folder -> the content of its page
compare     runs side by side
render      content -> HTML (templates/, vendored/)
write       `write_report`
"""
