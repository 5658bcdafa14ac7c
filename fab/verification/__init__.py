"""The proof of a mask order from its files alone.

verify        every check of an order, and the report
compare       what was read against what should be there
shop_checks   what a mask shop looks at, whatever is drawn
"""
