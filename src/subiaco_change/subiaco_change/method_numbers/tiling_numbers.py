"""Numbers of the tiles: surroundings that a task sees, and which fragments of objects belong together."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class TilingNumbers(StrictModel):
    """Numbers of ``tiling/``."""

    trail_surroundings: float = Field(
        50.0,
        description="Width of the surroundings of a tile in which ghost trails are measured [m]",
    )
    beam_reach: float = Field(
        6.0, description="Distance beyond the points of a task up to which beams are evaluated [m]"
    )
    sample_block: float = Field(
        20.0,
        description="Edge of the blocks that the second registration samples, several houses wide, so that "
        "walls and ground are in each [m]",
    )
    height_tiles: int = Field(
        50, description="Number of tiles from which the kind of heights of both epochs is determined"
    )
    task_margin: float = Field(
        10.0, description="Width of the surroundings of a tile or a candidate group that a task sees [m]"
    )
    ground_margin: float = Field(
        10.0, description="Width of the surroundings of a tile in which cells of the ground are compared [m]"
    )
    label_margin: float = Field(
        4.0, description="Width of the surroundings of a tile from which its points are labelled [m]"
    )
    region_cell: float = Field(
        4.0, description="Edge of the cells in which the surroundings of candidate groups are selected [m]"
    )
    sigma_step: int = Field(
        16, description="Number of points from one sample of the registration uncertainty to the next"
    )
    box_overlap: float = Field(
        0.2,
        description="Smallest overlap of the bounding boxes of two objects, as the ratio of intersection and "
        "union, from which the objects may match",
    )
    reach_margin: float = Field(
        0.25, description="Length by which candidate groups exceed the reach of every decision [m]"
    )
    shared_fraction: float = Field(
        0.5,
        description="Smallest fraction of the points of a fragment, among the points that two tiles share, "
        "from which the fragments of both tiles are one object",
    )
    shared_points: int = Field(
        3, description="Smallest number of shared points from which fragments of two tiles are one object"
    )
    map_class_points: int = Field(
        100, description="Smallest number of points of a part of a map from which its points are classified"
    )
