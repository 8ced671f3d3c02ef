"""All that people open in a change directory: report, summary, 3D viewer and QGIS project."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from subiaco_change.outputs.rasters import read_coverage
from subiaco_geo.work.executors import Start
from subiaco_report.page import read_complete, write_report
from subiaco_report.qgis_project import PROJECT, write_project
from subiaco_report.viewer.build import update_viewer


def write_pages(directory: Path, start: Start = partial) -> Path:
    """Build the pages of a change directory, and the QGIS project where there is none.

    A project that is there may be somebody's work by now; it stays. The 3D viewer is written where the
    clouds have at most 20 million points, or where there is one already.

    Parameters
    ----------
    directory : Path
    start : callable, optional
        Begins work beside this process: :meth:`subiaco_geo.work.executors.Executor.start`.

    Returns
    -------
    Path
        ``report.html``.

    Raises
    ------
    InputError
        The directory is not a complete change directory.
    """
    change = read_complete(directory)  # nothing is written of a directory that the report would refuse
    page = write_report(change, start, start(update_viewer, directory))
    if not (directory / PROJECT).exists():
        write_project(directory, change.run["crs"], read_coverage(directory / "coverage.tif").bounds)
    return page
