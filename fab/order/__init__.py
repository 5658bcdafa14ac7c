"""A mask order: from numbers to the folder that goes to the lab, and its proof.

formats       Formats: in which formats it is written
order         Order: what is drawn, for whom, and what everything is called
terms         what is asked of the mask shop besides the drawing
form          the order form, as CSV and as a page
recheck       layer colours and a deck of checks for KLayout
request       the order as its manifest records it, and back
drawing       everything that is drawn and stated, before anything is written
entries       entries of the manifest
papers        pictures and the run sheet
write         the folder and its manifest
verify        the proof from the folder alone
"""
