"""Evidence pictures of one row: before, after and difference, in plan and in section."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from shapely.geometry.base import BaseGeometry

from subiaco_change.outputs.clouds import change_palette
from subiaco_change.outputs.terrain import hillshade
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.codes import CHANGED, Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_report.colours import BACKGROUND, VIRIDIS, Colours
from subiaco_report.top_views import Frame, fill_holes, top_view

PANEL, SECTION, HEAD = 140, 84, 15  # edges of the parts of a picture on the page [pixel]
WIDTH, HEIGHT = 3 * PANEL, HEAD + PANEL + SECTION
#: No picture is larger than this [byte]: what bounds the report.
MAX_BYTES = 10_000
_LEAF = 0.25  # finest detail of the clouds [m]
_BESIDE = 40.0  # rows so near to each other are drawn in turn [m]
_SMALLEST = 8.0  # edge of the smallest view [m]
_MARGIN = 1.6  # view over footprint
_SLAB = 1.0  # a section shows points within this distance of the footprint [m]
_EXAGGERATIONS = (20, 10, 5, 2, 1)
_COLOURS = (64, 40, 24, 12, 6)
_STEP = 5  # plans have a multiple of so many cells a side, sections three fifths of them


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

    @property
    def cells(self) -> int:
        """Cells along an edge of the plan: what the clouds can tell, and no more than are shown."""
        return min(-(-math.ceil(self.side / _LEAF) // _STEP) * _STEP, PANEL)


@dataclass(frozen=True)
class Evidence:
    """The picture of a row in cells, and what the page draws over it.

    The picture has three plans side by side above three sections. Over it lie the ``outline`` of the
    footprint as an SVG path from the corner of a plan, the ends of the footprint in a section
    (``ticks``), a scale bar of ``bar_m`` [m], all lengths in pixels of the page, and a ``note``.
    """

    webp: bytes
    outline: str
    ticks: tuple[float, float]
    bar: float
    bar_m: int
    note: str

    @property
    def uri(self) -> str:
        """The picture as a data URI."""
        return "data:image/webp;base64," + base64.b64encode(self.webp).decode("ascii")


def evidence_pictures(epochs: Sequence[CloudFile], rows: gpd.GeoDataFrame) -> list[Evidence]:
    """Draw the evidence of every row, in the order of the rows.

    Parameters
    ----------
    epochs : (CloudFile, CloudFile)
        Labelled clouds of *before* and *after* in the frame of *after*.
    rows : GeoDataFrame
        Rows of the change table with footprints.

    Returns
    -------
    list of Evidence
        Each picture has at most :data:`MAX_BYTES`.
    """
    centres = rows.geometry.centroid
    places = np.floor(np.stack([centres.x, centres.y], axis=1) / _BESIDE)
    found: dict[int, Evidence] = {}
    for k in np.lexsort(places.T).tolist():  # neighbours in turn: the files are read in the same places
        shape, flat = rows.geometry.iloc[k], rows["class"].iloc[k] == "ground"
        view = choose_view(epochs, shape, flat=flat)
        found[k] = _over(shape, view, compact(Image.fromarray(draw(epochs, view))))
    return [found[k] for k in range(len(rows))]


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


def choose_view(epochs: Sequence[CloudFile], shape: BaseGeometry, flat: bool) -> View:
    """Choose a view that holds a footprint and, in the section, all that stands on it.

    ``flat`` lets a section exaggerate heights: changes of the ground are small.
    """
    west, south, east, north = shape.bounds
    inside = [e.inside(west - 0.3, south - 0.3, east + 0.3, north + 0.3) for e in epochs]
    kept = [c.select(c.fields["semantic"] == Semantic.GROUND) if flat else c for c in inside]
    z = np.concatenate([c.xyz[:, 2] + c.origin[2] for c in kept])
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


def draw(epochs: Sequence[CloudFile], view: View) -> Colours:
    """Draw before, after and difference, plans above and sections below, a pixel a cell."""
    half = view.side / 2
    (west, south), (east, north) = view.centre - half, view.centre + half
    parts = []
    for epoch in epochs:
        inside = epoch.inside(west, south, east, north)
        parts.append((inside.world(), np.asarray(inside.fields["change"], dtype=np.uint8)))
    both = (np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))
    shown = [(parts[0], _height_colours), (parts[1], _height_colours), (both, _change_colours)]
    plans = [_plan(points, view, colour) for points, colour in shown]
    sections = [_section(points, view, colour) for points, colour in shown]
    return np.concatenate([np.concatenate(plans, axis=1), np.concatenate(sections, axis=1)])


def _over(shape: BaseGeometry, view: View, webp: bytes) -> Evidence:
    scale = PANEL / view.side
    west, north = view.centre + view.side / 2 * np.array([-1.0, 1.0])
    low = view.centre[view.along] - view.side / 2
    ends = (shape.bounds[view.along], shape.bounds[view.along + 2])
    bar = max(x for x in (1, 2, 5, 10, 20, 50, 100, 200, 500) if x <= max(view.side / 3, 1))
    exaggerated = f", heights ×{view.exaggeration}" if view.exaggeration > 1 else ""
    return Evidence(
        webp,
        svg_path(shape, west, north, scale),
        (round((ends[0] - low) * scale, 1), round((ends[1] - low) * scale, 1)),
        round(bar * scale, 1),
        bar,
        f"looking {('north', 'west')[view.along]}{exaggerated}",
    )


def svg_path(shape: BaseGeometry, west: float, north: float, scale: float = 1.0) -> str:
    """Return the outlines of a footprint as an SVG path, y down from the north edge.

    Lengths are multiplied by ``scale``; what is finer than the clouds is left out.
    """
    plain = shape.simplify(_LEAF)
    parts = []
    for polygon in getattr(plain, "geoms", [plain]):
        xy = np.asarray(polygon.exterior.coords)[:-1, :2]
        local = np.round(np.stack([xy[:, 0] - west, north - xy[:, 1]], axis=1) * scale, 1)
        parts.append("M" + "L".join(f"{x:g} {y:g}" for x, y in local.tolist()) + "Z")
    return "".join(parts)


Points = tuple[Floats, NDArray[np.uint8]]
Paint = Callable[[Points, View], Floats]


def _height_colours(points: Points, view: View) -> Floats:
    low, high = view.heights
    share = np.clip((points[0][:, 2] - low) / (high - low), 0.0, 1.0)
    return np.asarray(VIRIDIS(0.05 + 0.95 * share)[:, :3] * 255.0)


def _change_colours(points: Points, _: View) -> Floats:
    return change_palette()[points[1].astype(np.int64)].astype(np.float64)


def _plan(points: Points, view: View, colour: Paint) -> Colours:
    half, pixel = view.side / 2, view.side / view.cells
    local = points[0] - np.append(view.centre, 0.0)
    frame = Frame(-half, -half, half, half, pixel)
    priority = np.isin(points[1], CHANGED) if colour is _change_colours else None
    seen = fill_holes(top_view(local, frame, priority))
    z = np.where(seen >= 0, points[0][seen, 2], np.nan) if len(local) else np.full(seen.shape, np.nan)
    return _filled(seen, points, view, colour, 0.45 + 0.65 * hillshade(z, pixel))


def _section(points: Points, view: View, colour: Paint) -> Colours:
    across = points[0][:, 1 - view.along]
    kept = (across >= view.slab[0]) & (across < view.slab[1])
    points = (points[0][kept], points[1][kept])
    half, pixel = view.side / 2, view.side / view.cells
    tall = view.side * SECTION / PANEL / 2
    toward = points[0][:, 1 - view.along] * (-1.0 if view.along == 0 else 1.0)  # the nearer one is seen
    u = points[0][:, view.along] - view.centre[view.along]
    v = (points[0][:, 2] - view.middle) * view.exaggeration
    priority = np.isin(points[1], CHANGED) if colour is _change_colours else None
    seen = top_view(np.stack([u, v, toward], axis=1), Frame(-half, -tall, half, tall, pixel), priority)
    return _filled(seen, points, view, colour)


def _filled(seen: Ints, points: Points, view: View, colour: Paint, shade: Floats | None = None) -> Colours:
    picture = np.empty((*seen.shape, 3), dtype=np.uint8)
    picture[:] = BACKGROUND
    hit = seen >= 0
    shown = seen[hit]
    values = colour((points[0][shown], points[1][shown]), view)
    values = values if shade is None else values * shade[hit][:, None]
    picture[hit] = np.clip(values, 0, 255).astype(np.uint8)
    return picture
