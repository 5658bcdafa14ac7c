"""Run sheet of a lab, step by step: a page to print, and JSON that takes measured numbers back.

tables        RunSheet: everything the sheet is made from
recipe        the steps in order
page          templates of HTML, filled in (those of the order form, too)
write         the page and the JSON
as_built      the same JSON with measured numbers filled in
"""
