"""A U-Net from captures to pictures, without any knowledge of the optics.

After O. Ronneberger, P. Fischer, T. Brox, "U-Net: convolutional networks for biomedical image segmentation", MICCAI
2015. Besides its size it differs in that margins are mirrored, that features are normalised, and that it answers the
difference from its input: in a short training it would otherwise still be learning to copy.
"""

from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float

from doedesign.evaluation.rivals.layers import QUIET, Answer, RivalNetwork, UnetTrunk
from doedesign.recon.network import Block

_SCALES = 5


class PlainUnet(RivalNetwork):
    """A U-Net of five scales. `PlainUnet.make` draws one."""

    trunk: UnetTrunk
    head: Block

    multiple: ClassVar[int] = 2 ** (_SCALES - 1)

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 12) -> "PlainUnet":
        """Draw one whose corrections begin near nothing.

        Args:
            colours: channels of a picture.
            seed: seed of its weights.
            width: features of the finest scale; each further one has twice as many.
        """
        rng = np.random.default_rng(seed)
        trunk = UnetTrunk.make(rng, colours, [width * 2**level for level in range(_SCALES)])
        return cls(colours, width, trunk, Block.make(rng, width, colours, 1, normal=False, act=False, gain=QUIET))

    def __call__(self, picture: Float[Array, "b y x c"], mask: Float[Array, "b y x"]) -> Answer:
        """Answer pictures; the mask is not looked at."""
        del mask
        self.require_fits(picture)
        return Answer(picture + self.head(self.trunk(picture)), {})
