"""Weights of LPIPS for the training loss, taken from an installed `lpips` and `torchvision`.

    pip install lpips torch torchvision
    python examples/convert_lpips.py vgg lpips_vgg.npz
    doedesign train RUN --images DIR --lpips-weights lpips_vgg.npz

`doedesign` brings neither: the backbones' weights are torchvision's (trained on ImageNet, and downloaded by torchvision
when this is run for the first time), the heads are the authors' (v0.1, BSD-2-Clause, within the `lpips` package). The
result is one .npz file of float32 arrays. `vgg` (59 MB) is what the paper's authors trained with; `squeeze` (3 MB)
takes a small part of its time; `alex` (10 MB) is what LPIPS's authors recommend for judging.

This may be run on another machine: the file is all that `doedesign` needs, and torch is not.
"""

import argparse
import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.cli import exit_code
from doedesign.training.distance.perceptual import weights_of
from fab.errors import InputError
from fab.files import write_atomic

MODELS = {"squeeze": "squeezenet1_1", "alex": "alexnet", "vgg": "vgg16"}


def convert(backbone: str, path: Path) -> None:
    """Write the weights of one backbone and its heads.

    Raises:
        InputError: torch, torchvision or lpips is not installed.
    """
    weights = weights_of(*state_dicts(backbone))
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **weights)
    write_atomic(path, buffer.getvalue())


def state_dicts(backbone: str) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Weights of a backbone that was trained on ImageNet, and of LPIPS's heads, as their packages name them."""
    try:
        import lpips  # pyright: ignore[reportMissingImports]
        import torchvision  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        rule = "must be installed, beside torch and torchvision, to convert weights"
        cure = "Run: pip install lpips torch torchvision. Another machine will do, too."
        raise InputError("lpips", rule, f'"{error}"', cure) from error
    features = getattr(torchvision.models, MODELS[backbone])(weights="IMAGENET1K_V1")
    # The heads come with the package; its own backbone is not needed, and at random it needs no download.
    heads = lpips.LPIPS(net=backbone, version="0.1", pnet_rand=True, verbose=False)
    return features.state_dict(), heads.state_dict()


def main(words: list[str] | None = None) -> int:
    """Convert as the command line says."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("backbone", choices=sorted(MODELS), help="which network LPIPS looks through")
    parser.add_argument("path", type=Path, help="the .npz file to write")
    given = parser.parse_args(words)
    convert(given.backbone, given.path)
    print(given.path)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
