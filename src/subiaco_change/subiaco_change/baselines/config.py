"""Parameters of the simple methods, each with where its value comes from.

"Tuned" means: the best mean mIoU of the published protocol over simulated surveys of
preset ``easy``, 20 s, seeds 101 and 102, one parameter after the other, in two rounds;
never over seeds that figures are reported on. What lay within 0.5 mIoU of the best was
rounded to one value for all methods (``cells``). C2C takes the values of the
nearest-neighbour method, whose level of detection never exceeds its floor there.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.semantics.ground import GroundConfig
from subiaco_geo.config import StrictModel

#: What a cell is that has no points in one epoch: not comparable (255), bare ground there, or Unchanged.
Voids = Literal["unobserved", "ground", "unchanged"]


class CellConfig(StrictModel):
    """From single points or heights to labelled cells; the same for every method."""

    cell: float = Field(0.5, gt=0, description="cell of decisions [m], published protocol")
    share: float = Field(
        0.3,
        gt=0,
        le=1,
        description="share of an epoch's points that makes a cell changed, published protocol",
    )
    thing_height: float = Field(
        0.5, gt=0, description="height above the ground of its own epoch from which a point is no ground [m]"
    )
    paint: Literal["cell", "surface"] = Field(
        "surface",
        description="points that take a cell's label: all of them, or those of the surface that changed",
    )


class DsmConfig(StrictModel):
    """Difference of digital surface models: highest point per cell."""

    threshold: float = Field(0.15, gt=0, description="height difference of a change [m]; tuned")
    opening: int = Field(
        0, ge=0, description="radius of the morphological opening [cells], 0 for none; tuned"
    )
    min_area: float = Field(4.0, ge=0, description="smallest contiguous change [m2]; tuned")
    voids: Voids = Field("ground", description="what a cell without points in one epoch is; tuned")


class NearestConfig(StrictModel):
    """Nearest-neighbour differencing against a level of detection."""

    lod_factor: float = Field(1.2, ge=0, description="gate as a multiple of the level of detection, paper")
    minimum: float = Field(0.35, ge=0, description="smallest distance of a change [m]; tuned")
    radius: float = Field(1.0, gt=0, description="neighbourhood of the level of detection [m], paper")
    noise: float = Field(0.01, ge=0, description="floor of the roughness term of an epoch [m], as of ours")
    opening: int = Field(
        0, ge=0, description="radius of the morphological opening [cells], 0 for none; tuned"
    )
    min_area: float = Field(4.0, ge=0, description="smallest contiguous change [m2]; tuned")
    voids: Voids = Field(
        "ground", description="what a changed cell without points in the other epoch is; tuned"
    )


class CloudToCloudConfig(StrictModel):
    """Nearest-neighbour distance (C2C) against one fixed threshold."""

    threshold: float = Field(0.75, gt=0, description="distance of a change [m]; as of nn")
    opening: int = Field(
        0, ge=0, description="radius of the morphological opening [cells], 0 for none; as of nn"
    )
    min_area: float = Field(4.0, ge=0, description="smallest contiguous change [m2]; as of nn")
    voids: Voids = Field(
        "unchanged", description="what a changed cell without points in the other epoch is; as of nn"
    )


class M3c2Config(StrictModel):
    """M3C2 (Lague, Brodu and Leroux 2013) against its own level of detection."""

    normal_radius: float = Field(
        2.0, gt=0, description="radius of the normals (half of D) [m], common practice"
    )
    radius: float = Field(1.0, gt=0, description="radius of the cylinder (half of d) [m], paper")
    half_length: float = Field(
        1.0, gt=0, description="half length of the cylinder in either epoch [m]; tuned"
    )
    min_count: int = Field(4, ge=1, description="points below which no distance is stated, Lague et al.")
    noise: float = Field(0.0, ge=0, description="floor of s / sqrt(N) [m]; the published form has none")
    minimum: float = Field(
        0.10, ge=0, description="smallest distance of a change [m], the paper's gate; tuned"
    )
    no_counterpart: Literal["unchanged", "changed"] = Field(
        "changed", description="what a point is whose cylinder is empty in the other epoch; tuned"
    )
    opening: int = Field(
        1, ge=0, description="radius of the morphological opening [cells], 0 for none; tuned"
    )
    min_area: float = Field(1.0, ge=0, description="smallest contiguous change [m2]; tuned")
    voids: Voids = Field(
        "ground", description="what a changed cell without points in the other epoch is; tuned"
    )


class BaselineConfig(StrictModel):
    """Everything that decides what a simple method says."""

    leaf: float = Field(0.25, gt=0, description="working leaf of both clouds [m], as of ours")
    normal_radius: float = Field(0.8, gt=0, description="radius of normals for registration and LoD [m]")
    registration: RegistrationConfig = RegistrationConfig()
    ground: GroundConfig = GroundConfig()
    cells: CellConfig = CellConfig()
    dsm: DsmConfig = DsmConfig()
    nn: NearestConfig = NearestConfig()
    c2c: CloudToCloudConfig = CloudToCloudConfig()
    m3c2: M3c2Config = M3c2Config()
