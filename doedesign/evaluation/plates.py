"""PSFs of the plates that rows look through: as drawn, and as some draws of a process make them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from doedesign.design.design import Design
from doedesign.evaluation.pairs import PairSet
from doedesign.evaluation.rows import FLAT, TRAININGS, MethodRow
from doedesign.evaluation.trainings import TrainingPlan
from doedesign.runtime.progress import meter
from fab.draws import sources_of
from fab.errors import InputError
from fab.files import canonical_json, sha256_bytes
from fab.process import Process
from sim.optic import HeightOptic
from sim.psf_bank import PsfBank, psf
from sim.rigorous.edge_optic import optic_as_drawn

_SEED = 23  # of the process's draws


class PlateBanks(NamedTuple):
    """PSFs of a plate at all depths of the pairs.

    Attributes:
        drawn: of the plate as drawn.
        fabricated: of every draw of the process; empty where no row asks for them, or there are none.
        why_none: why there are none though a row asks for them.
    """

    drawn: PsfBank
    fabricated: tuple[PsfBank, ...] = ()
    why_none: str = ""

    def seen_by(self, number: int, fabricated: bool) -> PsfBank:
        """PSFs of the plate that a pair is photographed through."""
        return self.fabricated[number % len(self.fabricated)] if fabricated else self.drawn

    def digest(self, fabricated: bool) -> str:
        """SHA-256 of the PSFs, with those of the draws or without."""
        banks = (self.drawn, *self.fabricated) if fabricated else (self.drawn,)
        return sha256_bytes(canonical_json([sha256_bytes(np.ascontiguousarray(b.energy).tobytes()) for b in banks]))


def plate_key(training: str, seed: int) -> str:
    """Key of the plate of a training."""
    return FLAT if training == FLAT else f"{training}@{seed}"


def plates_of(
    rows: Sequence[MethodRow],
    plan: TrainingPlan,
    pairs: PairSet,
    seeds: Sequence[int],
    missing: Mapping[str, str],
    process: Process | str | Path | None,
    draws: int,
) -> dict[str, PlateBanks]:
    """PSFs of every plate that rows look through, by `plate_key`, and of flat glass.

    Args:
        rows: the rows.
        plan: where trainings are.
        pairs: whose depths are asked for.
        seeds: seeds of the trainings.
        missing: trainings that are not there, which are left out.
        process: process of plates as fabricated; that of the design's spec if None.
        draws: plates as fabricated of each.

    Raises:
        InputError: the process cannot be read, or makes another staircase.
    """
    camera, depths = pairs.model.camera, pairs.depths_m
    named = {row.plate for row in rows if not missing.keys() & set(row.needs)} - {FLAT}
    made = {row.plate for row in rows if row.fabricated}
    wanted = [(name, seed) for name in sorted(named) for seed in seeds]
    found = {FLAT: PlateBanks(psf(HeightOptic.of(camera), camera, depths))}
    with meter("computing PSFs", 1 + len(wanted)) as progress:
        for count, (name, seed) in enumerate(wanted, 1):
            progress.advance(count)
            design = plan.design_after(TRAININGS[name], seed)
            drawn = psf(optic_as_drawn(camera, design.level_map.height_m, depths_m=depths), camera, depths)
            banks = PlateBanks(drawn)
            if name in made:
                banks = _with_draws(banks, design, pairs, design.process(process), draws)
            found[plate_key(name, seed)] = banks
        progress.advance(1 + len(wanted))
    return found


def _with_draws(banks: PlateBanks, design: Design, pairs: PairSet, process: Process, draws: int) -> PlateBanks:
    if not sources_of(process):
        return banks._replace(why_none="the process has no errors that vary; contact_aligner has")
    camera, depths = pairs.model.camera, pairs.depths_m
    try:
        plates = [design.fabricated(process, seed=_SEED, draw=f"normal/{k}", depths=depths) for k in range(draws)]
    except InputError as error:
        return banks._replace(why_none=f"errors beyond the model: {error}")
    return banks._replace(fabricated=tuple(psf(plate, camera, depths) for plate in plates))
