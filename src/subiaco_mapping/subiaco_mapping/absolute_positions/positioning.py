"""Control points and a reference cloud brought into the solution of a survey, and what came of them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.sources import open_epoch
from subiaco_mapping.absolute_positions.config import ControlConfig
from subiaco_mapping.absolute_positions.control_ties import (
    LocalControl,
    PlacedPoint,
    SubmapGround,
    place_points,
)
from subiaco_mapping.absolute_positions.reference_ties import ReferenceFit, fit_reference, read_reference
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.control import check_control
from subiaco_mapping.control_points import ControlPoints, read_control, split_roles
from subiaco_mapping.loop_closure.submaps import Submap
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.absolute_factors import AbsoluteTies, PointTie
from subiaco_mapping.pose_graph.records import Solved

_LOG = logging.getLogger(__name__)
_ROUNDS = NUMBERS.absolute_positions.rounds
_DOUBTFUL = NUMBERS.absolute_positions.contradiction
_DETERMINED = NUMBERS.absolute_positions.determined_variance
_HELD = NUMBERS.absolute_positions.held_sigma

Solve = Callable[[AbsoluteTies], Solved]


@dataclass(frozen=True)
class AbsoluteFacts:
    """What control points and reference did to a survey.

    Parameters
    ----------
    points : ControlPoints or None
        In the CRS of the map, each with its role; ``picked`` as the corrected map has it.
    refused : dict of str to str
        Control points that do not act, and why.
    doubtful : dict of str to float
        Control points that contradict the others, and by how much [m].
    gnss_offset : (3,) float64
        Added to every fix [m].
    reference : ReferenceFit or None
    warnings : tuple of str
    """

    points: ControlPoints | None = None
    refused: Mapping[str, str] = field(default_factory=dict)
    doubtful: Mapping[str, float] = field(default_factory=dict)
    gnss_offset: Floats = field(default_factory=lambda: np.zeros(3))
    reference: ReferenceFit | None = None
    warnings: tuple[str, ...] = ()

    def described(self, cloud: PointCloud) -> dict[str, Any]:
        """Return plain values for ``map.yaml``: residuals of the finished map at control and check points."""
        found: dict[str, Any] = {"warnings": list(self.warnings)}
        if self.reference is not None:
            offset = self.reference.offset
            found["reference"] = {
                **self.reference.counts,
                "map_less_reference_m": None if offset is None else np.round(offset, 4).tolist(),
            }
        if self.points is None:
            return found
        found["gnss_offset_m"] = (np.round(self.gnss_offset, 4) + 0.0).tolist()  # no minus zero
        found["refused"], found["doubtful"] = dict(self.refused), dict(self.doubtful)
        for role in ("control", "check"):
            rows = [
                row
                for row, (name, own) in enumerate(zip(self.points.names, self.points.roles, strict=True))
                if own == role and name not in self.refused
            ]
            found[role] = _residuals(cloud, self.points.select(rows)) if rows else {"points": 0}
        return found


def _residuals(cloud: PointCloud, points: ControlPoints) -> dict[str, Any]:
    plan = points.picked.copy()
    plan[:, 2] = np.nan  # heights are those of the finished map
    residuals = check_control(cloud, ControlPoints(points.names, points.surveyed, plan))
    rows = [
        {
            "name": name,
            "east_m": _plain(flat[0]),
            "north_m": _plain(flat[1]),
            "up_m": _plain(up),
        }
        for name, flat, up in zip(points.names, residuals.horizontal, residuals.vertical, strict=True)
    ]
    return {**residuals.summary(), "residuals": rows}


def _plain(value: float) -> float | None:
    return None if np.isnan(value) else round(float(value), 4)


def require_usable_files(config: MappingConfig) -> None:
    """Refuse control points and a reference that cannot be read, before the recordings are.

    Raises
    ------
    InputError
        A file is missing or damaged, or the reference has no CRS.
    """
    if config.control.file is not None:
        read_control(config.control.file, config.crs)
    if config.reference.cloud is not None and open_epoch(config.reference.cloud).crs is None:
        raise InputError(
            f"{config.reference.cloud}: the reference has no CRS; assign the one it was surveyed in"
        )


def position(
    config: MappingConfig,
    place: tuple[EnuFrame | None, str | None],
    submaps: Mapping[tuple[int, int], Submap],
    solved: Solved,
    solve: Solve,
) -> tuple[Solved, AbsoluteFacts | None]:
    """Solve again with control points and a reference, where the configuration names them.

    Parameters
    ----------
    config : MappingConfig
    place : tuple
        Local frame and CRS of the map.
    submaps : mapping of (chain, scan) to Submap
    solved : Solved
        By odometry, GNSS and loops.
    solve : callable
        Solves with ties.

    Raises
    ------
    InputError
        The map is local, loops are off, or the files cannot be used.
    """
    if config.control.file is None and config.reference.cloud is None:
        return solved, None
    frame, crs = place
    if frame is None or crs is None:
        raise InputError(
            "control.file, reference.cloud: the map is local, as no GNSS places it; control points and a "
            "reference correct a georeferenced map"
        )
    if not submaps:
        raise InputError(
            "control.file, reference.cloud: no submap to tie them to; set loops.enabled: true, or drive at "
            f"least {config.loops.submap_length:g} m"
        )
    first = {number: chain.T_world_lidar for number, chain in solved.chains.items()}
    reference = None
    if config.reference.cloud is not None:
        reference = _reference(config, frame, crs, submaps, solved)
    if config.control.file is None:
        assert reference is not None
        ties = AbsoluteTies(
            poses=reference.ties,
            reference_sigma=config.reference.sigma,
            pose_kernel=config.reference.kernel,
        )
        found = solve(ties) if reference.ties else solved
        return found, AbsoluteFacts(reference=reference, warnings=_about_reference(reference))
    return _with_control(config, (frame, crs), submaps, (first, reference), solved, solve)


def _reference(
    config: MappingConfig,
    frame: EnuFrame,
    crs: str,
    submaps: Mapping[tuple[int, int], Submap],
    solved: Solved,
) -> ReferenceFit:
    poses = {number: chain.T_world_lidar for number, chain in solved.chains.items()}
    covariances = {number: chain.covariance for number, chain in solved.chains.items()}
    around = np.concatenate([own[:, :3, 3] for own in poses.values()])
    points = read_reference(config.reference, frame, crs, around)
    return fit_reference(points, submaps, poses, covariances, (config.reference, config.loops))


def _about_reference(fit: ReferenceFit) -> tuple[str, ...]:
    disagree, used = fit.counts.get("refused_disagrees", 0), fit.counts.get("used", 0)
    found = []
    if used == 0:
        listed = ", ".join(f"{name} {count}" for name, count in sorted(fit.counts.items()) if count)
        found.append(f"the reference was not used at any place ({listed})")
    if disagree > used and fit.offset is not None:
        found.append(
            f"the reference contradicts the survey at {disagree} of {disagree + used} places: the map lies "
            f"{np.round(fit.offset, 2).tolist()} m (east, north, up) off it; check datum and heights of both"
        )
    return tuple(found)


def _with_control(
    config: MappingConfig,
    place: tuple[EnuFrame, str],
    submaps: Mapping[tuple[int, int], Submap],
    before: tuple[dict[int, Floats], ReferenceFit | None],
    solved: Solved,
    solve: Solve,
) -> tuple[Solved, AbsoluteFacts]:
    frame, crs = place
    first, reference = before
    own = config.control
    assert own.file is not None
    points = split_roles(read_control(own.file, crs, own.crs, own.geoid_grid), own.hold_out_every)
    control = _local(points, frame, crs, own)
    ground = SubmapGround(submaps, own)
    rows = [row for row, role in enumerate(points.roles) if role == "control"]
    placed: dict[int, PlacedPoint] = {}
    for _ in range(_ROUNDS):
        now = {number: chain.T_world_lidar for number, chain in solved.chains.items()}
        placed = place_points(control, rows, ground, first, now, own)
        acting = [point for point in placed.values() if point.ties]
        if not acting:
            reasons = "; ".join(f"{points.names[row]}: {placed[row].refused}" for row in placed)
            raise InputError(f"{own.file}: no control point acts on the map ({reasons})")
        solved = solve(_ties(config, control, placed, reference))
    doubtful = _doubtful(points, placed, solved)
    refused = {points.names[row]: point.refused for row, point in placed.items() if point.refused}
    moved = _moved_picks(control, ground, first, solved, frame, crs)
    points = ControlPoints(points.names, points.surveyed, moved, points.sigma, points.roles)
    warnings = [f"control point {name}: not used, {why}" for name, why in refused.items()]
    warnings += [
        f"control point {name}: contradicts the others by {off:.2f} m; its weight is small, check it"
        for name, off in doubtful.items()
    ]
    if "check" not in points.roles:
        warnings.append("no control point was held out: the map is not checked by points of its own")
    warnings += [] if reference is None else _about_reference(reference)
    for text in warnings:
        _LOG.warning("%s", text)
    return solved, AbsoluteFacts(points, refused, doubtful, solved.gnss_offset, reference, tuple(warnings))


def _local(points: ControlPoints, frame: EnuFrame, crs: str, config: ControlConfig) -> LocalControl:
    picks = points.picked.copy()
    flat = np.isfinite(picks[:, :2]).all(axis=1)
    level = np.where(np.isfinite(picks[:, 2]), picks[:, 2], points.surveyed[:, 2])
    local = np.full_like(picks, np.nan)
    if flat.any():
        whole = np.column_stack([picks[flat, :2], level[flat]])
        local[flat] = frame.points_from_map(whole, crs)
        local[flat, 2] = np.where(np.isfinite(picks[flat, 2]), local[flat, 2], np.nan)
    sigma = np.where(
        np.isfinite(points.sigma), points.sigma, [config.sigma_horizontal, config.sigma_vertical]
    )
    return LocalControl(points.names, frame.points_from_map(points.surveyed, crs), local, sigma)


def _ties(
    config: MappingConfig,
    control: LocalControl,
    placed: Mapping[int, PlacedPoint],
    reference: ReferenceFit | None,
) -> AbsoluteTies:
    """Put the ties together; fixes get an offset in those directions that enough points determine."""
    own = config.control
    acting = [row for row, point in placed.items() if point.ties]
    flat = sum(bool(np.isfinite(control.picks[row, :2]).all()) for row in acting)
    enough = np.array([flat >= own.min_for_offset] * 2 + [len(acting) >= own.min_for_offset])
    return AbsoluteTies(
        points=tuple(tie for row in acting for tie in placed[row].ties),
        poses=() if reference is None else reference.ties,
        offset_sigma=np.where(enough, own.offset_sigma, _HELD) if enough.any() else None,
        reference_sigma=config.reference.sigma,
        point_kernel=own.kernel,
        pose_kernel=config.reference.kernel,
    )


def _miss(tie: PointTie, solved: Solved) -> Floats:
    pose = solved.chains[tie.key[0]].T_world_lidar[tie.key[1]]
    return np.asarray(pose[:3, :3] @ tie.lever + pose[:3, 3] - tie.place)


def _doubtful(points: ControlPoints, placed: Mapping[int, PlacedPoint], solved: Solved) -> dict[str, float]:
    """Name the points that the solution misses by more than was stated and than the others scatter."""
    acting = {row: point.ties for row, point in placed.items() if point.ties}
    size, misses = {}, {}
    for row, ties in acting.items():
        off = [_miss(tie, solved) for tie in ties]
        square = [miss @ np.linalg.solve(tie.covariance, miss) for miss, tie in zip(off, ties, strict=True)]
        size[row] = float(np.sqrt(np.mean(square) * len(ties)))  # each covariance is of all its ties
        known = [np.diag(tie.covariance) < _DETERMINED for tie in ties]
        apart = [np.linalg.norm(miss[own]) for miss, own in zip(off, known, strict=True)]
        misses[row] = float(np.median(apart))
    scatter = max(1.0, 1.4826 * float(np.median(list(size.values()))))
    return {points.names[row]: round(misses[row], 3) for row in acting if size[row] > _DOUBTFUL * scatter}


def _moved_picks(
    control: LocalControl,
    ground: SubmapGround,
    first: Mapping[int, Floats],
    solved: Solved,
    frame: EnuFrame,
    crs: str,
) -> Floats:
    """Return where picked marks lie in the corrected map (N, 3) [m], NaN where none was picked."""
    moved = np.full_like(control.picks, np.nan)
    for row, pick in enumerate(control.picks):
        if not np.isfinite(pick[:2]).all():
            continue
        level = np.where(np.isfinite(pick), pick, control.places[row])
        keys = ground.near(level, first)
        if not keys:
            continue
        chain, scan = keys[0]
        old, new = first[chain][scan], solved.chains[chain].T_world_lidar[scan]
        local = new[:3, :3] @ (old[:3, :3].T @ (level - old[:3, 3])) + new[:3, 3]
        moved[row] = frame.points_to_map(local[None], crs)[0]
    return moved
