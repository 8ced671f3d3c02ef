"""Run of a simple or a learned method: from two survey maps to a change directory."""

from __future__ import annotations

import time
from collections.abc import Callable

from subiaco_change.job import run_job
from subiaco_change.outputs.directory import PageWriter
from subiaco_change.records import ChangeResult
from subiaco_change.request import ComparisonRequest
from subiaco_evaluation.baselines.cells import CellVerdict, Pair
from subiaco_evaluation.baselines.dsm import difference_surfaces
from subiaco_evaluation.baselines.m3c2 import difference_along_normals
from subiaco_evaluation.baselines.nearest import difference_by_lod, difference_by_threshold
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.baselines.patches import connect, label_points, make_records
from subiaco_evaluation.baselines.pdal import difference_by_pdal, require_pdal
from subiaco_evaluation.config import BaselineConfig
from subiaco_evaluation.learned.methods import LEARNED_METHODS, require_torch
from subiaco_evaluation.learned.weights_file import find_weights
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap

Progress = Callable[[str, float], None]

#: The simple methods by the name of the command; learned ones and PDAL's need more than our dependencies.
METHODS: dict[str, Callable[[Pair, BaselineConfig], CellVerdict]] = {
    "dsm": difference_surfaces,
    "nn": difference_by_lod,
    "m3c2": difference_along_normals,
    "c2c": difference_by_threshold,
}
PDAL_METHOD = "pdal-m3c2"
ALL_METHODS = (*METHODS, PDAL_METHOD, *LEARNED_METHODS)
_CAUTION = (
    "The baseline {} knows neither visibility nor objects nor classes. Its confidence is no probability."
)


def compare_pair(pair: Pair, method: str, config: BaselineConfig) -> ChangeResult:
    """Run a method on a prepared pair."""
    verdict = _verdict(pair, method, config)
    number, names = connect(verdict.code)
    clouds = label_points(pair, verdict, number, config)
    records = make_records(pair, verdict, number, names, clouds, method)
    caution = Finding("baseline", "note", _CAUTION.format(method))
    return ChangeResult(records, clouds[0], clouds[1], pair.registration, None, {}, (caution,))


def _verdict(pair: Pair, method: str, config: BaselineConfig) -> CellVerdict:
    if method in METHODS:
        return METHODS[method](pair, config)
    if method == PDAL_METHOD:
        return difference_by_pdal(pair, config)
    from subiaco_evaluation.learned.predict import predict  # imports PyTorch

    return predict(pair, config, method, find_weights(method, config.learned.weights))


def require_method(method: str, config: BaselineConfig) -> None:
    """Raise where a method is unknown, or what it needs is not installed.

    Raises
    ------
    InputError
    """
    if method not in ALL_METHODS:
        raise InputError(f"baseline {method}: known are {', '.join(ALL_METHODS)}")
    if method == PDAL_METHOD:
        require_pdal()
    if method in LEARNED_METHODS:
        require_torch(method)
        find_weights(method, config.learned.weights)


def detect_simply(
    before: SurveyMap,
    after: SurveyMap,
    method: str,
    config: BaselineConfig,
    progress: Progress | None = None,
    *,
    transform: Floats | None = None,
) -> ChangeResult:
    """Find what changed between two epochs by a simple method.

    Returns
    -------
    ChangeResult
        Rows are contiguous cells of one label; Unchanged ones make no row.

    Raises
    ------
    InputError, RegistrationError
    """
    require_method(method, config)
    say = progress or (lambda _name, _fraction: None)
    started = time.perf_counter()
    say("registration", 0.05)
    pair, findings = prepare_pair(before, after, config, transform)
    prepared = time.perf_counter()
    say(method, 0.6)
    result = compare_pair(pair, method, config)
    seconds = {"preparation": prepared - started, method: time.perf_counter() - prepared}
    return ChangeResult(
        result.records, result.before, result.after, result.registration, None, seconds,
        (*findings, *result.findings),
    )  # fmt: skip


def run_baseline(
    request: ComparisonRequest,
    method: str,
    config: BaselineConfig,
    progress: Progress | None = None,
    write_pages: PageWriter | None = None,
) -> ChangeResult:
    """Run a simple method on two epochs; errors as for :func:`subiaco_change.job.run_job`."""
    require_method(method, config)

    def detect(before: SurveyMap, after: SurveyMap) -> ChangeResult:
        return detect_simply(before, after, method, config, progress, transform=request.T_after_before)

    return run_job(request, config, detect, progress, notes={"baseline": method}, write_pages=write_pages)
