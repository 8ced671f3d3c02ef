"""From two survey maps to everything that changed between them, as one recipe."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from subiaco_change.changes.ablation import Part, pointwise, view_without
from subiaco_change.changes.ground_change import GroundComparison, compare_ground, ground_raster
from subiaco_change.changes.labelling import Labels, ground_records, label_epoch
from subiaco_change.changes.object_changes import ObjectChange, ObjectRules, compare_objects, make_record
from subiaco_change.changes.objects import EpochView, Reach
from subiaco_change.config import ChangeConfig
from subiaco_change.geometry import estimate_normals
from subiaco_change.observation.common_frame import levelled, seen_through
from subiaco_change.observation.evidence import Observer, make_observer
from subiaco_change.observation.placing import Placed, block_table, place
from subiaco_change.records import ChangeRecord, ChangeResult, Registration
from subiaco_change.registration.pair import PairInfo, check_pair
from subiaco_change.registration.register import given_registration, register
from subiaco_change.semantics.classes import SemanticResult, label_points
from subiaco_change.semantics.ground import Mask
from subiaco_change.semantics.instances import segment
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import Floats
from subiaco_geo.maps import SurveyMap

_LOG = logging.getLogger(__name__)
Progress = Callable[[str, float], None]


@dataclass
class _Stages:
    """Reports progress and keeps the seconds of every stage."""

    progress: Progress | None
    seconds: dict[str, float] = field(default_factory=dict)
    _started: float = 0.0
    _name: str = ""

    def start(self, name: str, fraction: float) -> None:
        """End the running stage and begin another at a fraction of the whole run."""
        now = time.perf_counter()
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._started
        self._started, self._name = now, name
        _LOG.info("%s", name)
        if self.progress is not None and name:
            self.progress(name, fraction)


@dataclass(frozen=True)
class _Epoch:
    """One epoch at the working leaf: its map, cloud with normals, labels, and observer."""

    survey: SurveyMap
    cloud: PointCloud
    semantic: SemanticResult
    instance: NDArray[np.int32]
    observer: Observer


@dataclass(frozen=True)
class _Comparison:
    """One pass over two registered epochs."""

    placed: Placed
    views: tuple[EpochView, EpochView]
    seen_by: tuple[Callable[[Floats], Mask], Callable[[Floats], Mask]]
    objects: list[ObjectChange]
    ground: GroundComparison | None


def detect_changes(
    before: SurveyMap,
    after: SurveyMap,
    config: ChangeConfig,
    progress: Progress | None = None,
    *,
    transform: Floats | None = None,
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

    Returns
    -------
    ChangeResult
        Clouds in the frame of *after*.

    Raises
    ------
    InputError, RegistrationError
    """
    stages = _Stages(progress)
    stages.start("check", 0.0)
    before, after, info = check_pair(before, after, config.leaf)
    clouds = [_with_normals(survey.cloud, config) for survey in (before, after)]
    observers = (
        make_observer(before, config.evidence, info.before_to_own),
        make_observer(after, config.evidence),
    )
    stages.start("registration", 0.05)
    registration = _register(clouds[0], clouds[1], config, transform)
    epochs = []
    for number, survey in enumerate((before, after)):
        stages.start("semantics", 0.25 + 0.2 * number)
        epochs.append(_prepare(survey, clouds[number], observers[number], config))
    result = _compare(epochs[0], epochs[1], registration, config, stages)
    if transform is None and config.second_registration:
        stages.start("second registration", 0.75)
        changed = _changed(result, 0), _changed(result, 1)
        again, failed = _again(registration, clouds, changed, config)
        info = replace(info, warnings=(*info.warnings, *failed))
        if _shift(registration, again, clouds[0]) > config.second_shift:
            result = _compare(epochs[0], epochs[1], again, config, stages, changed)
    stages.start("table", 0.95)
    return _assemble(result, epochs[0], epochs[1], config, stages, info)


def _with_normals(cloud: PointCloud, config: ChangeConfig) -> PointCloud:
    """Estimate normals, the same way for both epochs."""
    return cloud.with_fields(normals=estimate_normals(cloud.xyz, config.normal_radius))


def _register(
    before: PointCloud, after: PointCloud, config: ChangeConfig, transform: Floats | None
) -> Registration:
    if transform is None:
        return register(before, after, config.registration)
    method = "identity" if np.array_equal(transform, np.eye(4)) else "given"
    return given_registration(transform, before, after, config.registration, method)


def _again(
    first: Registration, clouds: list[PointCloud], changed: tuple[Mask, Mask], config: ChangeConfig
) -> tuple[Registration, tuple[str, ...]]:
    """Refine a registration without what its pass calls changed; what fails leaves it, and a warning."""
    try:
        return register(clouds[0], clouds[1], config.registration, *changed, start=first), ()
    except RegistrationError as error:
        note = f"the second estimate, without changed places, failed and the first is kept: {error}"
        _LOG.warning(note)
        return first, (note,)


def _prepare(survey: SurveyMap, cloud: PointCloud, observer: Observer, config: ChangeConfig) -> _Epoch:
    upright = levelled(cloud)
    semantic = label_points(upright, config.semantics, observer.passes(cloud.world()))
    instances = config.instances.model_copy(update={"leaf": config.leaf})
    return _Epoch(survey, cloud, semantic, segment(upright, semantic, instances), observer)


def _compare(
    before: _Epoch,
    after: _Epoch,
    registration: Registration,
    config: ChangeConfig,
    stages: _Stages,
    changed: tuple[Mask, Mask] | None = None,
) -> _Comparison:
    stages.start("level of detection", 0.65)
    unsteady = [np.isin(e.semantic.semantic, (Semantic.VEGETATION, Semantic.MOBILE)) for e in (before, after)]
    if changed is not None:
        unsteady = [mask | extra for mask, extra in zip(unsteady, changed, strict=True)]
    placed = place(
        (before.cloud, after.cloud),
        registration,
        (before.survey, after.survey),
        (before.semantic.semantic == Semantic.GROUND, after.semantic.semantic == Semantic.GROUND),
        (unsteady[0], unsteady[1]),
        config.placing,
        config.lod,
    )
    frame, moved, lods = placed.frame, placed.before, placed.lods
    stages.start("objects", 0.7)
    full = (_view(moved, before, lods[0]), _view(after.cloud, after, lods[1]))
    first, second = (view_without(view, config.without, config.measures.voxel) for view in full)
    views = (first, second)
    seen_by_before = seen_through(before.observer.observed, frame.before_world)
    seen_by_after = seen_through(after.observer.observed, frame.after_world)
    rules = _rules(config)
    objects = compare_objects(*views, seen_by_before, seen_by_after, rules)
    stages.start("ground", 0.73)
    ground = compare_ground(*views, config.ground)
    return _Comparison(placed, views, (seen_by_before, seen_by_after), objects, ground)


def _rules(config: ChangeConfig) -> ObjectRules:
    """Rules of the objects, less what is left out."""
    decisions = config.decisions
    if Part.LOD in config.without:
        decisions = decisions.model_copy(update={"lod_floor": 0.0})
    by_class = Part.CLASS_ASSOCIATION not in config.without
    return ObjectRules(config.measures, config.association, decisions, by_class)


def _view(cloud: PointCloud, epoch: _Epoch, lod: NDArray[np.float32]) -> EpochView:
    semantic = epoch.semantic
    own = np.take_along_axis(semantic.scores, semantic.semantic[:, None].astype(np.int64), axis=1)[:, 0]
    return EpochView(
        cloud.xyz,
        np.asarray(cloud.fields["normals"], dtype=np.float64),
        semantic.semantic,
        np.asarray(epoch.instance, dtype=np.int32),
        semantic.height_above_ground.astype(np.float64),
        np.asarray(lod, dtype=np.float64),
        own.astype(np.float64),
        epoch.observer.passes(epoch.cloud.world()),
    )


def _changed(result: _Comparison, epoch: int) -> Mask:
    """Points of an epoch that a pass calls changed, or cannot vouch for."""
    mask = np.zeros(len(result.views[epoch].xyz), dtype=bool)
    for change in result.objects:
        if change.decision.change is not Change.UNCHANGED:
            mask[change.points(("before", "after")[epoch])] = True
    if result.ground is not None:
        row, column, inside = result.ground.cell_of(result.views[epoch].xyz[:, :2])
        mask |= inside & (result.ground.patch[row, column] >= 0)
    return mask


def _shift(first: Registration, second: Registration, before: PointCloud) -> float:
    """Largest distance between two registrations at the corners of *before* [m]."""
    low, high = before.world().min(axis=0), before.world().max(axis=0)
    corners = np.array(
        [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    placed = [
        (corners - r.origin) @ r.T_local[:3, :3].T + r.T_local[:3, 3] + r.origin for r in (first, second)
    ]
    return float(np.linalg.norm(placed[0] - placed[1], axis=1).max())


def _assemble(
    result: _Comparison,
    before: _Epoch,
    after: _Epoch,
    config: ChangeConfig,
    stages: _Stages,
    info: PairInfo,
) -> ChangeResult:
    origin = result.placed.frame.origin
    evidence = _weaker(before.observer.kind, after.observer.kind)
    records: list[ChangeRecord] = []
    for number, change in enumerate(result.objects):
        kind = (
            evidence if change.before and change.after else (before if change.after else after).observer.kind
        )
        records.append(make_record(change, number, origin, kind, config.confidence))
    patches = ground_records(result.ground, result.views, origin, len(records), evidence)
    labels = [
        label_epoch(
            result.views[e],
            name,
            result.objects,
            records,
            result.ground,
            result.seen_by[1 - e],
            config.evidence,
            result.views[1 - e],
        )
        for e, name in enumerate(("before", "after"))
    ]
    if Part.OBJECTS in config.without:
        labels = [_by_point(result, e, labels[e], config) for e in (0, 1)]
    raster = None if result.ground is None else ground_raster(result.ground, origin, config.ground)
    clouds = [_labelled(c, v) for c, v in zip((result.placed.before, after.cloud), labels, strict=True)]
    stages.start("", 1.0)
    registration = _with_operation(result.placed.frame.registration, info)
    return ChangeResult(
        (*records, *patches),
        clouds[0],
        clouds[1],
        registration,
        raster,
        stages.seconds,
        info.warnings,
        block_table(result.placed),
    )


def _by_point(result: _Comparison, epoch: int, labels: Labels, config: ChangeConfig) -> Labels:
    """Label what is not ground point by point."""
    m = config.measures
    reach = Reach(m.same_low, m.same_high, m.same_factor)
    view, other = result.views[epoch], result.views[1 - epoch]
    alone = pointwise(view, other, result.seen_by[1 - epoch], ("before", "after")[epoch], reach)
    return replace(labels, change=np.where(view.semantic == Semantic.GROUND, labels.change, alone))


def _with_operation(registration: Registration, info: PairInfo) -> Registration:
    """Record how exact the coordinate operation was that brought *before* into the CRS of *after*."""
    if info.operation == "none":
        return registration
    accuracy = {"crs_operation_accuracy_m": info.accuracy_m}
    return replace(registration, details={**registration.details, **accuracy})


def _weaker(first: str, second: str) -> str:
    """Return the weaker of two kinds of evidence."""
    order = ("observed", "trajectory", "shadow", "assumed")
    return max(first, second, key=order.index)


def _labelled(cloud: PointCloud, labels: Labels) -> PointCloud:
    """Attach the labels that the outputs hand on."""
    kept = {name: values for name, values in cloud.fields.items() if name in ("intensity", "normals")}
    return PointCloud(cloud.xyz, cloud.origin, cloud.crs, {**kept, **labels.fields()})
