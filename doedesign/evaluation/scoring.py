"""All rows of one test pair, as an item of work for workers here or on a cluster.

A pair is drawn once; every camera photographs it once; every row makes its picture of one capture and is scored by
`doedesign.training.scores`.
"""

import threading
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.capture.from_spec import channels_from_rgb, rgb_from_channels
from doedesign.evaluation.candidates import Candidate
from doedesign.evaluation.external import read_pair
from doedesign.evaluation.methods import METHODS, MethodInputs
from doedesign.evaluation.pairs import PairSet
from doedesign.evaluation.plates import PlateBanks
from doedesign.training.distance.perceptual import Lpips
from doedesign.training.scores import scores_of_one
from sim.light import srgb_from_linear

RowScores = dict[str, dict[str, float | None]]
"""By region ("occluded", "full") and score ("ssim", "psnr", "closeness"); None where there is none."""


@dataclass(frozen=True, eq=False)
class PairWork:
    """Scores of candidates on test pairs; called with the number of a pair.

    Attributes:
        pairs: the pairs.
        plates: PSFs of every plate, by key.
        candidates: rows to score.
        lpips: weights of LPIPS, if at hand.
        known: scores there are already, as `key/number`, which are left out.
        token: text that copies share.
    """

    pairs: PairSet
    plates: Mapping[str, PlateBanks]
    candidates: tuple[Candidate, ...]
    lpips: Lpips | None = None
    known: frozenset[str] = frozenset()
    noun: ClassVar[str] = "pair"
    token: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, number: int) -> dict[str, RowScores]:
        """Scores of a pair by the candidates' keys."""
        asked = [one for one in self.candidates if f"{one.key}/{number}" not in self.known]
        clean, mask = self._shown(number)
        reference = srgb_from_linear(clean)
        found = {}
        for one in asked:
            picture = self.picture(number, one)
            found[one.key] = scores_of_one(picture, reference, mask, self.lpips)
        return found

    def picture(self, number: int, one: Candidate) -> Float[np.ndarray, "c y x"]:
        """The picture that a candidate makes of a pair, display values in the camera's colours."""
        clean, mask = self._shown(number)
        if one.folder is not None:
            rgb = read_pair(one.row.name, one.folder, number, mask.shape)
            return channels_from_rgb(rgb, self.pairs.model.camera)
        light = clean if one.row.sees == "scene" else self._capture(number, one.plate, one.row.fabricated)
        told = self.plates[one.plate].seen_by(number, one.row.fabricated and one.row.told == "right")
        far, near = (np.asarray(told.at(depth)) for depth in self.pairs.depths(number))
        if one.row.method == "network":
            return np.asarray(_restored(one.network, *(jnp.asarray(image)[None] for image in (light, far, near))))[0]
        if one.row.method == "rival":
            shown = jnp.asarray(srgb_from_linear(light).transpose(1, 2, 0))[None]
            return np.asarray(_answered(one.network, shown, jnp.asarray(mask)[None]))[0].transpose(2, 0, 1)
        return METHODS[one.row.method](MethodInputs(light, far, near, mask, self.pairs.model.sensor))

    def seen_by_program(self, number: int, plate: str | None) -> tuple[Float[np.ndarray, "3 y x"], np.ndarray]:
        """Red, green and blue display values that another program sees of a pair, and its mask `[y, x]`.

        Args:
            number: of the pair.
            plate: key of the plate that it is photographed through; None for the sharp scene with a black hole.
        """
        clean, mask = self._shown(number)
        light = np.where(mask >= 0.5, 0, clean) if plate is None else self._capture(number, plate, False)
        return rgb_from_channels(srgb_from_linear(light), self.pairs.model.camera), mask

    def _shown(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        return self._kept(number, "shown", self.pairs.shown)

    def _capture(self, number: int, plate: str, fabricated: bool) -> np.ndarray:
        bank = self.plates[plate].seen_by(number, fabricated)
        return self._kept(number, f"{plate} {fabricated}", lambda scene: self.pairs.photographed(number, scene, bank))

    def _kept(self, number: int, name: str, make: Any) -> Any:
        """A result of this pair, made once; of another pair nothing is kept."""
        memory = self._memory.__dict__
        if memory.get("number") != number:
            memory.clear()
            memory |= {"number": number, "scene": self.pairs.scene(number)}
        if name not in memory:
            memory[name] = make(memory["scene"])
        return memory[name]

    @cached_property
    def _memory(self) -> threading.local:
        """One for every thread, for a worker may evaluate several pairs at once."""
        return threading.local()

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: what was made of a pair stays here."""
        return {one.name: getattr(self, one.name) for one in fields(self)}


@eqx.filter_jit
def _restored(network: Any, capture: Any, far: Any, near: Any) -> Any:
    return network(capture, far, near)


@eqx.filter_jit
def _answered(network: Any, picture: Any, mask: Any) -> Any:
    return network(picture, mask).picture


class ScoreLines:
    """Lines of finished scores in the journal of an evaluation (`doedesign.runs.journal`)."""

    file = "scores.jsonl"
    noun = "score"

    def encode(self, key: str, found: RowScores) -> dict[str, Any]:
        """The line of one row and pair."""
        return {"key": key, "scores": found}

    def decode(self, line: Mapping[str, Any]) -> tuple[str, RowScores]:
        """The key and the scores of a line; a ValueError, KeyError or TypeError for something else."""
        key, found = line["key"], line["scores"]
        if not isinstance(key, str):
            raise TypeError("a key must be text")
        if not isinstance(found, dict) or not all(isinstance(values, dict) for values in found.values()):
            raise TypeError("scores must be listed by region and name")
        return key, {
            str(region): {str(name): None if value is None else float(value) for name, value in values.items()}
            for region, values in found.items()
        }
