"""Pictures of a change run: five a block, and one of the whole area."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats, Ints

from subiaco_change.outputs_clouds import change_palette
from subiaco_change.pictures_raster import Frame, fill_holes, hillshade, top_view
from subiaco_change.records import CHANGE_COLOURS, SEMANTIC_COLOURS, Change, Semantic

#: The five pictures of a block, in the order of the report, with their captions.
KINDS = {
    "projection": "Projection: the points from above, brightness by LiDAR intensity (or shading without it)",
    "height": "Height: the highest point of every pixel, in metres above the datum of the map",
    "semantics": "Semantics: the class of the point seen from above",
    "instances": "Instances: one colour an object, the same in both epochs; grey points belong to none",
    "change": "Change: labels in the paper's colours; changed points are drawn above unchanged ones",
}
BACKGROUND = (247, 247, 245)
_CHANGED = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)
_PIXEL = 0.25  # the working leaf [m]
_MIN_POINTS = 50

Colours = NDArray[np.uint8]


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
    cells, population = np.unique(index, axis=0, return_counts=True)
    kept = [tuple(c) for c, n in zip(cells.tolist(), population, strict=True) if n >= _MIN_POINTS]
    blocks = []
    for column, row in sorted(kept, key=lambda c: (-c[1], c[0])):
        west, south = (start + np.array([column, row]) * size).tolist()
        core = (west, south, west + size, south + size)
        margin = overlap / 2
        bounds = (west - margin, south - margin, west + size + margin, south + size + margin)
        blocks.append(Block(f"{chr(65 + int(count[1]) - 1 - row) if count[1] <= 26 else f'R{row}-'}{column + 1}", core, bounds))
    return blocks


def block_pictures(
    before: PointCloud, after: PointCloud, block: Block, marks: Iterable[Mark] = ()
) -> dict[str, bytes]:
    """Draw the five pictures of a block, before on the left and after on the right.

    Returns
    -------
    dict
        PNG bytes by the keys of :data:`KINDS`.
    """
    frame = Frame(*block.bounds, _PIXEL)
    near = [_crop(cloud, block) for cloud in (before, after)]
    heights = _height_range(near)
    drawn = {}
    for kind in KINDS:
        figure = Figure(figsize=(10.4, 5.75), dpi=100, facecolor="white")
        axes = figure.subplots(1, 2, sharex=True, sharey=True)
        for axis, cloud, title in zip(axes, near, ("before", "after"), strict=True):
            axis.imshow(paint(cloud, frame, kind, heights), extent=frame.extent, interpolation="nearest")
            _dress(axis, title, frame)
        if kind == "change":
            _draw_marks(axes[1], [m for m in marks if block.holds(m.x, m.y)])
        _explain(figure, axes, kind, heights)
        drawn[kind] = _png(figure)
    return drawn


def _crop(cloud: PointCloud, block: Block) -> PointCloud:
    west, south, east, north = block.bounds
    x, y = cloud.xyz[:, 0] + cloud.origin[0], cloud.xyz[:, 1] + cloud.origin[1]
    return cloud.select((x >= west) & (x < east) & (y >= south) & (y < north))


def _height_range(clouds: Sequence[PointCloud]) -> tuple[float, float]:
    z = np.concatenate([cloud.xyz[:, 2] + cloud.origin[2] for cloud in clouds])
    if len(z) == 0:
        return 0.0, 1.0
    low, high = np.percentile(z, [1.0, 99.5])
    return float(low), float(max(high, low + 1.0))


def paint(
    cloud: PointCloud, frame: Frame, kind: str, heights: tuple[float, float] = (0.0, 1.0), fill: int = 1
) -> Colours:
    """Return the top view of a cloud as colours (rows, columns, 3).

    Parameters
    ----------
    cloud : PointCloud
        With the fields of a labelled cloud.
    frame : Frame
        In world coordinates.
    kind : str
        A key of :data:`KINDS`.
    heights : (float, float)
        Ends of the height colours [m].
    fill : int
        Pixels by which points grow into empty places.
    """
    origin = np.append(cloud.origin[:2], 0.0)
    local = Frame(
        frame.west - origin[0], frame.south - origin[1], frame.east - origin[0], frame.north - origin[1], frame.pixel
    )
    change = np.asarray(cloud.fields["change"])
    priority = np.isin(change, _CHANGED) if kind == "change" else None
    view = fill_holes(top_view(cloud.xyz, local, priority), fill)
    seen = view >= 0
    picture = np.empty((*view.shape, 3), dtype=np.uint8)
    picture[:] = BACKGROUND
    if not seen.any():
        return picture
    index = view[seen]
    z = np.full(view.shape, np.nan)
    z[seen] = cloud.xyz[index, 2]
    shade = hillshade(z, frame.pixel)[seen]
    picture[seen] = _shaded(_colours(cloud, index, kind, heights, shade), shade, kind)
    return picture


def _colours(
    cloud: PointCloud, index: Ints, kind: str, heights: tuple[float, float], shade: Floats
) -> Floats:
    if kind == "projection":
        return _brightness(cloud, index, shade)[:, None] * np.array([235.0, 238.0, 245.0])
    if kind == "height":
        values = cloud.xyz[index, 2] + cloud.origin[2]
        return np.asarray(ScalarMappable(Normalize(*heights), "viridis").to_rgba(values)[:, :3] * 255.0)
    if kind == "semantics":
        return semantic_palette()[np.asarray(cloud.fields["semantic"])[index].astype(np.int64)]
    if kind == "instances":
        return instance_colours(np.asarray(cloud.fields["instance"])[index].astype(np.int64))
    return change_palette()[np.asarray(cloud.fields["change"])[index].astype(np.int64)].astype(np.float64)


def _brightness(cloud: PointCloud, index: Ints, shade: Floats) -> Floats:
    if "intensity" not in cloud.fields:
        return shade
    intensity = np.asarray(cloud.fields["intensity"], dtype=np.float64)
    low, high = np.percentile(intensity, [2.0, 98.0])
    if high <= low:
        return shade
    stretched = np.clip((intensity[index] - low) / (high - low), 0.0, 1.0)
    return np.asarray(0.15 + 0.6 * np.sqrt(stretched) + 0.25 * shade)


def _shaded(colours: Floats, shade: Floats, kind: str) -> Colours:
    if kind == "projection":
        return colours.astype(np.uint8)
    strength = 0.35 if kind == "height" else 0.55
    factor = 1.0 - strength + strength * shade / 0.85
    return np.clip(colours * factor[:, None], 0, 255).astype(np.uint8)


def semantic_palette() -> Floats:
    """Return the colour (256, 3) of every class code."""
    palette = np.zeros((256, 3))
    for semantic, rgb in SEMANTIC_COLOURS.items():
        palette[int(semantic)] = rgb
    return palette


def instance_colours(ids: Ints) -> Floats:
    """Return well-separated colours (N, 3) by id, the same in every picture; -1 is grey."""
    hue = (ids * 0.6180339887) % 1.0
    value = 0.72 + 0.25 * ((ids * 0.3819660113) % 1.0)
    sector = (hue * 6.0)[:, None] + np.array([0.0, 4.0, 2.0])
    ramp = np.clip(np.abs(sector % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    colours = 255.0 * value[:, None] * (1.0 - 0.65 * (1.0 - ramp))
    return np.where((ids < 0)[:, None], 205.0, colours)


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


def _explain(figure: Figure, axes: NDArray[np.object_], kind: str, heights: tuple[float, float]) -> None:
    figure.subplots_adjust(left=0.075, right=0.985, top=0.945, bottom=0.165, wspace=0.06)
    if kind == "height":
        scale = ScalarMappable(Normalize(*heights), "viridis")
        bar = figure.colorbar(scale, cax=figure.add_axes((0.3, 0.055, 0.4, 0.022)), orientation="horizontal")
        bar.ax.tick_params(labelsize=7)
        bar.set_label("height [m]", fontsize=8, labelpad=1)
    if kind == "semantics":
        entries = [_patch(s.label, SEMANTIC_COLOURS[s]) for s in Semantic]
        figure.legend(handles=entries, loc="lower center", ncols=5, fontsize=8, frameon=False)
    if kind == "change":
        figure.legend(handles=change_legend(), loc="lower center", ncols=7, fontsize=8, frameon=False)


def overview(
    before: PointCloud, after: PointCloud, blocks: Sequence[Block], marks: Iterable[Mark] = ()
) -> bytes:
    """Draw the whole area: changed points of both epochs over the unchanged surroundings.

    Returns
    -------
    bytes
        PNG.
    """
    frame = _overview_frame((before, after))
    both = _together(before, after)
    width, height = frame.east - frame.west, frame.north - frame.south
    figure = Figure(figsize=(11.0, float(np.clip(11.0 * height / width + 0.9, 3.5, 14.0))), dpi=130)
    axis = figure.subplots()
    axis.imshow(paint(both, frame, "change", fill=2), extent=frame.extent, interpolation="nearest")
    _dress(axis, "Changes between the two epochs (north is up)", frame)
    for block in blocks:
        west, south, east, north = block.core
        axis.plot([west, east, east, west, west], [south, south, north, north, south], color="#888888", lw=0.5, ls=":")
        axis.annotate(block.name, (west, north), (4, -10), textcoords="offset points", fontsize=8, color="#555555")
    _draw_marks(axis, list(marks))
    axis.set_xlim(frame.west, frame.east)
    axis.set_ylim(frame.south, frame.north)
    handles = change_legend()
    axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=7, fontsize=8, frameon=False)
    figure.tight_layout()
    return _png(figure)


def _overview_frame(clouds: Sequence[PointCloud], longest: int = 1300) -> Frame:
    world = np.concatenate([cloud.world()[:, :2] for cloud in clouds])
    (west, south), (east, north) = world.min(axis=0) - 2.0, world.max(axis=0) + 2.0
    pixel = max(_PIXEL, max(east - west, north - south) / longest)
    return Frame(float(west), float(south), float(east), float(north), float(pixel))


def _together(before: PointCloud, after: PointCloud) -> PointCloud:
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
