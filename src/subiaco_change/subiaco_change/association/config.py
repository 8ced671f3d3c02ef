"""Settings of the association, and of the parts that it is given."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel


class PartConfig(StrictModel):
    """What makes a part of an instance an object of its own."""

    points: int = Field(
        20,
        ge=0,
        description="Smallest number of points of a part that changed on its own; 0 never splits instances",
    )
    gap: float = Field(
        0.75, gt=0, description="Edge of the voxels in which pieces of one part are connected [m]"
    )
    length: float = Field(0.8, gt=0, description="Smallest horizontal extent of a part that is split off [m]")
    foot: float = Field(
        1.1,
        gt=0,
        description="Height above ground below which a part must begin to be split off [m]; a voxel of the "
        "trunk above the foot that no epoch counts",
    )
    hidden_foot: float = Field(
        2.0,
        gt=0,
        description="Height above ground below which a tree with a top of its own, or an object before a "
        "wall, must begin to be split off [m]; parked cars and hedges hide what is lower",
    )
    top: float = Field(
        0.6,
        ge=0,
        description="Height above ground that the upper tenth of a part must exceed [m]; lower parts are "
        "misclassified ground",
    )
    whole: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Fraction of the observed voxels in the columns of a part that must exist in one "
        "epoch alone",
    )
    remainder: float = Field(
        0.1, ge=0, lt=1, description="Fraction of the instance that must remain when its parts are split off"
    )
    touch: float = Field(1.5, gt=0, description="Distance within which a part adjoins a building [m]")
    subordinate: float = Field(
        1.0,
        gt=0,
        description="Ratio of part volume to building volume below which an adjoining part is an extension "
        "of the building",
    )


class AssociationConfig(StrictModel):
    """Gates, scales and prices of the assignment."""

    gate_distance: float = Field(
        2.0, gt=0, description="Largest centroid distance of two objects that may be matched [m] (paper)"
    )
    gate_overlap: float = Field(
        0.3,
        gt=0,
        le=1,
        description="Footprint intersection over union from which two objects may be matched at any "
        "distance [1] (Decision 8)",
    )
    spread_distance: float = Field(
        1.0,
        gt=0,
        description="Standard deviation of the centroid of one object between two epochs [m] (Decision 11)",
    )
    spread_relative: float = Field(
        0.15, ge=0, description="Additional standard deviation of the centroid per metre of object size [m/m]"
    )
    spread_overlap: float = Field(
        0.35,
        gt=0,
        description="Standard deviation of 1 - footprint intersection over union for one object in two "
        "epochs [1]",
    )
    histogram_bins: int = Field(10, ge=2, description="Number of bins of the height histogram (paper)")
    spread_histogram: float = Field(
        0.35,
        gt=0,
        description="Standard deviation of the height histogram distance for one object in two epochs [1]",
    )
    cost: Literal["scaled", "plain"] = Field(
        "scaled",
        description="Matching cost: scaled sums squared differences over their standard deviations; plain "
        "uses the paper's weights 1, 2, 0.5 (Decision 11)",
    )
    kappa: float = Field(
        0.0,
        ge=0,
        description="Weight of phi = max(0, LoD95 - d_perp) in the plain matching cost [1/m]; the paper "
        "uses 2 (Decision 8)",
    )
    unmatched: float = Field(
        6.0,
        gt=0,
        description="Cost of leaving one object unmatched, on the chi-square scale [1]; raise it for more "
        "matches",
    )
    contained: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of the voxels of a fragment that must lie inside an object for the two to "
        "be joined (Decision 9)",
    )
    parts: PartConfig = PartConfig()
    apart: float = Field(
        0.15,
        gt=0,
        le=1,
        description="Size of a fragment of a match, as a fraction of the largest fragment, from which it "
        "may be a separate object",
    )
    stacked: float = Field(
        0.3, ge=0, le=1, description="Fraction of common columns from which two fragments are one object"
    )
    same_place: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of common voxels from which two objects of different classes are one object "
        "(method C6)",
    )
