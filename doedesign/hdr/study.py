"""How well lamps are read: a plain lens and a plate before the same scenes, with the same solver, under several errors.

A case says in what a capture differs from what its solver knows. Scene i of every case has the same background and
lamps in the same places, and the plate of draw i; both cameras have the same noise seed. Differences are taken scene by
scene (`doedesign.training.scores.paired_difference`).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from doedesign.hdr.capture import LampCamera, LampCapture, LinePsfs, PlateSeries
from doedesign.hdr.scenes import LampScene, LampScenes
from doedesign.hdr.scores import HdrScore, judged_light
from doedesign.hdr.solver import LampSolver
from sim.imaging.glare import Glare

_BESIDE_PX = 16  # from the middle of a PSF, beyond which light counts as that of copies


@dataclass(frozen=True)
class LampCase:
    """Circumstances of captures.

    Attributes:
        name: a few words.
        fabricated: whether the plate is one of the process, drawn anew for every scene, or as drawn.
        strength: of the copies that the solver reckons with, over that of the design's.
        spectrum: of the lamps (`doedesign.hdr.scenes.Lamps`); the solver takes them for white.
        glare: whether the lens has glare.
        glare_spread: relative spread of the share of glare among lenses; the solver knows their mean.
        spilled: share of charge beyond the full well that blooms.
        lit: whether lamps stand before the background.
        cells_px: pixels of the design along the squares of a chequerboard in its place; None for the design.
    """

    name: str
    fabricated: bool = True
    strength: float = 1.0
    spectrum: str = "white"
    glare: bool = True
    glare_spread: float = 0.0
    spilled: float = 0.0
    lit: bool = True
    cells_px: int | None = None


CASES = (
    LampCase("fabricated"),
    LampCase("as drawn", fabricated=False),
    LampCase("copies 20 % weaker than known", strength=1.25),
    LampCase("copies 20 % stronger than known", strength=1 / 1.2),
    LampCase("lamps of narrow spectra", spectrum="narrow"),
    LampCase("no glare", glare=False),
    LampCase("glare 30 % off", glare_spread=0.3),
    LampCase("half of the charge blooms", spilled=0.5),
    LampCase("without lamps", fabricated=False, lit=False),
    LampCase("chequerboard", fabricated=False, cells_px=4),
)


class LampRow(NamedTuple):
    """Scores of one scene in one case through one camera, dB.

    Attributes:
        case: name of the case.
        camera: "clipped" (the plain lens without solver), "plain lens" or "plate".
        scene: number of the scene, and of the plate's draw.
        picture: its background.
        lamps: mu-law PSNR in the saturated part; NaN where nothing is.
        elsewhere: PSNR of display values in the rest.
    """

    case: str
    camera: str
    scene: int
    picture: str
    lamps: float
    elsewhere: float


class LampShot(NamedTuple):
    """A capture and what became of it."""

    scene: LampScene
    capture: LampCapture
    found: np.ndarray
    score: HdrScore


@dataclass(frozen=True, eq=False)
class LampStudy:
    """A plain lens and a plate before scenes with lamps.

    Attributes:
        camera: the camera.
        series: the plate's PSFs, as drawn and as fabricated.
        plain: PSFs of the plain lens.
        plate: a plate of a draw's number.
        scenes: the scenes.
        glare: of the lens.
        solver: the solver that both are given.
        boards: PSFs of chequerboards, by the pixels of the design along their squares; those that cases ask for.
    """

    camera: LampCamera
    series: PlateSeries
    plain: LinePsfs
    plate: Callable[[int], Any]
    scenes: LampScenes
    glare: Glare = field(default_factory=Glare)
    solver: LampSolver = field(default_factory=LampSolver)
    boards: Mapping[int, LinePsfs] = field(default_factory=dict)

    def fabricated(self, draw: int) -> LinePsfs:
        """PSFs of the plate of a draw, without glare."""
        return self.series.psf(self.plate(draw))

    def known(self, camera: str) -> np.ndarray:
        """PSFs `[c, y, x]` of white light with glare, as the solver knows them in the first case.

        Args:
            camera: "plain lens" or "plate".
        """
        return {"plain lens": self.plain, "plate": self.series.exact}[camera].with_glare(self.glare).white()

    def shots(self, case: LampCase, number: int, fabricated: LinePsfs | None = None) -> Mapping[str, LampShot]:
        """The captures of a scene through both cameras, and what the solver finds.

        Args:
            case: the circumstances.
            number: of the scene, and of the plate's draw.
            fabricated: PSFs of that plate, if they are at hand.
        """
        lamps = replace(self.scenes.lamps, spectrum=case.spectrum)
        scene = self.scenes.with_lamps(lamps).scene(number, self.camera.weights)
        scene = scene if case.lit else scene.without_lamps()
        truth, saturated = scene.light(), self.camera.saturated(scene)
        known = self.glare if case.glare else replace(self.glare, share=0.0)
        own = known.drawn(np.random.default_rng((number, 0x61A)), case.glare_spread) if case.glare_spread else known
        camera = replace(self.camera, spilled=case.spilled)
        drawn = self.series.exact if case.cells_px is None else self.boards[case.cells_px]
        made = (fabricated or self.fabricated(number)) if case.fabricated else drawn
        shots: dict[str, LampShot] = {}
        for name, light, reckoned in (
            ("plain lens", self.plain, self.plain),
            ("plate", made, with_strength(drawn, case.strength)),
        ):
            capture = camera.capture(scene, light.with_glare(own), number)
            found = self.solver.solve(capture, reckoned.with_glare(known).white()).light
            shots[name] = LampShot(scene, capture, found, judged_light(found, truth, saturated))
        bare = shots["plain lens"].capture
        # Without a solver a camera still makes up for the light that its glass takes.
        shown = bare.light / self.plain.white().sum(axis=(1, 2))[:, None, None]
        shots["clipped"] = LampShot(scene, bare, shown, judged_light(shown, truth, saturated))
        return shots

    def rows(self, case: LampCase, number: int, fabricated: LinePsfs | None = None) -> Iterator[LampRow]:
        """Scores of a scene; see `shots`."""
        for name, shot in self.shots(case, number, fabricated).items():
            yield LampRow(case.name, name, number, shot.scene.name, *shot.score)


def with_strength(psfs: LinePsfs, strength: float) -> LinePsfs:
    """PSFs whose copies are so many times as strong.

    Args:
        psfs: PSFs without glare.
        strength: factor of the light farther than 16 pixels from the middle.
    """
    axis = np.arange(psfs.energy.shape[-1]) - psfs.energy.shape[-1] // 2
    beside = np.hypot(axis[:, None], axis) > _BESIDE_PX
    return psfs._replace(energy=np.where(beside, np.float32(strength) * psfs.energy, psfs.energy))
