"""Training of the reconstruction network, with the plate or alone.

train, finetune     a training behind a plate, and one on real pairs
job                 steps, checkpoints, validation and results of either, in a folder
joint, optics       a step of network and plate, on one device or many; the plate inside it
lesson              the network's branch for veil and gain learns by itself before the first step
loss                the loss (eq. 13); distance/ has its distances between pictures
pairs               real captures with references
checkpoint, history, hosts  what is kept, what is recorded, several hosts
validation, scores  scenes never trained on; PSNR, SSIM and LPIPS by region
"""
