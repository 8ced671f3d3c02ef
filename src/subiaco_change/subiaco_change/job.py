"""The change job from two paths to a change directory, for the command and the node alike."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import geopandas as gpd
import numpy as np

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.confidence import ConfidenceCalibration, calibration_of
from subiaco_change.extensions import Extensions
from subiaco_change.given_classes import (
    CLASSIFICATION,
    SEMANTIC,
    ClassifiedEpoch,
    classified,
    given_class_findings,
)
from subiaco_change.input_checks import (
    InputCheckConfig,
    check_shift,
    check_surveys,
    facts_of,
    unstated_findings,
)
from subiaco_change.level_of_detection.registration_uncertainty import UncertaintyConfig
from subiaco_change.outputs.directory import MARKER, ChangeInputs, PageWriter, write_change_directory
from subiaco_change.outputs.parcels import read_lots, refuse_lots_elsewhere
from subiaco_change.outputs.reviews import read_reviewed
from subiaco_change.pipeline import detect_in_tiles
from subiaco_change.records import ChangeRecord, ChangeResult, TiledResult
from subiaco_change.request import ChangeRequest, ComparisonRequest
from subiaco_change.tiling.run import STAGES, ChangeRun
from subiaco_geo.atomic import refuse_existing, refuse_foreign
from subiaco_geo.clouds import extent_of
from subiaco_geo.codes import CHANGED
from subiaco_geo.config import StrictModel
from subiaco_geo.disk import ground_of, require_room
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.findings import Finding, announce
from subiaco_geo.frames import Floats
from subiaco_geo.locks import locked
from subiaco_geo.maps import load_epoch
from subiaco_geo.simulated import SIMULATIONS, distinct
from subiaco_geo.sources import Epoch, open_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.work.executors import make_executor, running
from subiaco_geo.work.object_store import ObjectStore
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.task_runner import TaskRunner, stages_from

_LOG = logging.getLogger(__name__)
Taken = TypeVar("Taken")
_JUMP = 20.0  # longer steps between scans lead from one recording to the next [m]
RESULT_BYTES, STAGE_BYTES = 60, 200  # a point takes on the disk; measured: 58, and 220 to 315
INPUT_BYTES = 32  # a point of the input takes among the stages, where all are written
_DATED = np.datetime64("2000-01-01")


@contextmanager
def task_runner(
    request: ChangeRequest,
    progress: Callable[[str, float], None] | None = None,
    on_tile: Callable[[str, str], None] | None = None,
) -> Iterator[TaskRunner]:
    """Set up the task runner for a request; stages beside its output are removed when the run succeeds.

    Raises
    ------
    InputError
        ``redo`` is no stage, another run works on the same output, or the scheduler does not answer.
    """
    redo = frozenset() if request.redo is None else stages_from(STAGES, request.redo)
    kept = _stage_folder(request)
    store = ObjectStore(request.stages) if isinstance(request.stages, str) else DiskStore(kept.absolute())
    with locked(kept):
        if request.stages is None and any(kept.glob("*/*.npz")):
            _LOG.warning("%s: what a run that was stopped finished there is used again", kept)
        with running(
            make_executor(request.workers, request.scheduler, ("subiaco_change.tiling.worker_start",))
        ) as executor:
            try:
                yield TaskRunner(store, executor, progress, redo, on_tile)
            except (InputError, RegistrationError):
                executor.close()  # what runs beside the task that failed still writes
                _forget(request, kept)  # the same input would fail again
                raise
            except KeyboardInterrupt:
                where = request.stages or kept
                _LOG.warning(
                    "stopped; what is finished is in %s, and the same command goes on from there", where
                )
                raise
        _forget(request, kept)


def _forget(request: ChangeRequest, kept: Path) -> None:
    """Remove the stages of a run, unless they are kept for good."""
    if request.stages is None:
        shutil.rmtree(kept, ignore_errors=True)


def read_transform(path: Path) -> Floats:
    """Read a 4x4 from text (four rows of four numbers) or from ``registration.json``.

    Raises
    ------
    InputError
        The file holds neither.
    """
    try:
        if path.suffix == ".json":
            values = np.array(json.loads(path.read_text())["T_after_before"], dtype=np.float64)
        else:
            values = np.loadtxt(path, dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = "no transform could be read" if path.is_file() else "no such file"
        raise InputError(
            f"{path}: {reason}; give a text file with four rows of four numbers, or a JSON file with "
            "T_after_before"
        ) from error
    if values.shape != (4, 4):
        raise InputError(f"{path}: expected a 4x4 transform, found shape {values.shape}")
    return values


def drive_facts(survey: SurveyMap | Epoch) -> dict[str, Any]:
    """Return the UTC times of the first and last scan and the kilometres driven; nothing where not known."""
    trajectory = survey.trajectory
    if trajectory is None or len(trajectory) < 2:
        return {}
    first, last = (np.datetime64(int(t), "ns") for t in trajectory.times_ns[[0, -1]])
    steps = np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1)
    km = round(float(steps[steps < _JUMP].sum()) / 1000.0, 3)
    if first < _DATED:  # seconds since the start of a recording, not times
        return {"km": km}
    return {"first": str(first)[:19], "last": str(last)[:19], "km": km}


def run_job(
    request: ComparisonRequest,
    config: StrictModel,
    detect: Callable[[SurveyMap, SurveyMap], ChangeResult],
    progress: Callable[[str, float], None] | None = None,
    *,
    notes: Mapping[str, str] | None = None,
    calibration: ConfidenceCalibration | None = None,
    write_pages: PageWriter | None = None,
) -> ChangeResult:
    """Load two epochs, find changes by any method, write the change directory.

    Parameters
    ----------
    request : ComparisonRequest
    config : StrictModel
        Of the method; written beside the result.
    detect : callable
        The method, given *before* and *after*.
    progress : callable, optional
    notes : mapping, optional
        Further facts for ``run.json``.
    calibration : ConfidenceCalibration, optional
        What the method's confidences were fitted on.
    write_pages : callable, optional
        Writes the report into the change directory.

    Raises
    ------
    InputError, RegistrationError
        Nothing is left under ``request.output`` then.
    """
    lots = _start(request)
    before = load_epoch(request.before, request.trajectory_before)
    after = load_epoch(request.after, request.trajectory_after)
    low, high = extent_of(after.cloud.xyz)
    _check_lots(request, lots, (low + after.cloud.origin, high + after.cloud.origin))
    checks, poses = InputCheckConfig(), UncertaintyConfig().unstated_pose
    surveys = facts_of(before), facts_of(after)
    found = _announced(check_surveys((request.before, request.after), surveys, checks))
    result = detect(before, after)
    if request.transform is None:
        found += _announced(check_shift(result.registration, surveys, poses, checks))
    if progress is not None:
        progress("writing", 0.97)
    inputs = _inputs(request, before, after, notes or {}, calibration or ConfidenceCalibration(), lots)
    inputs = replace(inputs, findings=found)
    write_change_directory(request.output, result, config, inputs, request.overwrite, write_pages)
    return result


def _begin(
    request: ChangeRequest,
    lots: gpd.GeoDataFrame | None,
    begun: Callable[[ChangeRun], None] | None,
    run: ChangeRun,
) -> None:
    """Look at a run whose epochs are cut before its stages begin."""
    _check_lots(request, lots, run.extents[1])
    points = run.kept_points
    if begun is not None:
        begun(run)
    kept = run.kept_points
    _require_room(request, *disk_bytes(kept, round(run.input_points * kept / max(points, 1)), run.config))


def disk_bytes(points: int, inputs: int, config: ChangeConfig) -> tuple[int, int]:
    """Return what the stages and the result of a run take on the disk [bytes].

    Parameters
    ----------
    points, inputs : int
        Points of both epochs at the working leaf, and of the input.
    config : ChangeConfig
    """
    if config.every_point:
        return points * STAGE_BYTES + inputs * INPUT_BYTES, inputs * RESULT_BYTES
    return points * STAGE_BYTES, points * RESULT_BYTES


def _require_room(request: ChangeRequest, staged: int, result: int) -> None:
    """Refuse a run whose stages or result [bytes] would fill a disk."""
    if isinstance(request.stages, str):
        require_room(request.output, result, "the result")
        return
    stages = _stage_folder(request)
    done = sum(file.stat().st_size for file in stages.rglob("*.npz"))  # of a run that was stopped
    needed = max(staged - done, 0)
    if ground_of(stages).stat().st_dev == ground_of(request.output).stat().st_dev:
        require_room(request.output, result + needed, "the run")
        return
    require_room(stages, needed, "the run")
    require_room(request.output, result, "the result")


def _stage_folder(request: ChangeRequest) -> Path:
    """Return where the finished stages of a run lie, or would lie where object storage keeps them."""
    beside = request.output.with_name(f"{request.output.name}.stages")
    return request.stages if isinstance(request.stages, Path) else beside


def _announced(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Say findings as they are made, long before the run ends."""
    announce(findings, _LOG)
    return findings


def _start(request: ComparisonRequest) -> gpd.GeoDataFrame | None:
    """Refuse an output that is there, or whose reviews cannot be read; return the lots, if there are any."""
    refuse_existing(request.output, request.overwrite)
    refuse_foreign(request.output, MARKER)
    read_reviewed(request.output)  # a table that cannot be read back is refused before the work, not after it
    if request.parcels is None:
        return None
    return read_lots(request.parcels, open_epoch(request.after).crs)


def _check_lots(
    request: ComparisonRequest, lots: gpd.GeoDataFrame | None, extent: tuple[Floats, Floats]
) -> None:
    """Refuse lots that lie apart from the later map, whose lowest and highest coordinates are known."""
    if request.parcels is not None and lots is not None:
        refuse_lots_elsewhere(request.parcels, lots, *extent)


def _inputs(
    request: ComparisonRequest,
    before: SurveyMap | Epoch,
    after: SurveyMap | Epoch,
    notes: Mapping[str, str],
    calibration: ConfidenceCalibration,
    lots: gpd.GeoDataFrame | None,
) -> ChangeInputs:
    named = distinct(name for epoch in (before, after) for name in epoch.info.get(SIMULATIONS, []))
    known = all(epoch.info.get("heights") == "ellipsoidal" for epoch in (before, after))
    facts = {"epochs": {"before": drive_facts(before), "after": drive_facts(after)}}
    return ChangeInputs(
        request.before,
        request.after,
        {**notes, **named, **facts},
        calibration=calibration,
        ellipsoidal=known,
        lots=lots,
    )


def run_change(
    request: ChangeRequest,
    progress: Callable[[str, float], None] | None = None,
    *,
    extensions: Extensions = Extensions(),  # noqa: B008 - frozen
    write_pages: PageWriter | None = None,
) -> tuple[ChangeRecord, ...]:
    """Run our own method on two epochs in tiles; return the rows. Errors as for :func:`run_job`.

    Parameters
    ----------
    request : ChangeRequest
    progress : callable, optional
        Called with the name of the stage, the fraction of the run that is done.
    extensions : Extensions
        Functions that replace parts of the method.
    write_pages : callable, optional
        Writes the report into the change directory.
    """
    return run_change_and(
        request, lambda result: result.records, progress, extensions=extensions, write_pages=write_pages
    )


def _extended(request: ChangeRequest, extensions: Extensions) -> tuple[tuple[Epoch, Epoch], Floats | None]:
    """Return epochs and transform as functions of the user give them; both surveys are read once."""
    forms = request.config.trajectories
    places = (
        (request.before, request.trajectory_before, forms.before, "trajectories.before"),
        (request.after, request.trajectory_after, forms.after, "trajectories.after"),
    )
    epochs: tuple[Epoch, Epoch] = (open_epoch(*places[0]), open_epoch(*places[1]))
    if extensions.registration is None and extensions.segmentation is None:
        return epochs, request.T_after_before
    surveys = load_epoch(*places[0]), load_epoch(*places[1])
    transform = extensions.transform(surveys, request.T_after_before)
    return extensions.segmented(epochs, surveys), transform


def run_change_and(
    request: ChangeRequest,
    take: Callable[[TiledResult], Taken],
    progress: Callable[[str, float], None] | None = None,
    *,
    on_tile: Callable[[str, str], None] | None = None,
    begun: Callable[[ChangeRun], None] | None = None,
    extensions: Extensions = Extensions(),  # noqa: B008 - frozen
    write_pages: PageWriter | None = None,
) -> Taken:
    """Run our own method as :func:`run_change`; return what is taken of the result.

    ``on_tile`` is told the stage and the name of every tile that is done; ``begun`` is given the run once
    both epochs are cut.
    """
    config = request.config
    lots = _start(request)
    epochs, transform = _extended(request, extensions)
    given: tuple[str, ...] = request.given if extensions.segmentation is None else ("semantic", "instance")
    labelled: tuple[ClassifiedEpoch, ClassifiedEpoch] | None = None
    if CLASSIFICATION in given:
        epochs = labelled = classified(epochs, config.classes)
        given = (SEMANTIC,)
    surveys = facts_of(epochs[0]), facts_of(epochs[1])
    poses = config.placing.uncertainty
    found = _announced(check_surveys((request.before, request.after), surveys, config.checks))
    found += unstated_findings(surveys, poses.unstated_pose, used=poses.pose_covariance)
    with task_runner(request, progress, on_tile) as runner:
        start = partial(_begin, request, lots, begun)
        result = detect_in_tiles(epochs, config, runner, transform=transform, given=given, begun=start)
        if labelled is not None:
            found += _announced(given_class_findings(labelled, (request.before, request.after)))
        result = extensions.decided(result)
        if transform is None:
            found += _announced(check_shift(result.registration, surveys, poses.unstated_pose, config.checks))
        if progress is not None:
            progress("writing", 0.97)
        simulated = all(epoch.info.get(SIMULATIONS) for epoch in epochs)
        kinds = {row.evidence for row in result.records if row.change in CHANGED}
        calibration = calibration_of(kinds, simulated, config.confidence)
        inputs = replace(_inputs(request, *epochs, {}, calibration, lots), findings=found)
        write_change_directory(
            request.output, result, config, inputs, request.overwrite, write_pages, runner.executor
        )
        return take(result)
