"""manifest.json: what every file of a mask order is.

records       the manifest and its entries, written and read with every check
cells         the geometry of a layout's cells as the manifest states it
"""
