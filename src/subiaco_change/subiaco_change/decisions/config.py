"""Settings of the decisions: limits of every class."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from subiaco_geo.config import StrictModel


class BuildingLimits(StrictModel):
    """From where on a building has grown or shrunk."""

    min_iou: float = Field(
        0.10,
        ge=0,
        le=1,
        description="Voxel intersection over union above which two matched buildings are compared for "
        "changes [1]",
    )
    height: float = Field(
        0.50,
        gt=0,
        description="Change of the height of a building beyond which the building is called Increased or "
        "Decreased [m]. Raise it to claim fewer changes",
    )
    volume: float = Field(
        0.10,
        gt=0,
        description="Change of the volume of a building, as a fraction of the volume, beyond which the "
        "building is called Increased or Decreased. Raise it to claim fewer changes",
    )
    certain: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Fraction of the limit that the nearer bound of a building's change must exceed; 1 "
        "asks for the whole interval beyond the limit",
    )
    sign_surface: float = Field(
        4.0,
        ge=0,
        description="Area of the walls of what was built on or taken away, whose place the other survey saw "
        "free on both sides, from which these walls tell the sign of a change of volume [m2]",
    )
    sign_depth: float = Field(
        6.0,
        gt=0,
        description="Depth to which what was built on or taken away is taken to lie behind its walls, if "
        "these tell the sign of a change of volume [m]",
    )
    height_surface: float = Field(
        2.0,
        ge=0,
        description="Area of new or former walls, whose place the other survey saw free on both "
        "sides, that supports a change of height without volume [m2]",
    )
    height_volume: float = Field(
        0.25,
        ge=0,
        description="Fraction of the volume limit that the upper bound of a building's volume change must "
        "reach to support its height change",
    )


class PlantLimits(StrictModel):
    """From where on a plant has grown or was trimmed."""

    FORMER_NAMES: ClassVar[Mapping[str, str]] = {"carried": "min_net_change"}

    min_iou: float = Field(
        0.10,
        ge=0,
        le=1,
        description="Voxel intersection over union above which two matched plants are compared for "
        "changes [1]",
    )
    base: float = Field(
        0.5,
        gt=0,
        description="Change of the height of the base of a crown beyond which a change of its surface is no "
        "matter of leaves [m]",
    )
    height: float = Field(
        0.30,
        gt=0,
        description="Change of the height of a plant beyond which the plant is called Increased or "
        "Decreased [m]. Raise it to claim fewer changes",
    )
    height_share: float = Field(
        0.04,
        ge=0,
        description="Fraction of the height of a tall plant that takes the place of this limit where it is "
        "larger: the higher a top, the farther away and with the wider gaps beams meet it",
    )
    volume: float = Field(
        0.15,
        gt=0,
        description="Change of the volume of a plant, as a fraction of the volume, beyond which the plant "
        "is called Increased or Decreased. Raise it to claim fewer changes",
    )
    min_net_change: float = Field(
        0.10,
        ge=0,
        description="Fraction of new or gone surface, observed by the other epoch, that must support a "
        "change (Decision 13); 0 asks for none",
    )
    followed: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Fraction of their limits by which the tops or the outline of a plant must have moved "
        "for new or lost surface to be a change",
    )
    side: float = Field(
        0.05,
        gt=0,
        description="Fraction of a crown that appeared or disappeared on one side of it from which a change "
        "of its surface is no matter of leaves; inf for never",
    )
    surface: float = Field(
        0.15,
        gt=0,
        description="Fraction of new or gone surface that is a change of volume by itself; inf for never",
    )
    outline: float = Field(
        0.08,
        gt=0,
        description="Shift of the outline, as a fraction of its distance from the middle, that is a "
        "change by itself; inf for never",
    )


class MovableLimits(StrictModel):
    """Within which a vehicle or another object of both epochs is the same."""

    same_iou: float = Field(
        0.20, ge=0, le=1, description="Voxel intersection over union above which an object is unchanged [1]"
    )
    shift: float = Field(2.0, gt=0, description="Largest centroid distance of an unchanged object [m]")
    longest: float = Field(
        4.0,
        gt=0,
        description="Length above which an object of class other is not movable, but a fence or a wall [m]",
    )
    tallest: float = Field(
        2.5,
        gt=0,
        description="Height above which an object of class other is not movable, but a pole or a sign [m]",
    )
    height: float = Field(
        0.25,
        gt=0,
        description="Change of the height of a section of a fence or wall beyond which the section is called "
        "Increased or Decreased [m]. Raise it to claim fewer changes",
    )


class DecisionConfig(StrictModel):
    """Table of section E; defaults are the paper's."""

    building: BuildingLimits = BuildingLimits()
    vegetation: PlantLimits = PlantLimits()
    mobile: MovableLimits = MovableLimits()
    lod_factor: float = Field(
        1.2, gt=0, description="Limit of a height change as a multiple of the level of detection (paper)"
    )
    lod_floor: float = Field(0.10, ge=0, description="Smallest limit of a height change [m] (Decision 4)")
    min_observed: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Observed fraction of a place below which no change is claimed (Decision 14)",
    )
    min_empty: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Fraction of the observed place that must be free in the other epoch for an object to "
        "be Added or Removed",
    )
    trail_moved: float = Field(
        0.6,
        gt=0.5,
        le=1,
        description="Mean probability of having moved from which an object of one epoch alone is a ghost "
        "trail; maps without beam times use the trail_passes settings",
    )
    trail_uncertain: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Probability that an object of one epoch alone moved, or that its place was not free in "
        "the other epoch, from which the object is Unobserved",
    )
    min_free: float = Field(
        0.8,
        ge=0.5,
        lt=1,
        description="Probability that an object is absent in the other survey, from crossing beams, below "
        "which nothing is claimed. Raise it to claim less",
    )
    min_free_surface: float = Field(
        0.7,
        ge=0.5,
        lt=1,
        description="Probability that the place of the new or lost surface of a plant was free in the other "
        "survey, below which nothing is claimed. Raise it to claim less",
    )
    least_volume: float = Field(
        2.0,
        ge=0,
        description="Volume that a building of one survey alone must enclose to be Added or Removed [m3]. "
        "Raise it to claim no small sheds",
    )
    trail_passes: float = Field(
        2.0,
        gt=0,
        description="Passes per return, at the densest quarter of points, from which a building-like "
        "object of one epoch is a ghost trail [1]",
    )
    trail_passes_thin: float = Field(
        5.0,
        gt=0,
        description="Passes per return from which an object of one epoch that is no building is a ghost "
        "trail [1]; beams graze thin objects",
    )
    trail_passes_lane: float = Field(
        1.3,
        gt=0,
        description="Passes per return from which an object of one epoch in a lane with known traffic is "
        "a ghost trail [1]",
    )
    trail_passes_high: float = Field(
        1.0,
        gt=0,
        description="Passes per return from which a high object that its own survey observed from both "
        "sides is a ghost trail [1]",
    )
    lane_confidence: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Highest confidence of a change in what one epoch alone holds in the lane that a survey "
        "vehicle drove through, as a probability",
    )
    vehicle_top: float = Field(
        4.4,
        gt=0,
        description="Height above ground that no road vehicle exceeds [m]; what is higher did not move "
        "while it was mapped",
    )
    vehicle_above: float = Field(
        0.05,
        gt=0,
        lt=1,
        description="Fraction of the voxels of an object above `vehicle_top` from which the object is no "
        "vehicle",
    )
    vehicle_width: float = Field(
        3.0,
        gt=0,
        description="Width that no road vehicle exceeds, mirrors included [m]; walls farther apart did not "
        "move where the times of beams tell nothing",
    )
    trail_high: float = Field(
        2.6,
        gt=0,
        description="Height above ground of its top from which an object counts as high in the ghost "
        "trail rules [m]",
    )
    trail_through: float = Field(
        0.65,
        gt=0,
        le=1,
        description="Fraction of the surface that its own survey must observe on both sides for a high "
        "object to be a ghost trail",
    )
    trail_top: float = Field(
        3.8, gt=0, description="Largest height above ground of the top of a moving object [m]"
    )
    min_voxels: int = Field(
        3,
        ge=1,
        description="Number of observed voxels above the foot of an object below which no change is claimed",
    )
