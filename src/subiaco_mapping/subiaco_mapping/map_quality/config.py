"""Configuration of the quality report: what it costs, and what its verdict asks for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from subiaco_geo.config import StrictModel


class MapQualityConfig(StrictModel):
    """Quality report of a map; limits are those of its verdict, nothing is refused."""

    FORMER_NAMES: ClassVar[Mapping[str, str]] = {
        "withheld": "holdout",
        "withheld_block_ns": "holdout_block_ns",
        "withheld_every": "holdout_every",
    }

    enabled: bool = Field(True, description="Write quality.html and quality.json into the map directory")
    holdout: bool = Field(
        True, description="Compare the map with withheld GNSS fixes; takes a second optimisation"
    )
    holdout_block_ns: int = Field(5_000_000_000, gt=0, description="Length of a block of withheld fixes [ns]")
    holdout_every: int = Field(10, ge=2, description="Number of blocks of fixes of which one is withheld")
    max_horizontal: float = Field(
        0.05,
        gt=0,
        description="Largest horizontal root mean square error at withheld fixes for the verdict good [m]",
    )
    max_vertical: float = Field(
        0.08,
        gt=0,
        description="Largest vertical root mean square error at withheld fixes for the verdict good [m]",
    )
    max_contradicting: float = Field(
        0.05,
        ge=0,
        le=1,
        description="Largest fraction of withheld fixes outside their stated 99.9 % interval for the "
        "verdict good",
    )
    max_ratio: float = Field(
        1.5,
        gt=0,
        description="Largest median ratio of errors at withheld fixes to their stated standard deviations "
        "for the verdict good",
    )
    max_seam: float = Field(
        0.05,
        gt=0,
        description="Largest 95 % quantile of seams between and within drives for the verdict good [m]",
    )
    max_wall: float = Field(
        0.06,
        gt=0,
        description="Largest 95 % quantile of wall thickness over patches for the verdict good [m]",
    )
    max_pause_days: float = Field(
        2.0,
        gt=0,
        description="Longest pause between two drives of one map [days]; a longer pause suggests mixed "
        "surveys. Raise it for a survey that took several weeks",
    )
    max_flagged: float = Field(
        0.05,
        ge=0,
        le=1,
        description="Largest fraction of the driven distance that the manifest may flag for one reason "
        "for the verdict good",
    )
