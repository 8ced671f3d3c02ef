"""Numbers of the segmentation, of point spacing and of free-space evidence."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class InstancesNumbers(StrictModel):
    """Numbers of ``segmentation/instances.py``."""

    fewest_points: int = Field(8, description="Number of points that an object needs at any density")
    fewest_points_of_plant: int = Field(
        5, description="Number of points that a plant needs at any density: beams pass through a crown"
    )


class RoofStructuresNumbers(StrictModel):
    """Numbers of ``segmentation/roof_structures.py``, and of parts over a building in later stages."""

    cell: float = Field(0.5, description="Edge of the columns in which a part lies over a building [m]")
    lowest: float = Field(
        2.5, description="Height above the ground above which an object that hangs over a building begins [m]"
    )
    share: float = Field(
        0.5,
        description="Fraction of the points of an object over a building from which it is a part of it",
    )
    foot_quantile: float = Field(
        0.02, description="Fraction of the points of an object that may lie below where it begins"
    )


class BuildingInteriorsNumbers(StrictModel):
    """Numbers of ``segmentation/building_interiors.py``."""

    cell: float = Field(0.5, description="Edge of the columns in which walls are searched [m]")
    sight: float = Field(
        40.0, description="Distance of the places of the sensor from which a point is looked at [m]"
    )
    sensor_step: float = Field(3.0, description="Distance between two places of the sensor [m]")
    before_point: float = Field(
        1.0, description="Distance from a point at which the search for walls before it begins [m]"
    )
    deepest: float = Field(
        6.0, description="Distance of a wall up to which a point may lie in the room behind it [m]"
    )
    close: float = Field(
        0.2, description="Fraction of the places of the sensor from which the wall must be as near as that"
    )
    hidden: float = Field(
        0.9, description="Fraction of the places of the sensor from which a point behind walls is hidden"
    )
    lowest_wall: float = Field(2.2, description="Smallest height of a wall of a building, that of a room [m]")
    opening: float = Field(
        4.0, description="Largest width of a window or a door below the roof of a building [m]"
    )


class RaisedGroundNumbers(StrictModel):
    """Numbers of ``segmentation/raised_ground.py``."""

    cell: float = Field(0.5, description="Edge of the cells in which raised ground is searched [m]")
    heights: tuple[float, float] = Field(
        (0.15, 0.7), description="Heights above the ground model between which ground was raised [m]"
    )
    level: float = Field(
        0.95, description="Vertical component of the normal above which a point is level, as a ratio"
    )
    roughness: float = Field(0.05, description="Roughness below which a surface is smooth [m]")
    width: float = Field(
        1.0,
        description="Smallest width of the smooth part of raised ground [m]; at its edges, and on walls and "
        "kerbs, neighbours of other heights make the surface rough",
    )
    area: float = Field(
        6.0, description="Smallest area of raised ground [m2]; the bonnets of cars and benches are smaller"
    )
    same_level: float = Field(
        0.1, description="Distance from the level of a cell within which its points are raised ground [m]"
    )


class ThinTrailsNumbers(StrictModel):
    """Numbers of ``segmentation/trail_swaths.py``."""

    thickness_radius: float = Field(
        1.2,
        description="Radius in which the thickness of a swath is measured [m]",
    )
    fewest_points: int = Field(40, description="Number of points that a thin ghost trail needs")
    thickness_places: int = Field(
        30,
        description="Number of places of a swath at which the thickness is measured",
    )
    open_window: float = Field(3.0, description="Edge of the window in which open ground is measured [m]")
    open_quantile: float = Field(
        0.8,
        description="Quantile of the observed fraction over all windows that stands for open ground",
    )


class TrailEndsNumbers(StrictModel):
    """Numbers of ``segmentation/trail_swaths.py``."""

    direction_reach: float = Field(
        6.0,
        description="Distance over which the direction of a ghost trail is measured [m]",
    )
    straightness: float = Field(
        2.0,
        description="Smallest ratio of length to width of the end of a ghost trail",
    )
    block: float = Field(2.0, description="Edge of the blocks into which long pieces are divided [m]")
    most_pieces: int = Field(60, description="Number of pieces that may continue one ghost trail")


class TrailShapeNumbers(StrictModel):
    """Numbers of ``segmentation/ghost_trails.py``."""

    layer: float = Field(
        0.5,
        description="Height of the layers in which a ghost trail is followed upward [m]",
    )
    doubtful: float = Field(
        0.5,
        description="Probability below which a thin ghost trail may still explain a point",
    )


class TrailSwathsNumbers(StrictModel):
    """Numbers of ``segmentation/trail_swaths.py``."""

    directions: int = Field(24, description="Number of directions of straight lines in half a turn")
    certain: float = Field(
        0.95,
        description="Probability of the edges and pieces that belong to a ghost trail",
    )
    vehicle_area: float = Field(
        3.0,
        description="Footprint from which a part beside the axis of a ghost trail may be a vehicle [m2]",
    )
    part_area: float = Field(
        1.0,
        description="Smallest footprint of a part beside the axis of a ghost trail [m2]",
    )
    shortest_parked: float = Field(
        3.0, description="Length of the shortest vehicle of a row of parked vehicles beside a trail [m]"
    )
    longest_parked: float = Field(
        6.5, description="Length of the longest vehicle of a row of parked vehicles [m]"
    )
    narrowest_parked: float = Field(
        0.9, description="Width of the narrowest vehicle of a row of parked vehicles [m]"
    )
    taller: float = Field(
        0.5,
        description="Height above a ghost trail from which a point does not belong to the trail [m]",
    )


class WiresAndPolesNumbers(StrictModel):
    """Numbers of ``segmentation/wires_and_poles.py``."""

    near_share: float = Field(
        0.75,
        description="Fraction of the points near a cell inside or beside the cell from which discs are "
        "counted",
    )
    cells_around: int = Field(2, description="Number of cells on every side of a pole that are evaluated")


class SpacingNumbers(StrictModel):
    """Numbers of ``point_spacing.py``: the spacing."""

    street_spacing: float = Field(0.36, description="Largest point spacing of a street survey [m]")
    neighbours: int = Field(
        16,
        description="Number of neighbours from which the spacing is measured, more than lie on one scan line",
    )
    sample: int = Field(2000, description="Number of points of a tile from which the spacing is measured")


class SparseNumbers(StrictModel):
    """Numbers of ``point_spacing.py``: lengths of sparse pairs."""

    nominal_leaf: float = Field(
        0.25, description="Leaf for which numbers of points per object are stated [m]"
    )


class ViewFromAboveNumbers(StrictModel):
    """Numbers of ``view_from_above.py``."""

    cell: float = Field(1.0, description="Smallest edge of the columns that show a view from above [m]")
    cell_spacings: float = Field(
        2.5, description="Smallest edge of a column as a multiple of the point spacing"
    )
    tall: float = Field(4.0, description="Difference of heights from which on a column is tall [m]")
    raised: float = Field(
        2.0, description="Height over the lowest point of a tall column from which on points count [m]"
    )
    top_share: float = Field(0.15, description="Fraction of the height of a tall column that is its top")
    gap: float = Field(10.0, description="Width of gaps that the outline of a cloud closes [m]")
    least_tall: int = Field(30, description="Smallest number of tall columns that shows a view from above")
    filled_share: float = Field(
        0.92,
        description="Smallest fraction of the columns within its outline that a cloud from above fills",
    )
    topmost_share: float = Field(
        0.38,
        description="Smallest fraction of the raised points of tall columns that lie at the tops of a cloud "
        "measured from above",
    )


class SurveyPlacesNumbers(StrictModel):
    """Numbers of ``survey_places.py``."""

    cell: float = Field(2.0, description="Edge of the cells in which points on the ground are counted [m]")
    ground_height: float = Field(
        0.2, description="Height over or below the ground model up to which a point lies on the ground [m]"
    )
    mean_radius: float = Field(
        10.0, description="Radius over which the density of the ground is averaged [m]; parked cars hide some"
    )
    compared_radius: float = Field(
        15.0, description="Radius in which no ground is much denser than at a place of the sensor [m]"
    )
    densest_share: float = Field(
        0.95, description="Smallest density of a place of the sensor as a ratio to the largest one around"
    )
    cap_percentile: float = Field(
        95.0, description="Density up to which cells count, as a percentile of the cells [1]"
    )
    filled_share: float = Field(
        0.3, description="Smallest density of the cell of a place as a ratio to the largest one that counts"
    )
    rounds: int = Field(2, description="Rounds in which a strip is drawn to its middle")
    apart: float = Field(2.5, description="Smallest distance between two places of the sensor [m]")
    gap: float = Field(30.0, description="Largest gap between places that dense ground closes [m]")
    gap_density: float = Field(
        0.7, description="Smallest density of the ground in a gap as a ratio to that at its ends"
    )
    least_places: int = Field(
        10, description="Smallest number of places of a street survey; a site scanned by hand shows few"
    )
    fineness: float = Field(
        4.0,
        description="Smallest number of points of the cloud on the ground at the places as a ratio to those "
        "at the working leaf; a cloud that was thinned to about the leaf does not tell",
    )
    beside: tuple[float, float] = Field(
        (15.0, 25.0), description="Distances from the places between which the ground must be less dense [m]"
    )
    beside_density: float = Field(
        0.5, description="Largest density of the ground beside the places as a ratio to that at them"
    )
    sensor_height: float = Field(
        2.0, description="Height of the sensor of a street survey over the ground [m]"
    )


class VisibilityEvidenceNumbers(StrictModel):
    """Numbers of ``visibility_evidence.py``."""

    prior_beams: float = Field(
        0.5,
        description="Number of beams that passed, and that returned, before any is counted (Jeffreys prior)",
    )
    exposed_share: float = Field(
        0.7,
        description="Fraction of the beams due at a top that must be due at a place above it, so that a "
        "plant, and no field of view, ends there",
    )
