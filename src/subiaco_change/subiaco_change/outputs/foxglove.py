"""A finished comparison as one MCAP file that Foxglove opens without software of ours.

The clouds, outlines and frames are ROS 2 messages with their definitions, on the topics of the change node.
The table is JSON with the schema of the change table, so that every column has its name and meaning.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from pyproj import Proj

from subiaco_change.outputs.clouds import change_palette, labelled_path
from subiaco_change.outputs.table import table_schema
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo import __version__
from subiaco_geo.bags import TYPESTORE
from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.crs import EnuFrame, horizontal, require_map_crs
from subiaco_geo.frames import Floats

#: Points of one epoch in the file; a viewer in a browser shows no more smoothly.
MOST_POINTS = 2_000_000

_FRAME = "map"
_QUIET = frozenset({Change.UNCHANGED, Change.NOT_REPORTED, Change.UNOBSERVED})
_POINT = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4"), ("change", "u1"), ("semantic", "u1"),
        ("instance", "<i4"), ("confidence", "<f4"), ("lod95", "<f4"),
    ]
)  # fmt: skip
_LINE_LIST, _TEXT = 5, 9  # constants of visualization_msgs/Marker
_POINT_TYPES = {"u1": 2, "i4": 5, "f4": 7}  # constants of sensor_msgs/PointField

#: World coordinates (N, 3) to the local frame (N, 3).
ToLocal = Callable[[Floats], Floats]


def write_foxglove(path: Path, directory: Path, table: gpd.GeoDataFrame, left_out: NDArray[np.int64]) -> None:
    """Write the labelled clouds, the outlines and the table of a change directory.

    Parameters
    ----------
    path : Path
        The ``.mcap`` that is written.
    directory : Path
        Change directory.
    table : GeoDataFrame
        The rows to write, with their footprints.
    left_out : (M,) int64
        Objects whose points get code 254, NotReported.

    Notes
    -----
    Clouds are float32 in the local frame ``map`` (east, north, up about the origin of the later cloud; the
    map's own axes where the map has no CRS). Of a cloud of more than :data:`MOST_POINTS` points, changed
    points are kept and the others thinned evenly.
    """
    origin, crs = _origin(labelled_path(directory, "after"))
    enu = _enu(origin, crs)

    def to_local(xyz: Floats) -> Floats:
        return np.asarray(xyz - origin) if enu is None else enu.points_from_map(xyz, str(crs))

    with path.open("wb") as stream:
        log = _Log(stream, _time_ns(table))
        heights: dict[int, tuple[float, float]] = {}
        counts: dict[str, str] = {}
        for epoch in ("before", "after"):
            points, total = _points(labelled_path(directory, epoch), to_local, left_out)
            _widen(heights, points)
            log.ros(f"/change/{epoch}", "sensor_msgs/msg/PointCloud2", _cloud_fields(points))
            counts[f"{epoch}_points"], counts[f"{epoch}_points_of"] = str(len(points)), str(total)
        log.ros("/change/markers", "visualization_msgs/msg/MarkerArray", _markers(table, heights, to_local))
        log.json("/change/table", "subiaco.ChangeTable", _table_schema(), _table_value(table, crs))
        if enu is not None:
            log.ros("/change/origin", "sensor_msgs/msg/NavSatFix", _origin_fields(enu))
            log.json("/change/footprints", "foxglove.GeoJSON", _GEOJSON_SCHEMA, _geojson(table))
        log.finish({"software": f"subiaco {__version__}", "crs": crs or "", **counts})


def _origin(path: Path) -> tuple[Floats, str | None]:
    first = next(iter(cloud_parts(path, ())))
    return first.origin, first.crs


def _enu(origin: Floats, crs: str | None) -> EnuFrame | None:
    if crs is None:
        return None
    easting, northing, height = origin.tolist()
    longitude, latitude = Proj(horizontal(require_map_crs(crs)))(easting, northing, inverse=True)
    return EnuFrame(latitude, longitude, height)


def _time_ns(table: gpd.GeoDataFrame) -> int:
    """Return the start of the day of the later survey (UTC), 0 where the maps state no times."""
    days = pd.to_datetime(table["date_after"], errors="coerce", utc=True).dropna()
    return int(days.iloc[0].value) if len(days) else 0


class _Log:
    """An MCAP file whose messages all carry one time; the last one comes a second later.

    A player shows nothing of a file without a duration.
    """

    def __init__(self, stream: Any, time_ns: int) -> None:
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"subiaco {__version__}")
        self._time_ns = time_ns
        self._schemas: dict[str, int] = {}
        self._tf()

    def ros(self, topic: str, kind: str, fields: dict[str, Any]) -> None:
        """Write a ROS 2 message from its fields; a header is added."""
        header = {"stamp": _stamp(self._time_ns), "frame_id": _FRAME}
        given = {"header": header, **fields} if "header" in _names(kind) else fields
        text, _ = TYPESTORE.generate_msgdef(kind, ros_version=2)
        data = bytes(TYPESTORE.serialize_cdr(_message(kind, given), kind))
        self._write(topic, (kind, "ros2msg", text.encode()), "cdr", data)

    def json(self, topic: str, name: str, schema: dict[str, Any], value: dict[str, Any]) -> None:
        """Write a JSON message with its schema."""
        described = (name, "jsonschema", json.dumps(schema).encode())
        self._write(topic, described, "json", json.dumps(value, allow_nan=False).encode())

    def finish(self, facts: dict[str, str]) -> None:
        """Close the file with facts about it."""
        self._time_ns += 10**9
        self._tf()
        self._writer.add_metadata("subiaco", facts)
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _tf(self) -> None:
        identity = {"translation": {}, "rotation": {"w": 1.0}}
        transform = {
            "header": {"stamp": _stamp(self._time_ns), "frame_id": "world"},
            "child_frame_id": _FRAME,
            "transform": identity,
        }
        self.ros("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [transform]})

    def _write(self, topic: str, schema: tuple[str, str, bytes], encoding: str, data: bytes) -> None:
        if topic not in self._schemas:
            name, form, text = schema
            number = self._writer.register_schema(name, form, text)
            self._schemas[topic] = self._writer.register_channel(topic, encoding, number)
        self._writer.add_message(self._schemas[topic], self._time_ns, data, self._time_ns)


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}


def _names(kind: str) -> tuple[str, ...]:
    return tuple(name for name, _ in TYPESTORE.fielddefs[kind][1])


#: Values of fields that are not given, by the primitive type.
_EMPTY = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def _message(kind: str, given: dict[str, Any]) -> Any:
    """Return the message of a type from nested fields; those that are not given are zero or empty."""
    fields = {name: _value(form, given.get(name)) for name, form in TYPESTORE.fielddefs[kind][1]}
    unknown = set(given) - fields.keys()
    if unknown:
        raise KeyError(f"{kind} has no field {', '.join(sorted(unknown))}")
    return TYPESTORE.types[kind](**fields)


def _value(form: Any, given: Any) -> Any:
    node, inner = int(form[0]), form[1]
    if node == 1:  # a primitive type
        return _EMPTY.get(inner[0], 0) if given is None else given
    if node == 2:  # a message
        return _message(inner, given or {})
    element, length = inner
    if int(element[0]) == 2:
        return [_message(element[1], item) for item in given or ()]
    if element[1][0] == "string":
        return list(given or ())
    return np.asarray(np.zeros(length) if given is None else given, np.dtype(element[1][0]))


def _points(path: Path, to_local: ToLocal, left_out: NDArray[np.int64]) -> tuple[NDArray[np.void], int]:
    """Return the points of a labelled cloud that are written, and how many the cloud has."""
    total = changed = 0
    for part in cloud_parts(path, ("change",)):
        total += len(part)
        changed += int(_is_changed(part).sum())
    stride = max(1, -(-(total - changed) // max(1, MOST_POINTS - changed)))
    return np.concatenate(list(_chosen(path, to_local, left_out, stride))), total


def _is_changed(cloud: PointCloud) -> NDArray[np.bool_]:
    return np.asarray(cloud.fields["change"]) < Change.UNCHANGED


def _chosen(
    path: Path, to_local: ToLocal, left_out: NDArray[np.int64], stride: int
) -> Iterator[NDArray[np.void]]:
    first = 0
    for part in cloud_parts(path, None):
        number = np.arange(first, first + len(part))
        first += len(part)
        yield _structured(part.select(_is_changed(part) | (number % stride == 0)), to_local, left_out)


def _structured(cloud: PointCloud, to_local: ToLocal, left_out: NDArray[np.int64]) -> NDArray[np.void]:
    points = np.zeros(len(cloud), _POINT)
    if len(cloud):
        points["x"], points["y"], points["z"] = to_local(cloud.world()).T
    for name in ("change", "semantic", "instance", "confidence", "lod95"):
        points[name] = cloud.fields[name]
    hidden = np.isin(points["instance"], left_out) & (points["change"] < Change.UNCHANGED)
    points["change"][hidden] = Change.NOT_REPORTED
    red, green, blue = change_palette()[points["change"].astype(np.int64)].astype(np.uint32).T
    points["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    return points


def _cloud_fields(points: NDArray[np.void]) -> dict[str, Any]:
    members: Any = _POINT.fields
    described = [
        {"name": name, "offset": offset, "datatype": _POINT_TYPES[dtype.str[1:]], "count": 1}
        for name, (dtype, offset, *_) in members.items()
    ]
    step = _POINT.itemsize
    return {
        "height": 1,
        "width": len(points),
        "fields": described,
        "point_step": step,
        "row_step": step * len(points),
        "data": points.view(np.uint8).reshape(-1),
        "is_dense": True,
    }


def _widen(heights: dict[int, tuple[float, float]], points: NDArray[np.void]) -> None:
    """Take the lowest and the highest point of every object into account, over both epochs."""
    ids, where = np.unique(points["instance"], return_inverse=True)
    low, high = np.full(len(ids), np.inf), np.full(len(ids), -np.inf)
    np.minimum.at(low, where, points["z"])
    np.maximum.at(high, where, points["z"])
    for number, bottom, top in zip(ids.tolist(), low.tolist(), high.tolist(), strict=True):
        known = heights.get(number, (np.inf, -np.inf))
        heights[number] = (min(known[0], bottom), max(known[1], top))


def _origin_fields(enu: EnuFrame) -> dict[str, Any]:
    return {"latitude": enu.latitude_deg, "longitude": enu.longitude_deg, "altitude": enu.height}


def _colour(change: Change) -> dict[str, float]:
    red, green, blue = (value / 255.0 for value in CHANGE_COLOURS[change])
    return {"r": red, "g": green, "b": blue, "a": 1.0}


def _markers(
    table: gpd.GeoDataFrame, heights: dict[int, tuple[float, float]], to_local: ToLocal
) -> dict[str, Any]:
    """Return the outline of every changed object as a prism of lines, with a label above the object."""
    markers: list[dict[str, Any]] = []
    by_label = {change.label: change for change in Change}
    for row in table.to_dict("records"):
        change = by_label[row["label"]]
        bounds = heights.get(row["object_id"])
        if change in _QUIET or bounds is None or row["geometry"] is None or row["geometry"].is_empty:
            continue
        markers += _prism(row, change, bounds, to_local)
    return {"markers": markers}


def _prism(
    row: dict[str, Any], change: Change, bounds: tuple[float, float], to_local: ToLocal
) -> list[dict[str, Any]]:
    low, high = bounds
    segments: list[dict[str, float]] = []
    for polygon in getattr(row["geometry"], "geoms", [row["geometry"]]):
        ring = np.asarray(polygon.exterior.coords)[:, :2]
        local = to_local(np.column_stack([ring, np.full(len(ring), row["z"])]))
        for (x0, y0, _), (x1, y1, _) in pairwise(local.tolist()):
            corners = [(x0, y0, low), (x1, y1, low), (x0, y0, high), (x1, y1, high)]
            corners += [corners[0], corners[2]]
            segments += [{"x": x, "y": y, "z": z} for x, y, z in corners]
    common = {"header": {"frame_id": _FRAME}, "id": row["object_id"], "color": _colour(change)}
    middle = to_local(np.array([[row["x"], row["y"], row["z"]]]))[0].tolist()
    above = {"x": middle[0], "y": middle[1], "z": high + 1.0}
    text = f"{row['object_id']} {row['class']} {row['label']}"
    outline = {"ns": "objects", "type": _LINE_LIST, "scale": {"x": 0.15}, "points": segments}
    label = {"ns": "labels", "type": _TEXT, "scale": {"z": 1.0}, "text": text}
    return [
        {**common, **outline, "pose": {"orientation": {"w": 1.0}}},
        {**common, **label, "pose": {"position": above, "orientation": {"w": 1.0}}},
    ]


_GEOJSON_SCHEMA: dict[str, Any] = {
    "type": "object",
    "title": "foxglove.GeoJSON",
    "properties": {"geojson": {"type": "string", "description": "GeoJSON data"}},
}


def _geojson(table: gpd.GeoDataFrame) -> dict[str, Any]:
    """Return the footprints of changed objects in longitude and latitude, coloured by their label."""
    quiet = {change.label for change in _QUIET}
    chosen = table[~table["label"].isin(quiet)][["object_id", "class", "label", "reason", "geometry"]]
    colours = {change.label: "#{:02x}{:02x}{:02x}".format(*rgb) for change, rgb in CHANGE_COLOURS.items()}
    chosen = chosen.to_crs("EPSG:4326")
    shapes = json.loads(chosen.to_json(drop_id=True))
    for feature in shapes["features"]:
        feature["properties"]["style"] = {"color": colours[feature["properties"]["label"]], "weight": 2}
    return {"geojson": json.dumps(shapes)}


def _table_schema() -> dict[str, Any]:
    rows = table_schema()
    return {
        "type": "object",
        "title": "subiaco.ChangeTable",
        "properties": {
            "crs": {"type": "string", "description": "CRS of x, y and z; empty where the maps are local."},
            "records": {name: rows[name] for name in ("type", "items", "description")},
        },
    }


def _table_value(table: gpd.GeoDataFrame, crs: str | None) -> dict[str, Any]:
    plain = pd.DataFrame(table.drop(columns="geometry"))
    return {"crs": crs or "", "records": json.loads(plain.to_json(orient="records", date_format="iso"))}
