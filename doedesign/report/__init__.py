"""Pictures of designs and of what became of them; those of the DOE are in `fab.plots`, of its light in `sim.plots`.

    history       loss curves of an optimisation and of a training
    sheet         rows of images below each other: simulated captures, scenes that were not trained on
    labels        errors and their values in words
    page          the report: all that is known of a run as one HTML file

Each function draws and returns what it drew on; `fab.figure.save` writes it as a PNG file. SI units in every argument,
human units on the axes; up in a picture is +y. Importing these modules is cheap: the first picture loads matplotlib.
"""
