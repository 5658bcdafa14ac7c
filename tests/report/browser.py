"""Headless Chromium for tests of pages; nothing but the page's own content may be asked for."""

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


@dataclass(frozen=True)
class Visit:
    """A page, and what it complained about or asked the network for."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def require_quiet(self) -> None:
        assert self.complaints == []
        assert self.requests == []

    def see_all(self) -> None:
        """Scroll through the page, so that everything on it is drawn."""
        place, end = 0, 1
        while place < end:
            self.page.evaluate("y => window.scrollTo(0, y)", place)
            self.page.wait_for_timeout(50)
            place, end = place + 600, self.page.evaluate("document.documentElement.scrollHeight")
        self.page.wait_for_timeout(300)


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def visit(browser: Any, path: Path, *, scheme: str = "light", width: int = 1280, height: int = 900) -> Visit:
    """Open a page from the disk."""
    # A reader's wish for less motion, so that no test waits for one.
    context = browser.new_context(
        color_scheme=scheme, viewport={"width": width, "height": height}, reduced_motion="reduce"
    )
    seen = Visit(context.new_page())
    page = seen.page
    page.set_default_timeout(60_000)
    page.on("console", lambda said: said.type == "error" and seen.complaints.append(said.text))
    page.on("pageerror", lambda error: seen.complaints.append(str(error)))
    page.on(
        "request",
        lambda asked: asked.url.startswith(("file:", "data:", "blob:")) or seen.requests.append(asked.url),
    )
    page.goto(path.absolute().as_uri())
    page.wait_for_selector("html[data-ready=yes]", state="attached")
    return seen


def violations(page: Any) -> list[tuple[str, str, str]]:
    """Rules of accessibility that a page breaks: rule, first place, what to do about it."""
    from axe_core_python.sync_playwright import Axe

    found = Axe().run(page)["violations"]
    return [(one["id"], one["nodes"][0]["html"][:200], one["nodes"][0].get("failureSummary", "")) for one in found]


def until(page: Any, script: str) -> None:
    """Wait until a script says yes; the page's own rules forbid scripts that it would have to evaluate itself."""
    for _ in range(600):
        if page.evaluate(script):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"never: {script}")
