"""Numbers of the decisions on objects, ground and plants."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class AbsenceNumbers(StrictModel):
    """Numbers of ``objects/measures.py``."""

    least_doubt: float = Field(
        1e-6,
        description="Smallest probability of an error that is used for one voxel",
    )


class LayersNumbers(StrictModel):
    """Numbers of ``objects/layers.py``."""

    depth: float = Field(
        2.0, description="Distance from a wall within which a place lies close before the wall [m]"
    )
    front: float = Field(
        0.75, description="Distance from a wall at which the space before it must have been seen free [m]"
    )
    ahead: float = Field(
        0.7,
        description="Smallest cosine between the normal of a wall and the direction to a place before the"
        " wall, as a ratio",
    )
    wall_normal: float = Field(
        0.8, description="Smallest horizontal component of the unit normal of a wall, as a ratio"
    )
    nearest_walls: int = Field(
        16, description="Number of the surfaces of walls nearest to a place of which one must face the place"
    )
    share: float = Field(
        0.5,
        description="Fraction of a part close before walls that both epochs have, above which the part is"
        " neither room nor extension",
    )


class BuildingExtensionsNumbers(StrictModel):
    """Numbers of ``instance_splitting/building_extensions.py``."""

    enclosing_share: float = Field(
        0.75,
        description="Fraction of its outline that touches a building from which a part of any size "
        "encloses the building",
    )
    car_height: float = Field(2.3, description="Largest height of a car [m]")
    fence_height: float = Field(
        2.0, description="Largest height above ground of a fence between two lots [m]"
    )
    room_height: float = Field(
        2.4,
        description="Smallest height of an extension [m]; a lower part beside a building is a shed",
    )
    least_contact: float = Field(
        0.03,
        description="Fraction of a part that must touch a building for the part to be its extension; a house "
        "beside it touches with a corner at most",
    )
    host_places: int = Field(
        4,
        description="Number of the nearest places of an extension that give its distance to a house",
    )
    host_gap: float = Field(
        0.5,
        description="Difference of distance from which the nearer house is the host of an extension [m]",
    )
    second_contact: float = Field(
        0.25,
        description="Fraction of the outline of a part that touches a second building from which the part "
        "belongs to neither",
    )
    host_inside: float = Field(
        0.3,
        description="Fraction of a building inside a part of one epoch from which the part is the "
        "building itself",
    )
    party_wall: float = Field(
        0.5,
        description="Distance from the edge of an outline within which a wall is shared with the "
        "neighbour [m]",
    )
    underside: float = Field(
        0.6,
        description="Height of the underside of a part, as a fraction of the height of its top, above "
        "which nothing carries the part",
    )
    normal_neighbours: int = Field(
        6,
        description="Number of voxels whose normals are compared, the voxel itself included",
    )
    smoothness: float = Field(
        0.78,
        description="Smallest mean cosine between the normals of neighbours on a wall or roof, as a "
        "ratio; foliage mostly stays below 0.75",
    )
    facing: float = Field(
        0.4,
        description="Smallest agreement of the azimuths of the normals of a part of a building with one "
        "rectangle, as a ratio from 0 to 1; houses have 0.6 to 1, crowns 0 to 0.2",
    )
    sloped: float = Field(
        0.3,
        description="Horizontal component of a normal from which its azimuth counts, as a ratio",
    )
    joint: float = Field(
        0.6,
        description="Distance in space between two bodies that meet [m]; between the voxels of two walls "
        "that meet is up to half a metre",
    )
    open_gap: float = Field(
        0.5,
        description="Fraction of the gap between two buildings that must be seen open for the buildings to "
        "stand apart",
    )
    foot: float = Field(
        1.0,
        description="Height above ground up to which a house reaches down [m]; what begins higher is part of "
        "another building",
    )
    roof_band: float = Field(
        0.75, description="Height below the top of a carport or a pergola that holds its roof [m]"
    )
    roof_share: float = Field(
        0.6, description="Smallest fraction of a carport or a pergola that is its roof, and no post or wall"
    )
    bare_share: float = Field(
        0.85, description="Fraction of the roof of a carport or a pergola below which the ground was met"
    )


class ColumnVolumesNumbers(StrictModel):
    """Numbers of ``objects/column_volumes.py``."""

    one_epoch_share: float = Field(
        0.75,
        description="Fraction of its observed surface from which a part exists in one epoch alone",
    )
    crossed_share: float = Field(
        0.2,
        description="Fraction of its new surface that beams of the other epoch must cross",
    )
    stray_share: float = Field(
        0.005,
        description="Fraction of places at either end of an extent that are left out as stray",
    )
    probe_heights: tuple[float, float, float] = Field(
        (0.3, 0.6, 0.9),
        description="Heights at which a survey is asked whether a column is free, as fractions of the "
        "height of its top",
    )


class ConfidenceNumbers(StrictModel):
    """Numbers of ``decisions/confidence.py`` and ``confidence_config.py``."""

    score_height_sigma: float = Field(0.10, description="Scale of the height term in the paper's score [m]")
    score_volume_sigma: float = Field(
        0.05,
        description="Scale of the volume term in the paper's score, as a fraction of the volume",
    )
    largest_calibration_error: float = Field(
        0.05,
        description="Largest expected calibration error, as a probability, at which confidences count as "
        "calibrated",
    )
    band_limits: tuple[float, float, float] = Field(
        (0.9, 0.7, 0.0),
        description="Confidences, as probabilities, from which the bands of the summary begin",
    )
    typical_observed: float = Field(0.8, description="Observed fraction of a typical row")
    typical_near_limits: float = Field(
        0.45,
        description="Fraction of the buildings and plants of a typical pair that lie near a limit",
    )
    near_limits_rows: float = Field(
        20.0,
        description="Number of rows of a typical pair that are added before the fraction of rows near a "
        "limit is taken, so that few rows say little",
    )
    gate_sigmas: float = Field(
        6.0,
        description="Largest distance between measure and limit that the confidence distinguishes, in "
        "standard deviations",
    )


class TrailShapesNumbers(StrictModel):
    """Numbers of ``decisions/trail_shapes.py``."""

    trail_width: float = Field(
        2.8, description="Largest width of the ghost trail of a vehicle, or of a row of its pieces [m]"
    )
    strip_length: float = Field(
        12.0, description="Length from which a strip on the road is longer than a standing vehicle [m]"
    )
    strip_width: float = Field(
        1.4, description="Smallest width of the trail of a vehicle [m]; hedges and walls are narrower"
    )
    road_beneath: float = Field(
        0.5,
        description="Density of the ground points beneath a strip, as a fraction of that beside it, from "
        "which nothing stood there",
    )
    person_width: tuple[float, float] = Field(
        (0.2, 0.8), description="Smallest and largest width of the trail of a pedestrian or cyclist [m]"
    )
    person_top: tuple[float, float] = Field(
        (1.5, 2.1),
        description="Lowest and highest top of the trail of a pedestrian or cyclist above ground [m]",
    )
    person_ground: float = Field(
        0.65,
        description="Density of the ground points beneath the trail of a pedestrian or cyclist, as a fraction"
        " of that beside it; a planted row hides more",
    )
    person_foot: float = Field(
        1.05,
        description="Largest height above ground at which the trail of a pedestrian or cyclist begins [m]: "
        "parked cars hide legs",
    )
    opaque_points: float = Field(
        1.25,
        description="Number of points of a standing object, as a multiple of the ground points beside it on "
        "the same area, below which the object may be a ghost trail",
    )
    ground_beneath: float = Field(
        0.6,
        description="Density of the ground points beneath an object of few points, as a fraction of that "
        "beside it, from which the object may be a ghost trail",
    )
    ground_unhidden: float = Field(
        0.9,
        description="Density of the ground points beneath an object of few points, as a fraction of that "
        "beside it, from which nothing is claimed of the object; parked cars of simulated streets stay below",
    )
    side_points: float = Field(
        1.25,
        description="Number of points of a standing object, as a multiple of the ground points on an area as "
        "large as the object's longer side, below which the object may be a ghost trail",
    )
    ground_shown: float = Field(
        0.75,
        description="Density of the ground points beneath an object with few points for its longer side, as "
        "a fraction of that beside it, from which nothing is claimed of the object",
    )
    footprint_cell: float = Field(
        0.5, description="Edge of the cells in which points of an object and of the ground are counted [m]"
    )
    ring_cells: int = Field(
        3, description="Width of the ring around an object in which the ground beside it is counted [cells]"
    )
    walked_length: float = Field(
        2.0, description="Smallest length of the trail of a pedestrian or cyclist [m]"
    )
    piece_reach: float = Field(
        1.5, description="Radius of the pieces of a strip of which the width is measured [m]: a way may bend"
    )


class DynamicObjectsNumbers(StrictModel):
    """Numbers of ``decisions/dynamic_objects.py``."""

    visibility_step: float = Field(
        0.5,
        description="Distance beside a surface at which the next voxel of the visibility layer lies [m]",
    )
    lane_reach: float = Field(
        1.0,
        description="Distance from a known ghost trail within which a point lies in the lane [m]",
    )
    lane_share: float = Field(
        0.9,
        description="Fraction of the points of an object that must lie in the lane of a ghost trail",
    )


class TrailInPiecesNumbers(StrictModel):
    """Numbers of ``decisions/trail_in_pieces.py``."""

    trail_length: float = Field(
        6.0,
        description="Length from which an object wider than a vehicle may hold the trails of two lanes [m]",
    )
    low: float = Field(
        0.3, description="Height above ground from which a point may belong to a piece of a ghost trail [m]"
    )
    high: float = Field(
        3.8, description="Height above ground up to which a point may belong to a piece of a ghost trail [m]"
    )
    held: float = Field(
        0.6,
        description="Distance from standing points of the other survey within which a piece stands in both "
        "surveys, and was not left by traffic [m]",
    )
    reach: float = Field(
        20.0, description="Distance from an object within which a row of pieces is followed [m]"
    )
    directions: int = Field(60, description="Number of directions in which a row of pieces is looked for")
    bends: tuple[float, ...] = Field(
        (
            *(-0.1, -0.08, -0.065, -0.05, -0.04, -0.03, -0.02, -0.015, -0.01, -0.005),
            *(0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1),
        ),
        description="Curvatures along which a row of pieces is looked for [1/m]; vehicles turn at junctions "
        "on circles of 10 m and more",
    )
    gentle_bend: float = Field(
        0.02,
        description="Largest curvature along which a row may hold an object of a vehicle's shape, and may go "
        "on at one side of an object alone [1/m]",
    )
    step: float = Field(0.5, description="Length of the steps in which a row of pieces is followed [m]")
    gap: float = Field(
        2.5, description="Largest gap between two pieces of a row [m]; a sweep meets a vehicle every 1 to 2 m"
    )
    half_width: float = Field(
        1.4,
        description="Distance from the middle of a row within which its pieces lie [m]; half the width of a "
        "bus with its mirrors",
    )
    rim: float = Field(
        0.35, description="Width of the strip on either side of a row that holds few points of pieces [m]"
    )
    rim_share: float = Field(
        0.1,
        description="Largest number of points in the strips beside a row, as a fraction of those of its "
        "pieces; a line that crosses a trail has more",
    )
    rim_weight: float = Field(
        4.0,
        description="Number of points of pieces that a point beside a row outweighs in the choice of a line",
    )
    section: float = Field(
        3.0, description="Length of the sections in which the width of a row of pieces is measured [m]"
    )
    ahead: float = Field(
        5.0, description="Distance from an object within which a row begins in line with the object [m]"
    )
    aside: float = Field(
        0.5,
        description="Largest distance between the middle of the beginning of a row and the middle of the "
        "object [m]; a vehicle parked beside a trail is farther away",
    )
    fewest_points: int = Field(100, description="Smallest number of points of the other pieces of a row")
    beyond: float = Field(8.0, description="Smallest length of a row beyond the object [m]")
    taller: float = Field(
        0.5, description="Height by which an object may be higher than the other pieces of its row [m]"
    )
    road: float = Field(
        0.75,
        description="Density of the ground points beneath a row of pieces, as a fraction of that beside it, "
        "from which traffic left the row; planted rows hide more",
    )
    places: int = Field(
        15, description="Number of places decided one by one, of an object longer and wider than a vehicle"
    )
    place_radius: float = Field(1.0, description="Radius of the place [m]")
    top_share: float = Field(
        0.95, description="Fraction of the points or voxels of a piece that lie below its top"
    )


class DrivenLaneNumbers(StrictModel):
    """Numbers of ``decisions/driven_lane.py``."""

    half_width: float = Field(
        1.2,
        description="Distance beside the path of a survey vehicle within which a place is carriageway [m]; a"
        " parked vehicle beside the lane is farther away",
    )
    beyond: float = Field(
        30.0, description="Distance beyond both ends of a drive over which the lane continues [m]"
    )
    gap: float = Field(
        8.0, description="Distance between two positions from which nothing is known of the path between [m]"
    )
    sensor_height: float = Field(
        5.0, description="Largest difference in height between a sensor and what lies in its lane [m]"
    )
    share: float = Field(0.6, description="Fraction of the footprint of an object that lies in a driven lane")
    step: float = Field(0.25, description="Distance between the points of a path [m]")
    heading_length: float = Field(
        3.0, description="Length of the end of a drive that gives the direction of the lane beyond [m]"
    )
    positions_apart: float = Field(
        0.5, description="Least distance between positions of a path that show its direction [m]"
    )
    curve_length: float = Field(
        12.0, description="Length of the end of a drive that gives the bend of the lane beyond [m]"
    )
    least_radius: float = Field(
        50.0,
        description="Radius of a bend below which the end of a drive is a turn, and the lane beyond straight"
        " [m]",
    )
    footprint_step: float = Field(
        0.25, description="Distance between the places that fill the footprint of an object [m]"
    )
    crossed_share: float = Field(
        0.5,
        description="Fraction of the columns of an object in the lane from which moving objects that were"
        " recorded in them show that the object is traffic",
    )
    crossed_column: float = Field(
        0.5, description="Edge of these columns, and distance between heights at which they are asked [m]"
    )
    crossed_probability: float = Field(
        0.9, description="Probability of having moved from which a place was crossed by a moving object"
    )


class GroundCellsNumbers(StrictModel):
    """Numbers of ``decisions/ground_cells.py``."""

    no_claim_lod: float = Field(
        10.0,
        description="Level of detection that is shown where none could be determined [m]",
    )
    wall_points: int = Field(
        2,
        description="Points under the other epoch's ground from which a cell holds the wall of a pit",
    )
    wall_share: float = Field(
        0.3,
        description="Fraction of the low points of a cell that must lie under the other epoch's ground",
    )
    wall_top: float = Field(
        0.3,
        description="Height above the other epoch's ground up to which points count as low points [m]",
    )
    wall_depth: float = Field(
        1.5,
        description="Depth under the other epoch's ground beyond which points show another level or "
        "reflections and no wall of a pit [m]",
    )
    seen_below: float = Field(
        0.5,
        description="Depth below the ground of one epoch at which the other one saw free space where the "
        "ground was dug away [m]",
    )
    floor_reach: float = Field(
        1.5,
        description="Distance from a wall within which the near edge of a pit hides its floor [m]",
    )
    dense_share: float = Field(
        0.5,
        description="Fraction of the other epoch's ground around that an epoch must have measured for its "
        "missing ground to be hidden, not unmeasured",
    )


class GroundChangeNumbers(StrictModel):
    """Numbers of ``decisions/ground_change.py``."""

    edge_share: float = Field(
        0.5,
        description="Fraction of the height of a change, or of its limit, beyond which a cell on its edge or "
        "between changed cells belongs to the change",
    )
    noise_reach: float = Field(
        10.0,
        description="Distance within which the ground shows the noise of a patch with few points [m]",
    )
    noise_block: float = Field(
        2.0,
        description="Edge of the blocks within which height errors of sparse ground are common [m]",
    )
    lod_cells: int = Field(
        25,
        description="Number of cells, or of blocks of cells, around a patch that tell its level of detection",
    )
    inner_share: float = Field(
        0.15,
        description="Fraction of the cells of a patch that must lie inside its rim for the rim not to count",
    )


class ViewOfCrownsNumbers(StrictModel):
    """Numbers of ``decisions/view_of_crowns.py``."""

    every_view: float = Field(
        2.0, description="Height above ground up to which the view of every survey reaches [m]"
    )
    beside_plant: float = Field(
        2.5,
        description="Distance from standing points of the other epoch within which a plant may be a part of a"
        " plant that both epochs have [m]",
    )
    crown_column: float = Field(0.5, description="Edge of the columns of a crown whose tops are compared [m]")
    crown_top: float = Field(
        0.95, description="Quantile of the tops of its columns, as a fraction, that is the top of a crown"
    )
    crown_columns: int = Field(8, description="Smallest number of columns of a crown whose top is known")
    cut_depth: float = Field(
        0.3, description="Depth below the top of a crown to which columns end that a field of view cut [m]"
    )
    cut_share: float = Field(
        0.35,
        description="Fraction of the columns of a crown that end near its top where a field of view cut it",
    )
    around: float = Field(
        8.0,
        description="Distance from a plant within which tops show whether both views reached as high [m]",
    )
    around_column: float = Field(1.0, description="Edge of the columns around a plant [m]")
    around_columns: int = Field(
        8, description="Number of columns around a plant that end as high as the plant, from which they tell"
    )
    around_points: int = Field(
        3, description="Number of points that a column around a plant needs in each epoch"
    )
    as_high: float = Field(
        1.0, description="Difference in height up to which a column ends as high as the plant beside it [m]"
    )
    goes_on: float = Field(
        0.3, description="Height by which a column goes on in the other survey where the view ended in it [m]"
    )
    goes_on_share: float = Field(
        0.25,
        description="Fraction of these columns that go on in the other survey from which the view, and not"
        " the plant, may have ended there",
    )


class ObjectDecisionNumbers(StrictModel):
    """Numbers of ``decisions/object_decision.py``."""

    flat_top: float = Field(
        0.6,
        description="Largest height of an object without class that may be raised ground [m]",
    )
    laid_top: float = Field(
        0.5,
        description="Largest height of a supposed vehicle or plant that may be ground [m]; vehicles are "
        "higher",
    )
    level_normal: float = Field(
        0.75,
        description="Smallest mean vertical component of normals of misclassified ground, as a ratio",
    )
    floating: float = Field(
        0.5, description="Height above the ground from which an object that touches nothing floats [m]"
    )
    line_height: float = Field(
        0.3, description="Height range up to which the points of an object may be of one scan line [m]"
    )
    held: float = Field(
        1.0,
        description="Distance to other points of its survey within which something may hold an object [m]",
    )
    same_point: float = Field(1e-6, description="Distance up to which two points are one and the same [m]")


class PlantMeasuresNumbers(StrictModel):
    """Numbers of ``decisions/plant_measures.py``."""

    surface_sample: int = Field(
        500,
        description="Number of points of a plant whose surface is compared with the other epoch",
    )
    place_cap: float = Field(0.9, description="Largest probability of being free that one place contributes")
    unknown_free: float = Field(0.5, description="Probability of being free of an unobserved place")
    top_quantile: float = Field(
        0.95, description="Quantile of the heights of a plant, as a fraction, that is its top"
    )
    voxels_per_patch: float = Field(
        2.0,
        description="Number of neighbouring voxels of a plant that a survey observes, or misses, together",
    )


class PlantTopsNumbers(StrictModel):
    """Numbers of ``objects/plant_tops.py``."""

    student_limit: float = Field(
        0.9987,
        description="Probability up to which the error of a median over few columns is widened to that of "
        "many columns",
    )


class PointLabelsNumbers(StrictModel):
    """Numbers of ``decisions/point_labels.py``."""

    interior_reach: float = Field(
        6.0,
        description="Distance from a building up to which points seen through windows have its label [m]",
    )
    surrounding_points: int = Field(
        12,
        description="Number of nearest points that decide whether a place lies among the points of an object",
    )


class RulesNumbers(StrictModel):
    """Numbers of ``decisions/rules.py``."""

    opposed_height: float = Field(
        0.5,
        description="Fraction of the limit on a change of height from which the height opposes the sign that "
        "new or lost surfaces of a building tell, and of the limit on a change of volume from which the "
        "volume opposes the sign of the height",
    )
    least_half_width: float = Field(
        0.05,
        description="Smallest half width of the bounds of a measure, as a fraction of its limit",
    )
    stated_growth: float = Field(
        10.0,
        description="Largest growth of the surface of a plant, as a fraction of the earlier surface, that a "
        "reason states as a number",
    )
    seen_whole: float = Field(
        0.9,
        description="Fraction of the surfaces of a building that both surveys must have seen for the reason "
        "not to say that nothing is known of the rest",
    )
    voxels_per_patch: float = Field(
        4.0,
        description="Number of voxels of a surface that are observed or occluded together",
    )


class SpaceCarvingNumbers(StrictModel):
    """Numbers of ``objects/space_carving.py``."""

    top_tolerance: float = Field(
        0.05,
        description="Depth of a voxel below the top edge to which the voxel belongs [m]",
    )
    fewest_columns: int = Field(4, description="Number of columns below which no height is measured")
    changed_columns: float = Field(
        0.1,
        description="Fraction of the columns of a building that adjoin each other, and rose or fell for"
        " certain, from which they tell how the height changed; an area as large as a room is enough",
    )
    moved_share: float = Field(
        0.5,
        description="Fraction of the columns of a roof that must have risen or fallen together, so that its"
        " volume changed by less than what is carved",
    )
    roof_normal: float = Field(
        0.7,
        description="Smallest vertical component of the normal of a roof, as a ratio",
    )
    observed_share: float = Field(
        0.05,
        description="Fraction of the surfaces of one survey above those of the other whose places the other "
        "must have observed, to show that they did not stand",
    )
    free_share: float = Field(
        0.5,
        description="Fraction of these observed places that must have been free",
    )
    room_sides: int = Field(
        3, description="Number of directions, of four, in which a survey must have seen a wall around a room"
    )


class VegetationNullNumbers(StrictModel):
    """Numbers of ``decisions/vegetation_null.py``."""

    scatters: int = Field(24, description="Number of standard deviations that are tried for a pair")
    rounds: int = Field(50, description="Number of rounds of expectation and maximisation")
    settled: float = Field(1e-6, description="Gain of the log likelihood that ends the rounds [1]")
    prior_plants: float = Field(
        4.0, description="Number of plants that the expected fraction of changed plants counts as"
    )
    stayed: float = Field(
        0.15,
        description="Distance that the tops and the outline of a plant move by at most where only its leaves "
        "changed [m]; half of the limit of a height",
    )
    most_of_leaves: float = Field(
        0.95,
        description="Fraction of the plants that kept their extent whose volume or surface changed by less "
        "than what a pair of other leaves must exceed",
    )


class VoxelObjectsNumbers(StrictModel):
    """Numbers of ``objects/voxel_objects.py``."""

    brief_probability: float = Field(
        0.5,
        description="Probability of having moved of what was observed for a moment only",
    )
    ground_neighbours: int = Field(
        8,
        description="Number of ground points around a place that give its ground height",
    )
    foot_factor: float = Field(
        1.5,
        description="Height of the foot of an object that may be ground, as a multiple of the configured "
        "foot",
    )
    passes_per_return: float = Field(
        2.0,
        description="Ratio of passes to returns at a point that static objects stay below",
    )
