"""The evidence of one row as a small picture: before, after and difference, in plan and in section."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
from matplotlib import colormaps, get_data_path
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from shapely.geometry.base import BaseGeometry

from subiaco_change.outputs.clouds import change_palette
from subiaco_change.report.paint import BACKGROUND, CHANGED, Colours
from subiaco_change.report.raster import Frame, fill_holes, hillshade, top_view
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints

PANEL, SECTION, HEAD, GAP = 140, 84, 15, 4  # edges of the parts of a picture [pixel]
WIDTH, HEIGHT = 3 * PANEL + 2 * GAP, HEAD + PANEL + GAP + SECTION
_BELOW = HEAD + PANEL + GAP  # where sections begin
#: No picture is larger than this [byte]: what bounds the report.
MAX_BYTES = 10_000
_LEAF = 0.25  # finest detail of the clouds [m]
_SMALLEST = 8.0  # edge of the smallest view [m]
_MARGIN = 1.6  # view over footprint
_SLAB = 1.0  # a section takes what stands this near to the footprint [m]
_EXAGGERATIONS = (20, 10, 5, 2, 1)
_COLOURS = (64, 40, 24, 12, 6)


class Tiles:
    """The points of a cloud sorted by tiles, so that a window is found without a look at all of them."""

    def __init__(self, cloud: PointCloud, size: float = 16.0) -> None:
        self.world = cloud.world()
        self.change = np.asarray(cloud.fields["change"])
        self.ground = np.asarray(cloud.fields["semantic"]) == Semantic.GROUND
        self._size = size
        self._low = np.floor(self.world[:, :2].min(axis=0) / size)
        column, row = (np.floor(self.world[:, :2] / size) - self._low).astype(np.int64).T
        self._columns = int(column.max()) + 1
        flat = row * self._columns + column
        self._order = np.argsort(flat, kind="stable")
        self._sorted = flat[self._order]

    def inside(self, west: float, south: float, east: float, north: float) -> Ints:
        """Return the indices (K,) of the points in a window [m], world coordinates."""
        (c0, r0), (c1, r1) = (
            np.floor(np.array(corner) / self._size) - self._low for corner in ((west, south), (east, north))
        )
        first, last = max(int(c0), 0), min(int(c1), self._columns - 1)
        if first > last:
            return np.zeros(0, dtype=np.int64)
        rows = np.arange(max(int(r0), 0), int(r1) + 1) * self._columns
        starts = np.searchsorted(self._sorted, rows + first, "left")
        ends = np.searchsorted(self._sorted, rows + last, "right")
        parts = [self._order[a:b] for a, b in zip(starts, ends, strict=True)]
        near = np.concatenate([np.zeros(0, dtype=np.int64), *parts])
        x, y = self.world[near, 0], self.world[near, 1]
        return near[(x >= west) & (x < east) & (y >= south) & (y < north)]


@dataclass(frozen=True)
class View:
    """What a picture shows.

    Parameters
    ----------
    centre : (2,) float64
        Middle of the plan, world [m].
    side : float
        Edge of the plan [m].
    along : int
        Axis that a section shows: 0 east (looking north), 1 north (looking west).
    slab : (float, float)
        Depth that a section takes, world [m].
    middle : float
        Height in the middle of a section [m].
    exaggeration : int
        Vertical over horizontal scale of a section.
    heights : (float, float)
        Heights between which colours run [m].
    """

    centre: Floats
    side: float
    along: int
    slab: tuple[float, float]
    middle: float
    exaggeration: int
    heights: tuple[float, float]


def evidence_pictures(before: PointCloud, after: PointCloud, rows: gpd.GeoDataFrame) -> Iterator[bytes]:
    """Draw the evidence of every row, in the order of the rows.

    Parameters
    ----------
    before, after : PointCloud
        Labelled clouds in the frame of *after*.
    rows : GeoDataFrame
        Rows of the change table with footprints.

    Yields
    ------
    bytes
        WebP of :data:`WIDTH` x :data:`HEIGHT` pixels, at most :data:`MAX_BYTES`.
    """
    epochs = (Tiles(before), Tiles(after))
    for shape, semantic in zip(rows.geometry, rows["class"], strict=True):
        yield compact(draw(epochs, shape, flat=semantic == "ground"))


def compact(picture: Image.Image) -> bytes:
    """Return a picture as lossless WebP of few colours, fewer where it would pass :data:`MAX_BYTES`.

    Few flat colours take half the room of a lossy picture, and letters and outlines stay sharp.
    """
    for colours in _COLOURS:
        stream = io.BytesIO()
        few = picture.quantize(colours, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.convert("RGB").save(stream, "WEBP", lossless=True, quality=50, method=3)
        if stream.tell() <= MAX_BYTES:
            break
    return stream.getvalue()


def choose_view(epochs: Sequence[Tiles], shape: BaseGeometry, flat: bool) -> View:
    """Choose a view that holds a footprint and, in the section, all that stands on it.

    ``flat`` lets a section exaggerate heights: changes of the ground are small.
    """
    west, south, east, north = shape.bounds
    inside = [e.inside(west - 0.3, south - 0.3, east + 0.3, north + 0.3) for e in epochs]
    kept = [i[e.ground[i]] if flat else i for e, i in zip(epochs, inside, strict=True)]
    z = np.concatenate([e.world[i, 2] for e, i in zip(epochs, kept, strict=True)])
    low, high = np.percentile(z, [1.0, 99.5]) if len(z) else (0.0, 0.0)
    tall = float(high - low)
    side = max(_SMALLEST, _MARGIN * max(east - west, north - south), 1.25 * tall * PANEL / SECTION)
    room = 0.6 * side * SECTION / PANEL
    exaggeration = next((e for e in _EXAGGERATIONS if e * tall <= room), 1) if flat else 1
    along = 0 if east - west >= north - south else 1
    across = (south, north) if along == 0 else (west, east)
    return View(
        np.array([(west + east) / 2, (south + north) / 2]),
        float(side),
        along,
        (across[0] - _SLAB, across[1] + _SLAB),
        float((low + high) / 2),
        exaggeration,
        (float(low), float(max(high, low + (0.3 if flat else 1.0)))),
    )


def draw(epochs: Sequence[Tiles], shape: BaseGeometry, flat: bool = False) -> Image.Image:
    """Draw before, after and difference of one footprint, plans above and sections below."""
    view = choose_view(epochs, shape, flat)
    half = view.side / 2
    window = (*(view.centre - half), *(view.centre + half))
    near = [(e.world[index], e.change[index]) for e in epochs for index in [e.inside(*window)]]
    both = (np.concatenate([n[0] for n in near]), np.concatenate([n[1] for n in near]))
    picture = Image.new("RGB", (WIDTH, HEIGHT), "white")
    pen = ImageDraw.Draw(picture)
    columns = (("before", near[0], _height_colours), ("after", near[1], _height_colours))
    for number, (title, points, colour) in enumerate((*columns, ("difference", both, _change_colours))):
        left = number * (PANEL + GAP)
        _paste(picture, _plan(points, view, colour), (left, HEAD), (PANEL, PANEL))
        _paste(picture, _section(points, view, colour), (left, _BELOW), (PANEL, SECTION))
        _text(pen, (left, 1), title)
        _outline(pen, shape, view, (left, HEAD))
        _scale_bar(pen, view, (left + 6, HEAD + PANEL - 6))
        _ticks(pen, shape, view, left)
    scale = f", heights ×{view.exaggeration}" if view.exaggeration > 1 else ""
    _text(pen, (3, _BELOW + 1), f"looking {('north', 'west')[view.along]}{scale}")
    return picture


def _paste(picture: Image.Image, part: Colours, at: tuple[int, int], size: tuple[int, int]) -> None:
    picture.paste(Image.fromarray(part).resize(size, Image.Resampling.NEAREST), at)


Points = tuple[Floats, NDArray[np.uint8]]
Paint = Callable[[Points, View], Floats]


def _height_colours(points: Points, view: View) -> Floats:
    low, high = view.heights
    share = np.clip((points[0][:, 2] - low) / (high - low), 0.0, 1.0)
    return np.asarray(colormaps["viridis"](0.05 + 0.95 * share)[:, :3] * 255.0)


def _change_colours(points: Points, _: View) -> Floats:
    return change_palette()[points[1].astype(np.int64)].astype(np.float64)


def _plan(points: Points, view: View, colour: Paint) -> Colours:
    half, pixel = view.side / 2, max(_LEAF, view.side / PANEL)
    local = points[0] - np.append(view.centre, 0.0)
    frame = Frame(-half, -half, half, half, pixel)
    priority = np.isin(points[1], CHANGED) if colour is _change_colours else None
    seen = fill_holes(top_view(local, frame, priority))
    z = np.where(seen >= 0, points[0][seen, 2], np.nan) if len(local) else np.full(seen.shape, np.nan)
    return _filled(seen, colour(points, view), 0.45 + 0.65 * hillshade(z, pixel))


def _section(points: Points, view: View, colour: Paint) -> Colours:
    across = points[0][:, 1 - view.along]
    kept = (across >= view.slab[0]) & (across < view.slab[1])
    points = (points[0][kept], points[1][kept])
    half, pixel = view.side / 2, max(_LEAF, view.side / PANEL)
    tall = view.side * SECTION / PANEL / 2
    toward = points[0][:, 1 - view.along] * (-1.0 if view.along == 0 else 1.0)  # the nearer one is seen
    u = points[0][:, view.along] - view.centre[view.along]
    v = (points[0][:, 2] - view.middle) * view.exaggeration
    priority = np.isin(points[1], CHANGED) if colour is _change_colours else None
    seen = top_view(np.stack([u, v, toward], axis=1), Frame(-half, -tall, half, tall, pixel), priority)
    return _filled(seen, colour(points, view))


def _filled(seen: Ints, colours: Floats, shade: Floats | None = None) -> Colours:
    picture = np.empty((*seen.shape, 3), dtype=np.uint8)
    picture[:] = BACKGROUND
    hit = seen >= 0
    values = colours[seen[hit]] if shade is None else colours[seen[hit]] * shade[hit][:, None]
    picture[hit] = np.clip(values, 0, 255).astype(np.uint8)
    return picture


_FONT = ImageFont.truetype(Path(get_data_path()) / "fonts/ttf/DejaVuSans.ttf", 10)


def _text(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str) -> None:
    pen.text(at, text, fill="black", font=_FONT, stroke_width=2, stroke_fill="white")


def _outline(pen: ImageDraw.ImageDraw, shape: BaseGeometry, view: View, corner: tuple[int, int]) -> None:
    scale = PANEL / view.side
    for part in getattr(shape, "geoms", [shape]):
        xy = np.asarray(part.exterior.coords)[:, :2] - view.centre
        pixels = np.stack([xy[:, 0] + view.side / 2, view.side / 2 - xy[:, 1]], axis=1) * scale + corner
        path = [tuple(p) for p in pixels.tolist()]
        pen.line(path, fill="white", width=3, joint="curve")
        pen.line(path, fill="black", width=1)


def _ticks(pen: ImageDraw.ImageDraw, shape: BaseGeometry, view: View, left: int) -> None:
    """Mark the ends of the footprint above and below its section."""
    low, high = shape.bounds[view.along], shape.bounds[view.along + 2]
    top, bottom = _BELOW, HEIGHT - 1
    for end in (low, high):
        x = left + (end - view.centre[view.along] + view.side / 2) * PANEL / view.side
        for a, b in ((top, top + 6), (bottom - 6, bottom)):
            pen.line([(x, a), (x, b)], fill="black", width=1)


def _scale_bar(pen: ImageDraw.ImageDraw, view: View, at: tuple[int, int]) -> None:
    length = max(x for x in (1, 2, 5, 10, 20, 50, 100, 200, 500) if x <= max(view.side / 3, 1))
    x, y = at
    end = x + length * PANEL / view.side
    pen.line([(x - 1, y), (end + 1, y)], fill="white", width=5)
    pen.line([(x, y), (end, y)], fill="black", width=2)
    _text(pen, (x, y - 16), f"{length} m")
