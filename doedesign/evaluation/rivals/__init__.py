"""Rivals: small networks after published ideas, to compare with as Tables 1 and 2 of the paper do.

Each is written anew after what its paper says, with a tenth to a hundredth of the weights, so that it can be trained
with the same pictures, obstructions and steps as the project's own network. It bears a name of its own: its scores are
not those of the original.

registry            the list: after whom, how large the original is, what each is shown
plain_unet, pyramid_deblurring              behind the plate (Table 1)
fourier_inpainting, two_stream_inpainting   fill holes of sharp scenes (Table 2)
fence_removal, attentive_drop_removal       behind a plain lens, with the mask (Table 2)
layers, adversary   what they are made of, and the networks that judge two of them in training
files               a rival's file and folder
training            a training in a folder, as the project's own
"""
