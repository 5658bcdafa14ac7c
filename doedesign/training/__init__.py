"""Training of the reconstruction network, with the plate or alone.

optics        the plate inside a training step
joint         state, step and devices of joint training
finetune      the step of fine-tuning on real pairs
loop          steps, checkpoints, validation and progress
loss, perceptual, backbones, similarity  what a reconstruction is judged by (eq. 13)
crops, pairs  real captures and references
checkpoint, history, hosts  what is kept, what is recorded, several hosts
scores, validation, evaluation  PSNR, SSIM and LPIPS by region; scenes never trained on
results       the folder of a training
"""
