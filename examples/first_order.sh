#!/bin/sh
# From nothing to the report of a verified order: a laser beam that becomes five by five spots.
# It writes into the current folder.
set -eu
doedesign new splitter                # a commented spec, splitter.toml
doedesign optimize splitter.toml      # the design, runs/splitter
doedesign masks runs/splitter         # the order for the lab, masks/splitter
doedesign verify masks/splitter       # read back: every pixel as designed
doedesign report runs/splitter        # one page that shows all of it
