"""Design of diffractive optical elements: from a spec to a plate that can be ordered, and what it will do.

Reading order, from the user's words to the result:

    spec            a TOML spec as frozen tables, its rules, its words for every mistake, its digest
    build           a spec's camera, levels and process, as values the physics works on
    drawing         what is to be drawn: level maps of runs, mask files, maps of the user's own
    parametrize     free parameters -> heights the process can make
    starts          baseline designs by name: flat, random, fresnel, ring
    patterns        target images: spots, areas, pictures
    objectives      what a design is judged by
    problem         spec -> loss of one step, ready to differentiate
    compiling       steps that take little memory
    optimize        the loop
    evaluate        the table of numbers every design gets
    predict         what a drawn design will do once it is made
    tolerance       what a process that strays makes of a design, and how far it may stray
    calibrate       the process errors that explain measured PSFs
    images          pictures of a folder as scenes
    capture         a spec's obstruction, sensor and colours
    simulated       one scene through a plate onto a sensor; capturefiles writes it
    recon           the reconstruction network and its training, with the plate or alone
    runs            run folders: manifest, checkpoint, resume
    report          pictures
    commands        the work behind each command
    progress, cli   how the user sees it

Conventions (the whole list is in README.md): a spec's lengths are text with a unit in TOML (`pitch = "1.85 um"`)
and SI numbers with the unit in the name everywhere else (`pitch_m`). Importing this package imports nothing
heavy; a module that needs jax says so by being imported where it is used.
"""

__version__ = "0.1.0"
