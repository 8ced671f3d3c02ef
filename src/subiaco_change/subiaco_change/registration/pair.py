"""Two epochs made ready for comparison: one CRS, one origin, one leaf, or a clear refusal."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.crs import Transform, transformer
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.maps import SurveyMap
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
    before_to_own : callable or None
        Brings world points (N, 3) of the pair's CRS back to the CRS in which
        the visibility layer of *before* still lives.
    warnings : tuple of str
    """

    crs: str | None
    operation: str = "none"
    accuracy_m: float = 0.0
    beams_crs: str | None = None
    before_to_own: Callable[[Floats], Floats] | None = None
    warnings: tuple[str, ...] = ()


def _check_cloud(name: str, cloud: PointCloud) -> None:
    if len(cloud) == 0:
        raise InputError(f"{name}: the cloud is empty; check the file")
    bad = int((~np.isfinite(cloud.xyz)).any(axis=1).sum())
    if bad:
        raise InputError(f"{name}: {bad} points have NaN or infinite coordinates; remove them")


def _extent(cloud: PointCloud) -> tuple[Floats, Floats]:
    return cloud.xyz.min(axis=0) + cloud.origin, cloud.xyz.max(axis=0) + cloud.origin


def _describe(low: Floats, high: Floats) -> str:
    return f"E {low[0]:.0f} to {high[0]:.0f}, N {low[1]:.0f} to {high[1]:.0f}"


def _check_extents(before: PointCloud, after: PointCloud) -> None:
    """Refuse georeferenced epochs that lie in different places."""
    (low_b, high_b), (low_a, high_a) = _extent(before), _extent(after)
    if np.any(np.maximum(low_b, low_a)[:2] >= np.minimum(high_b, high_a)[:2]):
        raise InputError(
            "the epochs lie in different places though both carry a CRS: before "
            f"{_describe(low_b, high_b)}, after {_describe(low_a, high_a)}; "
            "check that the files belong together and that their CRS are right"
        )


def _moved_trajectory(trajectory: Trajectory, operation: Transform) -> Trajectory:
    """Transform poses: positions by the operation, axes by its local rotation."""
    positions = trajectory.positions
    base = operation.apply(positions)
    axes = [operation.apply(positions + 10.0 * axis) - base for axis in np.eye(3)]
    u, _, vt = np.linalg.svd(np.stack(axes, axis=2))
    poses = trajectory.poses.copy()
    poses[:, :3, :3] = (u @ vt) @ poses[:, :3, :3]
    poses[:, :3, 3] = base
    return replace(trajectory, poses=poses)


def _moved_cloud(cloud: PointCloud, operation: Transform, crs: str) -> PointCloud:
    """Transform points; normals turn by well under a milliradian between datums and grids of one place."""
    origin = np.round(operation.apply(cloud.origin[None])[0], -2)
    xyz = operation.apply(cloud.world()) - origin
    return replace(cloud, xyz=xyz, origin=origin, crs=crs)


def _to_crs(survey: SurveyMap, crs: str) -> tuple[SurveyMap, PairInfo]:
    """Bring cloud and trajectory of a survey to another CRS; the visibility layer stays where it is."""
    own = survey.crs
    assert own is not None
    operation = transformer(own, crs)
    back = transformer(crs, own)
    trajectory = survey.trajectory
    moved = replace(
        survey,
        cloud=_moved_cloud(survey.cloud, operation, crs),
        trajectory=None if trajectory is None else _moved_trajectory(trajectory, operation),
    )
    note = (
        f"before was brought from {own} to {crs} by {operation.name!r}, accurate to {operation.accuracy_m} m"
    )
    _LOG.info(note)
    return moved, PairInfo(crs, operation.name, operation.accuracy_m, own, back.apply, (note,))


def _shares_origin(before: PointCloud, after: PointCloud, both_crs: bool) -> bool:
    """Tell whether the clouds can stand about one origin without losing digits."""
    return both_crs or float(np.linalg.norm(before.origin - after.origin)) < 10_000.0


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
    info = PairInfo(after.crs if both else None)
    if before.crs is not None and after.crs is not None:
        if before.crs != after.crs:
            before, info = _to_crs(before, after.crs)
        _check_extents(before.cloud, after.cloud)
    elif before.crs is not None or after.crs is not None:
        which = "before" if before.crs is None else "after"
        info = replace(info, warnings=(f"{which} has no CRS: the epochs are registered without priors",))
    if _shares_origin(before.cloud, after.cloud, both):
        before = replace(before, cloud=before.cloud.rebased(after.cloud.origin))
    clouds = [voxel_downsample(survey.cloud, leaf) for survey in (before, after)]
    return replace(before, cloud=clouds[0]), replace(after, cloud=clouds[1]), info
