"""The folder ``viewer`` of a change directory: octrees of both epochs, the table, and their page."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.outputs.change_directory_reading import ChangeDirectory, read_change_directory
from subiaco_change.outputs.clouds import open_labelled
from subiaco_change.records import SEMANTIC_COLOURS
from subiaco_geo.atomic import whole_directory
from subiaco_geo.cloud_windows import CloudFile
from subiaco_geo.codes import CHANGED_LABELS, Change, Semantic
from subiaco_geo.frames import Floats
from subiaco_report.facts import is_simulated, legend
from subiaco_report.row_data import pack, page_rows
from subiaco_report.summary import epoch_facts
from subiaco_report.viewer.node_files import IntensityStretch, node_columns, node_script
from subiaco_report.viewer.octree import (
    GRID,
    NodeKey,
    RootCube,
    column_level,
    nodes_of,
    unit_positions,
)

#: The folder in a change directory, its page, and the file that marks the folder as ours.
FOLDER, PAGE, MARKER = "viewer", "index.html", "README.txt"
_ABOUT = """3D viewer of the two surveys of this change directory.

Open index.html in a browser. No network is needed. If the browser refuses to load files from the disk, run
`python -m http.server` in the change directory and open http://localhost:8000/viewer/index.html.
The folders before and after hold the points in pieces that the page loads when they come into view.
three.min.js is three.js under the MIT licence: three.LICENSE.txt.
"""
_STATIC = ("index.html", "viewer.css", "viewer.js", "point_octree.js", "three.min.js", "three.LICENSE.txt")
#: Clouds with more points than this have no viewer unless it is asked for.
AUTOMATIC_POINTS = 20_000_000
_SAMPLE = 20_000
_EPOCHS = ("before", "after")
_TEXTS = ("label", "class", "reason", "review")
_NUMBERS = ("delta_h_m", "delta_v_m3", "confidence", "lod95_m", "observed_fraction", "x", "y", "z")


@dataclass
class _Bounds:
    """Lowest and highest coordinates [m] of the points of every object, relative to the root cube."""

    low: Floats
    high: Floats

    @staticmethod
    def of(count: int) -> _Bounds:
        return _Bounds(np.full((count, 3), np.inf), np.full((count, 3), -np.inf))

    def add(self, instance: NDArray[np.generic], xyz: Floats) -> None:
        ids = np.asarray(instance, dtype=np.int64)
        held = np.flatnonzero((ids >= 0) & (ids < len(self.low)))
        ids = ids[held]
        np.minimum.at(self.low, ids, xyz[held])
        np.maximum.at(self.high, ids, xyz[held])


def build_viewer(directory: Path) -> Path:
    """Write the folder ``viewer`` of a change directory.

    Parameters
    ----------
    directory : Path
        Change directory. A viewer that is there is replaced.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        The directory is not a complete change directory.
    """
    change = read_change_directory(directory)
    clouds = {epoch: open_labelled(directory, epoch) for epoch in _EPOCHS}
    low = np.min([cloud.low for cloud in clouds.values()], axis=0)
    high = np.max([cloud.high for cloud in clouds.values()], axis=0)
    root = RootCube.around(low, high)
    count = int(change.table["object_id"].max()) + 1 if len(change.table) else 0
    bounds = _Bounds.of(count)
    with whole_directory(directory / FOLDER, overwrite=True, marker=MARKER) as target:
        described = {epoch: _write_cloud(target, epoch, clouds[epoch], root, bounds) for epoch in _EPOCHS}
        document = _document(change, root, described, bounds)
        (target / "data.js").write_text(f'subiacoViewerData("{pack(document)}");\n', encoding="utf-8")
        for name in _STATIC:
            (target / name).write_bytes((files(__package__) / "static" / name).read_bytes())
        (target / MARKER).write_text(_ABOUT, encoding="utf-8")
    return directory / FOLDER / PAGE


def viewer_link(directory: Path) -> str | None:
    """Return the address of the viewer relative to the report, None where there is no viewer."""
    return f"{FOLDER}/{PAGE}" if (directory / FOLDER / PAGE).is_file() else None


def update_viewer(directory: Path) -> Path | None:
    """Write the viewer of a change directory where its clouds are small, or where there is one already.

    Returns
    -------
    Path or None
        The page.
    """
    points = sum(read_change_directory(directory).run["points"].values())
    if points > AUTOMATIC_POINTS and viewer_link(directory) is None:
        return None
    return build_viewer(directory)


def _write_cloud(
    target: Path, epoch: str, cloud: CloudFile, root: RootCube, bounds: _Bounds
) -> dict[str, Any]:
    """Write the nodes of one cloud; return what the page must know of them."""
    folder = target / epoch
    folder.mkdir()
    points, stretch, spacing, heights = _survey(cloud)
    level = column_level(points)
    above: dict[NodeKey, list[dict[str, NDArray[np.generic]]]] = defaultdict(list)
    nodes: dict[str, int] = {}

    def write(key: NodeKey, columns: dict[str, NDArray[np.generic]]) -> None:
        name = key.name()
        (folder / f"{name}.js").write_text(node_script(epoch, name, columns), encoding="ascii")
        nodes[name] = len(columns["x"])

    for i, j in np.ndindex(2**level, 2**level):
        part = cloud.inside(*root.column(level, i, j))
        if len(part) == 0:
            continue
        unit = unit_positions(part, root)
        bounds.add(part.fields["instance"], unit * root.size)
        changed = np.asarray(part.fields["change"]) <= int(Change.DECREASED)
        for key, index in nodes_of(unit, changed, level):
            columns = node_columns(part.select(index), unit[index], key, stretch)
            if key.level < level:
                above[key].append(columns)
            else:
                write(key, columns)
    for key, parts in above.items():
        write(key, {name: np.concatenate([p[name] for p in parts]) for name in parts[0]})
    return {
        "points": int(sum(nodes.values())),
        "spacing": spacing,
        "heights": [float(h - root.corner[2]) for h in heights],
        "box": [(cloud.low - root.corner).tolist(), (cloud.high - root.corner).tolist()],
        "nodes": [[name, nodes[name]] for name in sorted(nodes)],
    }


def _survey(cloud: CloudFile) -> tuple[int, IntensityStretch, float, tuple[float, float]]:
    """Return points, stretch of the intensity, median spacing [m] and usual heights of a cloud [m]."""
    points, spacings, bright, heights = 0, [], [], []
    for part in cloud.parts():
        points += len(part)
        some = np.linspace(0, len(part) - 1, min(len(part), _SAMPLE)).astype(np.int64)
        heights.append(part.xyz[some, 2] + part.origin[2])
        if "intensity" in part.fields:
            bright.append(np.asarray(part.fields["intensity"], dtype=np.float64)[some])
        if len(part) > 1:
            near, _ = cKDTree(part.xyz, balanced_tree=False, compact_nodes=False).query(
                part.xyz[some[:: max(1, len(some) // 2000)]], k=[2]
            )
            spacings.append(float(np.median(near)))
    shown = np.nanpercentile(np.concatenate(bright), [2.0, 98.0]) if bright else np.array([0.0, 1.0])
    low, high = np.percentile(np.concatenate(heights), [1.0, 99.0])
    spacing = float(np.median(spacings)) if spacings else 1.0
    return points, IntensityStretch(*map(float, shown)), max(spacing, 0.01), (float(low), float(high))


def _document(
    change: ChangeDirectory, root: RootCube, clouds: dict[str, Any], bounds: _Bounds
) -> dict[str, Any]:
    """Return what the page works on beside the points."""
    rows = page_rows(change.table)
    viridis = np.round(255 * colormaps["viridis"](np.arange(256))[:, :3]).astype(int)
    return {
        "crs": change.run.get("crs"),
        "corner": root.corner.tolist(),
        "size": root.size,
        "grid": GRID,
        "clouds": clouds,
        "days": {fact["epoch"]: fact["days"] for fact in epoch_facts(change.run)},
        "simulated": is_simulated(change.run),
        "labels": [{**entry, "code": int(code)} for entry, code in zip(legend(), Change, strict=True)],
        "classes": [
            {"label": s.label, "code": int(s), "colour": f"rgb{SEMANTIC_COLOURS[s]}"} for s in Semantic
        ],
        "changed": list(CHANGED_LABELS),
        "ramp": viridis.ravel().tolist(),
        "rows": _rows(rows, bounds, root),
        "left_out": len(change.table) - len(rows),
    }


def _rows(rows: gpd.GeoDataFrame, bounds: _Bounds, root: RootCube) -> dict[str, list[Any]]:
    """Return the rows column by column, and the box of the points of each, relative to the root cube [m]."""
    found: dict[str, list[Any]] = {"object_id": rows["object_id"].astype(int).tolist()}
    for name in _TEXTS:
        found[name] = rows[name].fillna("").astype(str).tolist()
    for name in _NUMBERS:
        values = rows[name].to_numpy(dtype=np.float64).round(3)
        found[name] = [float(v) if np.isfinite(v) else None for v in values]
    ids = rows["object_id"].to_numpy(dtype=np.int64)
    boxes = np.concatenate([bounds.low[ids], bounds.high[ids]], axis=1)
    place = rows[["x", "y", "z"]].to_numpy(dtype=np.float64) - root.corner
    none = ~np.isfinite(boxes).all(axis=1)  # an object of which no point carries the number
    boxes[none] = np.concatenate([place[none] - 1.0, place[none] + 1.0], axis=1)
    found["box"] = boxes.round(2).tolist()
    return found
