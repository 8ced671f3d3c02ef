"""Configuration of the change stage: the slices of its parts, composed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

from subiaco_change.association.config import AssociationConfig
from subiaco_change.decisions.confidence_config import ConfidenceConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.ground_cells import GroundChangeConfig
from subiaco_change.decisions.plant_measures import PlantConfig
from subiaco_change.given_classes import GivenClassesConfig
from subiaco_change.input_checks import InputCheckConfig
from subiaco_change.level_of_detection.alignment_corrections import PlacingConfig
from subiaco_change.level_of_detection.displacement_lod import LodConfig
from subiaco_change.method_rules import known_rules
from subiaco_change.objects.measures import MeasureConfig
from subiaco_change.point_spacing import SpacingConfig
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.segmentation.classes import SemanticsConfig
from subiaco_change.segmentation.instances import InstanceConfig
from subiaco_change.strategies import Part
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError
from subiaco_geo.trajectory_files.formats import EpochTrajectories


class TileConfig(StrictModel):
    """Tiles in which a run is done (method, part C5)."""

    size: float = Field(80.0, ge=40, multiple_of=20, description="Edge of a processing tile [m] (paper)")
    overlap: float = Field(
        10.0,
        ge=5,
        description="Width of the surroundings that are processed together with a tile [m] (paper)",
    )
    edge: float = Field(
        2.0,
        ge=0,
        description="Width of the outermost part of the surroundings, in which no object is classified [m]",
    )


class ChangeConfig(StrictModel):
    """Everything that decides what a change run says."""

    PUBLIC = (
        "leaf",
        "seed",
        "without",
        "registration.coarse",
        "placing.uncertainty.unstated_pose",
        "placing.warp.enabled",
        "lod.combine",
        "evidence.source",
        "evidence.min_beams",
        "decisions.min_observed",
        "decisions.least_volume",
        "decisions.building.height",
        "decisions.building.volume",
        "decisions.vegetation.height",
        "decisions.vegetation.volume",
        "ground.threshold",
        "ground.area",
        "ground.report_cell",
        "checks.pause_days",
    )

    leaf: float = Field(
        0.25,
        gt=0,
        le=0.5,
        description="Voxel edge to which both clouds are thinned before the comparison [m] (paper)",
    )
    every_point: bool = Field(
        True,
        description="Write every point of the input into the labelled clouds, with the label of the thinned "
        "point that it went into; without it the thinned points, in smaller files",
    )
    seed: int = Field(0, ge=0, description="Seed of all random numbers of a comparison")
    tiles: TileConfig = TileConfig()
    registration_points: int = Field(
        1_000_000,
        ge=10_000,
        description="Largest number of points of an epoch used by the registration; more points are "
        "thinned and come from fewer tiles",
    )
    normal_radius: float = Field(
        0.8,
        gt=0,
        description="Radius of normals of the thinned clouds [m]; 2.4 times the point spacing where the "
        "spacing exceeds 0.36 m",
    )
    second_registration: bool = Field(
        True,
        description="Register a second time without the points that the first comparison found changed "
        "(Decision 2)",
    )
    second_shift: float = Field(
        0.005,
        ge=0,
        description="Shift between first and second registration from which the comparison is repeated [m]",
    )
    second_points: int = Field(
        150_000,
        ge=0,
        description="Points of each epoch, in blocks all over the area, from which the second registration "
        "is estimated first; all points take part only where these move by half of second_shift; 0 takes all",
    )
    spacing: SpacingConfig = SpacingConfig()
    without: tuple[Part, ...] = Field(
        (), description="Parts of the method that are disabled, for ablation studies"
    )
    rules_off: Annotated[tuple[str, ...], AfterValidator(known_rules)] = Field(
        (), description="Rules of the method that are switched off, by name, for ablation studies"
    )
    registration: RegistrationConfig = RegistrationConfig()
    placing: PlacingConfig = PlacingConfig()
    lod: LodConfig = LodConfig()
    evidence: EvidenceConfig = EvidenceConfig()
    semantics: SemanticsConfig = SemanticsConfig()
    instances: InstanceConfig = InstanceConfig()
    measures: MeasureConfig = MeasureConfig()
    plants: PlantConfig = PlantConfig()
    association: AssociationConfig = AssociationConfig()
    decisions: DecisionConfig = DecisionConfig()
    ground: GroundChangeConfig = GroundChangeConfig()
    confidence: ConfidenceConfig = ConfidenceConfig()
    checks: InputCheckConfig = InputCheckConfig()
    trajectories: EpochTrajectories = EpochTrajectories()
    classes: GivenClassesConfig = GivenClassesConfig()


def with_parts_disabled(config: ChangeConfig, parts: Sequence[str]) -> ChangeConfig:
    """Return the configuration with these parts left out too.

    Raises
    ------
    InputError
        A part is not known.
    """
    known = [part.value for part in Part]
    for name in parts:
        if name not in known:
            raise InputError(f"--without {name}: not known; choose from {', '.join(known)}")
    return config.model_copy(update={"without": tuple(sorted({*config.without, *map(Part, parts)}))})
