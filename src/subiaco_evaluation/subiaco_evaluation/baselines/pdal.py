"""M3C2 as PDAL computes it (``filters.m3c2``), which is what QGIS offers."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.baselines.cells import CellVerdict, Pair, decide_from_points, mean_by_cell
from subiaco_evaluation.baselines.config import M3c2Config
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

_DRIVER = "filters.m3c2"
_FIELDS = ("m3c2_distance", "m3c2_uncertainty", "m3c2_count2")


def require_pdal() -> None:
    """Raise where no PDAL with ``filters.m3c2`` is on the path.

    Raises
    ------
    InputError
    """
    program = shutil.which("pdal")
    if program is None:
        raise InputError("pdal-m3c2: the command 'pdal' was not found; install PDAL 2.10 or later")
    listed = subprocess.run([program, "--drivers"], capture_output=True, text=True, check=False).stdout
    if _DRIVER not in listed:
        raise InputError(f"pdal-m3c2: {program} has no {_DRIVER}; install PDAL 2.10 or later")


def difference_by_pdal(pair: Pair, config: BaselineConfig) -> CellVerdict:
    """Label cells whose points moved by more than PDAL's uncertainty; settings are those of ``m3c2``."""
    settings = config.m3c2
    with tempfile.TemporaryDirectory(prefix="subiaco-pdal-") as folder:
        clouds = (pair.before.cloud, pair.after.cloud)
        sigma = pair.registration.sigma_reg_m
        found = [_compare(clouds[i], clouds[1 - i], sigma, settings, Path(folder)) for i in (0, 1)]
    changed = (_changed(*found[0], settings), _changed(*found[1], settings))
    code, confidence = decide_from_points(pair, changed, config.cells, settings, settings.voids)
    distance = mean_by_cell(pair, (found[0][0], -found[1][0]))
    return CellVerdict(code, confidence, distance, mean_by_cell(pair, (found[0][1], found[1][1])))


def pipeline(own: Path, other: Path, output: Path, sigma: float, settings: M3c2Config) -> list[object]:
    """Return the stages, as PDAL reads them, that compare every point of ``own`` with ``other``.

    Parameters
    ----------
    own, other : Path
        PLY files.
    output : Path
        CSV of one row for every point of ``own``, in their order.
    sigma : float
        Registration error [m].
    settings : M3c2Config
    """
    sources = (("own", own), ("other", other), ("core", own))
    readers = [{"type": "readers.ply", "filename": str(path), "tag": tag} for tag, path in sources]
    compare = {
        "type": _DRIVER, "inputs": [tag for tag, _ in sources], "tag": "m3c2",
        "normal_radius": settings.normal_radius, "cyl_radius": settings.radius,
        "cyl_halflen": settings.half_length, "reg_error": sigma, "min_points": settings.min_count,
    }  # fmt: skip
    write = {
        "type": "writers.text", "filename": str(output), "inputs": ["m3c2"], "format": "csv",
        "order": ",".join(f"{name}:6" for name in _FIELDS), "keep_unspecified": False, "quote_header": False,
    }  # fmt: skip
    return [*readers, compare, write]


def _compare(
    own: PointCloud, other: PointCloud, sigma: float, settings: M3c2Config, folder: Path
) -> tuple[Floats, Floats]:
    """Return distance and uncertainty (N,) of every point [m], NaN where PDAL computed none."""
    files = [folder / name for name in ("own.ply", "other.ply", "found.csv", "pipeline.json")]
    for path, cloud in zip(files[:2], (own, other), strict=True):
        write_cloud(path, PointCloud(cloud.xyz, np.zeros(3)))  # local, so that no digit is lost
    files[3].write_text(json.dumps(pipeline(files[0], files[1], files[2], sigma, settings)))
    done = subprocess.run(["pdal", "pipeline", str(files[3])], capture_output=True, text=True, check=False)
    if done.returncode or not files[2].is_file():
        reason = " ".join(done.stderr.split())[:200]
        raise InputError(f"pdal-m3c2: 'pdal pipeline' failed ({reason}); check the installation of PDAL")
    found = np.loadtxt(files[2], delimiter=",", skiprows=1, ndmin=2)
    if found.shape != (len(own), len(_FIELDS)):
        raise InputError(f"pdal-m3c2: PDAL wrote {len(found)} points for {len(own)}; use PDAL 2.10 or later")
    files[2].unlink()
    known = found[:, 2] > 0
    return np.where(known, found[:, 0], np.nan), np.where(known, found[:, 1], np.nan)


def _changed(distance: Floats, level: Floats, settings: M3c2Config) -> Mask:
    """Tell which points moved; PDAL says no distance where either cloud has too few points."""
    known = np.isfinite(distance)
    gate = np.maximum(np.nan_to_num(level), settings.minimum)
    moved = known & (np.abs(np.nan_to_num(distance)) > gate)
    return np.asarray(moved if settings.no_counterpart == "unchanged" else moved | ~known)
