"""All points of the input with the labels of the thinned points that they went into."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.tiling.epoch_tiles import EpochContext, InputPoints
from subiaco_change.tiling.retiling import LabelledPoints
from subiaco_change.tiling.stage_inputs import in_frame
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats, Ints


def with_every_point(
    thinned: PointCloud,
    points: LabelledPoints,
    pieces: Sequence[InputPoints],
    side: EpochContext,
    frame: CommonFrame,
) -> PointCloud:
    """Return a labelled tile with all points of the input in place of those at the leaf.

    The mean of a voxel lies up to half a diagonal from the points that it stands for, so that labels of means
    cannot be joined to the points of a file.

    Parameters
    ----------
    thinned : PointCloud
        Labelled points of a tile in the common frame.
    points : LabelledPoints
        The same points, with where they come from.
    pieces : sequence of InputPoints
        One for each of ``points.sources``.
    side : EpochContext
    frame : CommonFrame
        Of the comparison.
    """
    place: list[Floats] = []
    member: list[Ints] = []
    intensity: list[NDArray[Any]] = []
    for position, piece in enumerate(pieces):
        own = np.flatnonzero(points.source == position)
        label = np.full(int(piece.voxel.max(initial=-1)) + 1, -1, dtype=np.int64)
        label[points.row[own]] = own
        of = label[piece.voxel]
        kept = of >= 0
        place.append(in_frame(piece.xyz[kept], side, frame).xyz)
        member.append(of[kept])
        if piece.intensity is not None:
            intensity.append(piece.intensity[kept])
    index = np.concatenate(member)
    fields = {name: values[index] for name, values in thinned.fields.items()}
    if "intensity" in fields:
        fields["intensity"] = np.concatenate(intensity)
    return PointCloud(np.concatenate(place), thinned.origin, thinned.crs, fields)
