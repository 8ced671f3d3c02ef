"""Control points tied to submaps: ground at a surveyed height, and marks that a person found in the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats, invert_pose, transform_points
from subiaco_mapping.absolute_positions.config import ControlConfig
from subiaco_mapping.loop_closure.submaps import Submap
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.absolute_factors import PointTie
from subiaco_mapping.robust_plane import fit_plane

_FEW = NUMBERS.absolute_positions.plane_points
_LAYER = NUMBERS.absolute_positions.layer_height
_OUTLIER = NUMBERS.absolute_positions.plane_outlier
_OPEN = NUMBERS.absolute_positions.open_sigma
_STEEP = NUMBERS.absolute_positions.level_cosine
_UPWARDS = np.array([0.0, 0.0, 1.0])
_PICK_OFF = NUMBERS.absolute_positions.pick_distance


@dataclass(frozen=True)
class LocalControl:
    """Control points in the local frame of the pose graph.

    Parameters
    ----------
    names : tuple of str
    places : (N, 3) float64
        Surveyed [m].
    picks : (N, 3) float64
        In the map before the correction [m]; NaN where not picked, height NaN where only the plan was.
    sigma : (N, 2) float64
        Horizontal and vertical [m].
    """

    names: tuple[str, ...]
    places: Floats
    picks: Floats
    sigma: Floats


@dataclass(frozen=True)
class Ground:
    """A piece of ground in a submap: a place (3,) [m] on it and its normal (3,), local frame."""

    place: Floats
    normal: Floats


@dataclass(frozen=True)
class PlacedPoint:
    """How a control point acts: ties for the graph, or why there are none."""

    ties: tuple[PointTie, ...] = ()
    refused: str = ""


class SubmapGround:
    """Ground of submaps at places of the local frame.

    Parameters
    ----------
    submaps : mapping of (chain, scan) to Submap
        By their anchor.
    config : ControlConfig
    """

    def __init__(self, submaps: Mapping[tuple[int, int], Submap], config: ControlConfig) -> None:
        self._submaps, self._config = submaps, config
        self._points: dict[tuple[int, int], Floats] = {}

    def near(self, place: Floats, poses: Mapping[int, Floats]) -> list[tuple[int, int]]:
        """Return the anchors within reach of a place (3,), the nearest first."""
        keys = sorted(key for key in self._submaps if key[0] in poses)
        if not keys:
            return []
        positions = np.array([poses[chain][scan][:2, 3] for chain, scan in keys])
        away = np.linalg.norm(positions - place[:2], axis=1)
        order = np.argsort(away, kind="stable")
        return [keys[k] for k in order if away[k] <= self._config.reach]

    def at(self, key: tuple[int, int], place: Floats, pose: Floats, reach: float) -> Ground | None:
        """Return the ground of a submap under or over a place (3,), within ``reach`` of its height [m]."""
        if key not in self._points:
            self._points[key] = self._submaps[key].points()
        local = self._points[key] @ pose[:3, :3].T + pose[:3, 3] - place
        around = local[(local[:, :2] ** 2).sum(axis=1) < self._config.radius**2]
        around = around[np.abs(around[:, 2]) < reach]
        if len(around) < _FEW:
            return None
        around = around[around[:, 2] < np.quantile(around[:, 2], 0.2) + _LAYER]
        plane = fit_plane(around, _FEW, _OUTLIER, floor=1e-3)
        if plane is None:
            return None
        normal = np.array([-plane[0], -plane[1], 1.0])
        normal /= np.linalg.norm(normal)
        return None if normal[2] < _STEEP else Ground(place + plane * _UPWARDS, normal)


def place_points(
    control: LocalControl,
    rows: Sequence[int],
    ground: SubmapGround,
    first: Mapping[int, Floats],
    now: Mapping[int, Floats],
    config: ControlConfig,
) -> dict[int, PlacedPoint]:
    """Tie control points to the scans that saw them.

    Parameters
    ----------
    control : LocalControl
    rows : sequence of int
        Points that constrain.
    ground : SubmapGround
    first, now : mapping of int to (S, 4, 4)
        Poses by chain before any correction, in which points were picked, and at present.
    config : ControlConfig
    """
    return {row: _placed(control, row, ground, first, now, config) for row in rows}


def _placed(
    control: LocalControl,
    row: int,
    ground: SubmapGround,
    first: Mapping[int, Floats],
    now: Mapping[int, Floats],
    config: ControlConfig,
) -> PlacedPoint:
    place, pick = control.places[row], control.picks[row]
    if np.isfinite(pick[:2]).all():
        return _picked(control, row, ground, first, config)
    found = []
    keys = ground.near(place, now)
    if not keys:
        return PlacedPoint(refused=f"no scan came within {config.reach:g} m of it")
    for key in keys[: config.submaps]:
        seen = ground.at(key, place, now[key[0]][key[1]], 2.0 * config.max_offset)
        if seen is not None:
            found.append((key, seen))
    if not found:
        return PlacedPoint(refused="no ground was seen at its place")
    off = float(np.median([seen.place[2] - place[2] for _, seen in found]))
    if abs(off) > config.max_offset:
        return PlacedPoint(refused=f"the ground of the map lies {off:+.2f} m from its height")
    variance = len(found) * (control.sigma[row, 1] ** 2 + config.sigma_surface**2)
    ties = []
    for key, seen in found:
        along = np.outer(seen.normal, seen.normal)
        covariance = variance * along + _OPEN**2 * (np.eye(3) - along)
        lever = _in_frame(now[key[0]][key[1]], seen.place)
        ties.append(PointTie(key, lever, place, covariance, row))
    return PlacedPoint(tuple(ties))


def _picked(
    control: LocalControl,
    row: int,
    ground: SubmapGround,
    first: Mapping[int, Floats],
    config: ControlConfig,
) -> PlacedPoint:
    """Tie a mark to the nearest submap, from which it was seen where the pick says."""
    place, pick = control.places[row], control.picks[row].copy()
    keys = ground.near(pick, first)
    if not keys:
        return PlacedPoint(refused=f"no scan came within {config.reach:g} m of where it was picked")
    level = pick.copy()
    level[2] = pick[2] if np.isfinite(pick[2]) else place[2]
    pose = first[keys[0][0]][keys[0][1]]
    seen = ground.at(keys[0], level, pose, 2.0 * config.max_offset)
    sigma = np.array([np.hypot(control.sigma[row, 0], config.sigma_pick)] * 2 + [0.0])
    if not np.isfinite(pick[2]):
        if seen is None:
            return PlacedPoint(refused="no ground was seen where it was picked; give map_height too")
        pick[2] = seen.place[2]
        sigma[2] = np.hypot(control.sigma[row, 1], config.sigma_surface)
    else:
        sigma[2] = np.hypot(control.sigma[row, 1], config.sigma_pick)
        if seen is not None and abs(seen.place[2] - pick[2]) > _PICK_OFF:
            off = seen.place[2] - pick[2]
            return PlacedPoint(refused=f"the map of these drives lies {off:+.2f} m from where it was picked")
    if np.linalg.norm(pick - place) > config.max_offset:
        return PlacedPoint(refused=f"it was picked {np.linalg.norm(pick - place):.2f} m from where it is")
    return PlacedPoint((PointTie(keys[0], _in_frame(pose, pick), place, np.diag(sigma**2), row),))


def _in_frame(pose: Floats, place: Floats) -> Floats:
    """Return a place (3,) of the local frame in the frame of a pose."""
    return transform_points(invert_pose(pose), place[None])[0]
