"""Things close to the camera that cover part of its view, each drawn at random from physical parameters.

    view        the frame: eq. 11 of the paper, sizes of near things in pixels
    parameters  ranges to draw from, their limits, and what a kind of obstruction is
    noise       gradient noise
    fence       chain-link, bars and grids of round wire
    raindrop    drops of water that refract the scene; dirt or drops by the toss of a coin
    dirt        clumps of soil
    mixed       one of these three, by lot
    release     the three with the numbers of the paper's public code
    folder      masks out of a user's folder

A kind is a frozen dataclass of SI parameters, lengths being those of the thing itself; `kind.draw(rng, view,
background)` gives an `Obstruction` as a pinhole would see it: sharp, in linear light, at a depth. Blur is left to the
PSF. The same state of the generator gives the same bytes.
"""

from collections.abc import Mapping
from types import MappingProxyType

from sim.obstruction.dirt import Dirt
from sim.obstruction.fence import Fence
from sim.obstruction.folder import MaskFolder
from sim.obstruction.mixed import DirtRaindropFence
from sim.obstruction.parameters import ObstructionKind
from sim.obstruction.raindrop import DirtRaindrop, Raindrop
from sim.obstruction.release import ReleaseDirt, ReleaseFence, ReleaseRaindrop
from sim.obstruction.view import CameraView

__all__ = [
    "OBSTRUCTIONS",
    "CameraView",
    "Dirt",
    "DirtRaindrop",
    "DirtRaindropFence",
    "Fence",
    "MaskFolder",
    "ObstructionKind",
    "Raindrop",
    "ReleaseDirt",
    "ReleaseFence",
    "ReleaseRaindrop",
]

# By the name that a spec or the command line calls them; all but the folder can be made without arguments.
OBSTRUCTIONS: Mapping[str, type[ObstructionKind]] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            *(Fence, Raindrop, Dirt, DirtRaindrop, DirtRaindropFence),
            *(ReleaseFence, ReleaseRaindrop, ReleaseDirt, MaskFolder),
        )
    }
)
