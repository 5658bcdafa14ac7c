"""Design of diffractive optical elements, from a spec to a plate that can be ordered, and its light predicted.

    import doedesign as dd

    spec = dd.load_spec("examples/quick.toml", steps=60)
    design = dd.optimize(spec)
    design.level_map, design.height_m, design.camera

Public names are listed in `__init__.pyi` and loaded when they are used. The rooms behind them, from the user's words to
the result:

    templates       specs to begin with
    spec            a TOML spec as frozen tables, its rules, its messages, its digest
    build           spec -> values: camera, levels, process, wafer
    design          parameters, objectives and optimisation of a height map; `Design`, which carries the result
    spots           spots and diffraction orders, by phase retrieval
    areas           areas of even light, by optimal transport and L-BFGS
    focus           foci on the axis and an extended depth of focus, by L-BFGS on rings
    refinement      `refine`: the cell of a periodic run, refined by rigorous light
    precompensation `precompensate`: depths to command and edges to move, for a known process
    search          few values of least loss
    optimization    `optimize`: a spec becomes a design, in memory or in a run folder
    runs            designs on the disk, and the PSFs of a run
    prediction      PSFs and figures of merit of a design as fabricated
    lab             mask orders with their run sheets, and plates as measured
    tolerancing     yield, sensitivities and error budgets of a process
    calibration     the process errors that explain measured PSFs
    capture         scenes photographed through a plate
    hdr             lamps beyond the full well, read from weak copies that a plate throws beside them
    recon           the reconstruction network
    training        its training, with the plate or alone
    evaluation      the tables and figures of the paper: every method on the same captures
    report          pictures, and `write_report`: the page of a run
    overview        results on the disk at a glance: kinds, main numbers, comparison
    reference       keys of a spec, numbers and files of results, each with its one definition
    runtime         progress, signals, compilation
    cli             the command line

Conventions (see docs/explanation/conventions.md): in specs a length is text with a unit (`pitch = "1.85 um"`),
everywhere else an SI number with the unit in its name (`pitch_m`); functions take either. Importing this
package imports nothing heavy.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
