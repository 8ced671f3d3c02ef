"""Extensions: functions of users in place of the registration, the segmentation or the decision.

A function is called once for a pair or once for a cloud, with everything in memory; all other stages run tile
by tile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from subiaco_change.records import ChangeRecord, TiledResult
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, is_rigid
from subiaco_geo.sources import Epoch, LoadedEpoch
from subiaco_geo.survey_map import SurveyMap


class RegistrationFunction(Protocol):
    """Finds the rigid transform between two epochs."""

    def __call__(self, before: PointCloud, after: PointCloud) -> Floats:
        """Return ``T_after_before`` (4, 4) in world coordinates [m] of the CRS of *after*."""
        ...


class SegmentationFunction(Protocol):
    """Gives every point of one epoch a class and an object."""

    def __call__(self, cloud: PointCloud) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        """Return class codes (N,) of ``Semantic``, and object numbers (N,) with 0 for no object."""
        ...


class DecisionFunction(Protocol):
    """Replaces the decision of one row of the change table."""

    def __call__(self, row: ChangeRecord) -> ChangeRecord:
        """Return the row with its own ``change``, ``confidence`` and ``reason``; its number must stay."""
        ...


@dataclass(frozen=True)
class Extensions:
    """Functions that replace parts of the change run; None keeps the part of the method.

    Parameters
    ----------
    registration : RegistrationFunction, optional
    segmentation : SegmentationFunction, optional
    decision : DecisionFunction, optional
    """

    registration: RegistrationFunction | None = None
    segmentation: SegmentationFunction | None = None
    decision: DecisionFunction | None = None

    def segmented(
        self, epochs: tuple[Epoch, Epoch], surveys: tuple[SurveyMap, SurveyMap]
    ) -> tuple[Epoch, Epoch]:
        """Return both epochs with the fields ``semantic`` and ``instance`` of the segmentation function."""
        if self.segmentation is None:
            return epochs
        before, after = (_with_objects(survey, self.segmentation) for survey in surveys)
        return before, after

    def transform(self, surveys: tuple[SurveyMap, SurveyMap], given: Floats | None) -> Floats | None:
        """Return the transform of the registration function, or the given one.

        Raises
        ------
        InputError
            Both are there, or the function returns no rigid (4, 4) transform.
        """
        if self.registration is None:
            return given
        if given is not None:
            raise InputError("a transform and a registration function exclude each other; give one of them")
        before, after = (survey.cloud for survey in surveys)
        if before.crs != after.crs:
            raise InputError(
                f"registration function: the epochs are in {before.crs} and {after.crs}; reproject one"
            )
        found = np.asarray(self.registration(before, after), dtype=np.float64)
        if not is_rigid(found, 1e-6):
            raise InputError(
                f"registration function: returned no rigid transform (shape {found.shape}); return a (4, 4) "
                "array T_after_before with a rotation"
            )
        return found

    def decided(self, result: TiledResult) -> TiledResult:
        """Return the result with every row, and the points of its object, as the decision function says."""
        if self.decision is None:
            return result
        rows = tuple(_same_row(self.decision(row), row) for row in result.records)
        changed = {new.object_id: new for new, old in zip(rows, result.records, strict=True) if new != old}
        tile, labelled = (partial(_read_relabelled, read, changed) for read in (result.tile, result.labelled))
        return replace(result, records=rows, tile=tile, labelled=labelled)


def _read_relabelled(
    read: Callable[[str, str], PointCloud], changed: dict[int, ChangeRecord], epoch: str, name: str
) -> PointCloud:
    return _relabelled(read(epoch, name), changed)


def _with_objects(survey: SurveyMap, segment: SegmentationFunction) -> LoadedEpoch:
    semantic, instance = (np.asarray(values) for values in segment(survey.cloud))
    for name, values in (("class", semantic), ("object", instance)):
        if values.shape != (len(survey.cloud),) or values.dtype.kind not in "iu":
            raise InputError(
                f"segmentation function: {name} numbers have shape {values.shape} and type {values.dtype}; "
                f"return integers for all {len(survey.cloud)} points"
            )
    known = {int(code) for code in Semantic}
    if unknown := sorted(set(np.unique(semantic).tolist()) - known):
        raise InputError(f"segmentation function: class codes {unknown} are not known; use those of Semantic")
    cloud = survey.cloud.with_fields(semantic=semantic.astype(np.uint8), instance=instance.astype(np.int32))
    return LoadedEpoch(replace(survey, cloud=cloud))


def _same_row(new: ChangeRecord, old: ChangeRecord) -> ChangeRecord:
    if new.object_id != old.object_id or not 0.0 <= new.confidence <= 1.0:
        raise InputError(
            f"decision function: row {old.object_id} came back with number {new.object_id} and confidence "
            f"{new.confidence:g}; keep the number, and a confidence between 0 and 1"
        )
    return new


def _relabelled(cloud: PointCloud, changed: dict[int, ChangeRecord]) -> PointCloud:
    if not changed or not len(cloud):
        return cloud
    numbers = np.array(sorted(changed))
    place = np.clip(np.searchsorted(numbers, cloud.fields["instance"]), 0, len(numbers) - 1)
    hit = numbers[place] == cloud.fields["instance"]
    hit &= cloud.fields["change"] != Change.UNOBSERVED
    labels, confidences = cloud.fields["change"].copy(), cloud.fields["confidence"].copy()
    labels[hit] = np.array([changed[n].change for n in numbers.tolist()], dtype=labels.dtype)[place[hit]]
    confidences[hit] = np.array([changed[n].confidence for n in numbers.tolist()])[place[hit]]
    return cloud.with_fields(change=labels, confidence=confidences)
