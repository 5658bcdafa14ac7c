"""Fill what is covered from its surroundings: a program for `doedesign evaluate --method`, to begin your own with.

    doedesign evaluate RUN --method "filled:scene=python examples/fill_holes.py {in} {out}"

IN holds pictures and beside each its mask, white where the scene is covered (0000.png, 0000_mask.png, ...). OUT gets a
picture of the same name and size for each (`doedesign.evaluation.external`). Scikit-image fills the holes here; the
time that takes grows with their area.
"""

import sys
from pathlib import Path

from skimage.io import imread, imsave
from skimage.restoration import inpaint_biharmonic
from skimage.util import img_as_ubyte

MASK = "_mask.png"


def main(given: Path, found: Path) -> int:
    """Fill the holes of every picture of a folder."""
    found.mkdir(parents=True, exist_ok=True)
    for mask in sorted(given.glob(f"*{MASK}")):
        name = mask.name.removesuffix(MASK) + ".png"
        covered = imread(mask) >= 128
        filled = inpaint_biharmonic(imread(given / name), covered, channel_axis=-1)
        imsave(found / name, img_as_ubyte(filled), check_contrast=False)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
