"""Settings of the registration of two epochs."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel


class FeatureConfig(StrictModel):
    """The paper's coarse alignment; its values, except the FPFH radius, which it does not give."""

    salient_radius: float = Field(1.5, gt=0, description="ISS: radius of the scatter matrix [m]")
    support_radius: float = Field(2.0, gt=0, description="ISS: radius of non-maximum suppression [m]")
    fpfh_radius: float = Field(5.0, gt=0, description="FPFH: radius [m], ours")
    inlier: float = Field(0.6, gt=0, description="RANSAC: largest distance of a pair that agrees [m]")
    iterations: int = Field(20_000, ge=1, le=10_000_000, description="RANSAC: samples")


class RegistrationConfig(StrictModel):
    """Registration of two epochs (method part B; the paper's values where it gives them).

    Lengths marked *grows with the spacing* hold for a mapped street. Where points lie farther apart than
    0.36 m in either epoch, they are multiplied by the measured spacing over 0.36 m.
    """

    leaves: tuple[float, ...] = Field(
        (1.0, 0.5, 0.25),
        min_length=1,
        description="pyramid leaves, coarse first [m]; grows with the spacing",
    )
    normal_radius: float = Field(
        0.8, gt=0, description="normals: max(this, 2.5 leaf) [m]; grows with the spacing"
    )
    min_points: int = Field(300, ge=50, description="points that each epoch must have")
    outlier_neighbours: int = Field(10, ge=1, description="statistical outlier removal: neighbours")
    outlier_sigmas: float = Field(3.0, gt=0, description="statistical outlier removal: standard deviations")
    coarse: Literal["auto", "always", "never"] = Field(
        "auto", description="search without priors: auto = when identity does not hold and a CRS is missing"
    )
    coarse_method: Literal["pictures", "features"] = Field(
        "pictures", description="search: pictures from above (ours) or ISS, FPFH and RANSAC (paper)"
    )
    features: FeatureConfig = FeatureConfig()
    coarse_pixel: float = Field(
        1.0,
        gt=0,
        description="pixel of the bird's-eye pictures of the coarse search [m]; grows with the spacing",
    )
    coarse_candidates: int = Field(25, ge=1, le=200, description="start poses that are refined and judged")
    ndt_iterations: int = Field(30, ge=1, description="NDT iterations a cell size")
    ndt_leaves_per_cell: float = Field(4.0, ge=2, description="NDT cell edge in leaves of the level")
    tukey: float = Field(0.3, gt=0, description="Tukey biweight of point-to-plane residuals [m]")
    polish: float = Field(
        4.685,
        ge=0,
        description="Tukey biweight of the last fits, in robust standard deviations of the residuals (95 % "
        "efficiency): what changed by less than tukey does not pull; 0 = none, paper",
    )
    huber: float = Field(
        0.5, gt=0, description="Huber weight of the distance of a pair [m]; grows with the spacing"
    )
    icp_iterations: int = Field(20, ge=1, description="ICP iterations a level")
    icp_points: int = Field(200_000, ge=1000, description="points of before used by ICP at any level")
    plane_weight: float = Field(
        0.1, ge=0, description="lambda of the plane-to-plane term at the finest level, 0 = none, paper"
    )
    min_eigenvalue: float = Field(
        2e-3, gt=0, lt=1 / 3, description="information a unit weight below which a direction is degenerate"
    )
    min_overlap: float = Field(0.15, gt=0, lt=1, description="smallest overlap, share of the smaller cloud")
    min_standing: float = Field(
        0.35,
        ge=0,
        lt=1,
        description="smallest share of walls in the overlap that match; refused where the share is smaller "
        "by twice its standard error",
    )
    min_standing_search: float = Field(
        0.5, ge=0, lt=1, description="the same after a search without priors, which must be surer"
    )
    min_lying: float = Field(
        0.35, ge=0, lt=1, description="smallest share of ground in the overlap that matches, as min_standing"
    )
    min_support: float = Field(
        0.12,
        ge=0,
        lt=1,
        description="share of the structure (walls, crowns, trunks) that must match beyond chance, by three "
        "standard errors; 0 where both epochs have a CRS; chance is the match at poses 6 to 10 m aside",
    )
    max_rival: float = Field(
        0.7, gt=0, le=1, description="largest score of another place, share of the best, in a search"
    )
    max_rival_near: float = Field(
        1.05,
        gt=0,
        description="largest score of another place, share of that of a fit from the frames as given",
    )
    max_rmse: float = Field(0.15, gt=0, description="largest robust point-to-plane RMSE [m]")
    max_disagreement: float = Field(
        0.10, gt=0, description="largest distance of NDT and ICP solutions [m]; grows with the spacing"
    )
    max_disagreement_deg: float = Field(
        0.3, gt=0, description="largest angle between NDT and ICP solutions [deg]"
    )
    block: float = Field(20.0, gt=0, description="blocks of correlated residuals [m]")
    draws: int = Field(200, ge=10, description="block bootstrap draws")
    sigma_floor: float = Field(0.003, ge=0, description="smallest sigma_reg [m]")
    seed: int = Field(0, ge=0, description="seed of the bootstrap and of RANSAC")

    def scaled(self, scale: float) -> RegistrationConfig:
        """Return the settings for points that lie ``scale`` times as far apart as on a mapped street."""
        if scale == 1.0:
            return self
        lengths = ("normal_radius", "coarse_pixel", "huber", "max_disagreement")
        update = {name: scale * getattr(self, name) for name in lengths}
        return self.model_copy(update={**update, "leaves": tuple(scale * leaf for leaf in self.leaves)})
