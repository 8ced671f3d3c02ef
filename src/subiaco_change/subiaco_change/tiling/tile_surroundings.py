"""Both epochs around one tile, as the comparison needs them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.decisions.driven_lane import SurveyPath, lane_near
from subiaco_change.decisions.trail_in_pieces import Surroundings, surroundings
from subiaco_change.level_of_detection.common_frame import free_through, seen_through
from subiaco_change.objects.voxel_objects import UNCERTAIN, EpochView
from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.alignment import TileLods
from subiaco_change.tiling.epoch_preparation import load_observer
from subiaco_change.tiling.epoch_tiles import EpochContext
from subiaco_change.tiling.retiling import LabelledPoints, load_points
from subiaco_change.tiling.stage_inputs import load_frame
from subiaco_change.visibility_evidence import EvidenceConfig, Observer
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.work.tasks import Inputs

Near = Callable[[Floats], Mask]


@dataclass(frozen=True)
class Region:
    """Points of one epoch around a place.

    ``view`` with the objects of the whole city as instances; ``slot`` (N,) tile among ``tiles``;
    ``index`` (N,) place of the point there; ``seen`` tells which places of the common frame the
    epoch observed, ``empty`` where its beams went on and nothing came back, ``free`` how probable it
    is that nothing stood there, by its beams, ``above`` the same above the tops of plants, ``certain`` how
    certain that can be at most, and ``below_view`` which places are no higher than its view is known to have
    reached; ``driven`` which places its vehicle drove through, None where its trajectory is not known;
    ``moved`` how probable it is that what it found at places moved, None where its map has no times of beams;
    ``around`` what it holds farther around, None where that was not asked for.
    """

    view: EpochView
    tiles: list[str]
    slot: Ints
    index: Ints
    observed: Callable[[Floats], Mask]
    empty: Callable[[Floats], Mask]
    free: Callable[[Floats], Floats]
    above: Callable[[Floats], Floats]
    below_view: Callable[[Floats], Mask]
    certain: Callable[[Floats], Floats]
    driven: Callable[[Floats], Mask] | None
    moved: Callable[[Floats], Floats] | None
    around: Surroundings | None = None


def load_region(
    inputs: Inputs,
    side: EpochContext,
    origin: Floats,
    config: EvidenceConfig,
    near: Near,
    around: Near | None = None,
) -> Region:
    """Load those points of an epoch for which ``near`` holds, given places (N, 3) of the common frame.

    ``around``: the same for places of which only the surroundings are asked for.

    ``inputs`` hold ``points lods`` of the tiles around, ``beams``, the ``path`` of the survey vehicle where
    it is known, and the frame; ``origin`` (3,) is its own.
    """
    frame = load_frame(inputs, origin)
    tiles = inputs.under(f"points/{side.epoch}")
    parts: list[tuple[Any, ...]] = []
    own_world: list[Floats] = [np.zeros((0, 3))]
    wide: list[Surroundings] = []
    by_points = side.kind in ("shadow", "trajectory", "estimated")
    for position, name in enumerate(tiles):
        piece = inputs.of(LabelledPoints, f"points/{side.epoch}/{name}")
        cloud = load_points(inputs, side, name, origin)
        index = np.flatnonzero(near(cloud.xyz))
        passed, moved = piece.passed, piece.moved
        if around is not None:
            far = np.flatnonzero(around(cloud.xyz))
            labels = piece.semantic[far], piece.number[far], piece.height[far]
            wide.append(surroundings(cloud.xyz[far], *labels))
        if by_points:
            own_world.append(piece.xyz[_standing(piece)] + side.origin)
        parts.append(
            (
                cloud.xyz[index],
                np.asarray(cloud.fields["normals"])[index],
                piece.semantic[index],
                piece.number[index],
                piece.height[index],
                inputs.of(TileLods, f"lods/{name}").of(side.epoch).lod[index],
                piece.score[index],
                passed[index] if len(passed) else passed,
                moved[index] if len(moved) else moved,
                np.full(len(index), position, dtype=np.int64),
                index,
            )
        )
    view, slot, index = _view(parts)
    observer: Observer = load_observer(inputs, side, np.concatenate(own_world), config)
    path = inputs.find(SurveyPath, f"path/{side.epoch}")
    to_world = frame.before_world if side.epoch == "before" else frame.after_world
    return Region(
        view,
        tiles,
        slot,
        index,
        seen_through(observer.observed, to_world),
        seen_through(observer.empty, to_world),
        free_through(observer.free_probability, to_world),
        free_through(observer.free_above, to_world),
        seen_through(observer.below_view, to_world),
        free_through(observer.certainty, to_world),
        None if path is None else seen_through(lane_near(path, to_world(view.xyz)).covers, to_world),
        None if view.moved is None else free_through(observer.moved_or_not, to_world),
        Surroundings.joined(wide) if wide else None,
    )


def _standing(piece: LabelledPoints) -> Mask:
    """Tell which points (N,) of a tile belong to no ghost trail, which proves no sight of places near it."""
    loose = (piece.semantic == Semantic.MOBILE) & (piece.number < 0)
    return np.asarray(~(loose & (piece.moved > UNCERTAIN)) if len(piece.moved) else loose | True)


def _view(parts: list[tuple[Any, ...]]) -> tuple[EpochView, Ints, Ints]:
    empty = (
        np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int32),
        *(np.zeros(0, np.float32) for _ in range(5)), np.zeros(0, np.int64), np.zeros(0, np.int64),
    )  # fmt: skip
    joined: list[NDArray[Any]] = [np.concatenate(column) for column in zip(empty, *parts, strict=True)]
    xyz, normals, semantic, number, height, lod, score, passed, moved, slot, index = joined
    counted, timed = (len(found) == len(xyz) and len(xyz) > 0 for found in (passed, moved))
    view = EpochView(
        xyz,
        normals,
        semantic,
        number.astype(np.int32),
        height.astype(np.float64),
        lod.astype(np.float64),
        score.astype(np.float64),
        passed.astype(np.float64) if counted else None,
        moved.astype(np.float64) if timed else None,
    )
    return view, slot, index
