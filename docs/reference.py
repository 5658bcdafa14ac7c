"""A hook of MkDocs: the pages of the reference, made of the code that they describe as the site is built."""

from typing import Any

from mkdocs.structure.files import File, Files

from doedesign.reference.pages import pages


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the reference, in the place of files of the same names.

    Args:
        files: files of the site.
        config: configuration of the site.
    """
    for path, text in pages().items():
        if (old := files.get_file_from_path(path)) is not None:
            files.remove(old)
        files.append(File.generated(config, path, content=text))
    return files
