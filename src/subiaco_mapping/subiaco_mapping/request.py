"""Requests for a map: what the command, the launch file and the Python API build alike."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from subiaco_geo.requests import Request
from subiaco_mapping.config import MappingConfig


class MappingRequest(Request):
    """The recordings of one epoch, where their map is written, and everything that decides it."""

    bags: tuple[Path, ...] = Field(
        min_length=1,
        description="rosbag2 folders, .mcap files or simulated epoch folders, each one recording",
    )
    output: Path = Field(description="Map directory to write")
    workers: int = Field(
        1, ge=1, description="Number of recordings read in parallel; does not change the map"
    )
    resume: bool = Field(
        True, description="Use the recordings that a stopped run with the same output had finished"
    )
    keep_checkpoint: bool = Field(
        False, description="Leave the finished recordings beside the map for a run with other later settings"
    )
    overwrite: bool = Field(False, description="Replace a map directory that exists")
    config: MappingConfig = Field(MappingConfig(), description="Settings of the method")
