"""The paper's tables and figures, told truly: every method on the same captures, scored by one protocol.

Reading order:

    pairs            test pairs: an obstruction before a picture, fixed by a seed
    methods          from what a method is shown to a picture: as it is seen, deconvolution, inpainting, networks
    rows             rows of the two tables: camera, plate, PSFs and method of each, and how networks are trained
    published        the paper's own numbers
    rivals/          small networks after published ideas, and their training
    trainings        networks that rows need, found or trained
    plates           PSFs of the plates that rows look through, as drawn and as fabricated
    candidates       rows with all that they need, and why others cannot be scored
    external         programs of other people: folder in, folder out
    scoring          all rows of one pair, as an item of work
    statistics       means with bootstrap intervals over pictures and seeds
    tables           a table as CSV, JSON and LaTeX, and a sheet of pictures
    evaluate         a table from a design: what is missing is computed, what is finished is kept
    optics/          Figs. 4 and 8, and the paper's bench for PSFs as a measurement that `calibrate` takes

The masked protocol is that of `doedesign.training.scores`: the binary mask before any blur (at least half of a pixel
blocked); PSNR over its pixels; SSIM and 1 - LPIPS as the mean of their maps over it.
"""
