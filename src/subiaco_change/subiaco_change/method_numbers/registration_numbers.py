"""Numbers of the registration and the level of detection."""

from __future__ import annotations

from pydantic import Field

from subiaco_geo.config import StrictModel


class CoarseNumbers(StrictModel):
    """Numbers of ``registration/coarse.py``."""

    wall_normal: float = Field(
        0.5,
        description="Vertical component of a normal below which a surface is vertical, as a ratio",
    )


class CorrelationNumbers(StrictModel):
    """Numbers of ``registration/correlation.py``."""

    kernel: float = Field(
        1.0,
        description="Standard deviation of the kernel of the correlation, as a multiple of the point spacing",
    )
    reach: float = Field(3.0, description="Distance at which the kernel ends, in its standard deviations")
    rise: float = Field(
        1.0,
        description="Height above the lowest points around from which a point takes part in the "
        "correlation, as a multiple of the point spacing and of a metre",
    )
    points: int = Field(20_000, description="Largest number of points of the earlier epoch that take part")
    fewest: int = Field(400, description="Number of points of an epoch below which nothing is correlated")
    groups: int = Field(8, description="Number of groups of blocks that are correlated separately")
    iterations: int = Field(40, description="Largest number of steps to the peak of the correlation")
    longest_step: float = Field(0.5, description="Longest step to the peak, as a multiple of the kernel")


class DisplacedStartsNumbers(StrictModel):
    """Numbers of ``registration/displaced_starts.py``."""

    aside: float = Field(
        0.5,
        description="Distance of displaced starts from the fitted pose, as a multiple of the point spacing",
    )
    starts: int = Field(4, description="Number of displaced starts")
    points: int = Field(10_000, description="Largest number of points that are fitted from displaced starts")
    noted_level: float = Field(
        0.15,
        description="Standard deviation of the horizontal position from which a warning states it [m]",
    )


class FeaturesNumbers(StrictModel):
    """Numbers of ``registration/keypoints.py``."""

    edge_ratio: float = Field(0.9, description="Smallest ratio of corresponding edges of a RANSAC sample")


class FittingNumbers(StrictModel):
    """Numbers of ``registration/fitting.py``."""

    polishes: int = Field(
        2,
        description="Number of last fits, each with a width from the residuals of the fit before",
    )
    narrowest: float = Field(0.02, description="Smallest width of the biweight of a fit [m]")
    block_groups: int = Field(8, description="Number of groups of blocks that are fitted separately")
    group_iterations: int = Field(6, description="Number of iterations of the fit of one group of blocks")
    smallest_block: float = Field(
        2.5,
        description="Smallest edge of a block that is fitted separately, at the point spacing of a street "
        "[m]",
    )
    fewest_gaussians: int = Field(50, description="Number of Gaussians below which NDT gives no pose")
    column: float = Field(
        2.0,
        description="Edge of the columns of the overlap, at the point spacing of a street [m]",
    )
    level_normal: float = Field(
        0.8,
        description="Vertical component of a normal above which a surface does not constrain horizontal "
        "shifts, as a ratio",
    )
    equal_fit: float = Field(
        0.9,
        description="Fraction of the weight of the ICP pose from which the NDT pose fits equally well",
    )
    worse_factor: float = Field(
        3.0,
        description="Factor on the allowed disagreement of an NDT pose that matches worse",
    )
    too_small_errors: float = Field(
        2.0,
        description="Standard errors, a multiple, by which a matched share must be too small",
    )
    fewest_squares: int = Field(
        10,
        description="Number of squares with walls below which a trusted start needs no support by them",
    )
    support_errors: float = Field(
        3.0,
        description="Standard errors, a multiple, by which walls must match better than by chance",
    )


class IcpNumbers(StrictModel):
    """Numbers of ``registration/icp.py``."""

    curvature_kinds: tuple[float, ...] = Field(
        (0.003, 0.01, 0.03, 0.06, 0.1, 0.17),
        description="Curvatures, ratios of eigenvalues, that separate kinds of neighbourhoods",
    )
    fewest_pairs: int = Field(100, description="Number of pairs that show the spread of their kind")


class NdtNumbers(StrictModel):
    """Numbers of ``registration/ndt.py``."""

    mixture_width: float = Field(
        0.3,
        description="Width factor of the mixture component of NDT (Stoyanov et al. 2012 take 0.05; 0.3 "
        "measured better)",
    )
    filled: float = Field(
        0.4,
        description="Fraction of the variance of a uniform distribution over the voxel from which a voxel "
        "is filled",
    )
    loose: float = Field(
        100.0,
        description="Factor on the variance of a direction that an NDT cell does not constrain",
    )


class PairNumbers(StrictModel):
    """Numbers of ``registration/pair.py``."""

    unknown_accuracy: float = Field(
        0.5,
        description="Accuracy of a coordinate operation that states none [m]",
    )
    far: float = Field(
        100_000.0,
        description="Distance between two surveys above which they are of different cities [m]",
    )
    near: float = Field(
        20_000.0,
        description="Distance between two surveys below which they can be of one city [m]",
    )
    cell: float = Field(4.0, description="Edge of the cells whose lowest points are compared [m]")
    height_offset: float = Field(
        5.0,
        description="Height difference from which two surveys use different height systems [m]",
    )
    height_cells: int = Field(20, description="Number of cells that a finding on heights needs")


class PlanesNumbers(StrictModel):
    """Numbers of ``registration/planes.py``."""

    block: float = Field(20.0, description="Edge of the squares in which planes are searched [m]")
    thickness: float = Field(0.08, description="Largest distance of a point from its plane [m]")
    parallel: float = Field(
        0.95,
        description="Smallest cosine between the normals of a point and its plane, as a ratio",
    )
    fewest_points: int = Field(100, description="Number of points that a plane needs")
    planes: int = Field(8, description="Number of planes searched in a square")
    samples: int = Field(30, description="Number of samples drawn for a plane")


class PlausibilityNumbers(StrictModel):
    """Numbers of ``registration/plausibility.py``."""

    plane_points: int = Field(12, description="Number of points from which a local plane is estimated")
    flatness: float = Field(0.03, description="Largest curvature of a local plane, a ratio of eigenvalues")
    fewest_neighbours: int = Field(4, description="Number of neighbours that a point of a surface needs")
    wall_normal: float = Field(
        0.5,
        description="Largest vertical component of the normal of a wall, as a ratio",
    )
    ground_normal: float = Field(
        0.8,
        description="Smallest vertical component of the normal of ground, as a ratio",
    )
    parallel: float = Field(0.9, description="Smallest cosine between normals of one surface, as a ratio")
    match_reach: float = Field(0.5, description="Reach of a match without a plane, as a multiple of the leaf")
    chance_shifts: tuple[float, float] = Field(
        (6.0, 10.0),
        description="Shifts at which a match is chance, along the axes and across them [m]",
    )


class RegisterNumbers(StrictModel):
    """Numbers of ``registration/register.py``."""

    noted_shift: float = Field(
        0.02,
        description="Shift of a given transform by the registration from which a finding is reported [m]",
    )


class WarpNumbers(StrictModel):
    """Numbers of ``level_of_detection/alignment_corrections.py``."""

    rounds: int = Field(10, description="Number of iterations of the robust fit of the warp")


class CommonFrameNumbers(StrictModel):
    """Numbers of ``level_of_detection/common_frame.py``."""

    upright_deg: float = Field(
        2.0,
        description="Slope of the ground over the whole map above which the map is not upright [deg]",
    )


class DisplacementLodNumbers(StrictModel):
    """Numbers of ``level_of_detection/displacement_lod.py``."""

    z95: float = Field(
        1.96,
        description="Quantile of the normal distribution for 95 %, a factor on the standard deviation",
    )


class RegistrationUncertaintyNumbers(StrictModel):
    """Numbers of ``level_of_detection/registration_uncertainty.py``."""

    level_normal: float = Field(
        0.7,
        description="Vertical component of a normal from which a surface is level, as a ratio",
    )


class VerticalBiasNumbers(StrictModel):
    """Numbers of ``level_of_detection/alignment_corrections.py``."""

    cell: float = Field(0.5, description="Edge of the cells whose heights are compared [m]")
