"""Training of the reconstruction network, with the plate or alone.

train, finetune     a training behind a plate, and one on real pairs
job                 steps, checkpoints, validation and results of either, in a folder
joint, optics       a step of network and plate, on one device or many; the plate inside it
loss                the loss (eq. 13); perceptual, backbones, similarity are its distances
pairs               real captures with references
checkpoint, history, hosts  what is kept, what is recorded, several hosts
evaluation, scores  scenes never trained on; PSNR, SSIM and LPIPS by region
"""
