"""The mapping back end: collects scans and fixes, solves the pose graph, fuses the map."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from subiaco_geo.crs_area import require_usable
from subiaco_geo.errors import InputError
from subiaco_geo.locks import held_directory, sweep
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.full_density import FullDensity
from subiaco_mapping.fusion.map_builder import ProgressCallback, build_map, silent
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.sequences import SequenceRecord, begin_sequence
from subiaco_mapping.survey_graph.solution import GraphSolution, LiveEstimate
from subiaco_mapping.survey_graph.survey_graph import SurveyGraph


def sequence_folder(spool: Path, number: int) -> Path:
    """Return where the scans of a sequence lie."""
    return spool / f"{number:03d}"


class MappingBackend:
    """Take what the front end and the receiver give; solve and fuse on request.

    Parameters
    ----------
    config : MappingConfig
    extrinsics : Extrinsics
        Of the first sequence; :meth:`start_sequence` can bring others.
    spool : Path
        Folder for the deskewed scans; the caller removes it.

    Raises
    ------
    InputError
        The CRS is unknown or cannot be that of a map.
    """

    def __init__(self, config: MappingConfig, extrinsics: Extrinsics, spool: Path) -> None:
        require_usable(config.crs)
        self._config = config
        self._extrinsics = extrinsics
        self._spool = spool
        self._sequences: list[SequenceRecord] = []
        self._graph = SurveyGraph(config)
        self._solution: GraphSolution | None = None

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Begin a recording; what comes from now on is its own chain."""
        if any(sequence.name == name for sequence in self._sequences):
            raise InputError(f"sequence {name!r}: two bags have this name; rename one")
        if extrinsics is not None:
            self._extrinsics = extrinsics
        folder = sequence_folder(self._spool, len(self._sequences))
        self._sequences.append(begin_sequence(name, self._extrinsics, folder, self._config))

    def add_facts(self, **facts: Any) -> None:
        """Note facts about the current sequence for the manifest, e.g. packet counts."""
        self._current.facts.update(facts)

    @property
    def _current(self) -> SequenceRecord:
        if not self._sequences:
            self.start_sequence("survey")
        return self._sequences[-1]

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take one registered scan, stamps increasing within a sequence."""
        self._current.add(pose, scan)
        self._solution = None

    def on_fix(self, fix: GnssFix) -> None:
        """Take one fix; one without a solution or with NaN is counted and left out."""
        if self._current.add_fix(fix):
            self._solution = None

    def on_heading(self, heading: HeadingSample) -> None:
        """Take one heading of the antenna baseline; an unusable one is counted and left out."""
        if self._current.add_heading(heading):
            self._solution = None

    def optimize(self) -> GraphSolution:
        """Solve the graph of everything taken so far.

        Raises
        ------
        InputError
            No scans, or a sequence cannot be placed: see :class:`SurveyGraph`.
        """
        if self._solution is None:
            self._solution = self._graph.solve(self._filled())
        return self._solution

    def preview(self) -> LiveEstimate:
        """Solve incrementally what has come since the last time; for display while driving.

        Raises
        ------
        InputError
            No scans yet, or GNSS is required and does not place a sequence.
        """
        return self._graph.preview(self._filled())

    def _filled(self) -> list[SequenceRecord]:
        filled = [sequence for sequence in self._sequences if sequence.poses]
        if not filled:
            raise InputError(
                "no scan came out of the recording; check LiDAR topic, metadata and range limits"
            )
        return filled

    def build_map(
        self,
        progress: ProgressCallback | None = None,
        inputs: Mapping[str, str] | None = None,
        density: FullDensity | None = None,
    ) -> SurveyMap:
        """Solve, and fuse every scan at its pose.

        Parameters
        ----------
        progress : callable, optional
            Told stage and fraction.
        inputs : mapping of str to str, optional
            Names and hashes of the recordings, for ``map.yaml``.
        density : FullDensity, optional
            Where every return is written too; taken up if the settings ask for it.

        Returns
        -------
        SurveyMap

        Raises
        ------
        InputError
            No scans, or none for whose points the disk had room.
        """
        report = progress or silent
        sequences = self._filled()
        spools = [sequence.spool for sequence in sequences]
        if all(spool.left_out == len(spool) for spool in spools):
            raise InputError(
                f"{spools[0].folder}: the disk was full while all {sum(map(len, spools))} scans were read,"
                " and no points are left; make room on it"
            )
        report("solving the pose graph", 0.0)
        return build_map(sequences, self.optimize(), self._config, report, inputs, density)

    def with_quality(self, survey: SurveyMap, progress: ProgressCallback | None = None) -> SurveyMap:
        """Return a map that this back end has built with its quality report beside it."""
        from subiaco_mapping.map_quality.page import with_quality  # matplotlib, for this alone

        (progress or silent)("checking the map", 0.0)
        solution = self.optimize()
        if solution.absolute is not None:
            known = {**survey.info, "control": solution.absolute.described(survey.cloud)}
            survey = replace(survey, info=known)
        return with_quality(survey, solution, self._config)


class Backend(Protocol):
    """Steps of a mapping back end, as the pose-graph node calls them."""

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Begin a recording."""

    def add_facts(self, **facts: Any) -> None:
        """Note facts about the current recording."""

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take a registered scan."""

    def on_fix(self, fix: GnssFix) -> None:
        """Take a fix."""

    def on_heading(self, heading: HeadingSample) -> None:
        """Take a heading."""

    def optimize(self) -> GraphSolution:
        """Solve."""

    def preview(self) -> LiveEstimate:
        """Solve incrementally."""

    def build_map(
        self, progress: ProgressCallback | None = None, inputs: Mapping[str, str] | None = None
    ) -> SurveyMap:
        """Fuse."""

    def with_quality(self, survey: SurveyMap, progress: ProgressCallback | None = None) -> SurveyMap:
        """Lay the quality report beside a map."""


@contextmanager
def spool_folder(output_directory: str) -> Iterator[Path]:
    """Yield a folder for the deskewed scans (10 MB/s): beside the map, else in the temporary folder."""
    if not output_directory:
        with TemporaryDirectory(prefix="subiaco-spool-") as temporary:
            yield Path(temporary)
        return
    output = Path(output_directory).absolute()
    sweep(output.parent, f".{output.name}.spool-")
    with held_directory(output.with_name(f".{output.name}.spool-{os.getpid()}")) as folder:
        yield folder
