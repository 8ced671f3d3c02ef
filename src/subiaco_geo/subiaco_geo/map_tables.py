"""Tables of a map directory: covariances of poses, heights of tiles, uncertainty of tiles."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from subiaco_geo.csv_cells import escape_cell, restore_cell
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.tile_uncertainty import TILE_COLUMNS, tile_uncertainty
from subiaco_geo.trajectories import (
    format_seconds,
    parse_seconds,
)

#: Columns of ``heights.csv`` and of :attr:`subiaco_geo.survey_map.SurveyMap.heights`: centre of a 20 m tile
#: [m], median ground height [m], ground points, tilt of the ground [rad].
HEIGHT_COLUMNS = ("east", "north", "ground_height", "n", "tilt")
_TWIST = ("rx", "ry", "rz", "x", "y", "z")
_UPPER = np.triu_indices(6)
_COVARIANCE_COLUMNS = [f"cov_{_TWIST[i]}_{_TWIST[j]}" for i, j in zip(*_UPPER, strict=True)]
_UNCERTAINTY_COLUMNS = ["time_s", "sequence", *(f"sigma_{axis}" for axis in _TWIST), *_COVARIANCE_COLUMNS]


def write_uncertainty(path: Path, uncertainty: PoseUncertainty) -> None:
    """Write time [s], sequence, six sigmas and the upper triangle of the covariance a row."""
    upper = uncertainty.covariances[:, _UPPER[0], _UPPER[1]]
    rows = zip(uncertainty.times_ns.tolist(), uncertainty.sequences, uncertainty.sigmas, upper, strict=True)
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(_UNCERTAINTY_COLUMNS)
        for time_ns, sequence, sigmas, values in rows:
            writer.writerow(
                [format_seconds(time_ns), escape_cell(sequence), *(f"{v:.9g}" for v in (*sigmas, *values))]
            )


def read_uncertainty(path: Path) -> PoseUncertainty:
    """Read what :func:`write_uncertainty` wrote; InputError for anything else."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = list(csv.reader(stream)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error}); rebuild the map") from error
    if header != _UNCERTAINTY_COLUMNS:
        raise InputError(f"{path}: unexpected columns; rebuild the map")
    try:
        times_ns = np.array([parse_seconds(row[0]) for row in rows], dtype=np.int64)
        upper = np.array([[float(v) for v in row[8:]] for row in rows]).reshape(len(rows), 21)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: damaged ({error}); rebuild the map") from error
    covariances = np.zeros((len(rows), 6, 6))
    covariances[:, _UPPER[0], _UPPER[1]] = upper
    covariances[:, _UPPER[1], _UPPER[0]] = upper
    return PoseUncertainty(times_ns, [restore_cell(row[1]) for row in rows], covariances)


def write_heights(path: Path, heights: Floats) -> None:
    """Write tiles (K, 5) with the columns :data:`HEIGHT_COLUMNS`."""
    if heights.ndim != 2 or heights.shape[1] != len(HEIGHT_COLUMNS):
        raise InputError(f"heights must have shape (K, {len(HEIGHT_COLUMNS)}), got {heights.shape}")
    formats = ["%.3f", "%.3f", "%.4f", "%d", "%.6f"]
    np.savetxt(path, heights, fmt=formats, delimiter=",", header=",".join(HEIGHT_COLUMNS), comments="")


def write_tile_uncertainty(path: Path, survey: SurveyMap, heights: Floats) -> None:
    """Write the uncertainty of the tiles of ``heights`` (K, 5), where the survey knows that of its poses."""
    if survey.trajectory is None or survey.uncertainty is None or len(survey.uncertainty.times_ns) == 0:
        return
    positions = survey.trajectory.at(survey.uncertainty.times_ns)[:, :3, 3]
    rows = tile_uncertainty(heights[:, :3], positions, survey.uncertainty.covariances)
    np.savetxt(path, rows, fmt="%.4f", delimiter=",", header=",".join(TILE_COLUMNS), comments="")


def read_heights(path: Path) -> Floats:
    """Read what :func:`write_heights` wrote; InputError for anything else."""
    try:
        head, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: damaged ({error}); rebuild the map") from error
    if head.strip().split(",") != list(HEIGHT_COLUMNS):
        raise InputError(f"{path}: unexpected columns; rebuild the map")
    rows = [line.split(",") for line in lines if line.strip()]
    try:
        heights = np.array(rows, dtype=np.float64).reshape(len(rows), len(HEIGHT_COLUMNS))
    except ValueError as error:
        raise InputError(f"{path}: damaged ({error}); rebuild the map") from error
    if np.isinf(heights).any() or np.isnan(heights[:, [0, 1, 3]]).any():
        raise InputError(f"{path}: damaged (a tile has no place or an infinite height); rebuild the map")
    return heights
