"""Change results as messages: clouds, table, markers."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Point, Point32, Polygon, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from subiaco_change.outputs.preview import ChangePreview
from subiaco_change.outputs.table import footprint_polygon, object_uids
from subiaco_change.records import CHANGE_COLOURS, ChangeRecord
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats
from subiaco_msgs.msg import ChangeRecord as ChangeRecordMessage
from subiaco_msgs.msg import ChangeTable
from subiaco_ros.local_frame import LocalFrame
from subiaco_ros.messages import cloud_message, header, xyz_cloud

#: What happened nowhere is not marked.
_QUIET = frozenset({Change.UNCHANGED, Change.NOT_REPORTED, Change.UNOBSERVED})
#: Columns that message and record share by name; those set by hand are left out.
_SAME_NAME = tuple(
    field.name
    for field in fields(ChangeRecord)
    if field.name in ChangeRecordMessage.get_fields_and_field_types()
    and field.name not in {"object_id", "id_before", "id_after", "match_kind", "evidence", "footprint"}
)
#: Codes of the words in the table, by the constants of the message.
MATCH_KINDS = {
    word: getattr(ChangeRecordMessage, f"MATCH_{word.upper()}")
    for word in ("none", "one_to_one", "split", "merge")
}
EVIDENCE = {
    word: getattr(ChangeRecordMessage, f"EVIDENCE_{word.upper()}")
    for word in ("observed", "trajectory", "estimated", "shadow", "assumed")
}


def packed_colours(change: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the paper's colours of change codes (N,), packed as viewers expect in field ``rgb``."""
    table = np.zeros(256, np.uint32)
    for code, (red, green, blue) in CHANGE_COLOURS.items():
        table[code] = red << 16 | green << 8 | blue
    return table[change].view(np.float32)


def change_cloud_message(cloud: PointCloud, frame: LocalFrame, frame_id: str, time_ns: int) -> PointCloud2:
    """Build the labelled cloud of one epoch, float32 in the local frame."""
    change = np.asarray(cloud.fields["change"], np.uint8)
    points = xyz_cloud(
        frame.from_world(cloud.world()),
        change=change,
        semantic=np.asarray(cloud.fields["semantic"], np.uint8),
        instance=np.asarray(cloud.fields["instance"], np.int32),
        confidence=np.asarray(cloud.fields["confidence"], np.float32),
        lod95=np.asarray(cloud.fields["lod95"], np.float32),
        rgb=packed_colours(change),
    )
    return cloud_message(points, frame_id, time_ns)


def footprint_message(record: ChangeRecord, frame: LocalFrame) -> list[Polygon]:
    """Return the outer rings of a footprint in the local frame, at the height of the centroid."""
    rings = []
    for part in footprint_polygon(record).geoms:
        ring = np.asarray(part.exterior.coords)[:-1, :2]
        local = frame.from_world(np.column_stack([ring, np.full(len(ring), record.z)]))
        rings.append(Polygon(points=[Point32(x=x, y=y, z=z) for x, y, z in local.tolist()]))
    return rings


def record_message(record: ChangeRecord, uid: str, frame: LocalFrame) -> ChangeRecordMessage:
    """Build one row of the table."""
    message = ChangeRecordMessage(
        object_id=record.object_id,
        object_uid=uid,
        object_class=int(record.semantic),
        change=int(record.change),
        id_before=list(record.id_before),
        id_after=list(record.id_after),
        match_kind=MATCH_KINDS[record.match_kind],
        evidence=EVIDENCE[record.evidence],
        area_m2=record.area_m2,
        footprint=footprint_message(record, frame),
    )
    for name in _SAME_NAME:
        value = getattr(record, name)
        kind = type(getattr(message, name))
        setattr(message, name, kind(value))
    return message


def table_message(
    preview: ChangePreview, directory: Path, frame: LocalFrame, frame_id: str, time_ns: int
) -> ChangeTable:
    """Build the whole table."""
    counts = Counter(record.change for record in preview.records)
    uids = object_uids(preview.records)
    return ChangeTable(
        header=header(time_ns, frame_id),
        crs=preview.after.crs or "",
        directory=str(directory),
        records=[record_message(*row, frame) for row in zip(preview.records, uids, strict=True)],
        changes=[int(change) for change in counts],
        counts=list(counts.values()),
    )


def local_box(low: Floats, high: Floats, frame: LocalFrame) -> tuple[Floats, Floats]:
    """Return the lowest and highest local corner (3,) of a box given by its world corners."""
    pair = np.stack([low, high])
    corners = np.stack(np.meshgrid(*pair.T, indexing="ij"), axis=-1).reshape(-1, 3)
    local = frame.from_world(corners)
    return local.min(axis=0), local.max(axis=0)


def _colour(change: Change, alpha: float) -> ColorRGBA:
    red, green, blue = (value / 255.0 for value in CHANGE_COLOURS[change])
    return ColorRGBA(r=red, g=green, b=blue, a=alpha)


def _markers(record: ChangeRecord, low: Floats, high: Floats, frame_id: str, time_ns: int) -> list[Marker]:
    middle, size = (low + high) / 2, np.maximum(high - low, 0.1)
    box = Marker(header=header(time_ns, frame_id), ns="objects", id=record.object_id, type=Marker.CUBE)
    box.pose.position = Point(x=float(middle[0]), y=float(middle[1]), z=float(middle[2]))
    box.pose.orientation.w = 1.0
    box.scale = Vector3(x=float(size[0]), y=float(size[1]), z=float(size[2]))
    box.color = _colour(record.change, 0.35)
    text = Marker(header=header(time_ns, frame_id), ns="labels", id=record.object_id)
    text.type = Marker.TEXT_VIEW_FACING
    text.pose.position = Point(x=float(middle[0]), y=float(middle[1]), z=float(high[2]) + 1.0)
    text.pose.orientation.w = 1.0
    text.scale.z = 1.0
    text.color = _colour(record.change, 1.0)
    text.text = f"{record.object_id} {record.semantic.label} {record.change.label}"
    return [box, text]


def marker_message(preview: ChangePreview, frame: LocalFrame, frame_id: str, time_ns: int) -> MarkerArray:
    """Build a box and a label for every changed object, after deleting what stood there."""
    array = MarkerArray(markers=[Marker(header=header(time_ns, frame_id), action=Marker.DELETEALL)])
    for record in preview.records:
        if record.change in _QUIET or record.object_id not in preview.boxes:
            continue
        box = local_box(*preview.boxes[record.object_id], frame)
        array.markers.extend(_markers(record, *box, frame_id, time_ns))
    return array
