"""From registered scans and fixes to one map: collect, solve, fuse."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.clouds import PointCloud, from_world
from subiaco_geo.config import config_hash
from subiaco_geo.crs import EnuFrame, require_map_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, invert_pose, make_pose
from subiaco_geo.maps import PoseUncertainty, SurveyMap
from subiaco_geo.raywalk import VisibilityAccumulator
from subiaco_geo.trajectories import Trajectory
from subiaco_mapping import gnss
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion import VoxelAccumulator, add_scan, fused_cloud, walked_beams
from subiaco_mapping.graph import Chain, ChainSolution, GnssPriors, gravity_priors, solve
from subiaco_mapping.heights import height_table
from subiaco_mapping.manifest import LEGEND, describe_fixes, describe_sequence
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, OdometryPose
from subiaco_mapping.projection import Projection
from subiaco_mapping.spool import Spool

logger = logging.getLogger(__name__)

ProgressCallback = Callable[[str, float], None]


def silent(_stage: str, _fraction: float) -> None:
    """Report to nobody."""


@dataclass
class _Sequence:
    """What one recording has brought so far."""

    name: str
    extrinsics: Extrinsics
    spool: Spool
    poses: list[OdometryPose] = field(default_factory=list)
    accel: list[Floats] = field(default_factory=list)
    modes: list[str] = field(default_factory=list)
    columns: list[tuple[int, int]] = field(default_factory=list)  # lost, sent
    dropped_points: int = 0
    fixes: list[GnssFix] = field(default_factory=list)
    refused_fixes: int = 0
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def stamps_ns(self) -> Ints:
        return np.array([pose.stamp_ns for pose in self.poses], dtype=np.int64)

    @property
    def T_odom_lidar(self) -> Floats:
        return np.array([pose.T_odom_lidar for pose in self.poses])


@dataclass(frozen=True)
class SequenceSolution:
    """One sequence in the local frame of the graph.

    Parameters
    ----------
    name : str
    stamps_ns : (S,) int64
    T_local_lidar : (S, 4, 4) float64
    covariance : (S, 6, 6) float64
        Rotation [rad], translation [m], local axes.
    T_local_odom : (4, 4) float64
        At the newest scan: what carries fresh odometry over.
    fixes_used, fixes_refused, fixes_unattached, fixes_downweighted : int
    gnss_states : dict
        Counts and residuals by RTK state, see :func:`subiaco_mapping.manifest.describe_fixes`.
    gnss_inflation : float
        Of the fixes' variance.
    """

    name: str
    stamps_ns: Ints
    T_local_lidar: Floats
    covariance: Floats
    T_local_odom: Floats
    fixes_used: int
    fixes_refused: int
    fixes_unattached: int
    fixes_downweighted: int
    gnss_states: dict[str, Any] = field(default_factory=dict)
    gnss_inflation: float = 1.0


@dataclass(frozen=True)
class GraphSolution:
    """All sequences; ``frame`` is None for a local map, ``reason`` then says why."""

    sequences: tuple[SequenceSolution, ...]
    frame: EnuFrame | None
    reason: str | None


class MappingBackend:
    """Take what the front end and the receiver give; solve and fuse on request.

    Parameters
    ----------
    config : MappingConfig
    extrinsics : Extrinsics
        Of the first sequence; :meth:`start_sequence` can bring others.
    spool : Path
        Folder for the deskewed scans; the caller removes it.

    Raises
    ------
    InputError
        The CRS is unknown or cannot be that of a map.
    """

    def __init__(self, config: MappingConfig, extrinsics: Extrinsics, spool: Path) -> None:
        require_map_crs(config.crs)
        self._config = config
        self._extrinsics = extrinsics
        self._spool = spool
        self._sequences: list[_Sequence] = []
        self._solution: GraphSolution | None = None

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Begin a recording; what comes from now on is its own chain."""
        if any(sequence.name == name for sequence in self._sequences):
            raise InputError(f"sequence {name!r}: two bags have this name; rename one")
        if extrinsics is not None:
            self._extrinsics = extrinsics
        folder = self._spool / f"{len(self._sequences):03d}"
        spool = Spool(folder, self._config.fusion.max_range, self._config.decode.sky_range)
        self._sequences.append(_Sequence(name, self._extrinsics, spool))

    def add_facts(self, **facts: Any) -> None:
        """Note facts about the current sequence for the manifest, e.g. packet counts."""
        self._current.facts.update(facts)

    @property
    def _current(self) -> _Sequence:
        if not self._sequences:
            self.start_sequence("survey")
        return self._sequences[-1]

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take one registered scan, stamps increasing within a sequence."""
        current = self._current
        if current.poses and pose.stamp_ns <= current.poses[-1].stamp_ns:
            raise InputError(f"{current.name}: scan at {pose.stamp_ns} ns is not newer than the one before")
        current.spool.append(scan)
        current.poses.append(pose)
        current.accel.append(np.full(3, np.nan) if scan.accel is None else scan.accel)
        current.modes.append(scan.mode)
        current.columns.append((scan.lost_columns, scan.columns))
        current.dropped_points += scan.dropped_points
        self._solution = None

    def on_fix(self, fix: GnssFix) -> None:
        """Take one fix; one without a solution or with NaN is counted and left out."""
        if fix.is_usable():
            self._current.fixes.append(fix)
            self._solution = None
        else:
            self._current.refused_fixes += 1

    def optimize(self) -> GraphSolution:
        """Solve the graph of everything taken so far.

        Raises
        ------
        InputError
            No scans; GNSS cannot place a sequence although there are several, or it is required.
        """
        if self._solution is None:
            self._solution = self._solve()
        return self._solution

    def _solve(self) -> GraphSolution:
        sequences = [s for s in self._sequences if s.poses]
        if not sequences:
            raise InputError(
                "no scan came out of the recording; check LiDAR topic, metadata and range limits"
            )
        frame, reason = self._place(sequences)
        chains = [self._chain(sequence, frame) for sequence in sequences]
        solutions = solve(chains, self._config.graph, self._config.gnss.kernel)
        found = zip(sequences, chains, solutions, strict=True)
        return GraphSolution(tuple(self._summary(*item) for item in found), frame, reason)

    def _place(self, sequences: list[_Sequence]) -> tuple[EnuFrame | None, str | None]:
        """Return the ENU frame, or None and why the map stays local."""
        fixes = [fix for sequence in sequences for fix in sequence.fixes]
        frame = gnss.local_frame(fixes, self._config.gnss)
        for sequence in sequences:
            reason = "no usable GNSS fix" if frame is None else self._why_not(sequence, frame)
            if reason is None:
                continue
            if self._config.gnss.required or len(sequences) > 1:
                raise InputError(
                    f"{sequence.name}: cannot be georeferenced ({reason}); record GNSS over a longer way"
                    + (", or map it alone" if len(sequences) > 1 else ", or set gnss.required: false")
                )
            logger.warning("%s: %s; the map is local, without CRS", sequence.name, reason)
            return None, reason
        return frame, None

    def _why_not(self, sequence: _Sequence, frame: EnuFrame) -> str | None:
        if sequence.fixes and sequence.extrinsics.t_base_gnss is None:
            raise InputError(
                "/tf_static: no antenna lever arm; record base_link -> gnss_link or set sensors.gnss in "
                "config/sensors.yaml"
            )
        fixes, attachment = self._attached(sequence, frame)
        return gnss.enough_to_place(fixes.enu[attachment.kept], self._config.gnss)

    def _attached(self, sequence: _Sequence, frame: EnuFrame) -> tuple[gnss.EnuFixes, gnss.Attachment]:
        fixes = gnss.to_enu(sequence.fixes, frame, self._config.gnss)
        lever = sequence.extrinsics.t_lidar_gnss if sequence.fixes else np.zeros(3)
        attachment = gnss.attach(
            fixes.times_ns,
            sequence.stamps_ns,
            sequence.T_odom_lidar,
            lever,
            self._config.gnss.max_pose_gap_ns,
        )
        return fixes, attachment

    def _chain(self, sequence: _Sequence, frame: EnuFrame | None) -> Chain:
        stamps_ns, poses = sequence.stamps_ns, sequence.T_odom_lidar
        window_ns = self._config.graph.gravity_window_ns
        gravity = gravity_priors(stamps_ns, poses, np.array(sequence.accel), window_ns)
        base_up = poses[0, :3, :3] @ sequence.extrinsics.T_base_lidar[2, :3]
        ups = np.einsum("nij,nj->ni", poses[gravity.index, :3, :3], gravity.up)
        up_odom = ups.mean(axis=0) if len(ups) else base_up
        priors = None
        if frame is None:
            T_world_odom = make_pose(gnss.level_rotation(up_odom), np.zeros(3)) if len(ups) else np.eye(4)
        else:
            fixes, attachment = self._attached(sequence, frame)
            fixes = fixes.select(attachment.kept)
            priors = GnssPriors(
                attachment.index,
                fixes.enu,
                attachment.levers,
                fixes.covariance,
                fixes.status,
                gnss.correlation_inflation(fixes.times_ns, self._config.gnss),
            )
            at = poses[attachment.index]
            antenna = np.einsum("nij,nj->ni", at[:, :3, :3], attachment.levers) + at[:, :3, 3]
            sigma = np.sqrt(fixes.covariance[:, 0, 0])
            T_world_odom = gnss.place(antenna, fixes.enu, sigma, up_odom)
        return Chain(
            stamps_ns=stamps_ns,
            T_odom_lidar=poses,
            covariance=np.array([pose.covariance for pose in sequence.poses]),
            held=np.array([not (pose.degenerate or pose.predicted) for pose in sequence.poses]),
            segment=np.array([pose.segment for pose in sequence.poses], dtype=np.int64),
            T_world_odom=T_world_odom,
            gnss=priors,
            gravity=gravity,
        )

    @staticmethod
    def _summary(sequence: _Sequence, chain: Chain, solution: ChainSolution) -> SequenceSolution:
        used = len(solution.residuals)
        status = np.zeros(0, dtype=np.int64) if chain.gnss is None else chain.gnss.status
        received = [fix.status for fix in sequence.fixes]
        return SequenceSolution(
            name=sequence.name,
            stamps_ns=chain.stamps_ns,
            T_local_lidar=solution.T_world_lidar,
            covariance=solution.covariance,
            T_local_odom=solution.T_world_lidar[-1] @ invert_pose(chain.T_odom_lidar[-1]),
            fixes_used=used,
            fixes_refused=sequence.refused_fixes,
            fixes_unattached=len(sequence.fixes) - used if chain.gnss is not None else len(sequence.fixes),
            fixes_downweighted=int((solution.weights < 0.3).sum()),
            gnss_states=describe_fixes(status, received, solution.residuals, solution.weights),
            gnss_inflation=1.0 if chain.gnss is None else chain.gnss.inflation,
        )

    def build_map(
        self, progress: ProgressCallback | None = None, inputs: Mapping[str, str] | None = None
    ) -> SurveyMap:
        """Fuse every scan at its solved pose.

        Parameters
        ----------
        progress : callable, optional
            Told stage and fraction.
        inputs : mapping of str to str, optional
            Names and hashes of the recordings, for ``map.yaml``.

        Returns
        -------
        SurveyMap
        """
        report = progress or silent
        report("solving the pose graph", 0.0)
        solution = self.optimize()
        projection = Projection(solution.frame, self._config.crs if solution.frame is not None else None)
        first, last, visibility = self._fuse(solution, projection, report)
        report("finishing the map", 0.0)
        fusion, threads = self._config.fusion, self._config.threads
        cloud = fused_cloud(first, fusion, threads, projection.points, projection.directions, projection.crs)
        trajectory, uncertainty = _trajectory(solution, projection)
        report("finishing the map", 1.0)
        return SurveyMap(
            cloud=cloud,
            trajectory=trajectory,
            visibility=visibility.grid(),
            uncertainty=uncertainty,
            info=self._info(solution, trajectory, inputs or {}),
            last=_plain_cloud(last, projection) if len(last) else None,
            odometry=self._odometry(),
            manifest=self._manifest(solution),
            heights=height_table(cloud, fusion.height_tile),
            config=self._config.model_dump(mode="json"),
        )

    def _fuse(
        self, solution: GraphSolution, projection: Projection, report: ProgressCallback
    ) -> tuple[VoxelAccumulator, VoxelAccumulator, VisibilityAccumulator]:
        fusion = self._config.fusion
        first, last = VoxelAccumulator(fusion.leaf), VoxelAccumulator(fusion.leaf)
        start = projection.points(solution.sequences[0].T_local_lidar[:1, :3, 3])[0]
        visibility = VisibilityAccumulator(np.floor(start / 100.0) * 100.0, fusion.visibility_voxel)
        total = sum(len(sequence.stamps_ns) for sequence in solution.sequences)
        done = 0
        spools = [s.spool for s in self._sequences if s.poses]
        for spool, sequence in zip(spools, solution.sequences, strict=True):
            matrices, offsets = projection.affine(sequence.T_local_lidar[:, :3, 3])
            for k, pose in enumerate(sequence.T_local_lidar):
                scan = spool.read(k)
                add_scan(first, scan.xyz, scan.intensity, pose)
                add_scan(last, scan.last_xyz, scan.last_intensity, pose)
                beams, returned = walked_beams(scan, pose, fusion)
                ends = (beams @ pose[:3, :3].T + pose[:3, 3]) @ matrices[k].T + offsets[k]
                origin = matrices[k] @ pose[:3, 3] + offsets[k]
                visibility.add(np.broadcast_to(origin, ends.shape), ends, returned)
                done += 1
                if done % 10 == 0 or done == total:
                    report("fusing scans", done / total)
        return first, last, visibility

    def _odometry(self) -> dict[str, Trajectory]:
        found = {}
        for sequence in self._sequences:
            if sequence.poses:
                poses = invert_pose(sequence.T_odom_lidar[0]) @ sequence.T_odom_lidar
                found[sequence.name] = Trajectory(sequence.stamps_ns, poses)
        return found

    def _info(
        self, solution: GraphSolution, trajectory: Trajectory, inputs: Mapping[str, str]
    ) -> dict[str, Any]:
        start_s = int(trajectory.times_ns[0]) * 1e-9
        frame = solution.frame
        return {
            "epoch": round(1970.0 + start_s / (365.2425 * 86400), 3),
            "leaf": self._config.fusion.leaf,
            "scans": len(trajectory),
            "sequences": [sequence.name for sequence in solution.sequences],
            "inputs": dict(inputs),
            "config_hash": config_hash(self._config),
            "georeferenced": frame is not None,
            "local_because": solution.reason,
            "enu_origin": None if frame is None else [frame.latitude_deg, frame.longitude_deg, frame.height],
            "vertical_sigma_floor_m": self._config.gnss.sigma_fixed * self._config.gnss.vertical_factor,
        }

    def _manifest(self, solution: GraphSolution) -> dict[str, Any]:
        described = {}
        sequences = [s for s in self._sequences if s.poses]
        for sequence, solved in zip(sequences, solution.sequences, strict=True):
            facts = describe_sequence(
                sequence.poses,
                sequence.columns,
                sequence.modes,
                sequence.fixes,
                solved.T_local_lidar[:, :3, 3],
                self._config.manifest,
            )
            facts["gnss"] = {
                "used": solved.fixes_used,
                "refused": solved.fixes_refused,
                "unattached": solved.fixes_unattached,
                "downweighted": solved.fixes_downweighted,
                "variance_inflation": round(solved.gnss_inflation, 1),
                "states": solved.gnss_states,
            }
            facts["dropped_points"] = sequence.dropped_points
            described[sequence.name] = {**facts, **sequence.facts}
        return {
            "georeferenced": solution.frame is not None,
            "reason": solution.reason,
            "sequences": described,
            "legend": LEGEND,
        }


def _plain_cloud(accumulator: VoxelAccumulator, projection: Projection) -> PointCloud:
    found = accumulator.statistics()
    return from_world(projection.points(found.mean), projection.crs, intensity=found.intensity, n=found.n)


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
