"""Changes between two epochs: computed, or read from a change directory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from subiaco.maps import as_settings
from subiaco_change.config import ChangeConfig
from subiaco_change.extensions import (
    DecisionFunction,
    Extensions,
    RegistrationFunction,
    SegmentationFunction,
)
from subiaco_change.job import run_change
from subiaco_change.outputs.change_directory_reading import ChangeDirectory, read_change_directory
from subiaco_change.request import ChangeRequest
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import load_config
from subiaco_geo.frames import Floats
from subiaco_report.pages import write_pages

#: The change table: one row an object, with its footprint as geometry in the CRS of *after*.
ChangeTable = gpd.GeoDataFrame


@dataclass(frozen=True)
class Changes:
    """What changed between two epochs, read from a change directory.

    Parameters
    ----------
    directory : ChangeDirectory
    """

    directory: ChangeDirectory

    @property
    def path(self) -> Path:
        """The change directory."""
        return self.directory.path

    @property
    def table(self) -> gpd.GeoDataFrame:
        """The change table with footprints, one row an object."""
        return self.directory.table

    @property
    def run(self) -> Mapping[str, Any]:
        """What was compared, with which settings and versions, and the findings: ``run.json``."""
        return self.directory.run

    @property
    def T_after_before(self) -> Floats:
        """The registration (4, 4) in world coordinates [m]."""
        return np.asarray(self.directory.registration["T_after_before"], dtype=np.float64)

    def cloud(self, epoch: str) -> PointCloud:
        """Return the labelled cloud of ``before`` or ``after``, in the frame of *after*.

        Its fields ``change``, ``semantic`` and ``instance`` are codes of :class:`~subiaco.Change`, codes of
        :class:`~subiaco.Semantic`, and ``object_id`` of the table.
        """
        if epoch not in ("before", "after"):
            raise ValueError(f"epoch {epoch!r}: 'before' or 'after'")
        return self.directory.before if epoch == "before" else self.directory.after

    def points(self, object_id: int, epoch: str) -> Floats:
        """Return the world coordinates (N, 3) float64 [m] of the points of one object in one epoch."""
        cloud = self.cloud(epoch)
        mine: NDArray[np.bool_] = cloud.fields["instance"] == object_id
        return cloud.select(mine).world()


def open_changes(path: str | Path) -> Changes:
    """Open a change directory, the output of :func:`compare` or of ``subiaco change``.

    Raises
    ------
    InputError
        It does not exist, is something else, or lacks a file.
    """
    return Changes(read_change_directory(Path(path)))


def compare(
    before: str | Path,
    after: str | Path,
    output: str | Path,
    *,
    settings: Mapping[str, Any] | None = None,
    config: Sequence[str | Path] = (),
    registration: RegistrationFunction | None = None,
    segmentation: SegmentationFunction | None = None,
    decision: DecisionFunction | None = None,
    progress: Callable[[str, float], None] | None = None,
    **options: Any,
) -> Changes:
    """Find what changed between two epochs, and write the change directory.

    Parameters
    ----------
    before, after : path
        Map directories or bare clouds.
    output : path
        Change directory to write.
    settings : mapping, optional
        Settings by their dotted name, such as ``{"decisions.min_observed": 0.5}``.
    config : sequence of path
        YAML files of settings; later ones win.
    registration, segmentation, decision : callable, optional
        Your own function for this part of the method: see :class:`~subiaco.RegistrationFunction`,
        :class:`~subiaco.SegmentationFunction`, :class:`~subiaco.DecisionFunction`.
    progress : callable, optional
        Called with the name of the stage and the fraction done.
    **options
        The other fields of :class:`~subiaco.ChangeRequest`, such as ``trajectory_before``, ``transform``
        (4, 4), ``parcels``, ``given``, ``workers`` and ``overwrite``.

    Returns
    -------
    Changes

    Raises
    ------
    InputError
        An input cannot be read, an option is not known, a function returned something else, or the output
        exists.
    RegistrationError
        The epochs could not be registered.
    """
    model = load_config(ChangeConfig, tuple(Path(file) for file in config), as_settings(settings))
    request = ChangeRequest.of(before=before, after=after, output=output, config=model, **options)
    return run_comparison(request, progress, extensions=Extensions(registration, segmentation, decision))


def run_comparison(
    request: ChangeRequest,
    progress: Callable[[str, float], None] | None = None,
    *,
    extensions: Extensions = Extensions(),  # noqa: B008 - frozen
) -> Changes:
    """Run a request, as the command and the change node do; errors as for :func:`compare`."""
    run_change(request, progress, extensions=extensions, write_pages=write_pages)
    return open_changes(request.output)
