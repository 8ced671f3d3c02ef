"""Pictures of a change run: five a block, and one of the whole area."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image

from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats
from subiaco_report.colours import Colours, height_range, paint, seen_from_above
from subiaco_report.top_views import Above, Frame

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
#: Edge of a block [m]; neighbours share a strip of the overlap.
SIZE = 80.0
_OVERLAP = 10.0
_LEGIBLE = 300  # names on an overview
_PALETTE = 200  # colours of an overview beside those of the labels


@dataclass(frozen=True)
class Block:
    """One block of the report: core and pictured bounds (west, south, east, north) [m], world."""

    name: str
    core: tuple[float, float, float, float]
    bounds: tuple[float, float, float, float]

    def holds(self, x: Floats | float, y: Floats | float) -> NDArray[np.bool_]:
        """Tell whether world positions lie in the core."""
        west, south, east, north = self.core
        x, y = np.asarray(x), np.asarray(y)
        return np.asarray((x >= west) & (x < east) & (y >= south) & (y < north))


@dataclass(frozen=True)
class Mark:
    """A number drawn at a world position."""

    x: float
    y: float
    text: str


class PictureBlocks:
    """Blocks of :data:`SIZE`, centred on the points, and how many points each of them holds.

    Parameters
    ----------
    low, high : (2,) float64
        Extent of all points, world [m].
    """

    def __init__(self, low: Floats, high: Floats) -> None:
        self._count = np.maximum(np.ceil((high - low) / SIZE).astype(int), 1)
        self._start = np.round((low + high) / 2 - self._count * SIZE / 2)
        self._points = np.zeros(self._count, dtype=np.int64)

    def add(self, world: Floats) -> None:
        """Count points (N, 2 or more)."""
        index = np.clip(((world[:, :2] - self._start) // SIZE).astype(int), 0, self._count - 1)
        flat = index[:, 0] * self._count[1] + index[:, 1]
        self._points += np.bincount(flat, minlength=self._points.size).reshape(self._points.shape)

    def blocks(self) -> list[Block]:
        """Return the blocks that hold points, row by row from the north-west."""
        kept = np.argwhere(self._points >= _MIN_POINTS).tolist()
        return [self._block(column, row) for column, row in sorted(kept, key=lambda c: (-c[1], c[0]))]

    def _block(self, column: int, row: int) -> Block:
        west, south = (self._start + np.array([column, row]) * SIZE).tolist()
        core = (west, south, west + SIZE, south + SIZE)
        margin = _OVERLAP / 2
        bounds = (west - margin, south - margin, west + SIZE + margin, south + SIZE + margin)
        letter = chr(65 + int(self._count[1]) - 1 - row) if self._count[1] <= 26 else f"R{row}-"
        return Block(f"{letter}{column + 1}", core, bounds)


def block_pictures(before: PointCloud, after: PointCloud, block: Block) -> dict[str, bytes]:
    """Draw the five pictures of a block, before on the left and after on the right, a pixel a cell.

    Names and scales are the page's to draw: the browser does it for the blocks that are looked at.

    Parameters
    ----------
    before, after : PointCloud
        What lies within the bounds of the block.
    block : Block

    Returns
    -------
    dict
        WebP bytes by the keys of :data:`KINDS`.
    """
    frame, near = Frame(*block.bounds, _PIXEL), (before, after)
    heights = height_range(near)
    views = {first: [seen_from_above(c, frame, changed_first=first) for c in near] for first in (False, True)}
    return {
        kind: _webp(
            np.concatenate(
                [
                    paint(cloud, frame, kind, heights, seen_points=view)
                    for cloud, view in zip(near, views[kind == "change"], strict=True)
                ],
                axis=1,
            )
        )
        for kind in KINDS
    }


def _webp(colours: Colours) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(colours).save(stream, "WEBP", quality=60, method=2)  # 3: twice the time for 4 % less
    return stream.getvalue()


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


def _draw_blocks(axis: Axes, blocks: Sequence[Block], frame: Frame) -> None:
    for block in blocks:
        west, south, east, north = block.core
        corners = ([west, east, east, west, west], [south, south, north, north, south])
        axis.plot(*corners, color="#888888", lw=0.5, ls=":")
        axis.annotate(
            block.name, (max(west, frame.west), min(north, frame.north)), (4, -10),
            textcoords="offset points", fontsize=8, color="#555555",
        )  # fmt: skip


def _draw_marks(axis: Axes, marks: Sequence[Mark]) -> None:
    for mark in marks:
        axis.annotate(
            mark.text, (mark.x, mark.y), ha="center", va="center", fontsize=7, fontweight="bold",
            path_effects=[withStroke(linewidth=2.5, foreground="white")], annotation_clip=True,
        )  # fmt: skip


def change_legend() -> list[Patch]:
    """Return legend entries for every change label."""
    names = {Change.NOT_REPORTED: "Not reported", Change.UNOBSERVED: "Unobserved (nothing claimed)"}
    return [_patch(names.get(change, change.label), rgb) for change, rgb in CHANGE_COLOURS.items()]


def _patch(name: str, rgb: tuple[int, int, int]) -> Patch:
    return Patch(facecolor=tuple(c / 255 for c in rgb), edgecolor="#555555", linewidth=0.5, label=name)


def overview(seen: Above, blocks: Sequence[Block], marks: Sequence[Mark] = ()) -> bytes:
    """Draw the whole area: changed points of both epochs over the unchanged surroundings.

    Of a city neither blocks nor objects are named: nobody could read them.

    Returns
    -------
    bytes
        PNG.
    """
    frame = seen.frame
    width, height = frame.east - frame.west, frame.north - frame.south
    figure = Figure(figsize=(11.0, float(np.clip(11.0 * height / width + 0.9, 3.5, 14.0))), dpi=130)
    axis = figure.subplots()
    picture = paint(seen.cloud(), frame, "change", fill=2)
    axis.imshow(picture, extent=frame.extent, interpolation="nearest")
    _dress(axis, "Changes between the two epochs (north is up)", frame)
    if len(blocks) <= _LEGIBLE:
        _draw_blocks(axis, blocks, frame)
    if len(marks) <= _LEGIBLE:
        _draw_marks(axis, marks)
    axis.set_xlim(frame.west, frame.east)
    axis.set_ylim(frame.south, frame.north)
    handles = change_legend()
    axis.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=7, fontsize=8, frameon=False
    )
    figure.tight_layout()
    return _png(figure)


def overview_frame(low: Floats, high: Floats, longest: int = 1300) -> Frame:
    """Return a frame around an extent (2,), (2,) [m] whose longer side has at most so many pixels."""
    (west, south), (east, north) = low - 2.0, high + 2.0
    pixel = max(_PIXEL, max(east - west, north - south) / longest)
    return Frame(float(west), float(south), float(east), float(north), float(pixel))


def _png(figure: Figure) -> bytes:
    """Render to a palette PNG: a third of the size of full colour, and no metadata.

    Pixels in the colour of a label keep that colour exactly, however few they are.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    colours = np.asarray(canvas.buffer_rgba())[..., :3]
    few = Image.fromarray(colours).quantize(
        colors=_PALETTE, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
    )
    labels = np.array(list(CHANGE_COLOURS.values()), dtype=np.uint8)
    palette = np.zeros((_PALETTE + len(labels), 3), dtype=np.uint8)
    found = np.array(few.getpalette(), dtype=np.uint8).reshape(-1, 3)[:_PALETTE]
    palette[: len(found)], palette[_PALETTE:] = found, labels
    index = np.array(few)
    for place, colour in enumerate(labels, start=_PALETTE):
        index[(colours == colour).all(axis=2)] = place
    exact = Image.fromarray(index)
    exact.putpalette(palette.tobytes())
    stream = io.BytesIO()
    exact.save(stream, "PNG")  # optimised: four times the time for 1 % less
    return stream.getvalue()
