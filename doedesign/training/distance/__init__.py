"""Distances between pictures.

similarity    structural similarity, at one scale and at several
perceptual    LPIPS, or multi-scale SSIM in its stead
backbones     the first layers of the networks that LPIPS looks with
"""
