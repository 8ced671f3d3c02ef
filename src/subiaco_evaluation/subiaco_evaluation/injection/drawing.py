"""Pictures of a calibration: what is found by size, and where the ground would be seen to move."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from subiaco_change.outputs.rasters import LodRaster
from subiaco_evaluation.injection.detectability import Curve

_RESURFACING = 0.20  # what people ask about [m]


def draw_curves(path: Path, changes: pd.DataFrame, curves: dict[tuple[str, str], Curve]) -> None:
    """Draw found and missed changes and the fitted curve, a panel a class and kind."""
    groups = list(changes.groupby(["class_name", "kind"]))
    columns = min(3, max(1, len(groups)))
    lines = -(-len(groups) // columns)
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(3.6 * columns, 2.7 * lines), layout="constrained")
        FigureCanvasAgg(figure)
        axes = np.ravel(figure.subplots(lines, columns, squeeze=False))
        for axis, ((name, kind), part) in zip(axes, groups, strict=False):
            _panel(axis, str(name), str(kind), part, curves.get((str(name), str(kind))))
        for axis in axes[len(groups) :]:
            axis.set_axis_off()
        figure.savefig(path, dpi=100)


def _panel(axis: Any, name: str, kind: str, part: pd.DataFrame, curve: Curve | None) -> None:
    axis.plot(part["magnitude_m"], part["found"].astype(float), "|", color="0.3", markersize=10)
    lod = float(part["lod95_m"].median())
    said = "too few changes for a curve"
    if curve is not None and np.isfinite(lod):
        sizes = np.linspace(curve.tested[0], curve.tested[1], 200)
        axis.plot(sizes, curve.probability(sizes, lod), color="#1f77b4")
        smallest = float(curve.smallest(lod))
        said = "95 % not reached in what was tested"
        if np.isfinite(smallest):
            axis.axvline(smallest, color="#d62728", linestyle=":")
            said = f"95 % from {smallest:.2f} m"
    axis.set_title(f"{name}, {'shift' if kind == 'shift' else 'put or taken away'}\n{said}", fontsize=9)
    axis.set_xlabel("shift in height [m]" if kind == "shift" else "height of the object [m]")
    axis.set_ylabel("found")
    axis.set_ylim(-0.05, 1.05)


def draw_ground(path: Path, smallest: NDArray[np.float32], raster: LodRaster) -> None:
    """Draw where a resurfacing of 20 cm would be found with 95 % probability, and where not."""
    rows, columns = smallest.shape
    looked = np.isfinite(raster.lod95) & (raster.lod95 > 0)
    code = np.where(looked, np.where(smallest <= _RESURFACING, 1.0, 2.0), np.nan)
    east, south = raster.west + columns * raster.cell, raster.north - rows * raster.cell
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(8.0, float(np.clip(8.0 * rows / columns, 3.0, 12.0))), layout="constrained")
        FigureCanvasAgg(figure)
        axis = figure.subplots()
        colours = mpl.colors.ListedColormap(["#2ca02c", "#ff7f0e"])
        axis.imshow(
            code, cmap=colours, vmin=0.5, vmax=2.5, extent=(raster.west, east, south, raster.north),
            interpolation="nearest",
        )  # fmt: skip
        share = float((code[looked] == 1.0).mean()) if looked.any() else 0.0
        axis.set_title(
            f"Ground moved by {_RESURFACING * 100:.0f} cm: found with 95 % probability on the green "
            f"({share:.0%} of what was seen), with less on the orange",
            fontsize=9,
        )
        axis.ticklabel_format(useOffset=False, style="plain")
        axis.set_xlabel("east [m]")
        axis.set_ylabel("north [m]")
        figure.savefig(path, dpi=130)
