"""Settings of the registration of two epochs."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel


class KeypointConfig(StrictModel):
    """The paper's coarse alignment; its values, except the FPFH radius, which it does not give."""

    salient_radius: float = Field(1.5, gt=0, description="Radius of the scatter matrix of ISS keypoints [m]")
    support_radius: float = Field(
        2.0, gt=0, description="Radius of non-maximum suppression of ISS keypoints [m]"
    )
    fpfh_radius: float = Field(5.0, gt=0, description="Radius of FPFH descriptors [m]")
    inlier: float = Field(0.6, gt=0, description="Largest distance of a RANSAC inlier pair [m]")
    iterations: int = Field(20_000, ge=1, le=10_000_000, description="Number of RANSAC samples")


class RegistrationConfig(StrictModel):
    """Registration of two epochs (method part B; the paper's values where it gives them).

    Lengths marked *grows with the spacing* hold for a mapped street. Where points lie farther apart than
    0.36 m in either epoch, they are multiplied by the measured spacing over 0.36 m.
    """

    leaves: tuple[float, ...] = Field(
        (1.0, 0.5, 0.25),
        min_length=1,
        description="Voxel edges of the registration pyramid, coarsest first [m]; scaled with the point "
        "spacing",
    )
    normal_radius: float = Field(
        0.8,
        gt=0,
        description="Radius of normals, but at least 2.5 voxel edges of the pyramid level [m]; scaled "
        "with the point spacing",
    )
    min_points: int = Field(300, ge=50, description="Smallest number of points that each epoch must have")
    max_spacing: float = Field(
        2.2,
        gt=0,
        description="Largest median point spacing of either epoch [m]; at wider spacings, structure above "
        "the ground is a point or two an object, and a wrong pose passes the checks",
    )
    outlier_neighbours: int = Field(
        10, ge=1, description="Number of neighbours in the statistical outlier removal"
    )
    outlier_sigmas: float = Field(
        3.0, gt=0, description="Limit of the statistical outlier removal, in standard deviations"
    )
    coarse: Literal["auto", "always", "never"] = Field(
        "auto",
        description="Coarse search without prior position: auto searches if the frames as given do not "
        "fit and a CRS is missing",
    )
    coarse_method: Literal["pictures", "features"] = Field(
        "pictures",
        description="Coarse search by bird's-eye pictures, or by features: ISS, FPFH and RANSAC (paper)",
    )
    features: KeypointConfig = KeypointConfig()
    coarse_pixel: float = Field(
        1.0,
        gt=0,
        description="Pixel size of the bird's-eye pictures of the coarse search [m]; scaled with the "
        "point spacing",
    )
    coarse_candidates: int = Field(
        25,
        ge=1,
        le=200,
        description="Number of start poses of the coarse search that are refined and compared",
    )
    ndt_iterations: int = Field(30, ge=1, description="Largest number of NDT iterations per cell size")
    ndt_leaves_per_cell: float = Field(
        4.0, ge=2, description="Edge of an NDT cell as a multiple of the voxel edge of the pyramid level"
    )
    tukey: float = Field(
        0.3,
        gt=0,
        description="Width of the Tukey biweight of point-to-plane residuals [m]; larger residuals have "
        "no weight",
    )
    polish: float = Field(
        4.685,
        ge=0,
        description="Width of the Tukey biweight of the last fits, in robust standard deviations of the "
        "residuals (4.685: 95 % efficiency); 0 for none (paper)",
    )
    huber: float = Field(
        0.5,
        gt=0,
        description="Width of the Huber weight of point pair distances [m]; scaled with the point spacing",
    )
    icp_iterations: int = Field(20, ge=1, description="Largest number of ICP iterations per pyramid level")
    icp_points: int = Field(
        200_000,
        ge=1000,
        description="Largest number of points of the earlier epoch used by ICP at one pyramid level",
    )
    plane_weight: float = Field(
        0.1,
        ge=0,
        description="Weight lambda of the plane-to-plane term at the finest level; 0 for none (paper)",
    )
    min_eigenvalue: float = Field(
        2e-3,
        gt=0,
        lt=1 / 3,
        description="Eigenvalue of the information matrix per unit weight below which a direction is "
        "degenerate [1]",
    )
    min_overlap: float = Field(
        0.15, gt=0, lt=1, description="Smallest overlap of the epochs, as a fraction of the smaller cloud"
    )
    min_standing: float = Field(
        0.35,
        ge=0,
        lt=1,
        description="Smallest fraction of walls in the overlap that match; the fit is refused if twice "
        "the standard error below",
    )
    min_standing_search: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="Smallest fraction of walls in the overlap that match after a search without prior "
        "position",
    )
    min_lying: float = Field(
        0.35,
        ge=0,
        lt=1,
        description="Smallest fraction of ground in the overlap that matches; the fit is refused if twice "
        "the standard error below",
    )
    min_support: float = Field(
        0.12,
        ge=0,
        lt=1,
        description="Fraction of walls, crowns and trunks that must match beyond chance by three standard "
        "errors, unless both epochs have a CRS",
    )
    max_rival: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Largest score of a different place in a search, as a fraction of the best score",
    )
    max_rival_near: float = Field(
        1.05,
        gt=0,
        description="Largest score of a different place, as a multiple of the score of the fit from the "
        "frames as given",
    )
    max_rmse: float = Field(
        0.15, gt=0, description="Largest robust point-to-plane root mean square error [m]"
    )
    max_disagreement: float = Field(
        0.10,
        gt=0,
        description="Largest distance between the NDT and ICP solutions [m]; scaled with the point spacing",
    )
    max_disagreement_deg: float = Field(
        0.3, gt=0, description="Largest angle between the NDT and ICP solutions [deg]"
    )
    block: float = Field(
        20.0, gt=0, description="Edge of the blocks of correlated residuals in the bootstrap [m]"
    )
    draws: int = Field(200, ge=10, description="Number of block bootstrap samples")
    sigma_floor: float = Field(0.003, ge=0, description="Smallest value of sigma_reg of the registration [m]")
    seed: int = Field(0, ge=0, description="Seed of the bootstrap and of RANSAC")

    def scaled(self, scale: float) -> RegistrationConfig:
        """Return the settings for points that lie ``scale`` times as far apart as on a mapped street."""
        if scale == 1.0:
            return self
        lengths = ("normal_radius", "coarse_pixel", "huber", "max_disagreement")
        update = {name: scale * getattr(self, name) for name in lengths}
        return self.model_copy(update={**update, "leaves": tuple(scale * leaf for leaf in self.leaves)})
