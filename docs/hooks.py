"""Hooks of MkDocs: pictures that the package draws of itself, and those of finished studies, as files of the site."""

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
CACHE = ROOT / "build" / "pictures"
RESULTS = ROOT / "examples" / "results"

sys.path.insert(0, str(Path(__file__).parent))

import pictures  # noqa: E402


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add every picture that a page may show.

    Args:
        files: what the site has so far.
        config: of the site.
    """
    for name, path in pictures.draw_all(CACHE).items():
        files.append(File.generated(config, f"pictures/{name}.png", abs_src_path=str(path)))
    for path in sorted(RESULTS.rglob("*.png")):
        shown = f"results/{path.relative_to(RESULTS).as_posix()}"
        files.append(File.generated(config, shown, abs_src_path=str(path)))
    return files
