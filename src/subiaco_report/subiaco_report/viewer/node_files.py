"""Nodes of an octree as script files, which browsers load from a web server and from the file system alike.

Browsers let a page from the file system fetch nothing, and simple web servers ignore byte ranges; scripts
load everywhere. The script of a node calls ``subiacoNode(cloud, node, text)``, where the text is base64 of a
gzip stream with these columns one after another, each byte of a number in a plane of its own, low byte first:

| column | type | meaning |
|---|---|---|
| x, y, z | uint16 each | position in the cube of the node, 65536 steps along its edge |
| object | uint32 | object_id + 1; 0 for none |
| change | uint8 | code of the change table |
| class | uint8 | code of the classes |
| intensity | uint8 | stretched between the 2nd and the 98th percentile of the cloud |
| confidence | uint8 | 255 for 1 |
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_report.viewer.octree import NodeKey

_STEPS = 65536
#: Columns of a node and their types, in the order of the file.
COLUMNS: dict[str, np.dtype[np.generic]] = {
    "x": np.dtype("<u2"),
    "y": np.dtype("<u2"),
    "z": np.dtype("<u2"),
    "object": np.dtype("<u4"),
    "change": np.dtype("u1"),
    "class": np.dtype("u1"),
    "intensity": np.dtype("u1"),
    "confidence": np.dtype("u1"),
}


@dataclass(frozen=True)
class IntensityStretch:
    """Intensities shown as black and as white."""

    low: float
    high: float

    def bytes_of(self, values: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Return intensities (N,) as 0 to 255."""
        share = (np.asarray(values, dtype=np.float64) - self.low) / max(self.high - self.low, 1e-12)
        return np.round(255.0 * np.clip(np.nan_to_num(share), 0.0, 1.0)).astype(np.uint8)


def node_columns(
    cloud: PointCloud, unit: Floats, key: NodeKey, stretch: IntensityStretch
) -> dict[str, NDArray[np.generic]]:
    """Return the columns of the points of one node, which ``unit`` (N, 3) places in the root cube."""
    corner = np.array([key.x, key.y, key.z], dtype=np.float64)
    inside = np.clip((unit * 2**key.level - corner) * _STEPS, 0, _STEPS - 1).astype("<u2")
    count = len(unit)
    intensity = cloud.fields.get("intensity", np.zeros(count))
    confidence = np.nan_to_num(np.asarray(cloud.fields["confidence"], dtype=np.float64))
    return {
        "x": inside[:, 0],
        "y": inside[:, 1],
        "z": inside[:, 2],
        "object": (np.asarray(cloud.fields["instance"], dtype=np.int64) + 1).clip(0).astype("<u4"),
        "change": np.asarray(cloud.fields["change"], dtype=np.uint8),
        "class": np.asarray(cloud.fields["semantic"], dtype=np.uint8),
        "intensity": stretch.bytes_of(np.asarray(intensity)),
        "confidence": np.round(255.0 * confidence.clip(0.0, 1.0)).astype(np.uint8),
    }


def node_script(cloud: str, node: str, columns: Mapping[str, NDArray[np.generic]]) -> str:
    """Return the script of a node; neighbouring points are brought together, which compresses better."""
    order = np.lexsort([columns[name] for name in ("x", "y", "z", "object")])
    planes = bytearray()
    for name, kind in COLUMNS.items():
        values = np.ascontiguousarray(columns[name][order].astype(kind))
        planes += values.view(np.uint8).reshape(len(values), kind.itemsize).T.tobytes()
    text = base64.b64encode(gzip.compress(bytes(planes), 6, mtime=0)).decode("ascii")
    return f'subiacoNode("{cloud}","{node}","{text}");\n'
