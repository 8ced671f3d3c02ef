"""The map on top of the report: a picture of the city under clickable footprints."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.codes import Change
from subiaco_report.colours import Colours, paint
from subiaco_report.evidence_pictures import svg_path
from subiaco_report.top_views import Above

#: Pixels of the picture along its longer side.
LONGEST = 1600
_COLOURS = {c.label: f"rgb{CHANGE_COLOURS[c]}" for c in Change}


def city_map(seen: Above, rows: pd.DataFrame) -> dict[str, Any]:
    """Return what the template needs to draw the map.

    Parameters
    ----------
    seen : Above
        Both epochs.
    rows : GeoDataFrame
        Changed rows with footprints.

    Returns
    -------
    dict
        ``uri`` of the picture; ``width``, ``height`` [m]; ``west``, ``north`` (world) [m]; ``bar``, the
        length of a scale bar [m]; ``shapes``, outlines as SVG paths in metres from the upper left corner.
    """
    frame = seen.frame
    width, height = (frame.shape[1] * frame.pixel, frame.shape[0] * frame.pixel)
    picture = paint(seen.cloud(), frame, "change", fill=2)
    shapes = [
        {
            "id": row["object_id"],
            "label": row["label"],
            "colour": _COLOURS[row["label"]],
            "title": "{object_id}: {label}, {class}, confidence {confidence:.2f}".format(**row),
            "path": svg_path(row["geometry"], frame.west, frame.north),
        }
        for row in rows.to_dict("records")
    ]
    bar = max(x for x in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if x <= max(width / 6, 1))
    return {
        "uri": webp_uri(picture),
        "width": width,
        "height": height,
        "west": frame.west,
        "north": frame.north,
        "bar": bar,
        "shapes": shapes,
    }


def webp_uri(picture: Colours) -> str:
    """Return colours (rows, columns, 3) as a WebP data URI."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(stream, "WEBP", quality=70, method=2)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
