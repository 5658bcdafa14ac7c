"""GDSII and OASIS files, and two independent ways to read them.

writer        layout -> GDSII; an OASIS file -> GDSII through KLayout
oasis         layout -> OASIS
reader        this package's own GDSII reader
gdstk_reader  the same files read by gdstk, which had no part in the writing
plain         what gdstk read, taken from it as a plain stream
"""
