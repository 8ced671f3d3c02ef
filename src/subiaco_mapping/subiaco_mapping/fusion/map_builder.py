"""Scans at their solved poses to one survey map."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.config import config_hash
from subiaco_geo.crs_area import AUTO
from subiaco_geo.frames import invert_pose
from subiaco_geo.free_space.sensor_view import SENSOR, SensorView
from subiaco_geo.settings import method_statement, setting_values
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_mapping.config import ManifestConfig, MappingConfig
from subiaco_mapping.fusion.field_of_view import FieldOfView
from subiaco_mapping.fusion.finishing import FinishedMap, MapFusion
from subiaco_mapping.fusion.full_density import FullDensity
from subiaco_mapping.fusion.ground_heights import height_table
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.manifest import CONTRADICTED, LEGEND, describe_sequence, stretches
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.sequences import SequenceRecord
from subiaco_mapping.survey_graph.solution import GraphSolution

_VIEWED = NUMBERS.fusion.view_sample

ProgressCallback = Callable[[str, float], None]

#: Beginning of the names of folders in which voxel sums lie while scans are fused.
FUSION_FOLDER = "fusion-"


def silent(_stage: str, _fraction: float) -> None:
    """Report to nobody."""


def build_map(
    sequences: Sequence[SequenceRecord],
    solution: GraphSolution,
    config: MappingConfig,
    report: ProgressCallback = silent,
    inputs: Mapping[str, str] | None = None,
    density: FullDensity | None = None,
) -> SurveyMap:
    """Fuse every scan at its solved pose.

    Parameters
    ----------
    sequences : sequence of SequenceRecord
        In the order of the solution.
    solution : GraphSolution
    config : MappingConfig
    report : callable
        Told stage and fraction.
    inputs : mapping of str to str, optional
        Names and hashes of the recordings, for ``map.yaml``.
    density : FullDensity, optional
        Where every return is written too; taken up if the settings ask for it.

    Returns
    -------
    SurveyMap
    """
    projection = Projection.of_place(solution.frame, config.crs)
    # what is mapped from the folder outlives it: the disk gives it back when the map is let go
    view = FieldOfView(config.decode.sky_range, config.decode.max_range)
    with tempfile.TemporaryDirectory(prefix=FUSION_FOLDER, dir=sequences[0].spool.folder) as folder:
        wanted = density if config.fusion.full_density else None
        fused = _fuse(Path(folder), sequences, solution, config, projection, report, view, wanted)
    trajectory, uncertainty = _trajectory(solution, projection)
    return SurveyMap(
        cloud=fused.cloud,
        trajectory=trajectory,
        visibility=fused.visibility,
        uncertainty=uncertainty,
        info=_info(solution, trajectory, config, inputs or {}, view.view(trajectory.poses[:, :3, :3])),
        last=fused.last,
        moving=fused.moving,
        odometry=_odometry(sequences),
        manifest=describe(sequences, solution, config.manifest),
        heights=height_table(fused.cloud, config.fusion.height_tile),
        config=config.model_dump(mode="json"),
    )


def _fuse(
    folder: Path,
    sequences: Sequence[SequenceRecord],
    solution: GraphSolution,
    config: MappingConfig,
    projection: Projection,
    report: ProgressCallback,
    view: FieldOfView,
    density: FullDensity | None,
) -> FinishedMap:
    start = solution.sequences[0].T_local_lidar[0, :3, 3]
    fusion = MapFusion(folder, config.fusion, projection, start, density)
    sources = {id(s.spool): k for k, s in enumerate(sequences, 1)}
    total = sum(len(sequence.stamps_ns) for sequence in solution.sequences)
    done = 0
    pairs = zip((s.spool for s in sequences), solution.sequences, strict=True)
    for spool, sequence in sorted(pairs, key=lambda pair: int(pair[1].stamps_ns[0])):
        matrices, offsets = projection.affine(sequence.T_local_lidar[:, :3, 3])
        for k, pose in enumerate(sequence.T_local_lidar):
            scan = spool.read(k)
            fusion.add(scan, pose, matrices[k], offsets[k], int(sequence.stamps_ns[k]), sources[id(spool)])
            if done % _VIEWED == 0:
                view.add(scan.xyz, scan.sky_xyz)
            done += 1
            if done % 10 == 0 or done == total:
                report("fusing scans", done / total)
    report("finishing the map", 0.0)
    fused = fusion.finish(
        config.threads,
        lambda fraction: report("finishing the map", fraction),
        {k: sequence.name for k, sequence in enumerate(sequences, 1)},
    )
    report("finishing the map", 1.0)
    return fused


def _odometry(sequences: Sequence[SequenceRecord]) -> dict[str, Trajectory]:
    found = {}
    for sequence in sequences:
        poses = invert_pose(sequence.T_odom_lidar[0]) @ sequence.T_odom_lidar
        found[sequence.name] = Trajectory(sequence.stamps_ns, poses)
    return found


def _info(
    solution: GraphSolution,
    trajectory: Trajectory,
    config: MappingConfig,
    inputs: Mapping[str, str],
    view: SensorView | None,
) -> dict[str, Any]:
    start_s = int(trajectory.times_ns[0]) * 1e-9
    frame = solution.frame
    return {
        "epoch": round(1970.0 + start_s / (365.2425 * 86400), 3),
        "leaf": config.fusion.leaf,
        "scans": len(trajectory),
        **({} if view is None else {SENSOR: view.description()}),
        "sequences": [sequence.name for sequence in solution.sequences],
        "inputs": dict(inputs),
        "config_hash": config_hash(config),
        "method": method_statement(config, setting_values(NUMBERS)),
        "georeferenced": frame is not None,
        "crs_source": None if frame is None else "auto" if config.crs == AUTO else "given",
        "local_because": solution.reason,
        "enu_origin": None if frame is None else [frame.latitude_deg, frame.longitude_deg, frame.height],
        "geoid_grid": _grid_hash(config.gnss),
        "vertical_sigma_floor_m": config.gnss.sigma_fixed * config.gnss.vertical_factor,
    }


def _grid_hash(config: GnssConfig) -> str | None:
    if config.heights == "ellipsoidal":
        return None
    return hashlib.sha256(Path(config.geoid_grid).read_bytes()).hexdigest()


def describe(
    sequences: Sequence[SequenceRecord], solution: GraphSolution, config: ManifestConfig
) -> dict[str, Any]:
    """Return the manifest."""
    described = {}
    for sequence, solved in zip(sequences, solution.sequences, strict=True):
        facts = describe_sequence(
            sequence.poses,
            sequence.columns,
            sequence.modes,
            sequence.fixes,
            solved.T_local_lidar[:, :3, 3],
            config,
        )
        facts["gnss"] = {
            "used": solved.fixes_used,
            "refused": solved.fixes_refused,
            "unattached": solved.fixes_unattached,
            "downweighted": solved.fixes_downweighted,
            "contradicting": solved.fixes_contradicting,
            "headings_used": solved.headings_used,
            "headings_refused": solved.headings_refused,
            "states": solved.gnss_states,
        }
        if solved.fixes_contradicting > config.max_contradicting * solved.fixes_used:
            whole = np.ones(len(solved.stamps_ns), dtype=np.bool_)
            facts["flagged"][CONTRADICTED] = stretches(
                whole, solved.stamps_ns, solved.T_local_lidar[:, :3, 3]
            )
        facts["dropped_points"] = sequence.dropped_points
        described[sequence.name] = {**facts, **sequence.facts}
    return {
        "georeferenced": solution.frame is not None,
        "reason": solution.reason,
        CONTRADICTED: any(CONTRADICTED in facts["flagged"] for facts in described.values()),
        "sequences": described,
        "loops": solution.loops.described(),
        "legend": LEGEND,
    }


def _trajectory(solution: GraphSolution, projection: Projection) -> tuple[Trajectory, PoseUncertainty]:
    """Return all sequences in time order, world coordinates, with covariances in map axes."""
    stamps_ns = np.concatenate([s.stamps_ns for s in solution.sequences])
    local = np.concatenate([s.T_local_lidar for s in solution.sequences])
    covariance = np.concatenate([s.covariance for s in solution.sequences])
    names = np.repeat([s.name for s in solution.sequences], [len(s.stamps_ns) for s in solution.sequences])
    _, order = np.unique(stamps_ns, return_index=True)
    turn = np.zeros((len(order), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = projection.axes(local[order, :3, 3])
    rotated = turn @ covariance[order] @ np.swapaxes(turn, 1, 2)
    trajectory = Trajectory(stamps_ns[order], projection.poses(local[order]))
    return trajectory, PoseUncertainty(stamps_ns[order], [str(n) for n in names[order]], rotated)
