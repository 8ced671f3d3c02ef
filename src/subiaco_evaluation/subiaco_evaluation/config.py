"""Settings of the simple and of the learned methods, as one model."""

from __future__ import annotations

from pydantic import Field

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.segmentation.ground_model import GroundConfig
from subiaco_evaluation.baselines.config import (
    CellConfig,
    CloudToCloudConfig,
    DsmConfig,
    M3c2Config,
    NearestConfig,
)
from subiaco_evaluation.learned.config import LearnedConfig
from subiaco_geo.config import StrictModel


class BaselineConfig(StrictModel):
    """Everything that decides what a simple method says."""

    leaf: float = Field(
        0.25,
        gt=0,
        description="Voxel edge to which both clouds are thinned [m]; equals that of the full method",
    )
    normal_radius: float = Field(
        0.8, gt=0, description="Radius of the normals for registration and level of detection [m]"
    )
    registration: RegistrationConfig = RegistrationConfig()
    ground: GroundConfig = GroundConfig()
    cells: CellConfig = CellConfig()
    dsm: DsmConfig = DsmConfig()
    nn: NearestConfig = NearestConfig()
    c2c: CloudToCloudConfig = CloudToCloudConfig()
    m3c2: M3c2Config = M3c2Config()
    learned: LearnedConfig = LearnedConfig()
