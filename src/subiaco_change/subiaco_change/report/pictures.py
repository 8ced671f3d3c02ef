"""Pictures of a change run: five a block, and one of the whole area."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from PIL import Image

from subiaco_change.records import CHANGE_COLOURS
from subiaco_change.report.paint import Colours, height_range, paint
from subiaco_change.report.raster import Frame
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change

#: The five pictures of a block, in the order of the report, with their captions.
KINDS = {
    "projection": "Projection: the points from above, brightness by LiDAR intensity (or shading without it)",
    "height": "Height: the highest point of every pixel, in metres above the datum of the map",
    "semantics": "Semantics: the class of the point seen from above",
    "instances": "Instances: one colour an object, the same in both epochs; grey points belong to none",
    "change": "Change: labels in the paper's colours; changed points are drawn above unchanged ones",
}
_PIXEL = 0.25  # the working leaf [m]
_MIN_POINTS = 50


@dataclass(frozen=True)
class Block:
    """One block of the report: core and pictured bounds (west, south, east, north) [m], world."""

    name: str
    core: tuple[float, float, float, float]
    bounds: tuple[float, float, float, float]

    def holds(self, x: float, y: float) -> bool:
        """Tell whether a world position lies in the core."""
        return self.core[0] <= x < self.core[2] and self.core[1] <= y < self.core[3]


@dataclass(frozen=True)
class Mark:
    """A number drawn at a world position."""

    x: float
    y: float
    text: str


def block_grid(clouds: Sequence[PointCloud], size: float = 80.0, overlap: float = 10.0) -> list[Block]:
    """Return the blocks that hold points, row by row from the north-west.

    The grid is centred on the points; ``overlap`` [m] is shared by neighbours.
    """
    world = np.concatenate([cloud.world()[:, :2] for cloud in clouds])
    low, high = world.min(axis=0), world.max(axis=0)
    count = np.maximum(np.ceil((high - low) / size).astype(int), 1)
    start = np.round((low + high) / 2 - count * size / 2)
    index = np.clip(((world - start) // size).astype(int), 0, count - 1)
    flat, population = np.unique(index[:, 0] * count[1] + index[:, 1], return_counts=True)
    kept = [divmod(int(c), int(count[1])) for c, n in zip(flat, population, strict=True) if n >= _MIN_POINTS]
    blocks = []
    for column, row in sorted(kept, key=lambda c: (-c[1], c[0])):
        west, south = (start + np.array([column, row]) * size).tolist()
        core = (west, south, west + size, south + size)
        margin = overlap / 2
        bounds = (west - margin, south - margin, west + size + margin, south + size + margin)
        blocks.append(
            Block(
                f"{chr(65 + int(count[1]) - 1 - row) if count[1] <= 26 else f'R{row}-'}{column + 1}",
                core,
                bounds,
            )
        )
    return blocks


def block_pictures(before: PointCloud, after: PointCloud, block: Block) -> dict[str, bytes]:
    """Draw the five pictures of a block, before on the left and after on the right, a pixel a cell.

    Names and scales are the page's to draw: the browser does it for the blocks that are looked at.

    Returns
    -------
    dict
        WebP bytes by the keys of :data:`KINDS`.
    """
    frame = Frame(*block.bounds, _PIXEL)
    near = [_crop(cloud, block) for cloud in (before, after)]
    heights = height_range(near)
    return {
        kind: _webp(np.concatenate([paint(cloud, frame, kind, heights) for cloud in near], axis=1))
        for kind in KINDS
    }


def block_heights(before: PointCloud, after: PointCloud, block: Block) -> tuple[float, float]:
    """Return the heights between which the colours of a block run, world [m]."""
    near = [_crop(cloud, block) for cloud in (before, after)]
    return height_range(near)


def _webp(colours: Colours) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(colours).save(stream, "WEBP", quality=60, method=3)
    return stream.getvalue()


def _crop(cloud: PointCloud, block: Block) -> PointCloud:
    west, south, east, north = block.bounds
    x, y = cloud.xyz[:, 0] + cloud.origin[0], cloud.xyz[:, 1] + cloud.origin[1]
    return cloud.select((x >= west) & (x < east) & (y >= south) & (y < north))


def _dress(axis: Axes, title: str, frame: Frame) -> None:
    axis.set_title(title, fontsize=11, loc="left", fontweight="bold")
    axis.set_xlabel("east [m]", fontsize=8)
    axis.set_ylabel("north [m]", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.label_outer()
    for way in (axis.xaxis, axis.yaxis):
        way.set_major_formatter(lambda value, _: f"{value:.0f}")
    axis.locator_params(nbins=5)
    scale_bar(axis, frame)


def scale_bar(axis: Axes, frame: Frame) -> None:
    """Draw a bar of a round length in the lower left corner."""
    width = frame.east - frame.west
    length = max(x for x in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if x <= max(width / 4, 1))
    left, low = frame.west + 0.03 * width, frame.south + 0.035 * (frame.north - frame.south)
    halo = [withStroke(linewidth=4.5, foreground="white")]
    axis.plot([left, left + length], [low, low], color="black", linewidth=2.5, path_effects=halo)
    axis.annotate(
        f"{length} m", (left + length / 2, low), (0, 4), textcoords="offset points", ha="center",
        fontsize=8, path_effects=[withStroke(linewidth=2.5, foreground="white")],
    )  # fmt: skip
    axis.set_xlim(frame.west, frame.east)
    axis.set_ylim(frame.south, frame.north)


def _draw_marks(axis: Axes, marks: Sequence[Mark]) -> None:
    for mark in marks:
        axis.annotate(
            mark.text, (mark.x, mark.y), ha="center", va="center", fontsize=7, fontweight="bold",
            path_effects=[withStroke(linewidth=2.5, foreground="white")], annotation_clip=True,
        )  # fmt: skip


def change_legend() -> list[Patch]:
    """Return legend entries for every change label."""
    names = {Change.NOT_REPORTED: "Not reported (mobile)", Change.UNOBSERVED: "Unobserved in the other epoch"}
    return [_patch(names.get(change, change.label), rgb) for change, rgb in CHANGE_COLOURS.items()]


def _patch(name: str, rgb: tuple[int, int, int]) -> Patch:
    return Patch(facecolor=tuple(c / 255 for c in rgb), edgecolor="#555555", linewidth=0.5, label=name)


def overview(
    before: PointCloud, after: PointCloud, blocks: Sequence[Block], marks: Iterable[Mark] = ()
) -> bytes:
    """Draw the whole area: changed points of both epochs over the unchanged surroundings.

    Returns
    -------
    bytes
        PNG.
    """
    frame = overview_frame((before, after))
    both = together(before, after)
    width, height = frame.east - frame.west, frame.north - frame.south
    figure = Figure(figsize=(11.0, float(np.clip(11.0 * height / width + 0.9, 3.5, 14.0))), dpi=130)
    axis = figure.subplots()
    axis.imshow(paint(both, frame, "change", fill=2), extent=frame.extent, interpolation="nearest")
    _dress(axis, "Changes between the two epochs (north is up)", frame)
    for block in blocks:
        west, south, east, north = block.core
        axis.plot(
            [west, east, east, west, west],
            [south, south, north, north, south],
            color="#888888",
            lw=0.5,
            ls=":",
        )
        axis.annotate(
            block.name,
            (max(west, frame.west), min(north, frame.north)),
            (4, -10),
            textcoords="offset points",
            fontsize=8,
            color="#555555",
        )
    _draw_marks(axis, list(marks))
    axis.set_xlim(frame.west, frame.east)
    axis.set_ylim(frame.south, frame.north)
    handles = change_legend()
    axis.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=7, fontsize=8, frameon=False
    )
    figure.tight_layout()
    return _png(figure)


def overview_frame(clouds: Sequence[PointCloud], longest: int = 1300) -> Frame:
    """Return a frame around all points whose longer side has at most so many pixels."""
    world = np.concatenate([cloud.world()[:, :2] for cloud in clouds])
    (west, south), (east, north) = world.min(axis=0) - 2.0, world.max(axis=0) + 2.0
    pixel = max(_PIXEL, max(east - west, north - south) / longest)
    return Frame(float(west), float(south), float(east), float(north), float(pixel))


def together(before: PointCloud, after: PointCloud) -> PointCloud:
    """Return both epochs as one cloud, with field ``change``."""
    moved = before.rebased(after.origin)
    change = np.concatenate([np.asarray(c.fields["change"]) for c in (moved, after)])
    return PointCloud(np.concatenate([moved.xyz, after.xyz]), after.origin, after.crs, {"change": change})


def _png(figure: Figure) -> bytes:
    """Render to a palette PNG: a third of the size of full colour, and no metadata."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    picture.quantize(colors=200, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
        stream, "PNG", optimize=True
    )
    return stream.getvalue()
