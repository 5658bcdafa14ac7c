"""Everything that commands import, for the server that processes are forked from. Nothing is run here.

A process that has run a program of jax has threads, which a fork does not take along.
"""

import importlib
import pkgutil

import doedesign.cli
import fab
import sim

for package in (doedesign, sim, fab):
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
