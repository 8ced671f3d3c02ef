"""Settings of the space carving of buildings."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class CarvingConfig(StrictModel):
    """Cells of the space carving of buildings."""

    cell: float = Field(
        0.5,
        gt=0,
        description="Edge of the cells of space carving [m]; smaller cells cost memory, larger cells blur "
        "walls",
    )
    max_cells: int = Field(
        400_000,
        gt=1000,
        description="Largest number of cells of one object; larger objects are carved with larger cells",
    )
    thickness: int = Field(
        2,
        ge=1,
        description="Smallest extent of a change of volume [cells]; thinner changes are noise of surfaces",
    )
    support: int = Field(
        6,
        ge=1,
        description="Number of voxels of changed surface that a changed volume must have; fewer make no "
        "claim",
    )
    room: float = Field(
        2.2, gt=0, description="Smallest height of walls that enclose a volume [m]; lower walls are fences"
    )
    capped: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Fraction of columns with free space above their top from which the height rests on "
        "these columns alone; raise it for wider height bounds",
    )
    known_top: float = Field(
        1.0,
        ge=0,
        description="Largest distance between the bounds of the top of a column up to which the top is "
        "known [m]",
    )
    known_area: float = Field(
        12.0,
        gt=0,
        description="Area of the columns with known tops from which the height rests on these columns alone, "
        "if they are the highest ones [m2]; about the area of a room",
    )
    roof_gap: float = Field(
        1.25,
        ge=0,
        description="Largest distance from an observed top to the free space above at which the observed "
        "top is the top of the column [m]",
    )
    roof_width: float = Field(
        2.0,
        ge=0,
        description="Width of the parts of a roof from which they count for the height of a building [m]; "
        "chimneys, parapets and party walls are narrower",
    )
