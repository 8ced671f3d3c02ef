"""Colours of top views: intensity, height, class, object and change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from subiaco_change.outputs.clouds import change_palette
from subiaco_change.outputs.terrain import hillshade
from subiaco_change.records import SEMANTIC_COLOURS
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import CHANGED
from subiaco_geo.frames import Floats, Ints
from subiaco_report.top_views import Frame, fill_holes, top_view

VIRIDIS = colormaps["viridis"]  # a copy at every look-up, of which each makes its table anew
BACKGROUND = (247, 247, 245)

Colours = NDArray[np.uint8]


def height_range(clouds: Sequence[PointCloud]) -> tuple[float, float]:
    """Return the heights [m] between which colours run: nearly all points."""
    z = np.concatenate([cloud.xyz[:, 2] + cloud.origin[2] for cloud in clouds])
    if len(z) == 0:
        return 0.0, 1.0
    low, high = np.percentile(z, [1.0, 99.5])
    return float(low), float(max(high, low + 1.0))


@dataclass(frozen=True)
class TopView:
    """What is seen of a cloud from above: point (rows, columns) of every pixel, -1 for none; its shade."""

    point: Ints
    shade: Floats


def seen_from_above(cloud: PointCloud, frame: Frame, *, changed_first: bool, fill: int = 1) -> TopView:
    """Return what is seen of a cloud in a frame in world coordinates.

    ``changed_first``: changed points hide all others; ``fill``: pixels by which points grow.
    """
    origin = np.append(cloud.origin[:2], 0.0)
    local = Frame(
        frame.west - origin[0],
        frame.south - origin[1],
        frame.east - origin[0],
        frame.north - origin[1],
        frame.pixel,
    )
    priority = np.isin(np.asarray(cloud.fields["change"]), CHANGED) if changed_first else None
    view = fill_holes(top_view(cloud.xyz, local, priority), fill)
    seen = view >= 0
    z = np.full(view.shape, np.nan)
    z[seen] = cloud.xyz[view[seen], 2]
    return TopView(view, hillshade(z, frame.pixel) if seen.any() else z)


def paint(
    cloud: PointCloud,
    frame: Frame,
    kind: str,
    heights: tuple[float, float] = (0.0, 1.0),
    fill: int = 1,
    seen_points: TopView | None = None,
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
    seen_points : TopView, optional
        Of the cloud in the frame, where it is known: all kinds but *change* share one.
    """
    view = seen_points or seen_from_above(cloud, frame, changed_first=kind == "change", fill=fill)
    seen = view.point >= 0
    picture = np.empty((*seen.shape, 3), dtype=np.uint8)
    picture[:] = BACKGROUND
    if not seen.any():
        return picture
    index, shade = view.point[seen], view.shade[seen]
    picture[seen] = _shaded(_colours(cloud, index, kind, heights, shade), shade, kind)
    return picture


def _colours(
    cloud: PointCloud, index: Ints, kind: str, heights: tuple[float, float], shade: Floats
) -> Floats:
    if kind == "projection":
        return _brightness(cloud, index, shade)[:, None] * np.array([235.0, 238.0, 245.0])
    if kind == "height":
        values = cloud.xyz[index, 2] + cloud.origin[2]
        return np.asarray(ScalarMappable(Normalize(*heights), VIRIDIS).to_rgba(values)[:, :3] * 255.0)
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
