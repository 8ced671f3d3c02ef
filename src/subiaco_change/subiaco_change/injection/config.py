"""What is put into a map, and how a second drive would have seen it."""

from __future__ import annotations

from pydantic import Field

from subiaco_change.changes.decisions import DecisionConfig
from subiaco_change.changes.ground_cells import GroundChangeConfig
from subiaco_change.semantics.classes import SemanticsConfig
from subiaco_change.semantics.instances import InstanceConfig
from subiaco_geo.config import StrictModel


class SightConfig(StrictModel):
    """Lines of sight from the drive."""

    pose_spacing: float = Field(2.0, gt=0, description="distance between poses that look around [m]")
    views: int = Field(6, ge=1, description="nearest poses from which a place is looked at")
    max_range: float = Field(60.0, gt=0, description="longest line of sight [m]")
    width: float = Field(0.25, gt=0, description="width of a point that hides what is behind it [m]")
    cell_deg: float = Field(
        0.5, gt=0, le=5, description="cell of the depth images of what hides a line of sight [deg]"
    )


class RepeatConfig(StrictModel):
    """How a second pass over the same street differs where nothing changed (modelled).

    Beams fall elsewhere: a voxel that few of them hit may be missed, the middle of
    those that hit it wanders along the surface, and in foliage they meet other leaves.
    """

    sigma: float = Field(0.015, ge=0, description="noise of a map point, where the map has no spread [m]")
    again: float = Field(
        0.5, gt=0, le=1, description="chance that a voxel which one beam hit is hit again, a beam"
    )
    uneven: float = Field(
        1.0, gt=0, description="shape of the gamma distribution of beams from place to place; inf is even"
    )
    place: float = Field(2.0, gt=0, description="edge of such a place [m]")
    beams: float = Field(3.0, ge=1, description="beams a voxel, where the map does not count them")
    wander: float = Field(1.0, ge=0, description="shift of the middle of a voxel, over that of chance")
    foliage: float = Field(0.4, ge=0, description="largest distance to the leaf that is hit instead [m]")


class InjectionConfig(StrictModel):
    """How many changes of each kind, where, and how large."""

    seed: int = Field(0, ge=0, description="seed of every choice")
    leaf: float = Field(0.25, gt=0, le=0.5, description="leaf at which objects are taken and put [m]")
    inserted: int = Field(10, ge=0, description="objects put where nothing stood")
    removed: int = Field(8, ge=0, description="objects taken away")
    moved: int = Field(4, ge=0, description="objects taken from one place to another")
    grown: int = Field(6, ge=0, description="plants and buildings made taller")
    cut: int = Field(6, ge=0, description="plants and buildings cut to a part of their height")
    patches: int = Field(6, ge=0, description="ground patches raised or lowered")
    min_points: int = Field(120, ge=10, description="smallest object that is taken")
    max_range: float = Field(35.0, gt=0, description="farthest from the drive that anything is put [m]")
    clearance: float = Field(0.9, ge=0, description="free ground around an object that is put [m]")
    scale: tuple[float, float] = Field((0.3, 1.0), description="sizes of objects that are put")
    growth: tuple[float, float] = Field((0.1, 0.6), description="relative growth in height")
    cutting: tuple[float, float] = Field((0.1, 0.6), description="share of the height that is cut off")
    patch_rise: tuple[float, float] = Field((0.10, 0.50), description="rise or fall of a patch [m]")
    patch_width: tuple[float, float] = Field((3.0, 6.0), description="width of a patch [m]")
    patch_length: tuple[float, float] = Field((11.0, 16.0), description="length of a patch [m]")
    tries: int = Field(400, ge=1, description="places tried for an object before it is left out")
    sight: SightConfig = SightConfig()
    repeat: RepeatConfig = RepeatConfig()
    semantics: SemanticsConfig = SemanticsConfig()
    instances: InstanceConfig = InstanceConfig()
    decisions: DecisionConfig = DecisionConfig()
    ground: GroundChangeConfig = GroundChangeConfig()
