"""The work behind each command of the command line: read inputs, call the packages, write results.

    optimize    spec -> run folder
    masks       run or height map -> mask order; verify
    psf         run -> PSF banks, metrics and pictures of what was designed, quantised and drawn

Each takes plain arguments and returns the paths it wrote, so a script can call it as the command line does.
"""
