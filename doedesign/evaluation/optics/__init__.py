"""The paper's figures of optics, and its bench for PSFs.

plate_comparison    fig. 4: PSFs and MTFs of lens, Fresnel lens, diffuser, rings and a design
depth_study         fig. 8: light against depth, as drawn and as fabricated
psf_bench           fibre, collimator, 4F relay: the light that reaches the bench's camera
bench_measurement   photographs of a hidden plate on it, for `calibrate`
figures             the folders of these three
"""
