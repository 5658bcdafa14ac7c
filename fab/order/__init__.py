"""A mask order: from numbers to the folder that goes to the lab.

order         Order: what is drawn, for whom, and what everything is called
entries       entries of the manifest
write         the folder, its manifest, and its proof
"""
