"""How a design is trained with its network: the tables [network] and [train].

Both may be left out, and so may any key; a spec without them stays what it was.
"""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from doedesign.spec.values import Count, NotNegative, Positive, Seed, Steps
from doedesign.spec.values.table import SpecTable, optional
from fab.errors import InputError

USUAL_SIZE = 512

Flag = Annotated[bool, Field(strict=True)]
PictureShare = Annotated[float, Field(strict=True, gt=0, le=1)]


class NetworkSpec(SpecTable, frozen=True):
    """The reconstruction network (paper section 3.3); each block can be left out, as in the ablations of Table 1.

    Attributes:
        width: feature channels of the finest scale, a multiple of the camera's colours; coarser ones have 2, 4, 8 and
            12 times as many.
        depth: scales below the finest.
        wiener: Wiener blocks, which undo the far PSF, at every scale ("inverse filter").
        features: the features that the Wiener blocks see are learnt; otherwise they see the capture itself ("feature
            extraction").
        near_estimate: the near-PSF Wiener estimate stands beside the capture at the input.
        refine: the second stage of three residual blocks ("residual block").
        variant: "paper", or "release" for what the paper's public code does where the two differ.
        global_light: a branch of low resolution sees the whole picture and undoes veil and gain before the local ones
            (`doedesign.recon.global_light`); not with "release".
    """

    width: Annotated[int, Field(strict=True, ge=1, le=256)] = 12
    depth: Annotated[int, Field(strict=True, ge=1, le=4)] = 4
    wiener: Flag = True
    features: Flag = True
    near_estimate: Flag = True
    refine: Flag = True
    variant: Literal["paper", "release"] = "paper"
    global_light: Flag = optional(False)


class TrainSpec(SpecTable, frozen=True):
    """How network and optics are trained.

    Attributes:
        steps: training steps.
        batch: scenes per step.
        size: pixels (binned) per side of a training picture; on a sensor with fewer than the usual 512, what it has.
        learning_rate: Adam's step size for the network.
        optics_learning_rate: Adam's step size for the height map, radians of phase at the design wavelength; 0 keeps
            the map as it is.
        schedule: "cosine" lets both step sizes fall to a tenth, "constant" keeps them.
        mode: "simultaneous", or "alternating": the optics moves in one of `period` steps, the network in the others.
        period: steps of which one moves the optics, where `mode` is "alternating".
        freeze: what stays as it is: "none", "optics", or "network", with which the DOE alone learns, from what it
            captures.
        camera: "doe", or "conventional" for the same camera with a flat plate.
        l1: weight of the mean absolute difference.
        perceptual: weight of the perceptual distance.
        masked: weight of the mean absolute difference where the obstruction is.
        field: "random" sees every scene at a field angle of its own within the sensor, "off" on the axis.
        fabricated: every step sees a plate with errors drawn from the process.
        precision: "float32", or "mixed" for half the bits where that is safe.
        checkpointing: compute features twice instead of keeping them, for less memory.
        seed: seed of everything random.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between looks at pictures that are never trained on.
        validation: number of pictures that are never trained on.
        zoom: least and greatest share of a picture's shorter side that a crop spans, drawn at random and brought to
            `size`, such as [0.4, 1.0]; without it crops are the picture's own pixels (of at most twice `size`).
        light_scenes: scenes by which the branch of `network.global_light` learns by itself before the first step, such
            as 2400: they cost little, and it begins where the steps would bring it late.
        average: what a running mean of the network's weights keeps of itself in a step, such as 0.995; the mean is
            judged and written. 0 for the weights of the last step.
    """

    steps: Steps = 50_000
    batch: Annotated[int, Field(strict=True, ge=1, le=4096)] = 1
    size: Annotated[int, Field(strict=True, ge=16, le=8192)] = USUAL_SIZE
    learning_rate: Positive = 1e-4
    optics_learning_rate: NotNegative = 0.02
    schedule: Literal["cosine", "constant"] = "cosine"
    mode: Literal["simultaneous", "alternating"] = "simultaneous"
    period: Annotated[int, Field(strict=True, ge=2, le=1000)] = 4
    freeze: Literal["none", "optics", "network"] = "none"
    camera: Literal["doe", "conventional"] = "doe"
    l1: NotNegative = 1.0
    perceptual: NotNegative = 1.0
    masked: NotNegative = 1.0
    field: Literal["off", "random"] = "off"
    fabricated: Flag = False
    precision: Literal["float32", "mixed"] = "float32"
    checkpointing: Flag = False
    seed: Seed = 0
    checkpoint_every: Count = 200
    validate_every: Count = 500
    validation: Annotated[int, Field(strict=True, ge=1, le=10_000)] = 8
    zoom: tuple[PictureShare, PictureShare] | None = optional(example="[0.4, 1.0]")
    light_scenes: Annotated[int, Field(strict=True, ge=0, le=1_000_000)] = optional(0)
    average: Annotated[float, Field(strict=True, ge=0, lt=1)] = optional(0.0)

    @property
    def moves_optics(self) -> bool:
        """Whether training changes the height map."""
        return self.camera == "doe" and self.freeze != "optics" and self.optics_learning_rate > 0

    @property
    def moves_network(self) -> bool:
        """Whether training changes the network."""
        return self.freeze != "network"


def training_problems(network: NetworkSpec, train: TrainSpec, colours: int) -> Iterator[InputError]:
    """Yield every broken rule that joins values of network, training and the number of colours of the camera."""
    # A design that says nothing of a network may have any number of colours.
    if network != NetworkSpec() and network.width % colours:
        nearest = max(1, round(network.width / colours)) * colours
        rule = f"must be a multiple of the camera's {colours} colours"
        yield InputError("network.width", rule, str(network.width), f"Set width = {nearest}.")
    if not (network.features or network.wiener):
        cure = "Keep one of the two blocks."
        yield InputError("network.features", "features or wiener must be kept", "neither", cure)
    if network.global_light and network.variant == "release":
        rule, cure = 'must be left out of variant = "release", which has no veil and gain', "Remove one of the two."
        yield InputError("network.global_light", rule, "true", cure)
    if train.zoom is not None and train.zoom[0] > train.zoom[1]:
        rule = "must be two shares of a picture, the smaller first"
        yield InputError("train.zoom", rule, str(list(train.zoom)), f"Set zoom = {sorted(train.zoom)}.")
    if train.light_scenes and not network.global_light:
        rule, cure = "needs the branch that is to learn from them", "Set network.global_light = true."
        yield InputError("train.light_scenes", rule, str(train.light_scenes), cure)
    if train.light_scenes and not train.moves_network:
        rule, cure = 'must be left out with freeze = "network": there is nobody to teach', "Remove one of the two."
        yield InputError("train.light_scenes", rule, str(train.light_scenes), cure)
    # Two pixels at the coarsest scale: reflection at its border needs a neighbour.
    coarsest = 2**network.depth
    if train.size % coarsest or train.size < 2 * coarsest:
        nearest = max(2, round(train.size / coarsest)) * coarsest
        rule = f"must be a multiple of 2^network.depth = {coarsest}, and at least twice that"
        yield InputError("train.size", rule, str(train.size), f"Set size = {nearest}, or another depth of the network.")
    if not (train.moves_optics or train.moves_network):
        still = 'camera = "conventional"' if train.camera == "conventional" else "optics_learning_rate = 0"
        got, cure = f'freeze = "network" with {still}', "Let the network or the optics learn."
        yield InputError("train.freeze", "something must be left to train", got, cure)
    if train.l1 == train.perceptual == train.masked == 0:
        rule = "one of l1, perceptual and masked must be above 0"
        yield InputError("train.l1", rule, "0 for all of them", "Give a weight, such as l1 = 1.0.")
