"""Trained networks on a prepared pair of epochs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from subiaco_evaluation.baselines.cells import CellVerdict, Codes, Pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.grid import GridConfig, cell_rule
from subiaco_evaluation.learned.batches import collate
from subiaco_evaluation.learned.config import PointNetworkConfig, TrainingConfig
from subiaco_evaluation.learned.features import chosen_features, describe_pair
from subiaco_evaluation.learned.labels import CLASSES, to_codes
from subiaco_evaluation.learned.methods import POINT_METHODS
from subiaco_evaluation.learned.point_networks import POINT_NETWORKS
from subiaco_evaluation.learned.pyramids import Pyramid
from subiaco_evaluation.learned.raster_networks import RASTER_NETWORKS
from subiaco_evaluation.learned.sampling import cut_pair, grid_centres, network_input, padded, patch_corners
from subiaco_evaluation.learned.surveys import RasterPair, surface_models
from subiaco_evaluation.learned.training import load_arrays
from subiaco_evaluation.learned.weights_file import read_weights
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints


@dataclass(frozen=True)
class Trained:
    """A trained network, its settings, and the factors (classes,) of its probabilities."""

    model: torch.nn.Module
    config: TrainingConfig
    factors: Floats


def load_network(path: Path, method: str) -> Trained:
    """Read trained weights into their network.

    Raises
    ------
    InputError
        The file holds no weights of this method.
    """
    arrays, record = read_weights(path, method)
    try:
        config = TrainingConfig.model_validate(record["config"])
        if method in POINT_METHODS:
            model: torch.nn.Module = POINT_NETWORKS[method](config.point_network)
        else:
            model = RASTER_NETWORKS[method](config.raster_network)
        load_arrays(model, arrays)
        factors = np.array(record["class_factors"], dtype=np.float64)
    except (ValueError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: these weights do not fit {method} ({reason}); train again") from error
    return Trained(model.train(False), config, factors)


def predict(pair: Pair, config: BaselineConfig, method: str, weights: Path) -> CellVerdict:
    """Label the cells of a pair by a trained network."""
    trained = load_network(weights, method)
    with torch.no_grad():
        if method in POINT_METHODS:
            return _by_points(pair, config, trained)
        return _by_rasters(pair, config, trained)


def _by_points(pair: Pair, config: BaselineConfig, trained: Trained) -> CellVerdict:
    """Label the points of both clouds, each compared with the other one, then cells by the published rule."""
    sides, network = (pair.before, pair.after), trained.config.point_network
    pyramids = [chosen_features(pyramid, network.features) for pyramid in describe_pair(pair, network)]
    codes, trusts = [], []
    for epoch in (0, 1):
        chances = point_chances(
            trained.model, pyramids[1 - epoch], pyramids[epoch], network, config.learned.overlap
        )
        known = chances.sum(axis=1) > 0
        classes = np.where(known, (chances * trained.factors).argmax(axis=1), -1)
        member = pyramids[epoch].member
        codes.append(to_codes(classes, epoch)[member])
        trusts.append(chances.max(axis=1)[member])
    cell = np.concatenate([side.cell for side in sides])
    return _vote(pair, cell, np.concatenate(codes), np.concatenate(trusts), config)


def point_chances(
    model: torch.nn.Module, reference: Pyramid, compared: Pyramid, network: PointNetworkConfig, overlap: float
) -> Floats:
    """Return the mean probabilities (N, classes) of the compared finest points over a grid of cylinders.

    Points that no cylinder with points of both clouds holds have zeros.
    """
    xyz = compared.levels[0].xyz
    total, count = np.zeros((len(xyz), len(CLASSES))), np.zeros(len(xyz))
    for centre in grid_centres(xyz, network.radius, overlap):
        cylinder = cut_pair(reference, compared, centre, network.radius)
        if cylinder is not None:
            said = model(collate([cylinder], network)).exp().double().numpy()
            total[cylinder.compared.picked] += said
            count[cylinder.compared.picked] += 1
    return total / np.maximum(count, 1)[:, None]


def _vote(
    pair: Pair, cell: Ints, codes: NDArray[np.uint8], trust: Floats, config: BaselineConfig
) -> CellVerdict:
    size = pair.before.count.size
    column = np.where(codes > Change.UNCHANGED, 5, codes).astype(np.int64)
    counts = np.bincount(cell * 7 + column, minlength=size * 7).reshape(size, 7)
    chosen = cell_rule(counts, GridConfig(cell=config.cells.cell, share=config.cells.share))
    chosen = np.where(counts.sum(axis=1) > 0, chosen, Change.UNCHANGED).astype(np.uint8)
    won = (np.arange(size), np.where(chosen > Change.UNCHANGED, 5, chosen))
    total = np.bincount(cell * 7 + column, weights=trust, minlength=size * 7).reshape(size, 7)[won]
    mean = np.divide(total, counts[won], out=np.full(size, 0.5), where=counts[won] > 0)
    return _verdict(pair, chosen.reshape(pair.grid.shape), mean.reshape(pair.grid.shape))


def _by_rasters(pair: Pair, config: BaselineConfig, trained: Trained) -> CellVerdict:
    heights = surface_models(pair)
    chances = raster_chances(trained.model, heights, trained.config, config.learned.overlap)
    code = (chances * trained.factors[:, None, None]).argmax(axis=0).astype(np.uint8)
    code[(pair.before.count == 0) & (pair.after.count == 0)] = Change.UNCHANGED
    return _verdict(pair, code, chances.max(axis=0))


def raster_chances(
    model: torch.nn.Module, heights: Floats, trained: TrainingConfig, overlap: float
) -> Floats:
    """Return the mean probabilities (5, rows, columns) over patches of two surface models."""
    network = trained.raster_network
    patch, shape = network.patch, heights.shape[1:]
    whole = padded(RasterPair(heights, np.zeros(shape, dtype=np.int64)), patch).heights
    total, count = np.zeros((5, *whole.shape[1:])), np.zeros(whole.shape[1:])
    for top in patch_corners(whole.shape[1], patch, overlap):
        for left in patch_corners(whole.shape[2], patch, overlap):
            window = (slice(top, top + patch), slice(left, left + patch))
            given = network_input(whole[(slice(None), *window)], network.height_scale)
            total[(slice(None), *window)] += model(torch.from_numpy(given)[None]).exp()[0].double().numpy()
            count[window] += 1
    return np.asarray((total / count)[:, : shape[0], : shape[1]])


def _verdict(pair: Pair, code: Codes, confidence: Floats) -> CellVerdict:
    unknown: NDArray[Any] = np.full(pair.grid.shape, np.nan)
    return CellVerdict(code, confidence, np.where(np.isfinite(pair.rise), pair.rise, np.nan), unknown)
