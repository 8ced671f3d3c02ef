"""Classes that others gave to the points of a cloud: ASPRS codes in place of our own segmentation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats
from subiaco_geo.sources import Epoch
from subiaco_geo.survey_map import PoseUncertainty
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.visibility import VisibilityGrid

#: Point field of ASPRS codes, and that of our classes.
CLASSIFICATION, SEMANTIC = "classification", "semantic"
#: In the field of our classes: nobody gave one, the segmentation decides.
UNGIVEN = 255
_LEFT_OUT = 254
_CODES = 256


class GivenClassesConfig(StrictModel):
    """What the ASPRS codes of others mean here; codes in no list are classified by our segmentation."""

    ground: tuple[int, ...] = Field(
        (2, 8, 11), description="Number of each ASPRS class taken as ground: ground, key points, road"
    )
    building: tuple[int, ...] = Field(
        (6, 17), description="Number of each ASPRS class taken as building: building, bridge deck"
    )
    vegetation: tuple[int, ...] = Field(
        (3, 4, 5), description="Number of each ASPRS class taken as vegetation: low, medium, high"
    )
    mobile: tuple[int, ...] = Field(
        (64,), description="Number of each ASPRS class taken as mobile: the user code of our own files"
    )
    other: tuple[int, ...] = Field(
        (10, 13, 14, 15, 16),
        description="Number of each ASPRS class taken as other: rail, wires, towers, insulators",
    )
    left_out: tuple[int, ...] = Field(
        (7, 9, 18, 21, 22),
        description="Number of each ASPRS class whose points are not compared: noise, water, snow, "
        "temporary things",
    )

    def table(self) -> NDArray[np.uint8]:
        """Return our class (256,) of every ASPRS code, 255 where it is ours to find, 254 where left out.

        Raises
        ------
        InputError
            A code is in two lists, or beyond 255.
        """
        found = np.full(_CODES, UNGIVEN, dtype=np.uint8)
        lists = [(str(name.label), getattr(self, name.label), int(name)) for name in Semantic]
        for name, codes, ours in [*lists, ("left_out", self.left_out, _LEFT_OUT)]:
            for code in codes:
                if not 0 <= code < _CODES:
                    raise InputError(f"classes.{name}: {code} is no ASPRS class; give 0 to 255")
                if found[code] != UNGIVEN:
                    raise InputError(f"classes.{name}: {code} is in two lists; leave it in one")
                found[code] = ours
        return found


@dataclass
class _Count:
    """Points read so far, and of these with a given class, and left out."""

    points: int = 0
    given: int = 0
    left_out: int = 0


@dataclass(frozen=True)
class ClassifiedEpoch:
    """An epoch whose points carry the classes that others gave them, as the field ``semantic``."""

    epoch: Epoch
    table: NDArray[np.uint8]
    count: _Count = field(default_factory=_Count)

    @property
    def crs(self) -> str | None:
        """CRS, None for a local frame."""
        return self.epoch.crs

    @property
    def origin(self) -> Floats:
        """Origin (3,) of its points [m]."""
        return self.epoch.origin

    @property
    def trajectory(self) -> Trajectory | None:
        """Where the sensor went."""
        return self.epoch.trajectory

    @property
    def uncertainty(self) -> PoseUncertainty | None:
        """How well its poses are known."""
        return self.epoch.uncertainty

    @property
    def info(self) -> Mapping[str, Any]:
        """Content of ``map.yaml``."""
        return self.epoch.info

    @property
    def has_beams(self) -> bool:
        """Whether beams were counted."""
        return self.epoch.has_beams

    def clouds(self, fields: tuple[str, ...]) -> Iterator[PointCloud]:
        """Yield the points part by part, without those of classes that are not compared."""
        asked = tuple(dict.fromkeys([*(name for name in fields if name != SEMANTIC), CLASSIFICATION]))
        for part in self.epoch.clouds(asked):
            given = self._classes(part)
            kept = given != _LEFT_OUT
            self.count.points += len(part)
            self.count.left_out += int(np.count_nonzero(~kept))
            self.count.given += int(np.count_nonzero(given[kept] != UNGIVEN))
            if kept.any():
                yield part.with_fields(**{SEMANTIC: given}).select(kept)

    def _classes(self, part: PointCloud) -> NDArray[np.uint8]:
        codes = part.fields.get(CLASSIFICATION)
        if codes is None:
            return np.full(len(part), UNGIVEN, dtype=np.uint8)
        whole = np.nan_to_num(np.asarray(codes, dtype=np.float64), nan=-1.0)
        known = (whole >= 0) & (whole < _CODES)
        return np.where(known, self.table[np.where(known, whole, 0).astype(np.int64)], np.uint8(UNGIVEN))

    def beams(self) -> Iterator[VisibilityGrid]:
        """Yield the counts of beams part by part."""
        return self.epoch.beams()


def classified(
    epochs: tuple[Epoch, Epoch], config: GivenClassesConfig
) -> tuple[ClassifiedEpoch, ClassifiedEpoch]:
    """Return both epochs with the classes that others gave."""
    table = config.table()
    before, after = epochs
    return ClassifiedEpoch(before, table), ClassifiedEpoch(after, table)


def given_class_findings(
    epochs: tuple[ClassifiedEpoch, ClassifiedEpoch], paths: tuple[Path, Path]
) -> tuple[Finding, ...]:
    """Say, once both epochs are read, what share of the classes was given.

    Raises
    ------
    InputError
        No point of either epoch has a given class.
    """
    shares = [epoch.count.given / max(epoch.count.points - epoch.count.left_out, 1) for epoch in epochs]
    if max(shares) == 0.0:
        raise InputError(
            f"{paths[0]}, {paths[1]}: no point has a class in its field {CLASSIFICATION!r}; leave out "
            "--semantics, or classify the clouds"
        )
    sentence = "Classes of points were given in the files (ASPRS): " + ", ".join(
        f"{100 * share:.0f} % of the points of {name.upper()}"
        for name, share in zip(("before", "after"), shares, strict=True)
    )
    found = [
        Finding("classes_given", "note", f"{sentence}. All other points were classified by the segmentation.")
    ]
    left_out = sum(epoch.count.left_out for epoch in epochs)
    if left_out:
        found.append(
            Finding(
                "classes_left_out",
                "note",
                f"{left_out} points of classes that are not compared (noise, water, snow) were left out.",
            )
        )
    if min(shares) == 0.0:
        bare = ("BEFORE", "AFTER")[int(np.argmin(shares))]
        found.append(
            Finding(
                "classes_one_epoch",
                "warning",
                f"{bare} has no given classes: the two epochs were classified by different methods.",
                "Classify both epochs alike, or leave out --semantics.",
            )
        )
    return tuple(found)
