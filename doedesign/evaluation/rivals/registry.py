"""The list of rivals: after whom, how large the original is, and what each is shown.

The original's count of weights is that of what makes the picture, without adversaries; None where it is not stated.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from doedesign.evaluation.rivals.adversary import Adversary, AttentiveJudge, DoubleScaleJudge
from doedesign.evaluation.rivals.attentive_drop_removal import AttentiveDropRemoval
from doedesign.evaluation.rivals.fence_removal import FenceRemoval
from doedesign.evaluation.rivals.fourier_inpainting import FourierInpainting
from doedesign.evaluation.rivals.layers import RivalNetwork
from doedesign.evaluation.rivals.plain_unet import PlainUnet
from doedesign.evaluation.rivals.pyramid_deblurring import PyramidDeblurring
from doedesign.evaluation.rivals.two_stream_inpainting import TwoStreamInpainting

Given = Literal["scene with hole", "conventional capture", "doe capture"]


@dataclass(frozen=True)
class Rival:
    """A network to compare with.

    Attributes:
        name: its name here.
        after: the publication whose idea it takes up.
        original_parameters: weights of the original; None if not stated.
        parameters_from: where that number comes from.
        given: what it is shown. A scene with a hole is sharp and without noise, which the paper grants to methods that
            fill holes.
        mask_given: whether it is shown the true mask, too.
        make: draws it from colours, seed and, if wished, `width`.
        judge: draws its adversary in the same way; None without one.
    """

    name: str
    after: str
    original_parameters: int | None
    parameters_from: str
    given: Given
    mask_given: bool
    make: Callable[..., RivalNetwork]
    judge: Callable[..., Adversary] | None = None


RIVALS: Mapping[str, Rival] = {
    rival.name: rival
    for rival in (
        Rival(
            "plain_unet",
            "U-Net, Ronneberger et al. 2015",
            31_030_658,
            "counted from the architecture, one channel in and two out",
            "doe capture",
            mask_given=False,
            make=PlainUnet.make,
        ),
        Rival(
            "pyramid_deblurring",
            "DeblurGAN-v2, Kupyn et al. 2019",
            61_000_000,
            "about: the published weights with Inception-ResNet-v2 are a file of 244 MB, four bytes each",
            "doe capture",
            mask_given=False,
            make=PyramidDeblurring.make,
            judge=DoubleScaleJudge.make,
        ),
        Rival(
            "fourier_inpainting",
            "LaMa, Suvorov et al. 2021",
            27_000_000,
            "about, as stated of LaMa-Fourier; big-lama has 51 million",
            "scene with hole",
            mask_given=True,
            make=FourierInpainting.make,
        ),
        Rival(
            "two_stream_inpainting",
            "CTSDG, Guo et al. 2021",
            52_147_789,
            "counted from the generator of the authors' public code",
            "scene with hole",
            mask_given=True,
            make=TwoStreamInpainting.make,
        ),
        Rival(
            "fence_removal",
            "DefenceNet, Matsui and Ikehara 2020",
            None,
            "not stated",
            "conventional capture",
            mask_given=True,
            make=FenceRemoval.make,
        ),
        Rival(
            "attentive_drop_removal",
            "AttentiveGAN, Qian et al. 2018",
            6_244_362,
            "counted from the generator of the authors' public code",
            "conventional capture",
            mask_given=True,
            make=AttentiveDropRemoval.make,
            judge=AttentiveJudge.make,
        ),
    )
}
