"""Control points: residuals of a map, and the accuracy figures that surveyors sign."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from subiaco_geo.clouds import PointCloud, distance_to_box, extent_of
from subiaco_geo.datum_shifts import likely_shift
from subiaco_geo.frames import Floats
from subiaco_mapping.control_points import PICKED, ControlPoints
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.robust_plane import fit_plane

#: Fewer points than this make no accuracy statement (ASPRS Positional Accuracy Standards, edition 2, 2023).
ENOUGH = 30
#: Factors to 95 % of the RMSE of horizontal distances, and of heights (NSSDA, ICSM SP1).
HORIZONTAL_95, VERTICAL_95 = 1.7308, 1.96
_RADIUS = NUMBERS.control_points.radius
_REACH = NUMBERS.control_points.height_reach
_OUTLIER = NUMBERS.control_points.plane_outlier
_ALIKE = NUMBERS.control_points.common_cause_points
_FEW = NUMBERS.control_points.plane_points


@dataclass(frozen=True)
class ControlResiduals:
    """Map minus survey [m]; NaN where a residual could not be taken.

    Parameters
    ----------
    points : ControlPoints
    horizontal : (N, 2) float64
        East and north, of picked points.
    vertical : (N,) float64
        Of the picked point where its height is given, else of the map's surface.
    support : (N,) int64
        Map points that carry the surface.
    offset : (N,) float64
        Height of the lowest map surface at the place over the surveyed one, however far it lies; NaN
        where the map has no points [m].
    crs : str, optional
        Of map and points.
    extent : (2, 2) float64, optional
        South-west and north-east corner of the map [m].
    """

    points: ControlPoints
    horizontal: Floats
    vertical: Floats
    support: np.ndarray[Any, np.dtype[np.int64]]
    offset: Floats
    crs: str | None = None
    extent: Floats | None = None

    def summary(self) -> dict[str, Any]:
        """Return RMSE, bias and counts; a figure without points is None."""
        east_north = self.horizontal[np.isfinite(self.horizontal).all(axis=1)]
        heights = self.vertical[np.isfinite(self.vertical)]
        return {
            "points": len(self.points.names),
            "horizontal_points": len(east_north),
            "rmse_horizontal_m": (horizontal := _rms(np.linalg.norm(east_north, axis=1))),
            "horizontal_95_m": None if horizontal is None else HORIZONTAL_95 * horizontal,
            "bias_east_north_m": None if len(east_north) == 0 else east_north.mean(axis=0).tolist(),
            "vertical_points": len(heights),
            "rmse_vertical_m": (vertical := _rms(heights)),
            "vertical_95_m": None if vertical is None else VERTICAL_95 * vertical,
            "bias_vertical_m": None if len(heights) == 0 else float(heights.mean()),
            "warnings": self._warnings(len(east_north), len(heights)),
        }

    def _warnings(self, horizontal: int, vertical: int) -> list[str]:
        found = []
        if horizontal == 0:
            found.append(
                f"no horizontal residual: columns {', '.join(PICKED[:2])} say where a point lies in the map"
            )
        for name, count in (("horizontal", horizontal), ("vertical", vertical)):
            if 0 < count < ENOUGH:
                found.append(
                    f"{count} {name} points: {ENOUGH} or more are needed for a statement of accuracy"
                )
        bare = [n for n, v in zip(self.points.names, self.vertical, strict=True) if not np.isfinite(v)]
        heights = self._other_heights()
        if heights is not None:
            found.insert(0, heights)
        elif bare:
            found.append(f"no map surface at {', '.join(bare)}: outside the map, or too few points there")
        elsewhere = self._elsewhere()
        if elsewhere is not None:
            found.insert(0, elsewhere)
        frames = self._other_frame()
        return found if frames is None else [frames, *found]

    def _elsewhere(self) -> str | None:
        """Say how far outside the map control points lie, and whether exchanged columns bring them inside."""
        if self.extent is None:
            return None
        places = self.points.surveyed[:, :2]
        apart = distance_to_box(places, *self.extent)
        outside = apart > 0.0
        if not outside.any():
            return None
        far = apart[outside]
        span = f"{far.min():.0f} m" if len(far) == 1 else f"{far.min():.0f} to {far.max():.0f} m"
        text = f"{len(far)} of {len(apart)} control points lie outside the map, by {span}"
        if (distance_to_box(places[outside][:, ::-1], *self.extent) == 0.0).all():
            return f"{text}: with east and north exchanged they lie inside it; correct the columns"
        return f"{text}: check their CRS (--crs)" if outside.all() else text

    def _other_heights(self) -> str | None:
        """Say that the map's heights and the surveyed ones are of two kinds, where they lie apart alike."""
        apart = self.offset[np.isfinite(self.offset) & ~np.isfinite(self.vertical)]
        if len(apart) < max(_ALIKE, len(self.offset) / 2):
            return None
        offset = float(np.median(apart))
        if abs(offset) <= _REACH or 1.4826 * float(np.median(np.abs(apart - offset))) > _REACH:
            return None
        side = "above" if offset > 0 else "below"
        return (
            f"the map lies {abs(offset):.1f} m {side} {len(apart)} of {len(self.offset)} control points: the "
            "map has heights above the ellipsoid, the control points probably above the geoid (AHD in "
            "Australia; the two differ by about 33 m around Perth); bring the control points to heights "
            "above the ellipsoid"
        )

    def _other_frame(self) -> str | None:
        """Name the geodetic frames that explain the horizontal bias."""
        flat = self.horizontal[np.isfinite(self.horizontal).all(axis=1)]
        if len(flat) < _ALIKE or self.crs is None:
            return None
        bias = np.append(flat.mean(axis=0), 0.0)
        found = likely_shift(bias, self.points.surveyed[0], self.crs)
        if found is None:
            return None
        return (
            f"the map lies {float(np.linalg.norm(bias)):.2f} m off the control points, which is the shift "
            f"between {found.before} and {found.after} ({found.size:.2f} m): the control points are probably "
            f"in {found.before}; give their CRS with --crs"
        )


def check_control(cloud: PointCloud, points: ControlPoints) -> ControlResiduals:
    """Compare a map with surveyed points.

    The vertical residual is that of a plane through the map points within
    0.75 m, taken at the surveyed place, unless a height was picked. The
    horizontal one needs a picked place: a flat surface does not tell where on
    it a point lies.

    Parameters
    ----------
    cloud : PointCloud
        The map.
    points : ControlPoints
        In the CRS of the map.
    """
    local = points.surveyed - cloud.origin
    near = cKDTree(cloud.xyz[:, :2]).query_ball_point(local[:, :2], _RADIUS)
    vertical = points.picked[:, 2] - points.surveyed[:, 2]
    support, offset = np.zeros(len(local), dtype=np.int64), np.full(len(local), np.nan)
    for row, indices in enumerate(near):
        around = cloud.xyz[indices]
        if len(around) >= _FEW:
            offset[row] = np.quantile(around[:, 2], 0.2) - local[row, 2]
        around = around[np.abs(around[:, 2] - local[row, 2]) < _REACH] - local[row]
        support[row] = len(around)
        if np.isnan(vertical[row]):
            vertical[row] = _surface_offset(around)
    horizontal = (points.picked - points.surveyed)[:, :2]
    extent = np.array(extent_of(cloud.xyz[:, :2])) + cloud.origin[:2] if len(cloud) else None
    return ControlResiduals(points, horizontal, vertical, support, offset, cloud.crs, extent)


def _surface_offset(around: Floats) -> float:
    """Height at the origin of a plane through points (N, 3), NaN where too few carry one [m]."""
    plane = fit_plane(around, _FEW, _OUTLIER, floor=1e-4)
    return float("nan") if plane is None else float(plane[2])


def _rms(values: Floats) -> float | None:
    return None if len(values) == 0 else float(np.sqrt(np.mean(np.square(values))))


def describe_control(residuals: ControlResiduals) -> str:
    """Return the residuals as a text table, with the summary under it."""
    lines = [f"{'point':<16}{'east':>9}{'north':>9}{'up':>9}   map points"]
    for name, flat, up, support in zip(
        residuals.points.names, residuals.horizontal, residuals.vertical, residuals.support, strict=True
    ):
        cells = "".join(f"{'-':>9}" if np.isnan(v) else f"{v:>+9.3f}" for v in (*flat, up))
        lines.append(f"{name:<16}{cells}   {support}")
    summary = residuals.summary()
    lines.append("")
    lines += [_line(summary, "horizontal"), _line(summary, "vertical")]
    lines += [f"warning: {text}" for text in summary["warnings"]]
    return "\n".join(lines)


def _line(summary: Mapping[str, Any], kind: str) -> str:
    rmse = summary[f"rmse_{kind}_m"]
    if rmse is None:
        return f"RMSE {kind}: none over 0 points"
    within = summary[f"{kind}_95_m"]
    count = summary[f"{kind}_points"]
    return f"RMSE {kind}: {rmse:.3f} m over {count} points (map minus survey), {within:.3f} m at 95 %"
