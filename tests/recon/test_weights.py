"""A network's file: what comes back, how large it is, and what is refused."""

import json
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

from doedesign.recon.network import Network, NetworkShape
from doedesign.recon.weights import FORMAT, read_network, write_network
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import canonical_json
from tests.recon.drawn_networks import count_parameters, drawn

SMALL = NetworkShape(width=3, depth=1)
ABOUT = {
    "colours": ["red", "green", "blue"],
    "occlusion": "radiometric",
    "pictures": [{"name": "a.jpg", "licence": "CC0"}],
}


@pytest.fixture(scope="module")
def network() -> Network:
    return drawn(SMALL)


@pytest.fixture
def path(tmp_path: Path, network: Network) -> Path:
    write_network(tmp_path / "network.npz", network, ABOUT)
    return tmp_path / "network.npz"


def members(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def forged(path: Path, change) -> Path:
    """The file with a header or arrays changed on purpose, and a digest that fits."""
    header, arrays = read_archive(path, "network file", "")
    change(header, arrays)
    write_archive(path, header, arrays)
    return path


def test_a_network_comes_back_to_the_last_bit(path: Path, network: Network):
    found, about = read_network(path)
    assert about == ABOUT
    assert found.layout == network.layout
    assert jax.tree.structure(found) == jax.tree.structure(network)
    for before, after in zip(jax.tree.leaves(network), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(
    "layout",
    [
        NetworkShape(colours=1, width=2, depth=1, refine=False, near_estimate=False, wiener=False),
        NetworkShape(width=3, depth=2, features=False),
        NetworkShape(width=3, depth=1, variant="release"),
    ],
)
def test_every_ablation_has_a_file(tmp_path: Path, layout: NetworkShape):
    network = drawn(layout)
    write_network(tmp_path / "network.npz", network, {})
    assert jax.tree.structure(read_network(tmp_path / "network.npz")[0]) == jax.tree.structure(network)


def test_the_same_network_gives_the_same_bytes(path: Path, tmp_path: Path, network: Network):
    write_network(tmp_path / "again.npz", network, dict(reversed(ABOUT.items())))
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_the_full_network_fits_into_ten_megabytes(tmp_path: Path):
    network = drawn(NetworkShape())
    for half, bytes_each in ((False, 4), (True, 2)):
        write_network(tmp_path / "network.npz", network, ABOUT, half=half)
        size = (tmp_path / "network.npz").stat().st_size
        # Beside the weights there are names and headers: some 300 bytes for each of about sixty arrays.
        assert 0 < size - bytes_each * count_parameters(network) < 50_000
        assert size < 10_000_000


def test_half_precision_keeps_three_digits(tmp_path: Path, network: Network):
    write_network(tmp_path / "network.npz", network, ABOUT, half=True)
    found, _ = read_network(tmp_path / "network.npz")
    for before, after in zip(jax.tree.leaves(network), jax.tree.leaves(found), strict=True):
        assert after.dtype == before.dtype
        # Eleven bits, and below 2^-14 steps of 2^-24.
        np.testing.assert_allclose(after, before, rtol=2**-11, atol=2**-25)
    assert (tmp_path / "network.npz").stat().st_size > 2 * count_parameters(network)


def test_weights_that_are_not_finite_are_not_written(tmp_path: Path, network: Network):
    for bad, half in ((np.nan, False), (1e6, True)):
        broken = eqx.tree_at(lambda n: n.head[0].weights, network, network.head[0].weights.at[0, 0, 0, 0].set(bad))
        with pytest.raises(InputError, match=r"weights must be finite, but got others in \.head\[0\]\.weights"):
            write_network(tmp_path / "network.npz", broken, {}, half=half)
    assert not (tmp_path / "network.npz").exists()


def test_a_flipped_byte_is_refused_or_changes_nothing(path: Path, network: Network):
    """Every array and the header are guarded; of the archive's own book-keeping some bytes mean nothing (dates)."""
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    places = rng.choice(len(whole), 150, replace=False)
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            found, about = read_network(path)
        except InputError:
            refused += 1
            continue
        assert about == ABOUT
        assert all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(network)))
    assert refused > 100


def test_a_flipped_byte_among_weights_or_header_is_refused(path: Path, network: Network):
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            damaged = bytearray(whole)
            # The end of a member is its data; its name stands twice, before it and in the list at the end.
            start = whole.index(info.filename.encode()) + len(info.filename)
            damaged[start + info.file_size] ^= 1
            path.write_bytes(damaged)
            with pytest.raises(InputError, match="network"):
                read_network(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9, 0.999])
def test_a_file_cut_off_is_refused(path: Path, share: float):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match="must be a whole network file"):
        read_network(path)


def test_what_is_no_network_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="must exist"):
        read_network(tmp_path / "none.npz")
    for name, content in (("text.npz", b"no archive"), ("array.npz", b"\x93NUMPY")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="must be a whole network file"):
            read_network(tmp_path / name)
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(InputError, match="without a header"):
        read_network(tmp_path / "other.npz")
    np.savez(tmp_path / "objects.npz", header=np.array([{}], object), allow_pickle=True)
    with pytest.raises(InputError, match="must be a whole network file"):
        read_network(tmp_path / "objects.npz")


def test_another_format_or_content_is_refused_by_name(path: Path):
    whole = path.read_bytes()
    first = ".down[0].blocks[0].weights"

    def spoilt(name: str, value: float):
        def change(_, arrays):
            arrays[name] = arrays[name].copy()
            arrays[name].flat[0] = value

        return change

    cases = {
        f'the format must be "{FORMAT}"': lambda header, _: header.update(format="doedesign network 2"),
        "the layout must be one that this version knows": lambda header, _: header["layout"].update(width=4),
        "unexpected keyword": lambda header, _: header["layout"].update(colour="red"),
        "every array of the layout must be there": lambda _, arrays: arrays.pop(first),
        "must hold floats of shape": lambda _, arrays: arrays.update({first: np.zeros((2, 2), np.float32)}),
        "weights must be finite": spoilt(first, np.nan),
        "must hold the layout's arrays alone": lambda _, arrays: arrays.update(more=np.zeros(2, np.float32)),
        "must say what it is about": lambda header, _: header.update(about=None),
    }
    for message, change in cases.items():
        path.write_bytes(whole)
        with pytest.raises(InputError, match=message):
            read_network(forged(path, change))
    path.write_bytes(whole)
    read_network(forged(path, lambda header, arrays: None))  # the forger's digest is right, so each refusal was earned


def test_a_change_without_a_new_digest_is_refused(path: Path):
    arrays = members(path)
    header = json.loads(arrays["header"].tobytes())
    header["about"]["occlusion"] = "paper"
    arrays["header"] = np.frombuffer(canonical_json(header), np.uint8)
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="a file changed since"):
        read_network(path)


@pytest.mark.parametrize(
    "said", [{"width": 12.0}, {"width": "12"}, {"wiener": 1}, {"variant": "x"}, {"width": 3 << 20}]
)
def test_a_layout_that_was_sealed_again_is_refused_before_anything_is_made(path: Path, said: dict[str, object]):
    header, arrays = read_archive(path, "network file", "")
    write_archive(path, {**header, "layout": {**header["layout"], **said}}, arrays)
    with pytest.raises(InputError, match=f"the layout must be one that this version knows.*{next(iter(said))}"):
        read_network(path)


def test_a_file_is_about_as_large_as_the_network_that_it_promises(path: Path, monkeypatch: pytest.MonkeyPatch):
    """To compare with, that network is made: of four megabytes with a width of 996 it took ten gigabytes."""
    header, _ = read_archive(path, "network file", "")
    write_archive(path, {**header, "layout": {"width": 996}}, {"a": np.zeros(1_000_000, np.float32)})
    monkeypatch.setattr(Network, "make", lambda *_: pytest.fail("made"))
    with pytest.raises(InputError, match=r"the layout must be one that this version knows.*width of 996"):
        read_network(path)
