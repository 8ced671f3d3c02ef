"""Results of the change run: one record an object, and the whole result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from subiaco_geo.clouds import PointCloud, concatenate
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats

#: Colours of the paper, red green blue 0-255.
CHANGE_COLOURS: dict[Change, tuple[int, int, int]] = {
    Change.ADDED: (44, 160, 44),
    Change.REMOVED: (214, 39, 40),
    Change.INCREASED: (31, 119, 180),
    Change.DECREASED: (255, 127, 14),
    Change.UNCHANGED: (150, 150, 150),
    Change.NOT_REPORTED: (200, 200, 200),
    Change.UNOBSERVED: (225, 215, 190),
}

SEMANTIC_COLOURS: dict[Semantic, tuple[int, int, int]] = {
    Semantic.GROUND: (190, 174, 150),
    Semantic.BUILDING: (178, 74, 68),
    Semantic.VEGETATION: (70, 140, 60),
    Semantic.MOBILE: (70, 110, 190),
    Semantic.OTHER: (130, 130, 130),
}


@dataclass(frozen=True)
class ChangeRecord:
    """One row of the change table: an object, or a changed ground patch.

    Units are metres and cubic metres; ``x y z`` are world coordinates of the
    centroid in the frame of *after*. Statistics that do not exist for a row
    (e.g. ``iou_3d`` of an unmatched object) are NaN and empty in the files.
    """

    object_id: int
    semantic: Semantic
    change: Change
    id_before: tuple[int, ...]
    id_after: tuple[int, ...]
    match_kind: str  # one_to_one, split, merge, none
    delta_h_m: float
    delta_v_m3: float
    delta_v_surface_m3: float
    delta_c_m: float
    iou_3d: float
    d_perp_m: float
    lod95_m: float
    observed_fraction: float
    evidence: str  # observed, trajectory, estimated, shadow, assumed
    score_paper: float
    confidence: float
    n_before: int
    n_after: int
    x: float
    y: float
    z: float
    footprint: BaseGeometry  # world coordinates
    reason: str = ""  # the rule that decided, in words
    features: tuple[float, ...] = ()  # what the confidence rests on (changes.confidence.FEATURES)
    delta_h_low_m: float = float("nan")  # bounds of delta_h_m and delta_v_m3 (Decision 17)
    delta_h_high_m: float = float("nan")
    delta_v_low_m3: float = float("nan")
    delta_v_high_m3: float = float("nan")
    height_before_m: float = float("nan")  # 95 % height above ground of the points of that epoch
    height_after_m: float = float("nan")

    @property
    def area_m2(self) -> float:
        """Area of the footprint [m2]."""
        return float(self.footprint.area)


@dataclass(frozen=True)
class Registration:
    """The rigid transform between two epochs and how far to trust it.

    ``T_after_before`` acts on world coordinates of *before*; to keep the
    numbers small it is stored about ``origin`` (the overlap centroid):
    ``p_after = origin + T_local @ (p_before - origin)``.
    """

    T_local: Floats
    origin: Floats
    sigma_reg_m: float
    rmse_m: float
    inlier_ratio: float
    pose_std: Floats  # (6,) rotation [rad] then translation [m], about origin
    method: str
    degenerate: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    details: Mapping[str, float] = field(default_factory=dict)

    @property
    def T_after_before(self) -> Floats:
        """4x4 in world coordinates."""
        T_world = self.T_local.copy()
        T_world[:3, 3] = self.origin + self.T_local[:3, 3] - self.T_local[:3, :3] @ self.origin
        return T_world

    def placed(self, world: Floats) -> Floats:
        """Bring world coordinates (N, 3) of *before* to those of *after* [m]."""
        return np.asarray((world - self.origin) @ self.T_local[:3, :3].T + self.T_local[:3, 3] + self.origin)


@dataclass(frozen=True)
class GroundChange:
    """Raster of ground elevation change, row 0 in the north.

    ``dz`` and ``confidence`` are (rows, columns) float32, NaN where either
    epoch has no ground; ``west`` and ``north`` are world coordinates of the
    outer corner; ``cell`` is the edge [m].
    """

    dz: NDArray[np.float32]
    confidence: NDArray[np.float32]
    west: float
    north: float
    cell: float


@dataclass(frozen=True)
class ChangeResult:
    """Everything a change run found.

    ``before`` and ``after`` are clouds at the working leaf in the frame of
    *after*, with fields ``change`` uint8, ``semantic`` uint8, ``instance``
    int32, ``confidence`` float32, ``lod95`` float32 and, where known,
    ``intensity`` float32 and ``normals``. ``blocks`` has a row for every 20 m
    block that tells of the registration: see
    :func:`subiaco_change.level_of_detection.alignment_corrections.block_table`.
    """

    records: tuple[ChangeRecord, ...]
    before: PointCloud
    after: PointCloud
    registration: Registration
    ground: GroundChange | None
    seconds: Mapping[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    blocks: pd.DataFrame | None = None

    @property
    def crs(self) -> str | None:
        """CRS of the result."""
        return self.after.crs

    def parts(self) -> Iterator[tuple[PointCloud, PointCloud]]:
        """Yield both clouds part by part, places together: here all at once."""
        yield self.before, self.after

    def epoch(self, name: str) -> Iterator[PointCloud]:
        """Yield the cloud of one epoch, ``before`` or ``after``, part by part; parts hold points."""
        cloud: PointCloud = getattr(self, name)
        if len(cloud):
            yield cloud

    def reading(self, name: str) -> Callable[[], Iterator[PointCloud]]:
        """Return what yields the cloud of one epoch part by part, every time it is called."""
        return partial(self.epoch, name)


@dataclass(frozen=True)
class TiledResult:
    """Everything that a run in tiles found; as :class:`ChangeResult`, its clouds tile by tile.

    ``costs``: by stage, see :meth:`subiaco_geo.work.task_runner.TaskRunner.costs`. ``tile`` reads the
    cloud of an epoch in one of ``tiles``, thinned to the leaf; it may be empty. ``labelled`` reads the
    same with the points that are written (see ``every_point`` of the configuration).
    """

    records: tuple[ChangeRecord, ...]
    crs: str | None
    registration: Registration
    ground: GroundChange | None
    findings: tuple[Finding, ...]
    blocks: pd.DataFrame | None
    costs: Mapping[str, Mapping[str, float]]
    tiles: Sequence[str]
    tile: Callable[[str, str], PointCloud]
    labelled: Callable[[str, str], PointCloud]

    @property
    def seconds(self) -> dict[str, float]:
        """Processor seconds of every stage."""
        return {stage: cost["cpu_s"] for stage, cost in self.costs.items()}

    def parts(self) -> Iterator[tuple[PointCloud, PointCloud]]:
        """Yield both clouds of every tile."""
        return ((self.tile("before", name), self.tile("after", name)) for name in self.tiles)

    def epoch(self, name: str) -> Iterator[PointCloud]:
        """Yield the labelled cloud of one epoch, ``before`` or ``after``, of every tile that has points."""
        return _clouds_of(self.labelled, self.tiles, name)

    def reading(self, name: str) -> Callable[[], Iterator[PointCloud]]:
        """Return what yields the cloud of one epoch; without the rows, so that it is handed on cheaply."""
        return partial(_clouds_of, self.labelled, self.tiles, name)

    def whole(self) -> ChangeResult:
        """Put the tiles together in memory."""
        pairs = list(self.parts())
        before, after = (concatenate([pair[e] for pair in pairs]) for e in (0, 1))
        return ChangeResult(
            self.records,
            before,
            after,
            self.registration,
            self.ground,
            self.seconds,
            self.findings,
            self.blocks,
        )


def _clouds_of(
    read: Callable[[str, str], PointCloud], tiles: Sequence[str], epoch: str
) -> Iterator[PointCloud]:
    """Yield the clouds of an epoch in tiles, where they hold points."""
    return (cloud for tile in tiles if len(cloud := read(epoch, tile)))
