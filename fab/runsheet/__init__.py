"""What the lab does step by step, as a page to print and as JSON that takes measured numbers back.

tables        RunSheet: everything the sheet is made from
recipe        the steps in order
write         the page and the JSON
as_built      the same JSON with measured numbers filled in
"""
