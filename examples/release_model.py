"""A trained model as it is given away: small, with its design, its licences, and a capture to try it on.

    python examples/release_model.py TRAINED [ORDER] [--out masks/released]

TRAINED is the folder of a training (RUN/trained), ORDER what `doedesign masks TRAINED --out ORDER` wrote, or the
manifest of an order of the same plate. OUT gets

    network.npz     weights in half precision, what they were trained on and under which licences
    psf.exr         PSFs of the plate
    level_map.npz   the plate, with height.exr and spec.toml
    masks.json      the manifest of ORDER, where it is named; its files can be drawn again from the level map
    capture.png     a sample picture of scikit-image behind the obstruction, photographed through the plate with noise
    manifest.json   digests of all of these, how the network was trained and how it is judged

`doedesign reconstruct` takes a model from masks/released where none is named; the commands that take a run take the
folder for its plate.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from see_through import photographed

from doedesign.capture.images import sample_files
from doedesign.cli import exit_code
from doedesign.recon.model import RELEASED as HOME
from doedesign.recon.model import Model
from doedesign.recon.photos import write_reconstruction
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, write_network
from doedesign.runs.folder import HEIGHT, LEVEL_MAP, RELEASED
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from fab.level_map import read_level_map

SIDE, SEED = 512, 2
COPIED = (BANK_NAME, LEVEL_MAP, HEIGHT, "spec.toml")
TOLD = ("camera", "licence", "obstruction", "obstruction_parameters", "occlusion", "perceptual", "run")
SCORED = ("capture", "reconstruction", "wiener_far")


def release(
    trained: Path, order: Path | None, out: Path, *, pictures: Sequence[Mapping[str, str]] | None = None
) -> None:
    """Write the folder.

    Args:
        trained: folder of a finished training behind a plate.
        order: folder of the plate's mask order, or a manifest of one.
        out: the folder.
        pictures: name, digest and licence of every picture that was trained on, for the manifest.

    Raises:
        InputError: no finished training behind a plate, or an order of another plate.
    """
    manifest = read_json(trained / MANIFEST_NAME)
    if manifest.get("state") != "done" or manifest.get("camera") != "doe":
        raise InputError(str(trained), "must be a finished training behind a plate", "another", "Finish it first.")
    model = Model.open(trained)
    write_network(out / NETWORK_NAME, model.network, model.about, half=True)
    for name in COPIED:
        write_atomic(out / name, (trained / name).read_bytes())
    names = [NETWORK_NAME, *COPIED, "capture.png"]
    if order is not None:
        drawn = read_json(order / MANIFEST_NAME if order.is_dir() else order)
        if drawn["level_map_sha256"] != read_level_map(trained / LEVEL_MAP).digest:
            cure = "Draw it with: doedesign masks TRAINED --out ORDER"
            raise InputError(str(order), "the order must be drawn from this plate", "another plate's", cure)
        write_atomic(out / "masks.json", canonical_json(drawn))
        names.append("masks.json")
    chain = photographed(Model.open(out), sample_files()[0], SEED, side=SIDE)
    write_reconstruction(out / "capture.png", chain.plate, 16)
    scores = read_json(trained / "metrics.json")
    said = {
        "format": RELEASED,
        "state": "done",
        "spec_sha256": manifest["spec_sha256"],
        "trained": {key: manifest[key] for key in TOLD} | {"steps": model.about["steps"]},
        "held_out": {kind: scores[kind] for kind in SCORED} | {"scenes": len(scores["scenes"])},
        "capture": {"near_m": chain.near_m, "words": chain.words},
        **({} if pictures is None else {"pictures": list(pictures)}),
        "results_sha256": {name: sha256_file(out / name) for name in sorted(names)},
    }
    write_atomic(out / MANIFEST_NAME, canonical_json(said))


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trained", type=Path, help="folder of a training")
    parser.add_argument("order", nargs="?", type=Path, help="its mask order")
    parser.add_argument("--out", type=Path, default=HOME)
    given = parser.parse_args()

    def work() -> None:
        release(given.trained, given.order, given.out)
        print(given.out)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
