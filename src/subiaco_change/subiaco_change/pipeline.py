"""The recipe of the change run: from two survey maps to everything that changed between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from subiaco_change.config import ChangeConfig
from subiaco_change.level_of_detection.alignment_corrections import block_table, stated_registration
from subiaco_change.records import ChangeRecord, ChangeResult, GroundChange, Registration, TiledResult
from subiaco_change.registration.pair import PairInfo
from subiaco_change.tiling.alignment import TileLods, load_sigma
from subiaco_change.tiling.label_stage import TileLabels
from subiaco_change.tiling.labelled_tiles import LabelledTiles
from subiaco_change.tiling.run import ChangeRun, ComparisonResult
from subiaco_change.tiling.stage_inputs import Correction, load_frame
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats
from subiaco_geo.sources import Epoch, LoadedEpoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.task_runner import Progress, TaskRunner
from subiaco_geo.work.tasks import Inputs


def detect_changes(
    before: SurveyMap,
    after: SurveyMap,
    config: ChangeConfig,
    progress: Progress | None = None,
    *,
    transform: Floats | None = None,
    given: Sequence[str] = (),
    runner: TaskRunner | None = None,
) -> ChangeResult:
    """Find what changed between two epochs.

    Parameters
    ----------
    before, after : SurveyMap
        Maps, or bare clouds as maps without trajectory and visibility.
    config : ChangeConfig
    progress : callable, optional
        Called with the name of each stage and the fraction of the run done.
    transform : (4, 4) float64, optional
        A given ``T_after_before`` in world coordinates; identity says that
        the epochs are registered already. Without it they are registered.
    given : sequence of str
        Point fields that replace stages: ``semantic``, ``instance``.
    runner : TaskRunner, optional
        Where stages are kept and who does them; in memory and in this process by default.

    Returns
    -------
    ChangeResult
        Clouds in the frame of *after*.

    Raises
    ------
    InputError, RegistrationError
    """
    runner = TaskRunner(progress=progress) if runner is None else runner
    pair = LoadedEpoch(before), LoadedEpoch(after)
    return detect_in_tiles(pair, config, runner, transform=transform, given=given).whole()


def detect_in_tiles(
    epochs: tuple[Epoch, Epoch],
    config: ChangeConfig,
    runner: TaskRunner,
    *,
    transform: Floats | None = None,
    given: Sequence[str] = (),
    begun: Callable[[ChangeRun], None] | None = None,
) -> TiledResult:
    """Find what changed between two epochs without ever holding one of them; see :func:`detect_changes`.

    The result reads its clouds from the store of the runner: use it while that is there. ``begun`` is
    given the run once both epochs are cut, and may refuse them or leave tiles out.
    """
    run = ChangeRun(runner, config, tuple(given))
    run.cut(epochs)
    if begun is not None:
        begun(run)
    if transform is None or np.array_equal(transform, np.eye(4)):
        run.check_heights()
    run.follow_spacing()
    registration = run.register(transform)
    run.number()
    run.recut(registration)
    refined = transform is None and config.second_registration
    found = run.compare(registration, None, (0.5, 0.72 if refined else 0.92))
    info = run.info
    if refined:
        changed = run.changed(found, (0.72, 0.73))
        again, moved, failed = run.refine(found, changed)
        info = replace(
            info, findings=(*info.findings, *(Finding("registration", "warning", f) for f in failed))
        )
        if moved > config.second_shift:
            found = run.compare(again, changed, (0.76, 0.92))
    labelled = run.label(found)
    runner.store.note("stages.json", run.manifest(found, labelled))
    return _assemble(run, found, labelled, info)


def _assemble(
    run: ChangeRun, found: ComparisonResult, labelled: Mapping[str, str], info: PairInfo
) -> TiledResult:
    tiles = sorted(labelled)
    inputs = Inputs(run.runner.store, {**found.frame, **run.poses, "sigma": found.sigma})
    frame = load_frame(inputs, run.origin)
    sigma = load_sigma(inputs, run.origin, run.config.placing.uncertainty)
    samples = np.concatenate([run.runner.load(TileLods, found.lods[t]).sigma for t in tiles])
    bias = inputs.of(Correction, "bias").field
    registration = stated_registration(run.registration(found.registration), samples, bias)
    clouds = LabelledTiles.of(run, frame, labelled)
    return TiledResult(
        _with_points(run, found, labelled),
        run.sides[1].crs,
        _with_operation(registration, info),
        _raster(run, labelled),
        info.findings,
        block_table(sigma, frame),
        run.runner.costs(),
        tiles,
        clouds.tile,
        clouds.written,
    )


def _with_points(
    run: ChangeRun, found: ComparisonResult, labelled: Mapping[str, str]
) -> tuple[ChangeRecord, ...]:
    """Add the points that rows got when points were labelled: those of ground patches, and fragments."""
    records = list(found.table.records)
    counts: dict[int, NDArray[np.int64]] = {}
    for key in labelled.values():
        for number, *points in run.runner.load(TileLabels, key).added_points.tolist():
            counts[number] = counts.get(number, np.zeros(2, dtype=np.int64)) + np.array(points)
    for number, points in counts.items():
        row = records[number]
        records[number] = replace(
            row, n_before=row.n_before + int(points[0]), n_after=row.n_after + int(points[1])
        )
    return tuple(records)


def _raster(run: ChangeRun, labelled: Mapping[str, str]) -> GroundChange | None:
    """Lay the rasters of the tiles side by side, row 0 in the north."""
    cell = run.config.ground.report_cell
    edge = round(run.size / cell)
    opened = {name: run.runner.load(TileLabels, key) for name, key in labelled.items()}
    known = {name: piece for name, piece in opened.items() if piece.raster_dz is not None}
    if not known:
        return None
    places = {name: np.array([int(v) for v in name.split("_")]) for name in known}
    low, high = np.min(list(places.values()), axis=0), np.max(list(places.values()), axis=0)
    columns, rows = ((high - low + 1) * edge).tolist()
    grids = {field: np.full((rows, columns), np.nan, dtype=np.float32) for field in ("dz", "confidence")}
    for name, piece in known.items():
        column, row = ((places[name] - low) * edge).tolist()
        for field, grid in grids.items():
            grid[rows - row - edge : rows - row, column : column + edge] = getattr(piece, f"raster_{field}")
    west, north = tile_named(f"{low[0]}_{high[1]}", run.size).core[0::3]
    return GroundChange(grids["dz"], grids["confidence"], west, north, cell)


def _with_operation(registration: Registration, info: PairInfo) -> Registration:
    """Record how exact the coordinate operation was that brought *before* into the CRS of *after*."""
    if info.operation == "none":
        return registration
    accuracy = {"crs_operation_accuracy_m": info.accuracy_m}
    return replace(registration, details={**registration.details, **accuracy})
