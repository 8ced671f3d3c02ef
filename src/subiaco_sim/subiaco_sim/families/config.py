"""Settings of a street of either family; what is null is drawn from the seed."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from subiaco_geo.config import StrictModel


class Family(StrEnum):
    """Which generator lays out the street."""

    SUBURB = "suburb"
    DENSE = "dense"


class StreetConfig(StrictModel):
    """A street of a family preset; other presets have none of these settings."""

    length: float | None = Field(
        None, ge=40.0, le=600.0, description="Length of the street; the preset's when null [m]"
    )
    slope: float | None = Field(
        None, ge=0.0, le=0.12, description="Steepness of the land; drawn from the seed when null [m per m]"
    )
    activity: float = Field(
        1.0, ge=0.0, le=1.6, description="Factor on the share of things that change between the epochs"
    )
    foliage_ratio: float | None = Field(
        None,
        ge=1.0,
        le=4.0,
        description="Leaf density of the fuller epoch over the barer one; drawn from the seed when null "
        "[ratio]",
    )
    sway: float = Field(
        0.3,
        ge=0.0,
        le=1.0,
        description="Lean of a crown in the wind at most, drawn per epoch and per plant [m]",
    )
    traffic: float = Field(
        1.0, ge=0.0, le=4.0, description="Factor on the number of moving vehicles and people"
    )
