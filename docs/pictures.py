"""The pictures of the documentation, drawn by the package itself.

    python docs/pictures.py FOLDER [NAME ...]

draws some of them, or all. For the site a picture is drawn again when this file, an example or a file of the package
has changed, and taken from `build/pictures` otherwise. All are small designs, so that the whole takes a minute or two.
"""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from scipy.ndimage import maximum_filter, shift

import doedesign as dd
import fab
import sim
from doedesign.templates import template_text
from fab.figure import HEIGHTS, INK, LIGHT, SERIES, bare, panels, save
from fab.levels import planes
from sim.rigorous.comparison import compare_row, thin_amplitudes

ROOT = Path(__file__).parents[1]
_CODE = ("doedesign", "sim", "fab", "examples", "docs")
_WIDEST = 1600  # pixels
NM, UM = 1e-9, 1e-6
GREEN_M = 552 * NM


def draw_all(folder: Path) -> dict[str, Path]:
    """Draw every picture that is not there yet, every group in a process of its own.

    Args:
        folder: where pictures are kept, under the digest of the code that drew them.

    Returns:
        the file of every picture, by its name.
    """
    kept = folder / digest()
    kept.mkdir(parents=True, exist_ok=True)
    found = {name: kept / f"{name}.png" for group in GROUPS for name in group}
    missing = [[name for name in group if not found[name].is_file()] for group in GROUPS]
    running = [subprocess.Popen([sys.executable, __file__, str(kept), *names]) for names in missing if names]
    if any([one.wait() for one in running]):
        raise RuntimeError("a picture of the documentation could not be drawn")
    return found


def draw_group(names: list[str], folder: Path) -> None:
    """Draw some pictures, each of which appears whole.

    Args:
        names: of the pictures.
        folder: where they go.
    """
    for name in names:
        fresh = folder / f".{name}.png"
        next(group for group in GROUPS if name in group)[name](fresh)
        fresh.rename(folder / f"{name}.png")


def digest() -> str:
    """Digest of all that pictures depend on."""
    found = hashlib.sha256()
    for path in sorted(path for part in _CODE for path in (ROOT / part).rglob("*") if path.suffix in (".py", ".toml")):
        found.update(path.relative_to(ROOT).as_posix().encode())
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def of_template(name: str, picture: str, *overrides: str) -> Callable[[Path], None]:
    """Return a function that draws a picture of a template's run.

    Args:
        name: of the template.
        picture: name of the file that its run has.
        overrides: changes to the template, "table.key=value".
    """

    def draw(path: Path) -> None:
        with TemporaryDirectory() as folder:
            spec = Path(folder) / f"{name}.toml"
            spec.write_text(template_text(name))
            dd.optimize(spec, Path(folder) / "run", overrides=overrides)
            _keep(Path(folder) / "run" / picture, path)

    return draw


@cache
def quick() -> dd.Design:
    """The quick example."""
    return dd.optimize(dd.load_spec(ROOT / "examples" / "quick.toml"))


def level_map(path: Path) -> None:
    """Level map of the quick example."""
    save(quick().plot(), path)
    _keep(path, path)


def see_through(path: Path) -> None:
    """PSFs of the quick example, near and far."""
    design = quick()
    bank = sim.psf(design, depths=[design.near_m[0], design.far_m[-1]])
    save(bank.plot(), path)
    _keep(path, path)


def classic(path: Path) -> None:
    """Light behind three plates without an optimiser."""
    with panels(None, (8.3, 3.2), "Light behind classic plates") as figure:
        for axes, name in zip(figure.subplots(1, 3), ("vortex", "axicon", "lens_array"), strict=True):
            with TemporaryDirectory() as folder:
                spec = Path(folder) / f"{name}.toml"
                spec.write_text(template_text(name))
                cells = {} if name == "lens_array" else {"doe__samples": 500, "doe__aperture": "1 mm"}
                design = dd.optimize(dd.load_spec(spec, **cells))
            light = np.asarray(sim.psf(design).energy[0, 0])
            if name != "lens_array":
                cut = len(light) // 3
                light = light[cut : len(light) - cut, cut : len(light) - cut]
            axes.imshow(np.sqrt(np.maximum(light, 0.0)), cmap=LIGHT, origin="lower")
            axes.set_title(name)
            bare(axes)
    save(figure, path)


def pixels(path: Path) -> None:
    """The light of a far source, as pixels add it up, and as it is at their middles."""
    design, inner, fine = quick(), 24, 9
    camera = replace(design.camera, colours=design.camera.colours[1:2], window=inner)
    far = design.far_m[-1:]
    whole = np.asarray(sim.psf(design, camera, far).energy[0, 0])
    dense = replace(camera, pixel_m=camera.pixel_m / fine, window=inner * fine)
    points = np.asarray(sim.psf(design, dense, far).energy[0, 0])
    sampled = points[fine // 2 :: fine, fine // 2 :: fine] * fine**2
    off = np.linalg.norm(sampled / sampled.sum() - whole / whole.sum()) / np.linalg.norm(whole / whole.sum())
    shown = (
        (points * fine**2, "light on the sensor"),
        (whole, "added up over pixels"),
        (sampled, "at the middle of each pixel"),
    )
    title = f"A far source: samples at points are off by {off:.0%} of the pixels' light"
    with panels(None, (8.3, 3.2), title) as figure:
        for axes, (light, words) in zip(figure.subplots(1, 3), shown, strict=True):
            axes.imshow(np.sqrt(light), cmap=LIGHT, origin="lower", vmax=np.sqrt(sampled.max()))
            axes.set_title(words)
            bare(axes)
    save(figure, path)


def edges(path: Path) -> None:
    """A blazed grating and a random row: thin, with the light of walls, and rigorous."""
    index = float(sim.refractive_index("fused_silica", GREEN_M))
    step, cell = 75 * NM, 1.85 * UM
    blazed = np.arange(4) * 4 * step
    rough = np.random.default_rng(1).integers(0, 4, 16) * 4 * step
    title = "Orders of two rows of cells, 1.85 µm wide, 552 nm, TE"
    with panels(None, (8.3, 3.4), title) as figure:
        for axes, heights, words in zip(
            figure.subplots(1, 2, width_ratios=(1, 3)),
            (blazed, rough),
            ("blazed, 4 cells", "16 random cells"),
            strict=True,
        ):
            found = compare_row(heights, cell, GREEN_M, index)
            places = np.asarray(found.number, float)
            series = (
                (found.scalar, f"thin element, off by {found.error(found.scalar)[0]:.1%}", SERIES[1]),
                (found.edges[0], f"with walls, {found.error(found.edges)[0]:.1%}", SERIES[0]),
                (found.rigorous[0], "Maxwell", INK),
            )
            for n, (orders, label, hue) in enumerate(series):
                axes.bar(places + (n - 1) * 0.28, 100 * orders, 0.28, color=hue, label=label)
            axes.set_title(words)
            axes.set_xlabel("order")
            axes.set_ylabel("light (%)")
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.set_ylim(top=130 * max(found.scalar.max(), found.rigorous[0].max()))
            axes.legend()
    save(figure, path)


def fabricated(path: Path) -> None:
    """A patch as drawn and with displaced, widened masks, and the near light of both plates."""
    design, cells, fine = quick(), 14, 16
    first = design.level_map.shape[0] // 2
    patch = design.level_map.level[first : first + cells, first : first + cells]
    drawn = _depths(patch, design.levels, fine)
    rng = np.random.default_rng(3)
    moved = _depths(patch, design.levels, fine, rng.normal(0, 0.35, (design.levels.bits, 2)), wider=0.08)
    plate = design.fabricated("contact_aligner", seed=0)
    camera, near = replace(design.camera, colours=design.camera.colours[1:2]), design.near_m[:1]
    both = [np.asarray(sim.psf(one, camera, near).energy[0, 0]) for one in (design, plate)]
    title = "As drawn, and as it comes back"
    with panels(None, (8.3, 2.7), title) as figure:
        axes = figure.subplots(1, 4)
        for one, heights, words in (
            (axes[0], drawn, "14 x 14 cells, drawn"),
            (axes[1], moved, "masks off, edges wider"),
        ):
            one.imshow(heights, cmap=HEIGHTS, origin="lower")
            one.set_title(words)
        for one, light, words in ((axes[2], both[0], "near light, drawn"), (axes[3], both[1], "near light, one plate")):
            one.imshow(np.sqrt(light), cmap=LIGHT, origin="lower", vmax=np.sqrt(np.quantile(both[0], 0.9995)))
            one.set_title(words)
        for one in axes:
            bare(one)
    save(figure, path)


def _depths(
    level: np.ndarray, levels: fab.Levels, fine: int, places: np.ndarray | None = None, wider: float = 0.0
) -> np.ndarray:
    """Heights of a patch on `fine` samples per cell, every mask moved (y, x) and its openings grown, in cells."""
    height = np.zeros([side * fine for side in level.shape])
    for k, mask in enumerate(planes(level, levels)):
        opening = np.kron(np.asarray(mask, float), np.ones((fine, fine)))
        opening = maximum_filter(opening, 2 * round(wider * fine) + 1)
        if places is not None:
            opening = shift(opening, places[k] * fine, order=0, mode="nearest")
        height -= opening * levels.depths_m[k] if levels.depths_m else opening * 2**k * levels.step_m
    return height


def occlusion(path: Path) -> None:
    """Light past a bar, by four models and by wave optics, for the quick example."""
    sys.path.insert(0, str(ROOT / "examples"))
    import compare_occlusion

    design = quick()
    camera = replace(design.camera, window=design.camera.window - 1, colours=design.camera.colours[1:2])
    rows = compare_occlusion.compare(
        camera, design.height_m, min(design.near_m), max(design.far_m), line_px=16, middle_px=64
    )
    compare_occlusion.draw(path, rows, "quick example")


def quantisation(path: Path) -> None:
    """A blazed grating by its number of levels."""
    cells, height_m = 48, GREEN_M / (float(sim.refractive_index("fused_silica", GREEN_M)) - 1)
    index = float(sim.refractive_index("fused_silica", GREEN_M))
    counts = (2, 3, 4, 6, 8, 16)
    shares = []
    with panels(None, (8.3, 3.0), "One wave of height in L steps, and the light of the order that is wanted") as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.4))
        for count, hue in zip(counts, SERIES, strict=True):
            stairs = np.floor(np.arange(cells) * count / cells) / count * height_m
            _, amplitude = thin_amplitudes(stairs, 4 * UM, GREEN_M, index)
            shares.append(float(np.max(np.abs(amplitude) ** 2)))
            if count in (2, 4, 16):
                left.step(
                    np.arange(cells + 1) / cells,
                    np.append(stairs, stairs[-1]) / UM,
                    where="post",
                    color=hue,
                    label=f"{count} levels",
                )
        left.set_xlabel("place over period")
        left.set_ylabel("height (µm)")
        left.legend()
        bars = right.bar(
            [str(count) for count in counts], [100 * share for share in shares], color=SERIES[: len(counts)]
        )
        right.bar_label(bars, [f"{100 * share:.1f}" for share in shares])
        right.set_xlabel("levels")
        right.set_ylabel("light in the order (%)")
        right.set_ylim(0, 112)
    save(figure, path)


def _keep(drawn: Path, path: Path) -> None:
    """A picture with fewer pixels and at most 256 colours, small enough for a page."""
    with Image.open(drawn) as picture:
        small = picture.convert("RGB")
    small.thumbnail((_WIDEST, _WIDEST))
    small.quantize(256).save(path, optimize=True)


# Pictures of one group may share a design.
GROUPS: tuple[dict[str, Callable[[Path], None]], ...] = (
    {
        "quick": level_map,
        "see-through": see_through,
        "pixels": pixels,
        "as-fabricated": fabricated,
        "occlusion": occlusion,
        "edges": edges,
    },
    {
        "splitter": of_template("splitter", "orders.png"),
        "diffuser": of_template("diffuser", "area.png", "optimize.steps=100"),
        "bifocal": of_template("bifocal", "focus.png"),
        "classic": classic,
        "quantisation": quantisation,
    },
)


if __name__ == "__main__":
    draw_group(sys.argv[2:] or [name for group in GROUPS for name in group], Path(sys.argv[1]))
