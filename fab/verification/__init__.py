"""The proof of a mask order from its files alone.

verify        every check of an order, and the report
compare       content of the files against what should be there
shop_checks   checks of a mask shop, whatever is drawn
child         work in a process of its own, with limits
"""
