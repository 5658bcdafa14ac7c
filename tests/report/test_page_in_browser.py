"""The page in a real browser: all that moves, with mouse and keyboard, in light and dark, on a phone and on paper."""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.report.page.blocks import (
    Bar,
    BarBlock,
    ChartBlock,
    ChartSeries,
    DividerBlock,
    ModelBlock,
    PageContent,
    PictureBlock,
    TableBlock,
    TextBlock,
    section,
)
from doedesign.report.page.files import packed, pixels_image
from doedesign.report.page.maps import difference_block, height_block, map_block
from doedesign.report.page.psfs import compared_psfs, psf_block
from doedesign.report.page.render import render
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.rules.check import Rules, check
from fab.solids.meshfile import Mesh, write_glb
from sim.store import StoredBank
from tests.report.browser import chromium, needs_chromium, until, violations, visit

pytestmark = needs_chromium

# More than one tile along both sides, so that there are reduced copies; rows of another number than columns.
SHAPE = (560, 700)
PITCH_M = 1e-6


def level_map(seed: int) -> LevelMap:
    level = np.random.default_rng(seed).integers(0, 4, (SHAPE[0] // 4, SHAPE[1] // 4), np.uint8)
    grid = Grid(SHAPE, PITCH_M)
    return LevelMap(level.repeat(4, axis=0).repeat(4, axis=1), Levels(4, 1e-7), grid, 550e-6, f"map {seed}")


def bank(seed: int) -> StoredBank:
    energy = np.random.default_rng(seed).random((2, 3, 300, 300)).astype(np.float32) ** 4
    return StoredBank(energy / energy.sum(), ("red", "blue"), (0.01, 0.1, np.inf), 2e-6, (0.0, 0.0), False)


def scene(shade: int) -> str:
    return pixels_image(np.full((60, 80, 3), shade, np.uint8), photo=True).source


def model(folder: Path) -> ModelBlock:
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]) * 1e-4
    mesh = Mesh(corners, np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], np.int32), "a tetrahedron")
    write_glb(folder / "small.glb", mesh)
    return ModelBlock("Plate", "small.glb", packed((folder / "small.glb").read_bytes()), 2, "A tetrahedron.")


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A page with every kind of block, and one that compares."""
    folder = tmp_path_factory.mktemp("pages")
    first, other = level_map(1), level_map(2)
    rules = check(first, Rules(9e-6, 9e-6)).as_record()
    steps = tuple(map(float, range(1, 30)))
    chart = ChartBlock("Loss", "step", "loss", steps, (ChartSeries("loss", tuple(1 / k for k in steps)),))
    lines = (ChartSeries("red", (0.3, None)), ChartSeries("blue", (0.2, 0.4), True))
    depths = ChartBlock("Depths", "depth (mm)", "far spot", (6.0, 600.0), lines, x_log=True, markers=True)
    counts = ChartBlock(
        "Plates", "loss", "plates", (0.0, 1.0, 2.0), (ChartSeries("plates", (3.0, 5.0, None)),), steps=True
    )
    scenes = (("one", (("before", scene(40)), ("after", scene(200)))),
              ("two", (("before", scene(90)), ("after", scene(120)), ("truth", scene(250)))))  # fmt: skip
    picture = PictureBlock("Picture", "a white picture", pixels_image(np.full((40, 60), 255, np.uint8), photo=False))
    bars = (
        Bar("reached", 0.8, "80 %", 1.0, 0.7, 0.9, 0.85, "ceiling 85 %", "missed"),
        Bar("0th order", 0.02, "2 %", 1.0),
    )
    banks = [("as drawn", bank(1)), ("as fabricated", bank(2))]
    sections = [
        section("reached", "Reached", [BarBlock("Bars", bars, "A note.")]),
        section("maps", "Maps", [map_block(first, rules)]),
        section("light", "Light", [psf_block(banks), chart, depths, counts]),
        section("order", "Order", [model(folder), picture, DividerBlock("Before and after", scenes)]),
        section("rest", "Rest", [TableBlock("Table", ("a", "b"), (("1", "2"),)),
                                 TableBlock("Folded", ("", ""), (("c", "d"),), folded=True),
                                 TextBlock(("x = 1", "y = 2"), preformatted=True, title="Text")]),
    ]  # fmt: skip
    content = PageContent("every kind", (), tuple(one for one in sections if one), (("relief", "550 µm"),))
    compared = [
        section("maps", "Heights", [height_block("a", first), height_block("b", other),
                                    difference_block("b less a", first, other)]),
        section("light", "Light", [compared_psfs([("a", bank(1)), ("b", bank(2))])]),
    ]  # fmt: skip
    (folder / "page.html").write_bytes(render(content))
    (folder / "compared.html").write_bytes(
        render(PageContent("a and b", ("Differences are to the first.",), tuple(one for one in compared if one)))
    )
    return folder / "page.html", folder / "compared.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def bounds(page: Any, number: int = 0) -> list[float]:
    """What a map shows: left, top, width and height in shares of its width."""
    script = """number => { const b = document.querySelectorAll("[data-map]")[number].viewer.viewport.getBounds(true);
        return [b.x, b.y, b.width, b.height]; }"""
    return page.evaluate(script, number)


def pixel(page: Any, selector: str, x: float, y: float) -> list[int]:
    """Colour of a canvas at a share of its width and height."""
    script = """([selector, x, y]) => { const c = document.querySelector(selector);
        return [...c.getContext("2d").getImageData(Math.floor(x * c.width), Math.floor(y * c.height), 1, 1).data]; }"""
    return page.evaluate(script, [selector, x, y])


def test_nothing_is_asked_for_and_nothing_goes_wrong(browser: Any, paths: tuple[Path, Path]):
    for path in paths:
        seen = visit(browser, path)
        seen.see_all()
        seen.page.wait_for_selector("[data-map][data-ready=yes]")
        for kind in ("map", "psf"):
            assert seen.page.locator(f"[data-{kind}]:not([data-ready])").count() == 0
        assert seen.page.locator(".chart:not(:has(canvas))").count() == 0
        seen.require_quiet()


@pytest.mark.slow
def test_a_map_is_shown_pixel_by_pixel(browser: Any, paths: tuple[Path, Path]):
    """At 16 screen dots per pixel, the colour in the middle of a pixel is that of its level."""
    seen = visit(browser, paths[0])
    page, first = seen.page, level_map(1)
    page.locator("[data-map]").scroll_into_view_if_needed()
    page.wait_for_selector("[data-map][data-ready=yes]")
    page.click("text=Single pixels")
    page.wait_for_timeout(1500)
    left, top, width, _ = bounds(page)
    assert width * SHAPE[1] < 100
    colours = page.evaluate("""() => { const root = document.querySelector("[data-map]");
        const text = JSON.parse(document.getElementById("data-" + root.dataset.map).textContent).views[0].colours;
        return [...atob(text)].slice(8, 8 + 12).map(c => c.charCodeAt(0)); }""")
    canvas = "[data-map] .openseadragon-canvas canvas"
    scale = page.evaluate(f"document.querySelector('{canvas}').width") / (width * SHAPE[1])
    size = page.evaluate(f"[document.querySelector('{canvas}').width, document.querySelector('{canvas}').height]")
    for dx, dy in ((5, 5), (-7, 3), (12, -9)):
        x, row = SHAPE[1] // 2 + dx, SHAPE[0] // 2 + dy
        at = ((x + 0.5 - left * SHAPE[1]) * scale / size[0], (row + 0.5 - top * SHAPE[1]) * scale / size[1])
        level = int(first.level[SHAPE[0] - 1 - row, x])
        assert pixel(page, canvas, *at)[:3] == colours[3 * level : 3 * level + 3]
    page.click("text=Whole map")
    page.wait_for_timeout(300)
    assert bounds(page)[2] > 1
    seen.require_quiet()


@pytest.mark.slow
def test_views_and_broken_rules(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page = seen.page
    page.locator("[data-map]").scroll_into_view_if_needed()
    page.wait_for_selector("[data-map][data-ready=yes]")
    every = page.locator(".place").count()
    assert every > 2
    page.select_option("[data-map] [data-part=view]", label="mask 1")
    until(page, f"document.querySelectorAll('.place').length < {every}")
    assert page.locator(".place").count() > 0
    assert "open, etched" in page.inner_text("[data-map] [data-part=legend]")
    page.click("text=Places that break a rule")
    last = page.locator("[data-place]").last
    last.click()  # of mask 2: the view changes, and the map goes there
    page.wait_for_selector(".place[aria-current=true]")
    assert page.locator("[data-map] [data-part=view] option:checked").inner_text() == "mask 2"
    assert "µm" in page.inner_text("[data-map] [data-part=reading]")
    page.wait_for_timeout(500)
    assert bounds(page)[2] < 0.3
    page.click("[data-map] [data-part=home]")
    page.locator(".place").first.focus()
    page.keyboard.press("Enter")
    page.wait_for_timeout(500)
    assert bounds(page)[2] < 0.3
    page.uncheck("[data-map] [data-part=marks]")
    assert page.locator(".place").count() == 0
    seen.require_quiet()


@pytest.mark.slow
def test_a_map_is_moved_by_keys_and_wheel(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page = seen.page
    page.locator("[data-map]").scroll_into_view_if_needed()
    page.wait_for_selector("[data-map][data-ready=yes]")
    page.locator("[data-map] [role=application]").focus()
    whole = bounds(page)
    page.keyboard.press("+")
    page.wait_for_timeout(400)
    near = bounds(page)
    assert near[2] < whole[2]
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(400)
    assert bounds(page)[0] > near[0]
    page.locator("[data-map] .viewer").hover()
    page.mouse.wheel(0, -400)
    page.wait_for_timeout(400)
    assert bounds(page)[2] < near[2]
    seen.require_quiet()


@pytest.mark.slow
def test_psfs_follow_their_sliders(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page, root = seen.page, "[data-psf]"
    page.locator(root).scroll_into_view_if_needed()
    page.wait_for_selector(f'{root}[data-ready="0;0,0,log,whole"]')
    page.locator(f"{root} [data-part=depth]").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.locator(f"{root} [data-part=colour]").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_selector(f'{root}[data-ready="0;2,1,log,whole"]')
    assert page.inner_text(f"{root} [data-part=depth-text]") == "∞"
    assert page.inner_text(f"{root} [data-part=colour-text]") == "blue"
    page.check(f"{root} [data-part=middle]")
    page.wait_for_selector(f'{root}[data-ready="0;2,1,log,middle"]')
    energy = bank(1).energy[1, 2][86:214, 86:214]  # 128 of 300 pixels
    y, x = (int(i) for i in np.unravel_index(energy.argmax(), energy.shape))
    assert page.evaluate(f"document.querySelector('{root} canvas').width") == 128
    bright = pixel(page, f"{root} canvas", (x + 0.5) / 128, (127 - y + 0.5) / 128)
    page.check(f"{root} [data-part=lin]")
    page.wait_for_selector(f'{root}[data-ready="0;2,1,lin,middle"]')
    faint = np.abs(energy / energy.max() - 0.1).argmin()
    y, x = (int(i) for i in np.unravel_index(faint, energy.shape))
    dark = pixel(page, f"{root} canvas", (x + 0.5) / 128, (127 - y + 0.5) / 128)
    assert sum(bright[:3]) > 500 > 300 > sum(dark[:3])
    page.select_option(f"{root} [data-part=bank]", label="as fabricated")
    page.wait_for_selector(f'{root}[data-ready="1;2,1,lin,middle"]')
    page.locator(f"{root} canvas").first.hover()
    assert "from the axis" in page.inner_text(f"{root} [data-part=reading]")
    seen.require_quiet()


def test_a_divider_is_dragged_and_typed(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page = seen.page
    box = page.locator(".divided")
    box.scroll_into_view_if_needed()
    until(page, "document.querySelector('.divided').style.getPropertyValue('--at') === '50%'")
    at = page.locator("[data-divider] [data-part=at]")
    at.focus()
    page.keyboard.press("ArrowRight")
    assert box.evaluate("e => e.style.getPropertyValue('--at')") == "51%"
    place = box.bounding_box()
    assert place is not None
    y = min(max(place["y"] + 20, 100), 800)  # in the window, below the list of sections
    page.mouse.move(place["x"] + place["width"] / 2, y)
    page.mouse.down()
    page.mouse.move(place["x"] + place["width"] / 4, y)
    page.mouse.up()
    assert at.input_value() == "25"
    page.select_option("[data-divider] [data-part=scene]", label="two")
    page.select_option("[data-divider] [data-part=right]", label="truth")
    assert page.locator("[data-part=over]").get_attribute("alt") == "truth"
    assert page.locator("[data-part=over]").get_attribute("src") == scene(250)
    seen.require_quiet()


@pytest.mark.slow
def test_linked_maps_and_differences(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[1])
    page = seen.page
    seen.see_all()
    until(page, "document.querySelectorAll('[data-map][data-ready=yes]').length === 3")
    page.locator("[data-map]").first.locator("[data-part=pixels]").click()
    page.wait_for_timeout(500)
    views = [bounds(page, number) for number in range(3)]
    assert views[0][2] < 0.3
    assert np.allclose(views, views[0], rtol=1e-3)
    assert "red: higher" in page.locator("[data-part=legend]").last.inner_text()
    page.wait_for_selector('[data-psf][data-ready="0,1,2;0,0,log,whole"]')
    signs = np.sign(bank(2).energy[0, 0].mean() - bank(1).energy[0, 0].mean())
    assert signs in (-1, 0, 1)
    colour = pixel(page, "canvas[data-bank='2']", 0.5, 0.5)
    assert max(colour[:3]) == 255  # white mixed with red or with blue
    page.locator("[data-psf] [data-part=depth]").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_selector('[data-psf][data-ready="0,1,2;1,0,log,whole"]')
    seen.require_quiet()


@pytest.mark.slow
def test_a_model_is_drawn_or_the_page_says_why_not(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page = seen.page
    page.click("[data-model] button")
    if page.evaluate("!!document.createElement('canvas').getContext('webgl2')"):
        page.wait_for_selector("[data-model][data-ready=yes]", state="attached")
        until(page, "document.activeElement.tagName === 'MODEL-VIEWER'")
    else:
        until(page, "document.querySelector('[data-model] [data-part=reading]').textContent.includes('WebGL')")
    seen.require_quiet()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_everybody_can_read_it(browser: Any, paths: tuple[Path, Path], scheme: str, width: int):
    for path in paths:
        seen = visit(browser, path, scheme=scheme, width=width)
        seen.see_all()
        seen.page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
        assert violations(seen.page) == []
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
        seen.require_quiet()


@pytest.mark.slow
def test_dark_pages_are_dark_and_charts_follow(browser: Any, paths: tuple[Path, Path]):
    seen = visit(browser, paths[0])
    page = seen.page
    page.locator(".chart").first.scroll_into_view_if_needed()
    page.wait_for_selector(".chart canvas")

    def look() -> tuple[str, str]:
        page_colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return page_colour, page.evaluate("document.querySelector('.chart canvas').toDataURL()")

    light = look()
    page.emulate_media(color_scheme="dark")
    page.wait_for_timeout(200)
    dark = look()
    assert light[0] == "rgb(246, 247, 249)"
    assert dark[0] == "rgb(20, 24, 28)"
    assert light[1] != dark[1]
    seen.require_quiet()


@pytest.mark.slow
def test_keys_reach_everything(browser: Any, paths: tuple[Path, Path]):
    """Every control that is shown takes the focus by Tab, in the order of the page."""
    seen = visit(browser, paths[0])
    page = seen.page
    seen.see_all()
    page.wait_for_selector("[data-map][data-ready=yes]")
    page.evaluate("window.scrollTo(0, 0)")
    page.evaluate("""() => { document.querySelectorAll('details').forEach(one => { one.open = true; });
        const all = [...document.querySelectorAll(
            'a[href], button, select, summary, input:not([disabled]), [tabindex="0"]')]
            .filter(one => one.checkVisibility());
        // Of radio buttons of one name, Tab stops at the chosen one.
        window.missing = new Set(all.filter(one => one.type !== 'radio' || one.checked));
        document.addEventListener('focusin', event => window.missing.delete(event.target)); }""")
    for _ in range(page.evaluate("window.missing.size") + 20):
        page.keyboard.press("Tab")
    assert page.evaluate("[...window.missing].map(one => one.outerHTML.slice(0, 120))") == []
    seen.require_quiet()


@pytest.mark.slow
def test_paper_is_light_and_complete(browser: Any, paths: tuple[Path, Path], tmp_path: Path):
    """What nobody scrolled to is printed, too; a page that is dark on the screen is light on paper."""
    seen = visit(browser, paths[0], scheme="dark")
    seen.page.pdf(path=tmp_path / "page.pdf", format="A4")
    assert seen.page.locator(".chart:not(:has(canvas))").count() == 0
    seen.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert seen.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(246, 247, 249)"
    assert (tmp_path / "page.pdf").stat().st_size > 10_000
    seen.require_quiet()


def test_text_of_files_stays_text(browser: Any, tmp_path: Path):
    """Names that are HTML or end a script are shown as they are, in texts, labels and data."""
    evil = "</script><script>window.broken = 1</script><img src=x onerror='window.broken = 1'>\u2028\"&amp;"
    chart = ChartBlock(evil, evil, evil, (1.0, 2.0), (ChartSeries(evil, (1.0, 2.0)),), note=evil)
    blocks = [TextBlock((evil,), title=evil), TableBlock(evil, (evil,), ((evil,),), evil), chart,
              BarBlock(evil, (Bar(evil, 1.0, evil, 1.0, mark=1.0, mark_text=evil),), evil)]  # fmt: skip
    part = section("part", evil, blocks)
    assert part is not None
    path = tmp_path / "evil.html"
    path.write_bytes(render(PageContent(evil, (evil,), (part,), ((evil, evil),))))
    seen = visit(browser, path)
    seen.see_all()
    assert seen.page.evaluate("window.broken") is None
    assert seen.page.inner_text("h1") == evil.replace("\u2028", "\u2028")
    assert seen.page.locator("img").count() == 0
    seen.require_quiet()


def test_tiles_are_whole_pictures(paths: tuple[Path, Path]):
    """A tile put together from head, palette and data is a PNG that other software reads."""
    import io

    from PIL import Image

    first = level_map(1)
    data = map_block(first, check(first, Rules()).as_record()).data
    end = base64.b64decode("AAAAAElFTkSuQmCC")
    parts = [data["heads"]["512x512"], data["views"][0]["colours"], data["whole"][0][0]]
    with Image.open(io.BytesIO(b"".join(base64.b64decode(part) for part in parts) + end)) as image:
        image.load()
        assert image.mode == "P"
        numbers = np.asarray(image)
    expected = np.where(first.relief.inside(first.grid), first.level, 255)[::-1][:512, :512]
    np.testing.assert_array_equal(numbers, expected)
