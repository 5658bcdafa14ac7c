"""Rivals: what each idea promises, what is learnt, their files, and trainings that are stopped and go on.

Networks are as small as they go, and each is compiled once: the time goes into that.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from PIL import Image

import doedesign.evaluation.rivals.files
import doedesign.training.job
from doedesign.capture.images import sample_files
from doedesign.design.design import Design
from doedesign.evaluation.rivals.adversary import Adversary
from doedesign.evaluation.rivals.attentive_drop_removal import AttentiveDropRemoval
from doedesign.evaluation.rivals.fence_removal import FenceRemoval, smoothly_filled
from doedesign.evaluation.rivals.files import TrainedRival, open_rival, read_rival, rival_named, write_rival
from doedesign.evaluation.rivals.fourier_inpainting import FourierConvolution
from doedesign.evaluation.rivals.layers import Answer, RivalNetwork, count_of, known_of, pasted
from doedesign.evaluation.rivals.registry import RIVALS, Rival
from doedesign.evaluation.rivals.training import RivalTraining, RivalView, train_rival
from doedesign.evaluation.rivals.two_stream_inpainting import TwoStreamInpainting
from doedesign.recon.conv import convolution
from doedesign.recon.network import Block
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.level_maps import open_design
from doedesign.training.history import read_history
from doedesign.training.joint import LOOK_SEED
from doedesign.training.loss import adam_step
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import read_json
from fab.pictures import read_display
from sim.light import linear_from_srgb
from sim.tracing import compiled_quickly
from tests import compilations
from tests.doedesign.small_runs import finished_run
from tests.pictures import leave_out_pictures
from tests.recon.small_training import PLAIN, batch, heights, trainer
from tests.recon.test_train_command import SPEC, content

SIDE, COLOURS = 32, 3
WIDTHS = {"plain_unet": 4, "pyramid_deblurring": 4, "fourier_inpainting": 4, "two_stream_inpainting": 4}
FILLS_HOLES = ("fourier_inpainting", "two_stream_inpainting")
# Those that compile fastest are tried at every change.
FASTEST = ("plain_unet", "pyramid_deblurring", "fourier_inpainting")
EVERY = [pytest.param(name, marks=pytest.mark.slow if name in FASTEST else pytest.mark.study) for name in RIVALS]


def quickly(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that is called a few times."""
    return eqx.filter_jit(function, compiler_options=compiled_quickly())  # pyright: ignore[reportCallIssue]


def width_of(name: str) -> int:
    return WIDTHS.get(name, 3)


def drawn(name: str, seed: int = 0) -> RivalNetwork:
    return RIVALS[name].make(COLOURS, seed, width_of(name))


def judge_of(name: str) -> Adversary | None:
    judge = RIVALS[name].judge
    return None if judge is None else judge(COLOURS, 0, 2)


def scene() -> tuple[jax.Array, jax.Array, jax.Array]:
    """Two pictures of soft waves, the same with a dark disc, and its mask."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
    waves = np.random.default_rng(0).uniform(-3, 3, (2, COLOURS, 3))
    reference = np.stack([[0.5 + 0.3 * np.sin(a + 6 * (b * y + c * x)) for a, b, c in w] for w in waves], 0)
    mask = np.stack([np.clip(4 - 20 * np.hypot(y - v, x), 0, 1) for v in (0.0, 0.1)])
    reference = reference.transpose(0, 2, 3, 1)
    given = reference * (1 - mask[..., None])
    return jnp.float32(reference), jnp.float32(given), jnp.float32(mask)


@cache
def compiled(name: str) -> Callable[..., Any]:
    """Loss, answer and gradient of a rival and, where it has one, of its adversary; compiled quickly."""

    def cost(network: RivalNetwork, given: Any, adversary: Adversary | None) -> tuple[Any, Any]:
        reference, picture, mask = given
        answer = network(picture, mask)
        loss = jnp.mean(jnp.abs(answer.picture - reference)) + network.loss(answer, reference, mask)
        if adversary is not None:
            loss += 0.01 * adversary.deception(answer, reference)
        return loss, answer

    def both(network: RivalNetwork, given: Any, adversary: Adversary | None) -> Any:
        (loss, answer), slope = eqx.filter_value_and_grad(cost, has_aux=True)(network, given, adversary)
        if adversary is None:
            return loss, answer, slope, None
        fixed = jax.lax.stop_gradient(answer)
        return loss, answer, slope, eqx.filter_value_and_grad(lambda a: a.error(fixed, given[0]))(adversary)

    return quickly(both)


def looked(name: str, network: RivalNetwork | None = None, given: Any = None) -> tuple[Any, Answer, Any, Any]:
    return compiled(name)(network or drawn(name), given or scene(), judge_of(name))


def numbers(tree: Any) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


# --- every rival -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_every_weight_is_learnt(name: str):
    _, answer, slope, judged = looked(name)
    assert answer.picture.shape == (2, SIDE, SIDE, COLOURS)
    assert np.isfinite(answer.picture).all()
    for tree in (slope, () if judged is None else judged[1]):
        for where, leaf in jax.tree_util.tree_leaves_with_path(tree):
            assert np.abs(leaf).max() > 0, jax.tree_util.keystr(where)


@pytest.mark.parametrize("name", EVERY)
def test_a_rival_learns(name: str):
    network, losses = drawn(name), []
    moments = optax.scale_by_adam().init(eqx.filter(network, eqx.is_inexact_array))
    for _ in range(25):
        loss, _, slope, _ = looked(name, network)
        network, moments = _stepped(network, slope, moments)
        losses.append(float(loss))
    assert losses[-1] < 0.9 * losses[0]


@quickly
def _stepped(part: Any, slope: Any, moments: Any) -> Any:
    return adam_step(part, slope, moments, jnp.float32(0.03))


@pytest.mark.parametrize("name", RIVALS)
def test_a_seed_is_repeated(name: str):
    one, same, other = (numbers(drawn(name, seed)) for seed in (0, 0, 1))
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("name", RIVALS)
def test_sizes_and_colours_that_do_not_fit(name: str):
    network = drawn(name)
    for shape in ((1, network.multiple, 64, 3), (1, 65, 64, 3), (1, 64, 64, 1)):
        with pytest.raises(ValueError, match=r"`picture` must have|sides of `picture`"):
            network(jnp.zeros(shape), jnp.zeros(shape[:3]))


def test_the_list():
    """Small ones, each with its count beside the original's, and shown what the paper shows the original."""
    for name, rival in RIVALS.items():
        count = count_of(rival.make(3, 0))
        assert rival.name == name
        assert 0.3e6 < count < 1.5e6
        assert rival.original_parameters is None or count < rival.original_parameters / 10
        assert (rival.original_parameters is None) == (rival.parameters_from == "not stated")
    shown = {name: (rival.given, rival.mask_given) for name, rival in RIVALS.items()}
    assert {name for name, (given, _) in shown.items() if given == "scene with hole"} == set(FILLS_HOLES)
    assert {name for name, (_, mask) in shown.items() if not mask} == {"plain_unet", "pyramid_deblurring"}
    assert {name for name, rival in RIVALS.items() if rival.judge} == {"pyramid_deblurring", "attentive_drop_removal"}
    with pytest.raises(InputError, match="rival: must be one of plain_unet"):
        rival_named("plain_net")


# --- their ideas -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", FILLS_HOLES)
def test_a_hole_is_filled_and_the_rest_is_kept(name: str):
    reference, picture, mask = scene()
    known = np.asarray(mask) < 0.5
    _, answer, _, _ = looked(name)
    np.testing.assert_array_equal(np.asarray(answer.picture)[known], np.asarray(picture)[known])
    # Nothing is seen of the scene in the hole.
    hidden = jnp.where(jnp.asarray(known)[..., None], picture, 7.0)
    _, same, _, _ = looked(name, given=(reference, hidden, mask))
    np.testing.assert_array_equal(answer.picture, same.picture)


def test_a_fourier_convolution_sees_the_whole_picture():
    """A pixel in one corner reaches the other by one layer, in global features; in local ones it takes a detour."""
    layer = FourierConvolution.make(np.random.default_rng(0), 2, 6)
    rng = np.random.default_rng(1)
    narrow, wide = (jnp.asarray(rng.random((1, 32, 32, n)), jnp.float32) for n in (2, 6))
    lit = wide.at[:, 2, 3].add(1.0)
    before, after = layer(narrow, wide), layer(narrow, lit)
    far = np.s_[:, 8:, 8:]
    # A hundred times what rounding does.
    assert np.median(np.abs(after[1] - before[1])[far]) > 1e-5
    np.testing.assert_array_equal(after[0][far], before[0][far])
    one, other = (layer(*each)[0] for each in (before, after))
    assert np.median(np.abs(other - one)[far]) > 1e-5
    # Plain convolutions of the same kernels reach a pixel per layer.
    plain = [lit, wide]
    for _ in range(2):
        plain = [convolution(each, jnp.ones((3, 3, 6, 6))) for each in plain]
    np.testing.assert_array_equal(plain[0][far], plain[1][far])


def test_edges_have_a_loss_of_their_own():
    network = drawn("two_stream_inpainting")
    assert isinstance(network, TwoStreamInpainting)
    reference, _, mask = scene()
    _, answer, slope, _ = looked("two_stream_inpainting")
    assert answer.extras["edges"].shape == (2, SIDE, SIDE, 1)
    step = reference.at[:, :, SIDE // 2 :].set(0.0)
    sharp = jnp.full((2, SIDE, SIDE, 1), -8.0).at[:, :, SIDE // 2 - 1 : SIDE // 2 + 1].set(8.0)
    right, wrong = (answer._replace(extras={"edges": logit, "texture": step}) for logit in (sharp, -sharp))
    assert network.loss(right, step, mask) < 0.2 * network.loss(wrong, step, mask)
    assert np.abs(slope.edge_head.weights).max() > 0


@pytest.mark.slow
def test_a_smooth_filling():
    """A plane of one brightness comes back, whatever is known of it; known pixels stay."""
    known = jnp.asarray(np.random.default_rng(0).random((1, 24, 40, 1)) < 0.1, jnp.float32).at[:, :12].set(0.0)
    plane = jnp.full((1, 24, 40, 2), 0.3)
    np.testing.assert_allclose(smoothly_filled(plane * known, known), plane, rtol=1e-5)
    ramp = plane * jnp.arange(40)[:, None] / 40
    found = smoothly_filled(ramp, known)
    kept = np.asarray(known[..., 0]) > 0
    np.testing.assert_array_equal(np.asarray(found)[kept], np.asarray(ramp)[kept])
    assert found.min() >= ramp.min()
    assert found.max() <= ramp.max()


@pytest.mark.slow
def test_which_mask_fills():
    """The detector is trained in both cases, and heeded in one."""
    reference, picture, mask = scene()
    for fills, heeds in (("given", True), ("detected", False)):
        network = FenceRemoval.make(COLOURS, 0, 2, fills)
        assert network.layout["fills"] == fills
        answers = [_answered(network, picture, each) for each in (mask, jnp.zeros_like(mask))]
        assert np.array_equal(answers[0].picture, answers[1].picture) != heeds
        right = answers[0]._replace(extras={"detection": 8 * (2 * mask - 1)})
        assert network.loss(right, reference, mask) < 0.5 * network.loss(answers[0], reference, mask)
    with pytest.raises(ValueError, match="`fills` must be one of given, detected"):
        FenceRemoval.make(COLOURS, 0, 2, "both")


@quickly
def _answered(network: RivalNetwork, picture: jax.Array, mask: jax.Array) -> Answer:
    return network(picture, mask)


@pytest.mark.slow
def test_attention_is_supervised():
    """By the mask in every round, in the last most."""
    network = drawn("attentive_drop_removal")
    assert isinstance(network, AttentiveDropRemoval)
    reference, _, mask = scene()
    _, answer, _, _ = looked("attentive_drop_removal")
    attention = answer.extras["attention"]
    assert attention.shape == (4, 2, SIDE // 2, SIDE // 2, 1)
    half = mask.reshape(2, SIDE // 2, 2, SIDE // 2, 2).mean(axis=(2, 4))[..., None]
    right = jnp.broadcast_to(8 * (2 * half - 1), attention.shape)

    def cost(logits: jax.Array) -> float:
        return float(network.loss(answer._replace(extras={**answer.extras, "attention": logits}), reference, mask))

    assert cost(right) < cost(attention)
    assert cost(attention.at[3].set(right[3])) < cost(attention.at[0].set(right[0])) < cost(attention)


@pytest.mark.slow
def test_an_adversary_tells_true_from_false():
    """One that scores brightness knows a dark answer, and is deceived by a true one."""
    reference, _, _ = scene()
    for name in ("pyramid_deblurring", "attentive_drop_removal"):
        adversary, extras = judge_of(name), {"attention": jnp.zeros((1, 2, SIDE // 2, SIDE // 2, 1))}
        assert adversary is not None
        good, bad = (Answer(picture, extras) for picture in (reference, reference - 0.4))
        moments = optax.scale_by_adam().init(eqx.filter(adversary, eqx.is_inexact_array))
        errors = []
        for _ in range(12):
            error, slope = _judged(adversary, bad, reference)
            adversary, moments = _stepped(adversary, slope, moments)
            errors.append(float(error))
        assert errors[-1] < 0.9 * errors[0]
        assert adversary.deception(bad, reference) > adversary.deception(good, reference)


@quickly
def _judged(adversary: Adversary, answer: Answer, reference: jax.Array) -> Any:
    return eqx.filter_value_and_grad(lambda a: a.error(answer, reference))(adversary)


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_rival(tmp_path / "network.npz", "fence_removal", drawn("fence_removal"), {"steps": 3})
    return tmp_path / "network.npz"


def test_a_rival_comes_back_to_the_last_bit(path: Path):
    found, network = open_rival(path.parent), drawn("fence_removal")
    assert (found.rival, found.about, found.folder) == (RIVALS["fence_removal"], {"steps": 3}, path.parent)
    assert jax.tree.structure(found.network) == jax.tree.structure(network)
    assert all(np.array_equal(a, b) for a, b in zip(numbers(found.network), numbers(network), strict=True))
    again = path.with_name("again.npz")
    write_rival(again, "fence_removal", network, {"steps": 3})
    assert again.read_bytes() == path.read_bytes()


def _other_format(header: dict[str, Any], _: Any) -> None:
    header["format"] = "doedesign network 1"


def _other_rival(header: dict[str, Any], _: Any) -> None:
    header["rival"] = "lama"


def _other_layout(header: dict[str, Any], _: Any) -> None:
    header["layout"]["fills"] = "both"


def _large(header: dict[str, Any], _: Any) -> None:
    header["layout"]["width"] = 10**6


def _larger(header: dict[str, Any], _: Any) -> None:
    header["layout"]["width"] = 24


def _without(_: Any, arrays: dict[str, Any]) -> None:
    arrays.pop(next(iter(arrays)))


def _infinite(_: Any, arrays: dict[str, Any]) -> None:
    next(iter(arrays.values()))[:] = np.inf


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_other_format, 'the format must be "doedesign rival network 1"'),
        (_other_rival, "the rival must be one of"),
        (_other_layout, "layout.*`fills` must be one of"),
        (_large, "layout.*width is 1000000"),
        (_larger, "layout.*width is 24"),
        (_without, "every array of the layout must be there"),
        (_infinite, "weights must be finite"),
    ],
)
def test_a_bad_file_is_refused(path: Path, change: Any, words: str):
    header, arrays = read_archive(path, "file", "")
    change(header, arrays)
    write_archive(path, header, arrays)
    with pytest.raises(InputError, match=words):
        read_rival(path)


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_has_the_weights_by_which_its_file_is_judged(name: str):
    """A thousand times the square of its width at the least, also where it is narrow."""
    for width in (2, 8):
        assert count_of(RIVALS[name].make(3, 0, width=width)) >= 1000 * width**2


def test_a_broken_or_missing_file_is_refused(path: Path, tmp_path: Path):
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="must be a whole rival's network file"):
        open_rival(path.parent)
    with pytest.raises(InputError, match="must hold a trained rival"):
        open_rival(tmp_path / "none")
    broken = jax.tree.map(lambda leaf: leaf * np.nan, drawn("plain_unet"))
    with pytest.raises(InputError, match="weights must be finite"):
        write_rival(tmp_path / "broken.npz", "plain_unet", broken, {})


def test_a_picture_of_any_size():
    found = TrainedRival(RIVALS["plain_unet"], drawn("plain_unet"))
    picture = np.random.default_rng(0).random((3, 37, 20), np.float32)
    assert found.restored(picture, np.zeros((37, 20), np.float32)).shape == (3, 37, 20)
    # It is shown no mask, whatever is handed in.
    np.testing.assert_array_equal(found.shown(np.ones((2, 2))), np.zeros((2, 2)))


# --- training --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Programs that one test compiled serve the others."""
    with compilations.kept_in(tmp_path_factory.mktemp("compiled")) as folder:
        yield folder


@pytest.fixture(scope="module")
def design(tmp_path_factory: pytest.TempPathFactory) -> Design:
    run = finished_run(tmp_path_factory.mktemp("small"), SPEC)
    return open_design(run, False, free=TRAINING_TABLES)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    for k, path in enumerate(sample_files()):
        Image.fromarray(read_display(path, 96)[::-1][20:68, 10:66]).save(folder / f"{k}.png")
    return folder


@pytest.fixture(autouse=True)
def plain_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_pictures(monkeypatch, doedesign.training.job)


class OneLayer(RivalNetwork):
    """The least rival, which compiles in the least time."""

    layer: Block

    multiple: ClassVar[int] = 1

    @classmethod
    def make(cls, colours: int, seed: int, width: int = 1) -> "OneLayer":
        layer = Block.make(np.random.default_rng(seed), colours, colours, normal=False, act=False)
        return cls(colours, width, layer)

    def __call__(self, picture: Any, mask: Any) -> Answer:
        self.require_fits(picture)
        return Answer(self.layer(picture), {})

    def loss(self, answer: Answer, reference: Any, mask: Any) -> jax.Array:
        return 0.5 * jnp.mean(mask)


class OneLayerInHoles(OneLayer):
    """The same for holes alone."""

    def __call__(self, picture: Any, mask: Any) -> Answer:
        return Answer(pasted(self.layer(picture), picture, known_of(mask)), {})


def least(monkeypatch: pytest.MonkeyPatch, like: str) -> Rival:
    """The least rival in the place of another; it has fewer weights than a file of any other."""
    monkeypatch.setattr(doedesign.evaluation.rivals.files, "_LEAST_WEIGHTS", 1)
    rival = replace(RIVALS[like], make=(OneLayerInHoles if like in FILLS_HOLES else OneLayer).make)
    monkeypatch.setitem(RIVALS, like, rival)  # pyright: ignore[reportArgumentType]
    return rival


@pytest.mark.slow
def test_a_training_that_is_stopped_ends_with_the_same_bytes(
    design: Design, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Of a network with an adversary, whose state is in the checkpoint, too."""
    rival = least(monkeypatch, "pyramid_deblurring")

    def train(out: str, **more: Any) -> TrainedRival:
        return train_rival(rival, design, images, tmp_path / out, **{"steps": 4, **more})

    found = train("whole")
    step = RivalTraining.step

    def stopped(self: RivalTraining, state: Any, batch: Any) -> Any:
        if state.step == 3:
            raise KeyboardInterrupt
        return step(self, state, batch)

    with monkeypatch.context() as patch:
        patch.setattr(RivalTraining, "step", stopped)
        with pytest.raises(KeyboardInterrupt):
            train("out")
    assert (tmp_path / "out" / "checkpoint.npz").exists()
    train("out")
    assert content(tmp_path / "out") == content(tmp_path / "whole")
    records = read_history(tmp_path / "out" / "history.jsonl", 4)
    assert [record["step"] for record in records] == [0, 1, 2, 3]
    parts = records[0]["parts"]
    assert {"own", "deception", "adversary"} <= set(parts)
    total = parts["l1"] + parts["masked"] + parts["own"] + 0.01 * parts["deception"]
    assert records[0]["loss"] == pytest.approx(total, rel=1e-5)
    assert not np.array_equal(numbers(found.network)[0], numbers(OneLayer.make(1, 0))[0])
    about, manifest = found.about, read_json(tmp_path / "out" / "manifest.json")
    assert (about["steps"], about["original_parameters"], about["given"]) == (4, 61_000_000, "doe capture")
    assert about["parameters"] == count_of(found.network)
    assert set(manifest["results_sha256"]) >= {"network.npz", "metrics.json", "spec.toml", "pictures.json"}
    assert set(read_json(tmp_path / "out" / "metrics.json")) == {"capture", "reconstruction", "scenes"}
    # A folder of its own, or none.
    with pytest.raises(InputError, match="must belong to this training of a rival"):
        train("out", steps=5)


@pytest.mark.slow
def test_a_rival_sees_the_captures_of_the_project_s_own_network():
    """Noise and all."""
    made, two = trainer(*PLAIN, 'train.freeze="optics"'), batch(2, step=3)
    wanted, _ = made.reconstruct(made.initial(heights()), two)
    view = RivalView(made.doe, None, made.bench, "doe capture")
    shown, reference, mask = view.pictures(*view.seen(two, LOOK_SEED))
    # The two are compiled apart, which moves the last bits of a transform.
    np.testing.assert_allclose(linear_from_srgb(shown[..., 0]), wanted.capture[:, 0], atol=2e-5)
    np.testing.assert_array_equal(mask, np.stack([item.scene.obstructions[0].mask for item in two.items]))
    holes = RivalView(None, None, made.bench, "scene with hole")
    sharp, same, _ = holes.pictures(*holes.seen(two, LOOK_SEED))
    np.testing.assert_array_equal(same, reference)
    np.testing.assert_array_equal(sharp[..., 0], np.where(mask < 0.5, reference[..., 0], 0))


def test_a_training_on_scenes_with_holes(design: Design, images: Path, monkeypatch: pytest.MonkeyPatch):
    """Nothing is photographed, so what is known is exact; the plate does not matter."""
    rival = least(monkeypatch, "fourier_inpainting")
    found = train_rival(rival.name, design, images, steps=2)
    assert found.folder is None
    assert (found.about["height_sha256"], found.about["mask_given"]) == ("", True)
    mask = np.zeros((32, 32), np.float32)
    mask[8:20, 8:20] = 1
    picture = np.random.default_rng(0).random((1, 32, 32), np.float32)
    restored = found.restored(picture, mask)
    np.testing.assert_array_equal(restored[:, mask < 0.5], picture[:, mask < 0.5])


@pytest.mark.study
@pytest.mark.parametrize("name", RIVALS)
def test_every_rival_is_trained(name: str, design: Design, images: Path, tmp_path: Path):
    found = train_rival(name, design, images, tmp_path / "out", width=width_of(name), steps=2, batch=2)
    assert count_of(found.network) == found.about["parameters"]
    assert open_rival(tmp_path / "out").digest == found.digest
    camera = {"doe capture": "doe"}.get(found.rival.given, "conventional")
    assert f'camera = "{camera}"' in (tmp_path / "out" / "spec.toml").read_text()


def test_what_cannot_be_trained(design: Design, images: Path):
    cases: list[tuple[dict[str, Any], str]] = [
        ({"size": 16}, "train.size: must be a multiple of 16 for pyramid_deblurring, at least 32"),
        ({"width": 0}, "width: must be one that pyramid_deblurring can have"),
        ({"adversarial": -1.0}, "adversarial: must be a weight"),
        ({"stepps": 3}, "stepps"),
    ]
    for more, words in cases:
        with pytest.raises(InputError, match=words):
            train_rival("pyramid_deblurring", design, images, **more)
