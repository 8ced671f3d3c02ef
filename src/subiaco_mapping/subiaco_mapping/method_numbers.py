"""The numbers of the mapping that no setting reaches, in one place, each with unit and meaning.

The modules name them at their beginning. They are frozen: who changes one, changes it here, raises
``METHOD_VERSION`` in :mod:`subiaco_geo.settings`, and every map says so (``method`` in ``map.yaml``).
"""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class AbsolutePositionsNumbers(StrictModel):
    """Numbers of ``absolute_positions/``."""

    plane_points: int = Field(
        8,
        description="Smallest number of points of a submap that define the surface at a control point",
    )
    layer_height: float = Field(
        0.3,
        description="Height above the lowest point at a control point from which points belong to "
        "another surface [m]",
    )
    plane_outlier: float = Field(
        3.0,
        description="Distance from the fitted plane, in robust standard deviations, beyond which "
        "points are removed",
    )
    open_sigma: float = Field(
        100.0,
        description="Standard deviation of directions that a tie does not determine [m]",
    )
    level_cosine: float = Field(
        0.7,
        description="Smallest cosine of the inclination, a ratio, of a surface that determines a height",
    )
    pick_distance: float = Field(
        0.5,
        description="Largest distance of a picked height from the surface of the map [m]",
    )
    rounds: int = Field(
        2,
        description="Number of times that the ground at control points is searched in the corrected map",
    )
    contradiction: float = Field(
        3.29,
        description="Residual, a multiple of its standard deviation, beyond which a control point "
        "contradicts the others (99.9 %)",
    )
    determined_variance: float = Field(
        10.0,
        description="Largest variance of a direction that a tie determines [m2]",
    )
    held_sigma: float = Field(1e-4, description="Standard deviation of an offset that no tie determines [m]")
    reference_points: int = Field(
        500,
        description="Smallest number of points of a reference cloud around a submap",
    )
    weak_sigma: float = Field(
        2.0,
        description="Standard deviation of a direction beyond which a registration leaves the "
        "direction open [m]",
    )
    height_mismatch: float = Field(
        5.0,
        description="Height difference between reference and map beyond which the height systems differ [m]",
    )


class ControlPointsNumbers(StrictModel):
    """Numbers of ``control.py``."""

    radius: float = Field(
        0.75,
        description="Radius around a control point in which map points define the surface [m]",
    )
    height_reach: float = Field(
        1.0,
        description="Height difference to a control point beyond which map points are another surface [m]",
    )
    plane_outlier: float = Field(
        3.0,
        description="Distance from the fitted plane, in robust standard deviations, beyond which "
        "points are removed",
    )
    common_cause_points: int = Field(
        3,
        description="Number of control points with equal errors from which a common cause is named",
    )
    plane_points: int = Field(
        8,
        description="Smallest number of map points that define the surface at a control point",
    )


class FusionNumbers(StrictModel):
    """Numbers of ``fusion/``."""

    floor_voxels: float = Field(
        1.5,
        description="Height above the floor, a multiple of a voxel, below which a voxel shares its "
        "observations with the floor",
    )
    floor_cell: float = Field(0.5, description="Edge of the cells in which the lowest voxel is searched [m]")
    fragment_floor: float = Field(
        0.3, description="Height above the lowest point from which points may be a fragment of a vehicle [m]"
    )
    fragment_reach: float = Field(
        0.6, description="Distance up to which a point lies beside points of a moving object [m]"
    )
    fragment_length: float = Field(
        8.0,
        description="Greatest extent of a fragment along an axis [m]; less than the width of the "
        "surroundings that are processed together with a tile",
    )
    fragment_share: float = Field(
        0.8,
        description="Fraction of the points of a group that must lie beside points of a moving object for "
        "the group to be a fragment of it",
    )
    fragment_stood: float = Field(
        0.5,
        description="Fraction of the points of a group that were hit for long and hardly ever missed, from "
        "which the group stood and is no fragment",
    )
    fragment_moved: float = Field(
        0.85,
        description="Least probability that a fragment moved; below `moving.sure` the fragment stays in the "
        "map",
    )
    elevation_cell_deg: float = Field(0.1, description="Elevation step of the measured field of view [deg]")
    azimuth_cells: int = Field(
        72, description="Number of azimuths around for which the beams of a sensor are counted"
    )
    azimuth_stray: float = Field(
        0.02,
        description="Largest number of beams of a blind azimuth, a fraction of the median of all with beams",
    )
    range_cell: float = Field(0.5, description="Range step of the measured field of view [m]")
    stray_beams: float = Field(
        0.001,
        description="Fraction of the beams at either end of the field of view that are ignored",
    )
    useful_range: float = Field(
        0.99,
        description="Fraction of the returns within the useful range of the sensor",
    )
    beam_sample: int = Field(
        100,
        description="Number of scans from one sample of the angle between beams to the next",
    )
    view_sample: int = Field(
        10,
        description="Number of scans from one sample of the field of view to the next",
    )
    ground_cell: float = Field(
        1.0,
        description="Edge of the cells from which the ground of a tile is fitted [m]",
    )
    ground_fraction: float = Field(0.15, description="Smallest fraction of the cells of a tile with ground")
    ground_spread: float = Field(
        0.15,
        description="Smallest standard deviation of the ground cells along their narrow side, as a "
        "fraction of the edge of the tile",
    )
    ground_tilt_deg: float = Field(
        20.0,
        description="Largest inclination of the ground of a tile [deg]; steeper is a roof or a hedge",
    )
    ground_kernel: float = Field(
        0.3,
        description="Distance from the fitted ground beyond which cells have no weight [m]",
    )
    scan_returns: int = Field(
        1000,
        description="Smallest number of returns of a scan from which the angle between its beams is measured",
    )


class LoopClosureNumbers(StrictModel):
    """Numbers of ``loop_closure/``."""

    pair_distance: float = Field(0.5, description="Largest disagreement of two loops at one place [m]")
    pair_drift: float = Field(
        0.01,
        description="Growth of the largest disagreement of two loops with the distance between their "
        "places [m/m]",
    )
    pair_turn_deg: float = Field(2.0, description="Largest rotation between two consistent loops [deg]")
    overlay_cell: float = Field(
        0.5,
        description="Edge of the cells of the raster in which two submaps are overlaid [m]",
    )
    overlay_size: int = Field(256, description="Number of cells along the edge of that raster")
    overlay_turn_deg: float = Field(
        6.0,
        description="Largest rotation at which two submaps are overlaid [deg]",
    )
    overlay_turn_step_deg: float = Field(1.5, description="Step of these rotations [deg]")
    overlay_height: float = Field(
        1.0,
        description="Height above the ground from which points of a submap are overlaid [m]",
    )
    rings: int = Field(20, description="Number of rings of the descriptor Scan Context")
    sectors: int = Field(60, description="Number of sectors of the descriptor Scan Context")
    lane_offset: float = Field(
        3.5,
        description="Sideways distance at which a second descriptor of a place is made [m]",
    )
    lowest_height: float = Field(
        -3.0,
        description="Lowest height below the sensor that enters the descriptor [m]",
    )
    distribution_voxels: tuple[float, float] = Field(
        (2.0, 1.0),
        description="Edges of the voxels of the distributions in which submaps are registered, coarse "
        "to fine [m]",
    )
    coarse_iterations: int = Field(6, description="Largest number of iterations with the coarse voxels")


class OdometryNumbers(StrictModel):
    """Numbers of ``odometry/`` and of the velocity filter in ``preprocessing/``."""

    first_rounds: int = Field(
        5,
        description="Largest number of rounds that estimate the motion during the first scans",
    )
    first_settled: float = Field(
        0.005,
        description="Change of the motion between two scans that ends these rounds [m]",
    )
    plane_variance: float = Field(
        2e-3,
        description="Variance along the normal in the plane-to-plane metric [m2]",
    )
    typical_range: float = Field(
        20.0,
        description="Range at which the error of a rotation is stated as a distance [m]",
    )
    refinement_reach: float = Field(
        5.0 / 3.0,
        description="Correspondence distance of the refinement, a multiple of the kernel width of "
        "the scan matching",
    )
    gravity_bounds: tuple[float, float] = Field(
        (9.2, 10.4),
        description="Smallest and largest measured gravity at which the accelerometer is used [m/s2]",
    )
    first_speed_sigma: float = Field(20.0, description="Standard deviation of the speed at the start [m/s]")
    first_acceleration_sigma: float = Field(
        2.0,
        description="Standard deviation of the acceleration at the start [m/s2]",
    )


class PoseGraphNumbers(StrictModel):
    """Numbers of ``pose_graph/`` and ``survey_graph/``."""

    offset_share: float = Field(
        1e-3,
        description="Fraction of correlated GNSS errors that is assumed where a common offset is estimated",
    )
    offset_correlation_time: float = Field(30.0, description="Correlation time of these errors [s]")
    reference_turn_sigma: float = Field(
        1e-5,
        description="Standard deviation of the rotation of a reference cloud as a whole [rad]",
    )
    correlation_knots: int = Field(10, description="Number of knots per correlation time of the GNSS errors")
    lever_sigma: float = Field(
        1e-4,
        description="Standard deviation of a lever arm that is not estimated [m]",
    )
    heading_tilt_sigma: float = Field(
        1.0,
        description="Standard deviation of the tilt that a heading leaves open [rad]",
    )
    astray: tuple[float, float, float] = Field(
        (1.0, 1.0, 2000.0),
        description="Distance in latitude and longitude [deg] and in height [m] from the other "
        "fixes beyond which a fix is not of the drive",
    )
    gravity_bounds: tuple[float, float] = Field(
        (9.2, 10.4),
        description="Smallest and largest measured gravity that levels a pose [m/s2]",
    )
    marginal_residual: float = Field(
        1e-3,
        description="Largest residual, as a ratio, of a solution of the normal equations from which "
        "covariances are taken",
    )
    fix_outlier: float = Field(
        16.266,
        description="Ratio of squared residual and variance, summed over three axes, beyond which "
        "a fix is an outlier (99.9 %)",
    )


class UprightWallNumbers(StrictModel):
    """Numbers of ``pose_graph/upright_walls.py``."""

    edge: float = Field(3.0, description="Edge of the cubes that are searched for pieces of walls [m]")
    fewest: int = Field(12, description="Smallest number of voxels of a submap in a piece of wall")
    thickest: float = Field(
        0.04, description="Largest standard deviation of the points of a piece from its plane [m]"
    )
    narrowest: float = Field(
        0.5,
        description="Smallest standard deviation of the points of a piece along its narrower direction [m]",
    )
    reach: float = Field(0.1, description="Largest lean of a wall from the first guess of the vertical [rad]")
    kernel: float = Field(0.02, description="Width of the Cauchy kernel of the lean of a wall [rad]")
    same_azimuth: float = Field(
        0.1745, description="Width of a class of azimuths whose pieces can lie in one wall [rad]"
    )
    same_offset: float = Field(
        2.0, description="Width of a class of distances whose pieces can lie in one wall [m]"
    )
    rounds: int = Field(6, description="Number of rounds of the robust estimate of the vertical")
    guess_weight: float = Field(
        0.1, description="Weight of the first guess of the vertical, in numbers of walls"
    )


class PreprocessingNumbers(StrictModel):
    """Numbers of ``preprocessing/``."""

    standing_samples: int = Field(
        50,
        description="Smallest number of IMU samples at rest from which the gyroscope bias is estimated",
    )
    clock_warning_ms: float = Field(2.0, description="Offset of the IMU clock from which a map warns [ms]")
    clock_step: float = Field(
        0.25,
        description="Longest interval between scans from which the IMU clock is estimated [s]",
    )
    clock_hole: float = Field(
        0.05,
        description="Longest gap between IMU samples from which the IMU clock is estimated [s]",
    )
    clock_intervals: int = Field(
        30,
        description="Smallest number of intervals from which the IMU clock is estimated",
    )
    clock_kernel: float = Field(
        3.0,
        description="Width of the Huber kernel of that estimate, a multiple of a standard deviation",
    )
    clock_first_sigma: float = Field(
        1e-3,
        description="First standard deviation of a rotation between scans [rad]",
    )
    clock_memory: int = Field(
        50,
        description="Number of intervals over which that standard deviation is averaged",
    )
    clock_priors: tuple[float, ...] = Field(
        (0.1, 0.1, 0.1, 0.02, 0.02, 0.02, 0.1),
        description="Standard deviations beforehand of rotation [rad], bias [rad/s] and clock offset [s]",
    )
    timed_points: int = Field(
        100,
        description="Smallest number of points of a cloud from which the duration of a sweep is measured",
    )
    cloud_rings: tuple[int, int] = Field(
        (8, 256),
        description="Fewest and most rings of a cloud whose missing beams are searched for the sky",
    )
    cloud_columns: tuple[int, int] = Field(
        (180, 4096), description="Fewest and most columns that are assumed of a turn of a cloud"
    )
    ring_spread_deg: float = Field(
        0.3, description="Largest standard deviation of the elevations of one ring of a turning scanner [deg]"
    )
    ring_nearest: float = Field(
        3.0, description="Range below which returns tell no elevation, for their beams begin apart [m]"
    )
    sky_ring_step: int = Field(
        2,
        description="Number of rings from one beam into the sky that is kept to the next",
    )
    sky_columns: int = Field(
        128,
        description="Number of columns of a turn in which beams into the sky are kept",
    )
    sky_clutter: float = Field(
        0.1,
        description="Largest fraction of the rings above a beam into the sky that returned",
    )
    sky_below: float = Field(
        0.05,
        description="Smallest fraction of the rings below a beam into the sky that returned",
    )


class MappingNumbers(StrictModel):
    """All numbers of the mapping beside its settings, by the folder that uses them."""

    absolute_positions: AbsolutePositionsNumbers = AbsolutePositionsNumbers()
    control_points: ControlPointsNumbers = ControlPointsNumbers()
    fusion: FusionNumbers = FusionNumbers()
    loop_closure: LoopClosureNumbers = LoopClosureNumbers()
    odometry: OdometryNumbers = OdometryNumbers()
    pose_graph: PoseGraphNumbers = PoseGraphNumbers()
    upright_walls: UprightWallNumbers = UprightWallNumbers()
    preprocessing: PreprocessingNumbers = PreprocessingNumbers()


NUMBERS = MappingNumbers()
