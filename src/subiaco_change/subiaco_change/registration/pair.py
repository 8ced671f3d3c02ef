"""Two epochs made ready for comparison: one CRS, one origin, one leaf, or a clear refusal."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.quantiles import median_and_spread
from subiaco_geo.clouds import PointCloud, unique_cells, voxel_downsample
from subiaco_geo.crs import Transform, transformer
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

_COARSE = NUMBERS.pair.unknown_accuracy
_FAR = NUMBERS.pair.far
_NEAR = NUMBERS.pair.near
_CELL = NUMBERS.pair.cell
_HEIGHT_OFFSET = NUMBERS.pair.height_offset
_HEIGHT_CELLS = NUMBERS.pair.height_cells


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
    findings : tuple of Finding
    """

    crs: str | None
    operation: str = "none"
    accuracy_m: float = 0.0
    beams_crs: str | None = None
    findings: tuple[Finding, ...] = ()


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


def check_places(
    before: Floats, after: Floats, crs_before: str, crs_after: str, operation: Transform | None
) -> None:
    """Refuse georeferenced epochs that lie in different cities, and name the label that explains it.

    Parameters
    ----------
    before, after : (3,) float64
        A place of each epoch in its own CRS [m].
    crs_before, crs_after : str
    operation : Transform, optional
        From the CRS of *before* to that of *after*.
    """
    moved = before if operation is None else operation.apply(before[None])[0]
    distance = _apart(moved, after)
    if distance < _FAR:
        return
    if operation is not None and _apart(before, after) < _NEAR:
        hint = "the coordinates agree as they are, so that one of the two CRS is probably wrong"
    else:
        hint = _other_zone(before, after, crs_before, crs_after)
    raise InputError(
        f"the epochs lie in different places, {distance / 1000:.0f} km apart: before E {before[0]:.0f}, "
        f"N {before[1]:.0f} in {crs_before}, after E {after[0]:.0f}, N {after[1]:.0f} in {crs_after}; "
        f"{hint}; "
        "check that the files belong together and that their CRS are right"
    )


def _apart(first: Floats, second: Floats) -> float:
    return float(np.linalg.norm(first[:2] - second[:2]))


def _other_zone(before: Floats, after: Floats, crs_before: str, crs_after: str) -> str:
    """Find the neighbouring zone in which the coordinates of one epoch would lie beside the other epoch."""
    for name, own, place, crs, other in (
        ("before", crs_before, before, crs_after, after),
        ("after", crs_after, after, crs_before, before),
    ):
        number = own.removeprefix("EPSG:")
        for step in (1, -1, 2, -2, 3, -3) if number.isdigit() else ():
            zone = f"EPSG:{int(number) + step}"
            try:
                there = transformer(zone, crs).apply(place[None])[0]
            except InputError:
                continue
            if _apart(there, other) < _NEAR:
                return f"the coordinates of {name} fit if its CRS is {zone} instead of {own}"
    return "no neighbouring zone explains it"


def lowest_points(xyz: Floats) -> dict[tuple[int, int], float]:
    """Return the height of the lowest point [m] of every cell of 4 m of points (N, 3) in the world."""
    cells, member = unique_cells(np.floor(xyz[:, :2] / _CELL).astype(np.int64))
    low = np.full(len(cells), np.inf)
    np.minimum.at(low, member, xyz[:, 2])
    return {(i, j): z for (i, j), z in zip(cells.tolist(), low.tolist(), strict=True)}


def refuse_height_offset(before: dict[tuple[int, int], float], after: dict[tuple[int, int], float]) -> None:
    """Refuse georeferenced epochs whose heights are of two kinds, from :func:`lowest_points` of both.

    Raises
    ------
    InputError
        The lowest points of most cells differ by one and the same offset of more than 5 m.
    """
    shared = before.keys() & after.keys()
    if len(shared) < _HEIGHT_CELLS:
        return
    differences = np.array([after[cell] - before[cell] for cell in sorted(shared)])
    offset, spread = median_and_spread(differences)
    if abs(offset) <= _HEIGHT_OFFSET or spread > max(1.0, 0.1 * abs(offset)):
        return
    lower = "before" if offset > 0 else "after"
    raise InputError(
        f"the heights of {lower} are {abs(offset):.1f} m lower than those of the other epoch, at one place "
        "in plan: one epoch probably has heights above the ellipsoid and the other above the geoid (AHD in "
        "Australia; the two differ by about 33 m around Perth); bring both to one kind of height, or give "
        "the shift with --transform"
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
        found: tuple[Finding, ...] = ()
        if before != after:
            which, other = ("BEFORE", "AFTER") if before is None else ("AFTER", "BEFORE")
            sentence = (
                f"The survey {which} states no CRS. Its coordinates need not agree with those of {other}:"
                " the registration finds the position from the points alone."
            )
            found = (Finding("crs_missing", "warning", sentence, "Write the CRS into the file."),)
        return PairInfo(None, findings=found), None
    if before == after:
        return PairInfo(after), None
    operation = transformer(before, after)
    sentence = (
        f"The survey before was brought from {before} to {after} by {operation.name!r}, "
        f"accurate to {operation.accuracy_m} m."
    )
    coarse = operation.accuracy_m > _COARSE
    remedy = "Give both surveys the CRS of one geodetic frame, that of the base station." if coarse else ""
    finding = Finding("crs_operation", "warning" if coarse else "note", sentence, remedy)
    return PairInfo(after, operation.name, operation.accuracy_m, before, (finding,)), operation


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
    before: SurveyMap, after: SurveyMap, leaf: float = 0.25, *, aligned: bool = True
) -> tuple[SurveyMap, SurveyMap, PairInfo]:
    """Make two epochs comparable.

    Parameters
    ----------
    before, after : SurveyMap
    leaf : float
        Working leaf to which both clouds are downsampled [m].
    aligned : bool
        No transform is given that says otherwise: heights of two kinds are refused.

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
    if before.crs is not None and after.crs is not None:
        check_places(before.cloud.origin, after.cloud.origin, before.crs, after.crs, operation)
    if operation is not None and info.crs is not None:
        before = _to_crs(before, info.crs, operation)
    if both:
        check_extents(_extent(before.cloud), _extent(after.cloud))
        if aligned:
            refuse_height_offset(lowest_points(before.cloud.world()), lowest_points(after.cloud.world()))
    if shares_origin(before.cloud.origin, after.cloud.origin, both):
        before = replace(before, cloud=before.cloud.rebased(after.cloud.origin))
    clouds = [voxel_downsample(survey.cloud, leaf) for survey in (before, after)]
    return replace(before, cloud=clouds[0]), replace(after, cloud=clouds[1]), info
