"""The reference of everything that has a name: keys of a spec, numbers of results, files, functions.

    keys       every key of a spec, from its model: kind, unit, default, limits, meaning, example
    options    options that a start, an objective and an obstruction take
    numbers    every number of a metrics.json: unit, range, definition, formula
    other_numbers  those of other result files
    files      every file that a command writes
    pages      all of these as pages of the documentation

Nothing is said twice: texts are those of the code that works with them, and `doedesign spec` prints the same keys.
"""
