"""GDSII and OASIS files, and two independent ways to read them.

writer        layout -> GDSII, by this package; OASIS through KLayout
reader        this package's own GDSII reader
gdstk_reader  the same files read by gdstk, which had no part in the writing
"""
