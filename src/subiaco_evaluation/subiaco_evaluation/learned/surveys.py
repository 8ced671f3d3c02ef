"""Labelled pairs of surveys in the form that networks learn from, kept on the disk between trainings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_evaluation.baselines.cells import Pair
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.grid import GridConfig, cell_keys, look_up, rasterise
from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.learned.config import PointNetworkConfig
from subiaco_evaluation.learned.features import FEATURES, chosen_features, describe_pair
from subiaco_evaluation.learned.labels import CLASSES, IGNORED, MOVING_OBJECTS, to_classes
from subiaco_evaluation.learned.pyramids import Pyramid, pyramid_arrays, pyramid_of_arrays
from subiaco_evaluation.object_matching import transfer
from subiaco_evaluation.truth import SurveyTruth, read_truth
from subiaco_geo.atomic import whole_file
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.maps import load_epoch

_RADIUS = 0.3  # farther truth does not label a point, as in the evaluation [m]
Say = Callable[[str, float], None]


@dataclass(frozen=True)
class PointPair:
    """Pyramids of both epochs, and the network class (N,) of every point of their finest levels."""

    pyramids: tuple[Pyramid, Pyramid]
    classes: tuple[Ints, Ints]


@dataclass(frozen=True)
class RasterPair:
    """Surface models (2, rows, columns) [m], and codes (rows, columns); -1 where nothing is learned."""

    heights: Floats
    codes: Ints


def surface_models(pair: Pair) -> Floats:
    """Return the highest point of every cell (2, rows, columns) [m]; the ground where a cell has none."""
    return np.stack([np.where(s.count > 0, s.top, s.ground) for s in (pair.before, pair.after)])


def vote(classes: Ints, member: NDArray[np.int32], count: int) -> Ints:
    """Return the commonest class (count,) of the points of every voxel, -1 where none has one."""
    known = classes != IGNORED
    flat = np.bincount(member[known] * len(CLASSES) + classes[known], minlength=count * len(CLASSES))
    votes = flat.reshape(count, len(CLASSES))
    return np.where(votes.sum(axis=1) > 0, votes.argmax(axis=1), IGNORED)


def read_labelled_pair(survey: Path, config: BaselineConfig) -> tuple[Pair, SurveyTruth]:
    """Read a simulated survey, registered by its true transform."""
    truth = read_truth(survey)
    before, after = (load_epoch(survey / epoch) for epoch in ("before", "after"))
    return prepare_pair(before, after, config, truth.T_after_before)[0], truth


def label_points(pair: Pair, truth: SurveyTruth, network: PointNetworkConfig) -> PointPair:
    """Build the pyramids of both epochs and label their finest levels."""
    real = in_after_frame(truth)
    pyramids, classes = describe_pair(pair, network), []
    for epoch, (name, side) in enumerate((("before", pair.before), ("after", pair.after))):
        change = transfer(side.cloud, real[name], _RADIUS).true_change
        learned = to_classes(np.where(change < 0, int(Change.UNOBSERVED), change), epoch)
        classes.append(vote(learned, pyramids[epoch].member, len(pyramids[epoch].levels[0].xyz)))
    return PointPair(pyramids, (classes[0], classes[1]))


def label_cells(pair: Pair, truth: SurveyTruth) -> RasterPair:
    """Return both surface models with the truth of every cell by the published rule."""
    real = in_after_frame(truth)
    clouds = (real["before"], real["after"])
    grid = GridConfig(cell=pair.grid.cell)
    xyz = np.concatenate([cloud.world() for cloud in clouds])
    change = np.concatenate([np.asarray(cloud.fields["change"]) for cloud in clouds])
    cells = rasterise(xyz, change, np.repeat([0, 1], [len(cloud) for cloud in clouds]), grid)
    row, column = np.divmod(np.arange(pair.before.count.size), pair.grid.shape[1])
    centres = np.column_stack([column, row]) + 0.5
    world = centres * pair.grid.cell + pair.grid.corner + pair.after.cloud.origin[:2]
    codes = look_up(cells, cell_keys(world, grid))[0].astype(np.int64).reshape(pair.grid.shape)
    return RasterPair(surface_models(pair), np.where(codes < 5, codes, IGNORED))


@dataclass(frozen=True)
class Prepared:
    """Where the prepared forms of labelled surveys lie; they are made when they are first asked for."""

    folder: Path
    network: PointNetworkConfig
    baseline: BaselineConfig = field(default_factory=BaselineConfig)

    def points(self, surveys: Sequence[Path], say: Say) -> list[PointPair]:
        """Return the point form of every survey."""
        return [self._points(self._file(survey, say)) for survey in surveys]

    def rasters(self, surveys: Sequence[Path], say: Say) -> list[RasterPair]:
        """Return the raster form of every survey."""
        return [self._rasters(self._file(survey, say)) for survey in surveys]

    def _points(self, path: Path) -> PointPair:
        with np.load(path, allow_pickle=False) as arrays:
            whole = (pyramid_of_arrays(arrays, name, self.network.levels) for name in ("before", "after"))
            pyramids = [chosen_features(pyramid, self.network.features) for pyramid in whole]
            return PointPair((pyramids[0], pyramids[1]), (arrays["classes_before"], arrays["classes_after"]))

    def _rasters(self, path: Path) -> RasterPair:
        with np.load(path, allow_pickle=False) as arrays:
            return RasterPair(arrays["heights"], arrays["codes"])

    def _file(self, survey: Path, say: Say) -> Path:
        path = self.folder / f"{survey.absolute().name}-{self._key(survey)}.npz"
        if not path.is_file():
            say(f"preparing {survey.name}", 0.0)
            pair, truth = read_labelled_pair(survey, self.baseline)
            points, cells = label_points(pair, truth, self.network), label_cells(pair, truth)
            arrays: dict[str, NDArray[Any]] = {"heights": cells.heights, "codes": cells.codes}
            for index, name in enumerate(("before", "after")):
                arrays |= pyramid_arrays(points.pyramids[index], name)
                arrays[f"classes_{name}"] = points.classes[index]
            with whole_file(path) as temporary:
                np.savez(temporary, **arrays)  # type: ignore[arg-type]
        return path

    def _key(self, survey: Path) -> str:
        """Name what the prepared form depends on: the survey as it lies there, the grids, the thinning."""
        scene = (survey / "truth" / "scene.yaml").read_bytes() if survey.is_dir() else b""
        sizes = {
            "network": self.network.model_dump(include={"first_grid", "levels", "neighbours", "search"}),
            "baseline": self.baseline.model_dump(include={"leaf", "cells", "ground"}),
            "survey": str(survey.resolve()),
            "features": FEATURES,
            "moving": MOVING_OBJECTS,
        }  # fmt: skip
        return hashlib.sha256(scene + json.dumps(sizes, sort_keys=True).encode()).hexdigest()[:12]
