"""Calibration: the process errors behind measured PSFs, how well they are known, and what two numbers alone may mean.

    result = dd.calibrate(design, "measurement.toml")
    result.process                  # the estimate, usable everywhere a process is
    dd.explain_ratio(design, dd.Targets(520e-9, 0.1, ring_to_disc=1.0))      # where only a ring:disc ratio was measured

Reading order:

    measurement     the TOML file of a measurement and its images
    unknowns        which errors are looked for, and their prior
    geometry        how the camera stood, which is looked for with them
    forward_model   the model: from errors to images, and gradients back
    target          one measured image beside its model
    objective       all of it as one least-squares objective, with derivatives
    fit             the search
    uncertainty     the posterior, and checks of it
    estimate        `calibrate`: all of this behind one function
    explanations    `explain_ratio`: errors that would give two measured numbers
    files           what both write; plots draws their pictures

The model is `sim.surface.as_fabricated` and the far-field path, the same that design, tolerance and prediction use.
"""
