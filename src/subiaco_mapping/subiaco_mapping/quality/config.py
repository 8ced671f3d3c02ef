"""Configuration of the quality report: what it costs, and what its verdict asks for."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class QualityConfig(StrictModel):
    """Quality report of a map; limits are those of its verdict, nothing is refused."""

    enabled: bool = Field(True, description="write quality.html and quality.json beside the map")
    withheld: bool = Field(
        True, description="solve once more without a share of the fixes and compare; costs one more solution"
    )
    withheld_block_ns: int = Field(5_000_000_000, gt=0, description="length of a withheld block [ns]")
    withheld_every: int = Field(10, ge=2, description="one block in so many is withheld")
    max_horizontal: float = Field(0.05, gt=0, description="withheld fixes, horizontal RMSE [m]")
    max_vertical: float = Field(0.08, gt=0, description="withheld fixes, vertical RMSE [m]")
    max_contradicting: float = Field(
        0.05, ge=0, le=1, description="share of withheld fixes beyond 99.9 % of what was stated"
    )
    max_ratio: float = Field(1.5, gt=0, description="withheld errors over their stated sigma, by the median")
    max_seam: float = Field(0.05, gt=0, description="seams, 95 % [m]")
    max_wall: float = Field(0.06, gt=0, description="wall thickness, 95 % of patches [m]")
    max_pause_days: float = Field(
        2.0,
        gt=0,
        description="longest pause between two drives of one map [days]; beyond it the map probably mixes"
        " surveys. Raise it for a survey that took several weeks",
    )
    max_flagged: float = Field(0.05, ge=0, le=1, description="share of the way that the manifest flags")
