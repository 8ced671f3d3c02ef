"""Settings of injected changes, and of the simulated second drive."""

from __future__ import annotations

from pydantic import Field

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.ground_cells import GroundChangeConfig
from subiaco_change.segmentation.classes import SemanticsConfig
from subiaco_change.segmentation.instances import InstanceConfig
from subiaco_geo.config import StrictModel


class SightConfig(StrictModel):
    """Lines of sight from the drive."""

    pose_spacing: float = Field(
        2.0,
        gt=0,
        description="Distance along the trajectory between poses from which visibility is computed [m]",
    )
    views: int = Field(
        6, ge=1, description="Number of nearest poses from which the visibility of a place is computed"
    )
    max_range: float = Field(60.0, gt=0, description="Longest line of sight [m]")
    width: float = Field(0.25, gt=0, description="Width of a point that occludes the space behind it [m]")
    cell_deg: float = Field(
        0.5,
        gt=0,
        le=5,
        description="Angular size of the cells of the depth images in which occlusion is computed [deg]",
    )


class RepeatConfig(StrictModel):
    """How a second pass over the same street differs where nothing changed (modelled).

    Beams fall elsewhere: a voxel that few of them hit may be missed, the middle of
    those that hit it wanders along the surface, and in foliage they meet other leaves.
    """

    sigma: float = Field(
        0.015,
        ge=0,
        description="Standard deviation of the noise of a map point, used where the map states no spread [m]",
    )
    again: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Probability that a voxel hit by one beam is hit again by one beam of a repeated survey",
    )
    uneven: float = Field(
        1.0,
        gt=0,
        description="Shape parameter of the gamma distribution of beams between places [1]; inf is even",
    )
    place: float = Field(
        2.0, gt=0, description="Edge of the places between which the number of beams varies [m]"
    )
    beams: float = Field(
        3.0, ge=1, description="Number of beams per voxel, used where the map does not count beams"
    )
    wander: float = Field(
        1.0, ge=0, description="Factor on the random shift of the mean point of a voxel in a repeated survey"
    )
    foliage: float = Field(
        0.4, ge=0, description="Largest distance between the leaves that two surveys of one plant hit [m]"
    )


class InjectionConfig(StrictModel):
    """How many changes of each kind, where, and how large."""

    seed: int = Field(0, ge=0, description="Seed of all random numbers of the injection")
    leaf: float = Field(
        0.25, gt=0, le=0.5, description="Point spacing at which objects are extracted and inserted [m]"
    )
    inserted: int = Field(10, ge=0, description="Number of objects inserted in free places")
    removed: int = Field(8, ge=0, description="Number of objects removed")
    moved: int = Field(4, ge=0, description="Number of objects moved to another place")
    grown: int = Field(6, ge=0, description="Number of plants and buildings whose height is increased")
    cut: int = Field(6, ge=0, description="Number of plants and buildings whose height is reduced")
    patches: int = Field(6, ge=0, description="Number of ground patches that are raised or lowered")
    min_points: int = Field(
        120, ge=10, description="Smallest number of points of an object that is used for injection"
    )
    max_range: float = Field(
        35.0, gt=0, description="Largest distance from the trajectory at which changes are injected [m]"
    )
    clearance: float = Field(0.9, ge=0, description="Free distance around an inserted object [m]")
    scale: tuple[float, float] = Field(
        (0.3, 1.0), description="Smallest and largest scale factor of inserted objects"
    )
    growth: tuple[float, float] = Field(
        (0.1, 0.6), description="Smallest and largest increase in height, as a fraction of the height"
    )
    cutting: tuple[float, float] = Field(
        (0.1, 0.6), description="Smallest and largest reduction in height, as a fraction of the height"
    )
    patch_rise: tuple[float, float] = Field(
        (0.10, 0.50), description="Smallest and largest rise or fall of a ground patch [m]"
    )
    patch_width: tuple[float, float] = Field(
        (3.0, 6.0), description="Smallest and largest width of a ground patch [m]"
    )
    patch_length: tuple[float, float] = Field(
        (11.0, 16.0), description="Smallest and largest length of a ground patch [m]"
    )
    tries: int = Field(
        400, ge=1, description="Number of places tried for an object before the object is left out"
    )
    sight: SightConfig = SightConfig()
    repeat: RepeatConfig = RepeatConfig()
    semantics: SemanticsConfig = SemanticsConfig()
    instances: InstanceConfig = InstanceConfig()
    decisions: DecisionConfig = DecisionConfig()
    ground: GroundChangeConfig = GroundChangeConfig()
