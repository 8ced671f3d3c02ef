"""Evidence of free space: which places of a map the other epoch could see, and how surely they were free."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from subiaco_change.geometry import build_index
from subiaco_change.visibility_tests import (
    CountedBeams,
    EverythingSeen,
    Flags,
    PointShadow,
    PosesAndPoints,
    Surroundings,
    VisibilityTest,
    view_level,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.expected_visibility import (
    ExpectedVisibility,
    ExpectedVisibilityConfig,
    OccupiedVoxels,
    occupied_columns,
    occupied_corner,
    render_views,
    sample_poses,
)
from subiaco_geo.free_space.sensor_view import described_view, spin_axes, spin_headings
from subiaco_geo.free_space.view_estimation import estimate_view, view_histogram, with_blind_arcs
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

_LOG = logging.getLogger(__name__)

EvidenceKind = Literal["observed", "trajectory", "estimated", "shadow", "assumed"]
#: Kinds of evidence, the best first.
KINDS: tuple[EvidenceKind, ...] = ("observed", "trajectory", "estimated", "shadow", "assumed")


class EvidenceConfig(StrictModel):
    """Free-space evidence (Decision 13)."""

    source: Literal["auto", "observed", "trajectory", "shadow", "assumed"] = Field(
        "auto",
        description="Evidence of free space; auto takes the best that the map has, in the order observed, "
        "trajectory, estimated, shadow",
    )
    min_beams: int = Field(
        1, ge=1, description="Number of beams from which a voxel of the visibility layer counts as observed"
    )
    poses: ExpectedVisibilityConfig = Field(
        default_factory=ExpectedVisibilityConfig,
        description="Settings of the expected visibility computed from a trajectory (Decision 16)",
    )
    ground_lift: float = Field(
        0.4,
        ge=0,
        description="Height above a ground point at which an observed place shows that the ground was "
        "observed [m]",
    )
    ground_ring: float = Field(
        1.0,
        gt=0,
        description="Radius of the ring of eight places that represents the ground between beams [m]",
    )
    ground_share: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Fraction of the ring around a ground point that must be observed for the ground to "
        "count as observed (Decision 14)",
    )
    ground_between: float = Field(
        3.0,
        gt=0,
        description="Distance of ground points on three sides within which the ground between them counts "
        "as observed [m]",
    )
    shadow_radius: float = Field(
        1.0,
        gt=0,
        description="Distance of a point that proves a place was visible in a cloud without trajectory [m]",
    )
    shadow_height: float = Field(
        15.0,
        gt=0,
        description="Height above an observed point up to which places count as observed in a cloud "
        "without trajectory, unless the cloud shows a view from above [m]",
    )
    shadow_touch: float = Field(
        0.35,
        gt=0,
        description="Distance within which a point occupies a place in a cloud without trajectory [m]",
    )
    shadow_trust: float = Field(
        0.8,
        gt=0.5,
        lt=1,
        description="Probability that a place without points above an observed point was free in a cloud "
        "without trajectory",
    )
    shadow_level: float = Field(
        6.0,
        gt=0,
        description="Distance within which a cloud without trajectory must hold a point as high as the "
        "surface that a plant gained or lost, for its place to count as observed [m]: the field of view may "
        "end lower",
    )
    shadow_slope: float = Field(
        0.4,
        ge=0,
        description="Slope at which the view that a point shows falls towards the sensor in a cloud without "
        "trajectory, as a ratio; 0.4 is the highest beam of a sensor with a view of 45 degrees",
    )
    shadow_cell: float = Field(
        0.5,
        gt=0,
        description="Edge of the columns whose lowest points surround a place in a cloud without "
        "trajectory [m]",
    )
    shadow_ring: float = Field(
        1.5,
        gt=0,
        description="Distance within which lower points must surround a place for the place to count as free "
        "in a cloud without trajectory [m]",
    )
    shadow_sides: int = Field(
        6,
        ge=0,
        le=8,
        description="Number of the eight sides of a place on which lower points must lie for the place to "
        "count as free in a cloud without trajectory",
    )
    hidden_trust: float = Field(
        0.65,
        ge=0.5,
        lt=1,
        description="Probability that a place was free that poses of a trajectory have in view only at or "
        "behind a surface, and that lies without points above an observed point: foliage lets beams by. 0.5 "
        "says nothing of such places. Beside a point behind that surface, shadow_trust counts instead",
    )
    shadow_certain: float = Field(
        0.85,
        gt=0.5,
        le=1,
        description="Largest probability that an object is absent in a cloud without trajectory, however "
        "many of its places were free: one unknown line of sight may explain them all. Lower it to claim "
        "less",
    )


@dataclass(frozen=True)
class Observer:
    """What one epoch could see. Build it with :func:`make_observer`.

    Parameters
    ----------
    kind : str
        ``observed`` (measured beams), ``trajectory`` (expected visibility from
        poses), ``estimated`` (from poses estimated from the cloud), ``shadow``
        (from the points alone) or ``assumed``.
    to_own : callable, optional
        Brings world points (N, 3) of the pair's common CRS to the CRS in
        which this epoch's evidence lives; identity if None.
    certain : float
        Probability that the evidence of the points alone is right as a whole, which bounds what many places
        prove together.
    """

    kind: EvidenceKind
    test: VisibilityTest
    to_own: Callable[[Floats], Floats] | None = None
    certain: float = 1.0

    def _own(self, world: Floats) -> Floats:
        points = np.asarray(world, dtype=np.float64).reshape(-1, 3)
        return points if self.to_own is None or len(points) == 0 else self.to_own(points)

    def observed(self, world: Floats) -> Flags:
        """Tell which points (N, 3), in this epoch's world frame, this epoch could see."""
        return self.test.observed(self._own(world))

    def empty(self, world: Floats) -> Flags:
        """Tell which points (N, 3) this epoch saw to be empty: beams went on, nothing came back."""
        return self.test.passed(self._own(world))

    def free_probability(self, world: Floats) -> Floats:
        """Return the probability (N,) that places (N, 3) were free; 0.5 where the epoch knows nothing.

        Counted beams and poses that passed through or met a surface, as a beta distribution with half a
        beam each way beforehand.
        """
        return self.test.free_probability(self._own(world))

    def free_above(self, world: Floats) -> Floats:
        """Return the probability (N,) that places (N, 3) above the tops of plants were free.

        Where poses are known, what the points alone call free may lie beyond the field of view.
        """
        if isinstance(self.test, PosesAndPoints):
            return self.test.free_in_view(self._own(world))
        return self.free_probability(world)

    def certainty(self, world: Floats) -> Floats:
        """Return the probability (N,) that the evidence at places (N, 3) is right as a whole.

        One unknown line of sight may explain all free places of an object that the points alone call free.
        """
        own = self._own(world)
        if isinstance(self.test, PosesAndPoints):
            return np.where(self.test.rests_on_points(own), self.certain, 1.0)
        return np.full(len(own), self.certain)

    def below_view(self, world: Floats) -> Flags:
        """Tell which points (N, 3) lie no higher than the field of view is known to have reached around.

        A bare cloud does not tell where a crown ends and where the field of view does: above all that it
        holds around, the top of what it holds is not known. Poses tell, except of places of which the points
        alone speak.
        """
        own = self._own(world)
        if isinstance(self.test, PointShadow):
            return self.test.levelled(own)
        if not isinstance(self.test, PosesAndPoints):
            return np.ones(len(own), dtype=np.bool_)
        known = ~self.test.rests_on_points(own)
        known[~known] = self.test.points.levelled(own[~known])
        return known

    def passes(self, world: Floats) -> Floats | None:
        """Beams (N,) that passed for each that returned at points (N, 3); None where nothing counted them."""
        if self.kind != "observed" or not isinstance(self.test, CountedBeams):
            return None
        hits, passes = self.test.grid.lookup(self._own(world))
        return np.asarray(passes / np.maximum(hits, 1), dtype=np.float64)

    def moved(self, world: Floats) -> Floats | None:
        """Probability (N,) that what mapping found at points (N, 3) moved; None where the map has no times.

        0 where mapping has no verdict.
        """
        if self.kind != "observed" or not isinstance(self.test, CountedBeams):
            return None
        found = self.test.grid.moved(self._own(world))
        return None if found is None else np.nan_to_num(found.astype(np.float64))

    def moved_or_not(self, world: Floats) -> Floats:
        """Probability (N,) that what mapping found at points (N, 3) moved; 0 where the map has no times."""
        found = self.moved(world)
        return np.zeros(len(world)) if found is None else found


def ground_observed(observed: Callable[[Floats], Flags], xyz: Floats, config: EvidenceConfig) -> Flags:
    """Tell which ground places (N, 3) an epoch saw, between its beams too.

    Far from the road beams meet the ground metres apart; the voxel of a
    ground point is then empty although the ground there was in plain view. A
    place counts as seen when its own voxel was, or the place ``ground_lift``
    above it (a beam that grazes the ground), or most of a ring around it: a
    shadow is open on one side at most along its border.

    Parameters
    ----------
    observed : callable
        (N, 3) points -> (N,) bool, seen by the epoch.
    xyz : (N, 3) float64
        In the frame that ``observed`` takes.
    config : EvidenceConfig
    """
    lift = np.array([0.0, 0.0, config.ground_lift])
    seen = observed(xyz) | observed(xyz + lift)
    open_ = np.flatnonzero(~seen)
    turned = np.zeros(len(open_))
    for angle in np.arange(8) * (np.pi / 4):
        place = xyz[open_] + config.ground_ring * np.array([np.cos(angle), np.sin(angle), 0.0])
        turned += observed(place) | observed(place + lift)
    seen[open_] = turned >= 8 * config.ground_share
    return seen


def weakest(kinds: Iterable[EvidenceKind]) -> EvidenceKind:
    """Return the weakest of some kinds of evidence."""
    return max(kinds, key=KINDS.index)


def evidence_kind(has_beams: bool, trajectory: Trajectory | None, config: EvidenceConfig) -> EvidenceKind:
    """Name the best evidence that a map carries, or the one asked for.

    Raises
    ------
    InputError
        The evidence asked for is not in the map.
    """
    driven = trajectory is not None and len(trajectory) > 0
    if config.source == "observed" and not has_beams:
        raise InputError("evidence.source=observed: the map has no visibility layer; use auto")
    if config.source == "trajectory" and not driven:
        raise InputError("evidence.source=trajectory: no trajectory; give --trajectory-before/-after")
    if config.source != "auto":
        return config.source
    if has_beams:
        return "observed"
    return "trajectory" if driven else "shadow"


def make_observer(
    survey: SurveyMap,
    config: EvidenceConfig,
    to_own: Callable[[Floats], Floats] | None = None,
    *,
    from_above: bool = False,
) -> Observer:
    """Build the observer of one epoch from the best evidence there is, or the one asked for.

    Parameters
    ----------
    survey : SurveyMap
        In its own frame; after :func:`subiaco_change.registration.pair.check_pair` only the
        visibility layer is still in the original CRS.
    config : EvidenceConfig
    to_own : callable, optional
        See :class:`Observer`; used for the visibility layer alone.
    from_above : bool
        Without visibility layer and trajectory, the whole cloud of which this is a part was measured from
        above (see :mod:`subiaco_change.view_from_above`).

    Raises
    ------
    InputError
        The evidence asked for is not in the map.
    """
    kind = evidence_kind(survey.visibility is not None, survey.trajectory, config)
    if kind == "assumed":
        return Observer("assumed", EverythingSeen())
    if kind == "observed" and survey.visibility is not None:
        return Observer("observed", CountedBeams(survey.visibility, config.min_beams), to_own)
    if kind == "trajectory" and survey.trajectory is not None:
        return poses_observer(
            expected_visibility(survey, survey.trajectory, config.poses), survey.cloud, config
        )
    test = replace(_shadow(survey.cloud, config), from_above=from_above)
    return Observer("shadow", test, certain=config.shadow_certain)


def poses_observer(poses: ExpectedVisibility, cloud: PointCloud, config: EvidenceConfig) -> Observer:
    """Build the observer of an epoch with a trajectory, from its expected visibility and its points around.

    Parameters
    ----------
    poses : ExpectedVisibility
    cloud : PointCloud
        Of the same world as the poses.
    config : EvidenceConfig
    """
    test = PosesAndPoints(poses, _shadow(cloud, config), config.hidden_trust)
    return Observer("trajectory", test, certain=config.shadow_certain)


def _shadow(cloud: PointCloud, config: EvidenceConfig) -> PointShadow:
    """Build the test by the points of a cloud alone."""
    index = build_index(cloud.xyz, config.shadow_radius)
    return PointShadow(
        index,
        cloud.origin,
        config.shadow_radius,
        config.shadow_height,
        config.shadow_trust,
        config.shadow_touch,
        view_level(index, config.shadow_level, config.shadow_slope),
        Surroundings.of(cloud.xyz, config.shadow_cell, config.shadow_ring, config.shadow_sides),
    )


def expected_visibility(
    survey: SurveyMap, trajectory: Trajectory, config: ExpectedVisibilityConfig
) -> ExpectedVisibility:
    """Render what the poses of a whole epoch must have seen, by its map's sensor or an estimate of it."""
    world = survey.cloud.world()
    chosen = trajectory.poses[sample_poses(trajectory.positions, config.pose_spacing)]
    images = render_views(world, chosen[:, :3, 3].copy(), spin_axes(chosen[:, :3, :3]), config)
    view = described_view(survey.info)
    if view is None:
        view = estimate_view([view_histogram(world, images, config)], config)
    occupied = OccupiedVoxels.of(world, occupied_corner(world.min(axis=0), config), config.occupied)
    columns = occupied_columns(occupied.keys, occupied.corner, occupied.voxel)
    view = with_blind_arcs(view, trajectory.poses, columns, config)
    images = images.blinded(spin_headings(chosen[:, :3, :3]), view.blind or ())
    return ExpectedVisibility(images, occupied, view, config)
