"""Draw a simulated survey from above: both epochs, coloured by the true change.

Example: python scripts/draw_survey.py out/survey docs/pictures/simulator-default.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
import yaml
from PIL import Image

mpl.use("Agg")
import matplotlib.pyplot as plt

COLOURS = {
    0: ("Added", "#1aa33a"),
    1: ("Removed", "#d62020"),
    2: ("Increased", "#1f4fd8"),
    3: ("Decreased", "#ff8c00"),
    4: ("Unchanged", "#b8b8b8"),
    254: ("moving (not reported)", "#8a2be2"),
    255: ("other drive could not see", "#f3e3a8"),
}
MOST = 600_000  # points drawn an epoch


def draw(survey: Path, picture: Path) -> None:
    """Draw both epochs side by side; what is higher covers what is lower."""
    scene = yaml.safe_load((survey / "truth" / "scene.yaml").read_text())
    with np.load(survey / "before" / "truth" / "points.npz") as data:
        low, high = np.percentile(data["xyz"][:, :2], [1, 99], axis=0)
    wide = high[0] - low[0] > 1.8 * (high[1] - low[1])
    rows, size = ((2, 1), (14, 10.5)) if wide else ((1, 2), (15, 7.2))
    figure, axes = plt.subplots(*rows, figsize=size, sharex=True, sharey=True, layout="constrained")
    middle = None
    for axis, epoch in zip(axes, ("before", "after"), strict=True):
        with np.load(survey / epoch / "truth" / "points.npz") as data:
            xyz, change = data["xyz"], data["change"]
        middle = np.median(xyz[:, :2], axis=0) if middle is None else middle
        order = np.argsort(xyz[:, 2])[:: max(1, len(xyz) // MOST)]
        colour = np.full(256, "#b8b8b8", dtype="U7")
        for code, (_, name) in COLOURS.items():
            colour[code] = name
        place = xyz[order, :2] - middle
        axis.scatter(*place.T, c=colour[change[order]], s=0.25, linewidths=0, rasterized=True)
        axis.set(title=f"{epoch} ({scene['epochs'][epoch]['lidar']})", xlabel="east [m]", aspect="equal")
    axes[0].set_ylabel("north [m]")
    handles = [plt.Line2D([], [], ls="", marker="s", color=c, label=n) for n, c in COLOURS.values()]
    figure.legend(handles=handles, loc="outside lower center", ncols=7, frameon=False)
    figure.suptitle(f"simulated survey, preset {scene['preset']}, seed {scene['seed']}")
    figure.savefig(picture, dpi=72)
    with Image.open(picture) as image:
        image.convert("RGB").quantize(200, method=Image.Quantize.MAXCOVERAGE).save(picture, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("survey", type=Path, help="output of subiaco simulate")
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    draw(options.survey, options.picture)
