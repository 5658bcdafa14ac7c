"""Rows of the two tables: what each looks at, through which plate, and by which method.

A plate is named by the training that it came out of, or "flat" for a conventional camera. Of a plate as fabricated,
pair i sees draw i of the process (modulo their number), and its network is told the PSFs of that very plate ("right"),
as a lab would that measured them, or those of the design ("drawn").

Single-image methods get what the paper gives them: the true mask, and inpainting the sharp scene around the hole, which
no camera sees. Rows ending in `_of_capture` are the same methods given what a conventional camera does see.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fab.errors import InputError

FLAT = "flat"
ROBUST = "robust"

_STILL = 'train.freeze="optics"'

Sees = Literal["capture", "scene"]


@dataclass(frozen=True)
class Training:
    """How a network that rows need is trained.

    Attributes:
        name: name of its folder.
        changes: changes to the design's spec, "table.key=value".
        rival: a network after a published idea (`doedesign.evaluation.rivals`) instead of the project's own.
        plate: training whose plate it stands behind and leaves as it is; None for the design to begin with.
    """

    name: str
    changes: tuple[str, ...] = ()
    rival: str | None = None
    plate: str | None = None

    @property
    def after(self) -> str | None:
        """Name of the training that comes before, whose plate this one stands behind; None without one."""
        return None if self.plate == FLAT else self.plate

    @property
    def keeps_plate(self) -> bool:
        """Whether the plate stays that of the design it begins with, so that there is one without the training."""
        return self.plate is None and _STILL in self.changes


@dataclass(frozen=True)
class MethodRow:
    """One row of a table.

    Attributes:
        name: name in files.
        label: name for people.
        method: one of `METHODS`, "network" or "rival".
        training: whose weights the method has.
        plate: training whose plate the camera has, or "flat".
        sees: "capture", or "scene" where the method is given the sharp scene.
        fabricated: whether the plate is as fabricated.
        told: PSFs that the method is told: "right", or "drawn" for those of the design.
        paper: row of the paper's table; None for what the paper does not have.
    """

    name: str
    label: str
    method: str
    training: str | None = None
    plate: str = FLAT
    sees: Sees = "capture"
    fabricated: bool = False
    told: Literal["right", "drawn"] = "right"
    paper: str | None = None

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the trainings that it needs: that of its method, and that of its plate if that moves it."""
        moved = self.plate != FLAT and not TRAININGS[self.plate].keeps_plate
        return (*((self.training,) if self.training else ()), *((self.plate,) if moved else ()))


TRAININGS = {
    one.name: one
    for one in (
        Training("proposed"),
        Training("no_inverse_filter", ("network.wiener=false",)),
        Training("no_residual_block", ("network.refine=false",)),
        Training("no_feature_extraction", ("network.features=false",)),
        Training("sequential", (_STILL,)),
        Training("conventional", ('train.camera="conventional"',)),
        # Whatever the other trainings are asked for: here no network learns.
        Training("optics_only", ('train.freeze="network"', "train.light_scenes=0")),
        Training(ROBUST, (_STILL,)),
        Training("pyramid_deblurring", rival="pyramid_deblurring", plate="proposed"),
        Training("plain_unet", rival="plain_unet", plate="proposed"),
        Training("fourier_inpainting", rival="fourier_inpainting", plate=FLAT),
        Training("two_stream_inpainting", rival="two_stream_inpainting", plate=FLAT),
        Training("fence_removal", rival="fence_removal", plate=FLAT),
        Training("attentive_drop_removal", rival="attentive_drop_removal", plate=FLAT),
    )
}


def _network(name: str, label: str, paper: str | None = None) -> MethodRow:
    return MethodRow(name, label, "network", name, name, paper=paper)


def _after_plate(name: str, label: str, paper: str | None = None) -> MethodRow:
    """A method behind the proposed plate that learns nothing, or whose name is a rival's."""
    rival = name in TRAININGS
    method = "rival" if rival else "as_seen" if name == "capture" else name
    return MethodRow(name, label, method, name if rival else None, "proposed", paper=paper)


TABLE_1 = (
    _network("proposed", "Proposed", "proposed"),
    _network("no_inverse_filter", "Without inverse filter", "no_inverse_filter"),
    _network("no_residual_block", "Without residual block", "no_residual_block"),
    _network("no_feature_extraction", "Without feature extraction", "no_feature_extraction"),
    _network("sequential", "Optics first, network after", "sequential"),
    _after_plate("pyramid_deblurring", "Pyramid network (after DeblurGAN-v2)", "pyramid_deblurring"),
    _after_plate("plain_unet", "Plain U-Net", "plain_unet"),
    _after_plate("richardson_lucy_far", "Richardson-Lucy, far PSF", "richardson_lucy_far"),
    _after_plate("richardson_lucy_near", "Richardson-Lucy, near PSF"),
    _after_plate("wiener_far", "Wiener, far PSF", "wiener_far"),
    _after_plate("wiener_near", "Wiener, near PSF", "wiener_near"),
    _after_plate("capture", "Capture through the plate", "capture"),
)


def _inpainting(name: str, label: str, paper: str | None = None) -> tuple[MethodRow, MethodRow]:
    """A method given the sharp scene around the hole, and the same given a conventional capture."""
    trained = name in TRAININGS
    method, training = ("rival", name) if trained else (name, None)
    return (
        MethodRow(name, f"{label}, given the scene", method, training, sees="scene", paper=paper),
        MethodRow(f"{name}_of_capture", f"{label}, given the capture", method, training),
    )


_SPECIAL = {
    "fence": MethodRow(
        "fence_removal", "Fence removal (after DefenceNet)", "rival", "fence_removal", paper="fence_removal"
    ),
    "raindrop": MethodRow(
        "attentive_drop_removal",
        "Attentive drop removal (after AttentiveGAN)",
        "rival",
        "attentive_drop_removal",
        paper="attentive_drop_removal",
    ),
}


def _process_rows(training: str, label: str) -> tuple[MethodRow, MethodRow]:
    """The plate of a training as fabricated, its network told the PSFs of this very plate, or those of the design."""
    right = MethodRow(
        f"{training}_fabricated",
        f"{label}, as fabricated, PSFs measured",
        "network",
        training,
        training,
        "capture",
        True,
    )
    wrong = MethodRow(
        f"{training}_untold", f"{label}, as fabricated, PSFs of the design", "network", training, training, "capture",
        True, "drawn",
    )  # fmt: skip
    return right, wrong


def _capture_rows(name: str, plate: str, label: str, paper: str | None = None) -> tuple[MethodRow, MethodRow]:
    """Captures through the plate of a training, as drawn and as fabricated."""
    return (
        MethodRow(name, label, "as_seen", None, plate, paper=paper),
        MethodRow(f"{name}_fabricated", f"{label}, as fabricated", "as_seen", None, plate, fabricated=True),
    )


def table_2(obstruction: str, *, robust: bool = False) -> tuple[MethodRow, ...]:
    """Rows of Table 2 for an obstruction.

    Args:
        obstruction: its kind, or a folder of masks that is named after it; fences and raindrops have a method of their
            own.
        robust: whether there is a robust design to judge besides.
    """
    special = next((row for name, row in _SPECIAL.items() if name in Path(obstruction).name), None)
    return (
        _network("proposed", "Proposed", "proposed"),
        *_process_rows("proposed", "Proposed"),
        *((_network(ROBUST, "Robust plate"), *_process_rows(ROBUST, "Robust plate")) if robust else ()),
        *_capture_rows("optics_only", "optics_only", "Optics alone, its capture", paper="optics_only"),
        *_capture_rows("capture", "proposed", "Capture through the plate", paper="capture"),
        *(_capture_rows("robust_capture", ROBUST, "Capture through the robust plate") if robust else ()),
        MethodRow("conventional_capture", "Conventional capture", "as_seen", paper="conventional_capture"),
        MethodRow("conventional_network", "Conventional camera, same network", "network", "conventional"),
        *_inpainting("fourier_inpainting", "Fourier inpainting (after LaMa)", "fourier_inpainting"),
        *_inpainting("two_stream_inpainting", "Two-stream inpainting (after CTSDG)", "two_stream_inpainting"),
        *((special,) if special else ()),
        *_inpainting("biharmonic", "Biharmonic inpainting"),
        *_inpainting("telea", "Telea inpainting"),
        *_inpainting("navier_stokes", "Navier-Stokes inpainting"),
    )


def rows_of(table: int, obstruction: str, *, robust: bool = False, names: Sequence[str] = ()) -> tuple[MethodRow, ...]:
    """Rows of Table 1 or 2, or those of some names; see `table_2`.

    Raises:
        InputError: another table, or a name that none of its rows has.
    """
    if table not in (1, 2):
        raise InputError("table", "must be 1 or 2, as in the paper", table, "Choose one of the two.")
    rows = TABLE_1 if table == 1 else table_2(obstruction, robust=robust)
    known = [row.name for row in rows]
    for name in names:
        if name not in known:
            raise InputError("rows", f"must be among {', '.join(known)}", repr(name), "Choose among these.")
    return tuple(row for row in rows if not names or row.name in names)


def trainings_of(rows: Sequence[MethodRow]) -> tuple[Training, ...]:
    """Trainings that rows need, those first that others stand behind."""
    needed: dict[str, Training] = {}

    def add(name: str) -> None:
        one = TRAININGS[name]
        if one.after is not None:
            add(one.after)
        needed[name] = one

    for row in rows:
        for name in row.needs:
            add(name)
    return tuple(needed.values())
