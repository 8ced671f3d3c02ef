"""Two epochs made ready for comparison: one CRS, one origin, one leaf, or a clear refusal."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.crs import Transform, transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class PairInfo:
    """What was done to bring two epochs together.

    Parameters
    ----------
    crs : str or None
        Of the pair: that of *after*; None unless both epochs have one.
    operation : str
        The coordinate operation applied to *before*, ``none`` if none.
    accuracy_m : float
        Its accuracy as PROJ states it [m].
    beams_crs : str or None
        CRS in which the visibility layer of *before* still lives, where it is another.
    warnings : tuple of str
    """

    crs: str | None
    operation: str = "none"
    accuracy_m: float = 0.0
    beams_crs: str | None = None
    warnings: tuple[str, ...] = ()


def _check_cloud(name: str, cloud: PointCloud) -> None:
    if len(cloud) == 0:
        raise InputError(f"{name}: the cloud is empty; check the file")
    check_finite(cloud, f"{name}: ")


def check_finite(cloud: PointCloud, who: str = "") -> None:
    """Refuse coordinates that are no numbers."""
    bad = int((~np.isfinite(cloud.xyz)).any(axis=1).sum())
    if bad:
        raise InputError(f"{who}{bad} points have NaN or infinite coordinates; remove them")


def _extent(cloud: PointCloud) -> tuple[Floats, Floats]:
    return cloud.xyz.min(axis=0) + cloud.origin, cloud.xyz.max(axis=0) + cloud.origin


def _describe(low: Floats, high: Floats) -> str:
    return f"E {low[0]:.0f} to {high[0]:.0f}, N {low[1]:.0f} to {high[1]:.0f}"


def check_extents(before: tuple[Floats, Floats], after: tuple[Floats, Floats]) -> None:
    """Refuse georeferenced epochs whose least and largest world coordinates (3,) lie in different places."""
    (low_b, high_b), (low_a, high_a) = before, after
    if np.any(np.maximum(low_b, low_a)[:2] >= np.minimum(high_b, high_a)[:2]):
        raise InputError(
            "the epochs lie in different places though both carry a CRS: before "
            f"{_describe(low_b, high_b)}, after {_describe(low_a, high_a)}; "
            "check that the files belong together and that their CRS are right"
        )


def moved_trajectory(trajectory: Trajectory, operation: Transform) -> Trajectory:
    """Transform poses: positions by the operation, axes by its local rotation."""
    positions = trajectory.positions
    base = operation.apply(positions)
    axes = [operation.apply(positions + 10.0 * axis) - base for axis in np.eye(3)]
    u, _, vt = np.linalg.svd(np.stack(axes, axis=2))
    poses = trajectory.poses.copy()
    poses[:, :3, :3] = (u @ vt) @ poses[:, :3, :3]
    poses[:, :3, 3] = base
    return replace(trajectory, poses=poses)


def moved_cloud(cloud: PointCloud, operation: Transform, crs: str) -> PointCloud:
    """Transform points; normals turn by well under a milliradian between datums and grids of one place."""
    origin = np.round(operation.apply(cloud.origin[None])[0], -2)
    xyz = operation.apply(cloud.world()) - origin
    return replace(cloud, xyz=xyz, origin=origin, crs=crs)


def agree(before: str | None, after: str | None) -> tuple[PairInfo, Transform | None]:
    """Find the CRS of a pair, and the operation that brings *before* there; None where it is there.

    Raises
    ------
    InputError
        A difference that PROJ can only guess at.
    """
    if before is None or after is None:
        warnings: tuple[str, ...] = ()
        if before != after:
            which = "before" if before is None else "after"
            warnings = (f"{which} has no CRS: the epochs are registered without priors",)
        return PairInfo(None, warnings=warnings), None
    if before == after:
        return PairInfo(after), None
    operation = transformer(before, after)
    note = (
        f"before was brought from {before} to {after} by {operation.name!r}, "
        f"accurate to {operation.accuracy_m} m"
    )
    _LOG.info(note)
    return PairInfo(after, operation.name, operation.accuracy_m, before, (note,)), operation


def _to_crs(survey: SurveyMap, crs: str, operation: Transform) -> SurveyMap:
    """Bring cloud and trajectory of a survey to another CRS; the visibility layer stays where it is."""
    trajectory = survey.trajectory
    return replace(
        survey,
        cloud=moved_cloud(survey.cloud, operation, crs),
        trajectory=None if trajectory is None else moved_trajectory(trajectory, operation),
    )


def shares_origin(before: Floats, after: Floats, both_crs: bool) -> bool:
    """Tell whether clouds of two origins (3,) can stand about one without losing digits."""
    return both_crs or float(np.linalg.norm(before - after)) < 10_000.0


def check_pair(
    before: SurveyMap, after: SurveyMap, leaf: float = 0.25
) -> tuple[SurveyMap, SurveyMap, PairInfo]:
    """Make two epochs comparable.

    Parameters
    ----------
    before, after : SurveyMap
    leaf : float
        Working leaf to which both clouds are downsampled [m].

    Returns
    -------
    before, after : SurveyMap
        Clouds (and the trajectory of *before*) in the CRS of *after* and at
        the leaf; about one origin, unless they share no frame and lie more
        than 10 km apart in numbers.
    info : PairInfo

    Raises
    ------
    InputError
        An empty cloud, NaN, a CRS difference that PROJ can only guess at, or
        georeferenced epochs whose extents are disjoint.
    """
    _check_cloud("before", before.cloud)
    _check_cloud("after", after.cloud)
    both = before.crs is not None and after.crs is not None
    info, operation = agree(before.crs, after.crs)
    if operation is not None and info.crs is not None:
        before = _to_crs(before, info.crs, operation)
    if both:
        check_extents(_extent(before.cloud), _extent(after.cloud))
    if shares_origin(before.cloud.origin, after.cloud.origin, both):
        before = replace(before, cloud=before.cloud.rebased(after.cloud.origin))
    clouds = [voxel_downsample(survey.cloud, leaf) for survey in (before, after)]
    return replace(before, cloud=clouds[0]), replace(after, cloud=clouds[1]), info
