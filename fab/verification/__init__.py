"""The proof of a mask order from its files alone; `fab.order.verify` says what they should hold, and asks all of it.

report        the checks and their answers
files         every mask file and model, read back
compare       content of mask files against what should be there
values        values and papers (run sheet, pictures) against what should be there
shop_checks   checks of a mask shop, whatever is drawn
child         work in a process of its own, with limits
"""
