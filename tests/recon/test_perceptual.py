"""LPIPS against an independent graph and published numbers; MS-SSIM against scipy; files that hold no weights."""

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from doedesign.cli import exit_code
from doedesign.training.distance import perceptual, similarity
from doedesign.training.distance.backbones import weight_shapes
from doedesign.training.distance.perceptual import Lpips, read_lpips, weights_of
from doedesign.training.distance.similarity import MsSsim
from fab.errors import InputError

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data" / "lpips_squeeze"
sys.path.insert(0, str(ROOT / "examples"))

import convert_lpips  # noqa: E402 # pyright: ignore[reportMissingImports]


def quick_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile without the optimisations of LLVM, which take longer than anything that runs here."""
    options = {"xla_backend_optimization_level": 0}
    return eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]


lpips, lpips_map = quick_jit(Lpips.__call__), quick_jit(Lpips.map)
ms_ssim = quick_jit(similarity.ms_ssim)

BACKBONES = ("squeeze", "alex", "vgg")
# One size for most: compiling takes longer than anything else here. Odd and even, and no multiple of any stride.
SIDE = (38, 53)
LEAST = {"squeeze": 17, "alex": 31, "vgg": 16}


# The reference graph: torchvision's `features`, entry by entry, on [c, y, x] in float64.


def vgg_modules() -> list[tuple]:
    plan = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
    return [m for n in plan for m in ([("pool", 2, False)] if n == "M" else [("conv", 1, 1), ("relu",)])]


MODULES = {
    "squeeze": [
        *[("conv", 2, 0), ("relu",), ("pool", 3, True), ("fire",), ("fire",), ("pool", 3, True), ("fire",), ("fire",)],
        *[("pool", 3, True), ("fire",), ("fire",), ("fire",), ("fire",)],
    ],
    "alex": [
        *[("conv", 4, 2), ("relu",), ("pool", 3, False), ("conv", 1, 2), ("relu",), ("pool", 3, False)],
        *[("conv", 1, 1), ("relu",), ("conv", 1, 1), ("relu",), ("conv", 1, 1), ("relu",), ("pool", 3, False)],
    ],
    "vgg": vgg_modules(),
}
TAPS = {"squeeze": (1, 4, 7, 9, 10, 11, 12), "alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}


def conv(x: np.ndarray, weights: dict[str, np.ndarray], key: str, stride: int, margin: int) -> np.ndarray:
    kernel = weights[f"{key}.weight"].astype(np.float64)
    padded = np.pad(x, ((0, 0), (margin, margin), (margin, margin)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[2:], (1, 2))[:, ::stride, ::stride]
    return np.tensordot(kernel, windows, ((1, 2, 3), (0, 3, 4))) + weights[f"{key}.bias"][:, None, None]


def pool(x: np.ndarray, size: int, partial: bool) -> np.ndarray:
    if partial:  # a window may begin inside and end beyond
        x = np.pad(x, ((0, 0), (0, 1), (0, 1)), constant_values=-np.inf)
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), (1, 2))[:, ::2, ::2].max((-2, -1))


def taps(backbone: str, weights: dict[str, np.ndarray], image: np.ndarray) -> list[np.ndarray]:
    x = (2.0 * image[:, ::-1] - 1 - np.array([[[-0.030]], [[-0.088]], [[-0.188]]])) / [[[0.458]], [[0.448]], [[0.450]]]
    found = []
    for k, (kind, *how) in enumerate(MODULES[backbone][: TAPS[backbone][-1] + 1]):
        if kind == "conv":
            x = conv(x, weights, f"features.{k}", *how)
        elif kind == "relu":
            x = x.clip(0)
        elif kind == "pool":
            x = pool(x, *how)
        else:
            few = conv(x, weights, f"features.{k}.squeeze", 1, 0).clip(0)
            sides = [conv(few, weights, f"features.{k}.expand{n}x{n}", 1, n // 2) for n in (1, 3)]
            x = np.concatenate(sides).clip(0)
        if k in TAPS[backbone]:
            found.append(x)
    return found


def expected_lpips(backbone: str, weights: dict[str, np.ndarray], a: np.ndarray, b: np.ndarray) -> float:
    total = 0.0
    for k, pair in enumerate(zip(taps(backbone, weights, a), taps(backbone, weights, b), strict=True)):
        unit_a, unit_b = (f / (np.linalg.norm(f, axis=0) + 1e-10) for f in pair)
        total += np.einsum("c,cyx->yx", weights[f"lin{k}"], (unit_a - unit_b) ** 2).mean()
    return total


def random_weights(backbone: str) -> dict[str, np.ndarray]:
    """Weights that keep features at about one, kernels in half precision."""
    rng = np.random.default_rng(7)
    weights = {}
    for key, shape in weight_shapes(backbone).items():  # pyright: ignore[reportArgumentType]
        if key.endswith("weight"):
            spread = np.float32(np.sqrt(2 / np.prod(shape[1:])))
            weights[key] = (spread * rng.standard_normal(shape, np.float32)).astype(np.float16)
        elif key.endswith("bias"):
            weights[key] = 0.1 * rng.standard_normal(shape, np.float32)
        else:
            weights[key] = rng.uniform(0, 2 / shape[0], shape).astype(np.float32)
    return weights


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, tuple[Lpips, dict[str, np.ndarray]]]:
    """Every backbone with random weights, read from a file."""
    found = {}
    for backbone in BACKBONES:
        path = tmp_path_factory.mktemp("weights") / f"{backbone}.npz"
        weights = random_weights(backbone)
        np.savez(path, allow_pickle=False, **weights, **{"classifier.1.weight": np.ones(3)})
        found[backbone] = read_lpips([path]), weights
    return found


def assert_same_weights(a: Lpips, b: Lpips) -> None:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    assert all(np.array_equal(*pair) for pair in pairs)
    assert a.backbone == b.backbone


def pictures(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture and a noisy one like it."""
    a = gaussian_filter(rng.uniform(0, 1, shape), (0, 0, 2, 2))
    a = (a - a.min()) / np.ptp(a)
    b = a + 0.1 * rng.standard_normal(shape)
    return a.astype(np.float32), b.clip(0, 1).astype(np.float32)


@pytest.mark.parametrize(
    ("backbone", "side"),
    [*(pytest.param(name, SIDE, marks=pytest.mark.slow) for name in BACKBONES), ("squeeze", (25, 36))],
)
def test_is_the_reference_graph(made, rng, backbone: str, side: tuple[int, int]):
    model, weights = made[backbone]
    a, b = pictures(rng, (2, 3, *side))
    expected = [expected_lpips(backbone, weights, *pair) for pair in zip(a, b, strict=True)]
    # Sums of up to 4608 products in float32, through at most 13 layers.
    np.testing.assert_allclose(lpips(model, a, b), expected, rtol=1e-4)
    assert min(expected) > 1e-3


def test_float32_weights_are_what_was_in_the_file(made):
    for model, weights in made.values():
        first = weights["features.0.weight"].astype(np.float32)
        np.testing.assert_array_equal(model.kernels["0"], first.transpose(2, 3, 1, 0))
        assert {leaf.dtype for leaf in jax.tree.leaves(model)} == {jnp.dtype("float32")}
        assert len(model.digest) == 64


@pytest.mark.parametrize("backbone", BACKBONES)
def test_least_size(made, backbone: str):
    model, _ = made[backbone]
    least = model.least_px
    assert (least, model.name) == (LEAST[backbone], f"lpips_{backbone}")
    enough, short = (jax.ShapeDtypeStruct((1, 3, least, side), jnp.float32) for side in (least, least - 1))
    # A tap without places would have no mean.
    layers = eqx.filter_eval_shape(perceptual._taps, model, enough, enough)
    assert all(layer.size > 0 for layer in layers)
    assert len(layers) == len(model.heads)
    with pytest.raises(ValueError, match=f"at least {least} x {least} pixels"):
        eqx.filter_eval_shape(model, short, short)


def test_unlike_pictures_are_refused(made):
    model, _ = made["squeeze"]
    for other in ((1, 3, 20, 21), (1, 1, 20, 20), (2, 3, 20, 20)):
        with pytest.raises(ValueError, match="one shape"):
            model(jnp.zeros((1, 3, 20, 20)), jnp.zeros(other))
    with pytest.raises(ValueError, match="1 or 3 colours"):
        model(jnp.zeros((1, 2, 20, 20)), jnp.zeros((1, 2, 20, 20)))


@pytest.mark.slow
def test_equal_pictures_are_at_no_distance(made, rng):
    a, b = pictures(rng, (2, 3, *SIDE))
    for distance in (*(partial(lpips, made[name][0]) for name in ("squeeze", "alex")), quick_jit(MsSsim())):
        assert np.abs(distance(a, a)).max() < 1e-6  # the mean of ones rounds
        there, back = distance(a, b), distance(b, a)
        assert there.min() > 1e-3
        np.testing.assert_allclose(there, back, rtol=1e-5)
    np.testing.assert_allclose(quick_jit(MsSsim())(a, b), 1 - ms_ssim(a, b), atol=1e-6)


def test_one_colour_stands_for_three(made, rng):
    a, b = pictures(rng, (2, 1, *SIDE))
    model, _ = made["squeeze"]
    grey = lpips(model, np.repeat(a, 3, 1), np.repeat(b, 3, 1))
    np.testing.assert_allclose(lpips(model, a, b), grey, rtol=1e-5)


@pytest.mark.slow
def test_the_map_says_where(made, rng):
    """A change at low rows and high columns; the map's mean is the distance but for the edges of enlarged maps."""
    a, _ = pictures(rng, (1, 3, 96, 96))
    b = a.copy()
    b[:, :, 8:24, 64:88] = rng.uniform(0, 1, (3, 16, 24))
    model, _ = made["squeeze"]
    where = np.asarray(lpips_map(model, a, b))
    assert where.shape == (1, 96, 96)
    y, x = np.unravel_index(where[0].argmax(), (96, 96))
    # Within the changed place, give or take the 16 pixels of the deepest map.
    assert 0 <= y < 40
    assert 48 <= x < 96
    assert where.mean() == pytest.approx(float(lpips(model, a, b)[0]), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alex", "ms_ssim"])
def test_gradients_are_finite_differences(made, rng, name: str):
    """In double precision, so that a step may be small enough to cross hardly any kink."""
    a, b = pictures(rng, (1, 3, *SIDE))
    toward = rng.standard_normal(a.shape)
    with jax.enable_x64(True):
        model = MsSsim() if name == "ms_ssim" else made[name][0]
        model = jax.tree.map(lambda w: jnp.asarray(w, jnp.float64), model)

        @quick_jit
        def distance(model, steps):
            return jax.value_and_grad(lambda s: model(a + s[0] * toward, b + s[1] * toward)[0])(steps)

        _, slopes = distance(model, jnp.zeros(2))
        for step, slope in zip(1e-6 * np.eye(2), slopes, strict=True):
            ends = [float(distance(model, jnp.asarray(sign * step))[0]) for sign in (1, -1)]
            # Of some 1e5 ReLUs and maxima a few lie within the step and change the slope by their share.
            assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3)
            assert abs(slope) > 1e-5  # a difference resolves 1e-10


@pytest.mark.slow
def test_gradients_are_finite_where_nothing_is_seen(made):
    """All features zero, equal pictures, black and white, inverted structure: no place for 0/0."""
    seeing, _ = made["squeeze"]
    blind = eqx.tree_at(lambda m: m.biases, seeing, jax.tree.map(lambda bias: bias - 1e3, seeing.biases))
    checks = (np.indices(SIDE).sum(0) % 2 * np.ones((1, 3, 1, 1))).astype(np.float32)
    black, white = np.zeros_like(checks), np.ones_like(checks)
    slope = quick_jit(lambda model, a, b: jax.value_and_grad(lambda a: model(a, b).sum())(a))
    for model in (seeing, blind, MsSsim()):
        for pair in ((black, black), (black, white), (white, checks), (checks, checks), (checks, 1 - checks)):
            value, gradient = slope(model, *pair)
            assert np.isfinite(gradient).all(), model
            assert (model is blind) <= (value == 0)


def expected_ms_ssim(a: np.ndarray, b: np.ndarray, exponents: list[float]) -> float:
    """One colour, in float64, by scipy's Gaussian filter."""

    def blurred(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, 1.5, truncate=3.5)[5:-5, 5:-5]

    result, a, b = 1.0, a.astype(np.float64), b.astype(np.float64)
    for k, exponent in enumerate(exponents):
        mean_a, mean_b = blurred(a), blurred(b)
        covariance = blurred(a * b) - mean_a * mean_b
        contrast = (2 * covariance + 9e-4) / (blurred(a * a) - mean_a**2 + blurred(b * b) - mean_b**2 + 9e-4)
        if k == len(exponents) - 1:
            contrast *= (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
        result *= max(contrast.mean(), 1e-3) ** (exponent / sum(exponents))
        y, x = (n // 2 for n in a.shape)
        a, b = (v[: 2 * y, : 2 * x].reshape(y, 2, x, 2).mean((1, 3)) for v in (a, b))
    return result


@pytest.mark.parametrize(("side", "scales"), [((11, 30), 1), ((22, 25), 2), ((175, 180), 4), ((176, 201), 5)])
def test_ms_ssim(rng, side: tuple[int, int], scales: int):
    exponents = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333][:scales]
    a, b = pictures(rng, (2, 3, *side))
    expected = [np.mean([expected_ms_ssim(p, q, exponents) for p, q in zip(*pair, strict=True)]) for pair in zip(a, b)]  # noqa: B905
    np.testing.assert_allclose(ms_ssim(a, b), expected, rtol=1e-4)  # variances are small differences in float32
    with pytest.raises(ValueError, match="at least 11 x 11"):
        similarity.ms_ssim(a[..., :10, :], b[..., :10, :])


def test_ms_ssim_of_inverted_structure_is_its_floor(rng):
    """Contrast terms near -1 count as 0.001, at every scale."""
    a, _ = pictures(rng, (1, 1, 40, 40))
    assert float(ms_ssim(a, 1 - a)[0]) == pytest.approx(1e-3, rel=1e-4)


needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data/lpips_squeeze")


@needs_data
def test_published_values():
    model = read_lpips([DATA / "squeezenet1_1_features_fp16.npz", DATA / "lpips_v0.1_lin_squeeze.npz"])
    assert model.name == "lpips_squeeze"
    expected = json.loads((DATA / "expected.json").read_text("utf-8"))
    with np.load(DATA / "torchmetrics_doctest_pair.npz", allow_pickle=False) as archive:
        a, b = ((archive[key][:, :, ::-1] + 1) / 2 for key in ("img1", "img2"))
    # The same weights in another library's float32.
    np.testing.assert_allclose(lpips(model, a, b), expected["torchmetrics_doctest_pair"]["total"], atol=1e-5)
    np.testing.assert_allclose(lpips(model, a, b), [0.1024, 0.0938], atol=1e-3)  # as published
    ref, *others = (
        np.asarray(Image.open(DATA / f"ex_{name}.png").convert("RGB"), np.float32)[::-1].transpose(2, 0, 1)[None] / 255
        for name in ("ref", "p0", "p1")
    )
    for name, other in zip(("p0", "p1"), others, strict=True):
        np.testing.assert_allclose(lpips(model, ref, other), expected[f"ex_ref_vs_ex_{name}"]["total"], atol=1e-5)


@needs_data
@pytest.mark.parametrize("backbone", BACKBONES)
def test_heads_as_published_have_the_shapes_we_ask_for(backbone):
    with np.load(DATA / f"lpips_v0.1_lin_{backbone}.npz", allow_pickle=False) as archive:
        shapes = {key: archive[key].shape for key in archive.files}
    assert shapes == {key: shape for key, shape in weight_shapes(backbone).items() if key.startswith("lin")}


@pytest.fixture
def spoilt(made, tmp_path: Path):
    """Write squeeze's weights with some exchanged (None leaves one out)."""

    def write(**exchanged) -> Path:
        weights = {**made["squeeze"][1], **exchanged}
        np.savez(tmp_path / "w.npz", **{key: value for key, value in weights.items() if value is not None})
        return tmp_path / "w.npz"

    return write


FIRST, HEAD = "features.0.weight", "lin3"


@pytest.mark.parametrize(
    ("exchanged", "message"),
    [
        ({FIRST: None}, f"all weights of the squeeze backbone .* no {FIRST}\\."),
        ({HEAD: None, "lin6": None}, f"no {HEAD} and 1 more"),
        (
            {FIRST: np.zeros((64, 3, 7, 7), np.float32)},
            r"must be floats \(64, 3, 3, 3\), but got float32 \(64, 3, 7, 7\)",
        ),
        ({HEAD: np.zeros(384, np.int64)}, r"must be floats \(384,\), but got int64"),
        ({HEAD: np.full(384, np.nan, np.float32)}, f"{HEAD} must be finite"),
        ({HEAD: np.full(384, 1e60)}, f"{HEAD} must be finite in float32"),
        ({HEAD: np.array([None] * 384)}, "must be a whole .npz file of numbers"),
    ],
)
def test_spoilt_weights_are_told(spoilt, exchanged, message):
    with pytest.raises(InputError, match=message) as told:
        read_lpips([spoilt(**exchanged)])
    assert "w.npz" in told.value.where


def test_files_that_are_none(spoilt, tmp_path: Path):
    whole = spoilt().read_bytes()
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "bent.npz").write_bytes(whole[:5000] + b"\0" * 99 + whole[5099:])
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "words.npz").write_text("no weights")
    for name in ("array.npy", "half.npz", "bent.npz", "empty.npz", "words.npz"):
        with pytest.raises(InputError, match=r"must be a whole \.npz file of numbers"):
            read_lpips([tmp_path / name])
    with pytest.raises(InputError, match="must exist"):
        read_lpips([tmp_path / "gone.npz"])
    with pytest.raises(InputError, match="must be a file"):
        read_lpips([tmp_path])
    with pytest.raises(InputError, match="must hold a backbone"):
        read_lpips([tmp_path / "other.npz"])
    with pytest.raises(InputError, match="no file: must hold a backbone"):
        read_lpips([])


def test_backbone_and_heads_in_two_files(made, tmp_path: Path):
    model, weights = made["squeeze"]
    paths = tmp_path / "features.npz", tmp_path / "heads.npz"
    for path, head in zip(paths, (False, True), strict=True):
        np.savez(path, **{key: value for key, value in weights.items() if key.startswith("lin") == head})
    joined = read_lpips(paths)
    assert_same_weights(joined, model)
    assert joined.digest == read_lpips(paths[::-1]).digest
    assert len(joined.digest.split("+")) == 2
    with pytest.raises(InputError, match="one file only, but got lin0 once more"):
        read_lpips([*paths, paths[1]])


def state_dicts(weights: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """As torchvision and the authors' package have them, with all that is not wanted."""
    backbone = {key: value for key, value in weights.items() if key.startswith("features")}
    heads = {key: value[None, :, None, None] for key, value in weights.items() if key.startswith("lin")}
    named = {f"{key}.model.1.weight": value for key, value in heads.items()}
    again = {f"lins.{key[3:]}.model.1.weight": value for key, value in heads.items()}
    random = {"net.slice1.0.weight": np.zeros((64, 3, 3, 3)), "scaling_layer.shift": np.zeros((1, 3, 1, 1))}
    return {**backbone, "classifier.1.weight": np.ones((1000, 512, 1, 1))}, {**random, **named, **again}


def test_conversion_takes_what_is_needed(made):
    for _, weights in made.values():
        found = weights_of(*state_dicts(weights))
        assert list(found) == list(weights)
        for key, value in found.items():
            assert value.dtype == np.float32
            np.testing.assert_array_equal(value, weights[key].astype(np.float32))
    with pytest.raises(InputError, match=r"the state dicts: must hold all weights .* no lin0 and 4 more"):
        weights_of(state_dicts(made["vgg"][1])[0], {})


def test_the_converter_writes_a_file_that_is_read(made, tmp_path: Path, monkeypatch, capsys):
    model, weights = made["squeeze"]
    features, heads = (SimpleNamespace(state_dict=lambda state=state: state) for state in state_dicts(weights))
    models = SimpleNamespace(squeezenet1_1=lambda weights: features)
    monkeypatch.setitem(sys.modules, "torchvision", SimpleNamespace(models=models))
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=lambda **_: heads))
    path = tmp_path / "new" / "squeeze.npz"
    assert convert_lpips.main(["squeeze", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    read = read_lpips([path])
    assert_same_weights(read, model)
    first = path.read_bytes()
    convert_lpips.main(["squeeze", str(path)])
    assert path.read_bytes() == first


def test_the_converter_says_what_is_not_installed(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert exit_code(lambda: convert_lpips.main(["vgg", str(tmp_path / "x.npz")])) == 2
    assert "pip install lpips torch torchvision" in capsys.readouterr().err
    assert not (tmp_path / "x.npz").exists()
