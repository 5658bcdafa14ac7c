"""Reconstruction: a network that turns the captures of a camera with its plate back into pictures.

Reading order, from a scene to a trained network and back to pictures:

    data            scenes for training: pictures, crops and obstructions, seeded, resumable, prepared ahead
    chain           the optics inside a training step: parameters -> PSFs -> capture
    conv, wiener    layers: convolutions, filters that undo a PSF
    network         the network
    loss            what training minimises; perceptual (LPIPS, on backbones) and similarity (SSIM) are its distances
    train           one step of optics and network, on one device or many
    loop            steps with history and checkpoints, until they are done or stopped; checkpoint, history, hosts
    heldout         pictures that are never trained on; scores and judged say how good a reconstruction is
    baselines       deconvolution without training
    weights, model  a network's file, and the folder that it shares with the PSFs of its plate
    tiles, photos   captures of any size, from and to picture files
    pairs, crops, tuning    real captures with references, and a step that learns from them
"""
