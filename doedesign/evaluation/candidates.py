"""Rows with all that they need to be scored, and why others cannot be."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.evaluation.plates import PlateBanks, plate_key
from doedesign.evaluation.rivals.files import open_rival
from doedesign.evaluation.rows import FLAT, TRAININGS, MethodRow
from doedesign.evaluation.trainings import TrainingPlan
from doedesign.recon.weights import NETWORK_NAME, read_network
from fab.files import canonical_json, sha256_bytes, sha256_file


class Candidate(NamedTuple):
    """A row with all that it needs: one seed of its training.

    Attributes:
        row: the row.
        seed: seed of the training; 0 without one.
        plate: key of its plate (`doedesign.evaluation.plates`).
        network: called with (capture, far, near) `[1, c, y, x]` for "network", (picture, mask) for "rival".
        folder: pictures of an external method, which are read.
        digest: of all that its scores depend on besides the pairs.
    """

    row: MethodRow
    seed: int
    plate: str
    network: Any = None
    folder: Path | None = None
    digest: str = ""

    @property
    def key(self) -> str:
        """Name in files: another network or plate has another one."""
        return f"{self.row.name}@{self.seed}#{self.digest[:12]}"


class Unscored(NamedTuple):
    """A row that cannot be scored, and why."""

    row: MethodRow
    why: str


def candidates_of(
    rows: Sequence[MethodRow],
    plan: TrainingPlan,
    seeds: Sequence[int],
    missing: Mapping[str, str],
    plates: Mapping[str, PlateBanks],
    judged_by: Sequence[Path],
) -> tuple[tuple[Candidate, ...], tuple[Unscored, ...]]:
    """Rows that can be scored, one for every seed, and those that cannot.

    A network that was trained on one of the pictures that it is to be judged by has no score.

    Args:
        rows: the rows.
        plan: where trainings are.
        seeds: seeds of the trainings.
        missing: why trainings are not there, by name.
        plates: PSFs of the rows' plates.
        judged_by: pictures of the pairs.
    """
    ready: list[Candidate] = []
    left: list[Unscored] = []
    for row in rows:
        why = next((missing[name] for name in row.needs if name in missing), "")
        # What nothing is trained for is the same for every seed.
        own = seeds if row.needs else (0,) if row.plate == FLAT else seeds[:1]
        found = []
        for seed in () if why else own:
            key = plate_key(row.plate, seed)
            network, weights, seen = _network(plan, row, seed)
            if row.fabricated and not plates[key].fabricated:
                why = plates[key].why_none
            elif known := sorted(seen & {path.name for path in judged_by}):
                why = f"trained on {known[0]}, which is among the pictures to judge by"
            digest = sha256_bytes(canonical_json([row.method, weights, plates[key].digest(row.fabricated)]))
            found.append(Candidate(row, seed, key, network, None, digest))
        if why:
            left.append(Unscored(row, why))
        else:
            ready += found
    return tuple(ready), tuple(left)


def _network(plan: TrainingPlan, row: MethodRow, seed: int) -> tuple[Any, str, set[str]]:
    """The network of a row, the digest of its file, and names of the pictures that it was trained on."""
    if row.training is None:
        return None, "", set()
    folder = plan.folder(TRAININGS[row.training], seed)
    digest = sha256_file(folder / NETWORK_NAME)
    if row.method == "network":
        network, about = read_network(folder / NETWORK_NAME)
    else:
        rival = open_rival(folder)
        network, about = rival.network, rival.about
    pictures = about.get("pictures")
    seen = pictures.get("training", ()) if isinstance(pictures, Mapping) else ()
    return network, digest, {Path(str(name)).name for name in seen}
