"""Street quality as markers for RViz and Foxglove."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from subiaco_geo.crs import EnuFrame
from subiaco_ros.messages import header

_WIDTH = 2.5
_ABOVE = 0.3


def _colour(text: str) -> ColorRGBA:
    red, green, blue = (int(text[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return ColorRGBA(r=red, g=green, b=blue, a=0.8)


def street_markers(collection: dict[str, Any], origin: EnuFrame, frame_id: str) -> MarkerArray:
    """Build one list of lines of every feature, in the local frame at ``origin``."""
    marker = Marker(header=header(0, frame_id), ns="streets", id=0, type=Marker.LINE_LIST, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    marker.scale.x = _WIDTH
    for feature in collection["features"]:
        longitude, latitude = np.array(feature["geometry"]["coordinates"]).T
        enu = origin.from_geodetic(latitude, longitude, np.full(len(latitude), origin.height))
        points = [Point(x=float(x), y=float(y), z=_ABOVE) for x, y in enu[:, :2]]
        for pair in pairwise(points):
            marker.points.extend(pair)
            marker.colors.extend([_colour(feature["properties"]["stroke"])] * 2)
    return MarkerArray(markers=[marker])
