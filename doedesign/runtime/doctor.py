"""A checkup of this installation and this machine: versions, devices, memory, extras, programs beside them."""

import os
import platform
import re
import shutil
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from doedesign import __version__
from doedesign.runtime.pool import free_gib
from doedesign.runtime.viewers import browser, has_display, layout_viewer, system_viewer
from sim.threads import cores

_GIB = 1 << 30
_LIBRARIES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "matplotlib", "klayout", "gdstk", "cadquery", "pydantic")
# What is left out without an extra, in the words of its commands. Those of developers are no business of users.
EXTRAS: Mapping[str, str] = {
    "bayer": "sensors with a Bayer mosaic: simulate, train, evaluate",
    "cluster": "workers of a Dask cluster: tolerance, evaluate",
    "cuda": "an NVIDIA GPU: optimize, train and all else that computes",
    "evaluation": "two of the single-image methods of evaluate",
    "raw": "camera RAW files: calibrate, reconstruct, finetune",
    "rigorous": "squares by Maxwell's equations: certify, refine",
    "tensorboard": "TensorBoard: train",
}
_CACHE = "JAX_COMPILATION_CACHE_DIR"


class Extra(NamedTuple):
    """An extra of the installation.

    Attributes:
        name: its name, for pip.
        gives: what needs it.
        missing: packages of it that are not installed; empty where it is there.
    """

    name: str
    gives: str
    missing: tuple[str, ...]


class Checkup(NamedTuple):
    """Findings of a checkup.

    Attributes:
        versions: of this package, Python and main libraries; None where one is missing.
        devices: what jax computes on, in words.
        cores: processors that this process may use.
        memory_gib: memory of the machine; None where the system does not say.
        free_gib: of which free now; None likewise.
        disk_free_gib: room on the disk of the working folder.
        compiled: folder in which compiled programs are kept; None where they are not kept.
        extras: extras of the installation.
        programs: paths of programs beside it, by name; None where one is not found.
        display: whether a window can be opened.
    """

    versions: dict[str, str | None]
    devices: tuple[str, ...]
    cores: int
    memory_gib: float | None
    free_gib: float | None
    disk_free_gib: float
    compiled: str | None
    extras: tuple[Extra, ...]
    programs: dict[str, str | None]
    display: bool

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return self._asdict() | {"extras": [one._asdict() for one in self.extras]}

    def lines(self) -> list[tuple[str, str]]:
        """Name and words of everything, for people."""
        known = {name: version or "not installed" for name, version in self.versions.items()}
        found = [("doedesign", known.pop("doedesign")), ("Python", known.pop("python"))]
        found.append(("libraries", ", ".join(f"{name} {version}" for name, version in known.items())))
        found.append(("devices", ", ".join(self.devices)))
        memory = "unknown" if self.memory_gib is None else f"{self.memory_gib:.1f} GiB"
        free = "" if self.free_gib is None else f", {self.free_gib:.1f} GiB free"
        found += [("cores", str(self.cores)), ("memory", memory + free)]
        found.append(("disk", f"{self.disk_free_gib:.1f} GiB free in {Path.cwd()}"))
        kept = self.compiled or f"not kept between commands; {_CACHE}=FOLDER in the environment keeps them"
        found.append(("compiled programs", kept))
        for one in self.extras:
            cure = f"pip install 'doedesign[{one.name}]'"
            state = "there" if not one.missing else f"missing {', '.join(one.missing)}: {cure}"
            found.append((f"extra {one.name}", f"{state} ({one.gives})"))
        found += [(name, path or "not found") for name, path in self.programs.items()]
        return [*found, ("display", "yes" if self.display else "none: show prints paths instead")]


def examine() -> Checkup:
    """Look at this installation and this machine; nothing is changed, and nothing missing is an error."""
    versions = {"doedesign": __version__, "python": platform.python_version()}
    memory, free = _memory_gib(), free_gib()
    return Checkup(
        {**versions, **{name: _version(name) for name in _LIBRARIES}},
        _devices(),
        cores(),
        memory,
        None if free == float("inf") else round(free, 1),
        round(shutil.disk_usage(Path.cwd()).free / _GIB, 1),
        _compiled(),
        tuple(Extra(name, gives, _missing(name)) for name, gives in EXTRAS.items()),
        {"KLayout": layout_viewer(), "viewer of pictures": system_viewer(), "browser": browser()},
        has_display(),
    )


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _missing(extra: str) -> tuple[str, ...]:
    """Packages of an extra that are not installed, by this package's own record."""
    try:
        needs = metadata.requires("doedesign") or []
    except metadata.PackageNotFoundError:  # run from its source
        return ()
    packages = []
    for need in needs:
        requirement, _, condition = need.partition(";")
        if re.search(rf"extra\s*==\s*['\"]{extra}['\"]", condition):
            match = re.match(r"[\w.-]+", requirement.strip())
            packages.append(match[0] if match else requirement)
    found = {name for name in packages if _version(name) is not None}
    if extra == "cuda":  # the extra is jax itself, with a plugin
        return () if any(_version(f"jax-cuda{major}-plugin") for major in (12, 13)) else ("jax-cuda12-plugin",)
    return tuple(name for name in packages if name not in found)


def _devices() -> tuple[str, ...]:
    try:
        import jax

        return tuple(f"{one.platform} {one.id}: {one.device_kind}" for one in jax.devices())
    # A driver that does not fit shows in whatever way its library has.
    except Exception as error:
        return (f"jax finds none: {error}",)


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / _GIB, 1)
    except (ValueError, OSError, AttributeError):
        return None


def _compiled() -> str | None:
    if _CACHE in os.environ:
        return os.environ[_CACHE]
    config = getattr(sys.modules.get("jax"), "config", None)
    return getattr(config, "jax_compilation_cache_dir", None)
