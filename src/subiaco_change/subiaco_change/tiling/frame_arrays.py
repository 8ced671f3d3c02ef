"""The common frame as arrays that tasks hand to each other."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.level_of_detection.displacement_field import BlockGrid, SmoothField
from subiaco_change.records import Registration
from subiaco_change.tiling.epoch_tiles import Side
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

#: Aliases under which a task finds what makes up its frame.
REGISTRATION, CORRECTIONS = "registration", ("bias", "warp")


def registration_arrays(registration: Registration) -> dict[str, Any]:
    """Return a registration as arrays."""
    r = registration
    words = {
        "method": r.method,
        "degenerate": r.degenerate,
        "warnings": r.warnings,
        "details": dict(r.details),
        "numbers": (r.sigma_reg_m, r.rmse_m, r.inlier_ratio),
    }
    return {
        "T_local": r.T_local,
        "origin": r.origin,
        "pose_std": r.pose_std,
        "words": np.array(json.dumps(words)),
    }


def registration_of(arrays: Arrays) -> Registration:
    """Return the registration that :func:`registration_arrays` took apart."""
    words = json.loads(str(arrays["words"]))
    sigma, rmse, inliers = words["numbers"]
    return Registration(
        arrays["T_local"],
        arrays["origin"],
        sigma,
        rmse,
        inliers,
        arrays["pose_std"],
        words["method"],
        tuple(words["degenerate"]),
        tuple(words["warnings"]),
        words["details"],
    )


def field_arrays(field: SmoothField | None) -> dict[str, Any]:
    """Return a smooth field as arrays; none at all for None."""
    if field is None:
        return {}
    grid = field.grid
    return {"values": field.values, "corner": grid.corner, "cell": np.float64(grid.cell)}


def field_of(arrays: Arrays) -> SmoothField | None:
    """Return the field that :func:`field_arrays` took apart."""
    if "values" not in arrays:
        return None
    values = arrays["values"]
    shape = (int(values.shape[0]), int(values.shape[1]))
    return SmoothField(BlockGrid(arrays["corner"], float(arrays["cell"]), shape), values)


def load_frame(inputs: Inputs, origin: Floats) -> CommonFrame:
    """Return the frame about an origin (3,) with as many corrections as the task rests on."""
    frame = CommonFrame(registration_of(inputs[REGISTRATION]), origin)
    for name in CORRECTIONS:
        if name in inputs:
            frame = frame.corrected(field_of(inputs[name]))
    return frame


def in_frame(xyz: Floats, side: Side, frame: CommonFrame, normals: Floats | None = None) -> PointCloud:
    """Bring points (N, 3) of an epoch, about its own origin, into the common frame."""
    fields = {} if normals is None else {"normals": np.asarray(normals, dtype=np.float64)}
    cloud = PointCloud(np.asarray(xyz, dtype=np.float64), side.origin, side.crs, fields)
    return frame.bring(cloud) if side.epoch == "before" else cloud
