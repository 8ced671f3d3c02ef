"""What stages hand to each other: slices of the configuration, registration, corrections, frame."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar

import numpy as np

from subiaco_change.config import ChangeConfig
from subiaco_change.level_of_detection.common_frame import CommonFrame, SmoothField
from subiaco_change.method_rules import rules_of_stages
from subiaco_change.records import Registration
from subiaco_change.tiling.epoch_tiles import EpochContext
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_geo.tiles import Tile, tile_named
from subiaco_geo.work.tasks import Inputs

Slice = TypeVar("Slice")
#: A dataclass whose fields are named like those of :class:`~subiaco_change.config.ChangeConfig`.
AnySlice = TypeVar("AnySlice")


def slice_of(kind: type[AnySlice], config: ChangeConfig) -> AnySlice:
    """Take of a configuration what a stage reads: another setting elsewhere redoes nothing.

    Of the rules that are switched off, a slice holds those that act in its ``RULE_STAGES``.
    """
    names = [own.name for own in fields(kind)]  # type: ignore[arg-type]
    values: dict[str, Any] = {name: getattr(config, name) for name in names}
    if "rules_off" in values:
        values["rules_off"] = rules_of_stages(config.rules_off, vars(kind)["RULE_STAGES"])
    return kind(**values)


@dataclass(frozen=True)
class TileParams(Generic[Slice]):
    """Parameters of a stage that looks at both epochs.

    ``tile``: name of the tile, or *all*; ``size``: edge of a tile [m]; ``origin`` (3,): of the common frame
    in the world [m]; ``config``: what the stage reads of the configuration.
    """

    tile: str
    size: float
    sides: tuple[EpochContext, ...]
    origin: Floats
    config: Slice

    @property
    def rules_off(self) -> tuple[str, ...]:
        """Rules that are switched off in the stage."""
        return tuple(getattr(self.config, "rules_off", ()))

    def square(self, rim: float = 0.0) -> Tile:
        """Return the tile with surroundings of a width [m]."""
        return tile_named(self.tile, self.size, rim)


#: Aliases under which a task finds what makes up its frame.
REGISTRATION, CORRECTIONS = "registration", ("bias", "warp")


@dataclass(frozen=True)
class PairRegistration:
    """The registration of a pair.

    ``shift``: of a second estimate, how far it moves *before* at most against the first one [m];
    ``failed``: why the first estimate was kept, None where it was not.
    """

    registration: Registration
    shift: float
    failed: str | None


@dataclass(frozen=True)
class Correction:
    """A smooth correction beyond the rigid transform, None where there is none."""

    field: SmoothField | None


def load_frame(inputs: Inputs, origin: Floats) -> CommonFrame:
    """Return the frame about an origin (3,) with as many corrections as the task rests on."""
    frame = CommonFrame(inputs.of(PairRegistration, REGISTRATION).registration, origin)
    for name in CORRECTIONS:
        correction = inputs.find(Correction, name)
        if correction is not None:
            frame = frame.corrected(correction.field)
    return frame


def in_frame(
    xyz: Floats, side: EpochContext, frame: CommonFrame, normals: Floats | None = None
) -> PointCloud:
    """Bring points (N, 3) of an epoch, about its own origin, into the common frame."""
    fields = {} if normals is None else {"normals": np.asarray(normals, dtype=np.float64)}
    cloud = PointCloud(np.asarray(xyz, dtype=np.float64), side.origin, side.crs, fields)
    return frame.bring(cloud) if side.epoch == "before" else cloud
