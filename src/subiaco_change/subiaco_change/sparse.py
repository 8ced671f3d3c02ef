"""Lengths of the configuration raised to what the density of a pair can show (Decision 7).

A cell, a voxel or a clustering distance below the spacing of a cloud holds a point or none, so that
nothing touches anything. Every length serves clouds up to the spacing that the configuration names;
beyond, it is raised until it is so many spacings as it was there, or as many as it takes to join
points of one surface. The fewest points of an object fall with the square of the spacing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pydantic import Field

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.spacing import STREET_SPACING
from subiaco_geo.config import StrictModel

if TYPE_CHECKING:
    from subiaco_change.config import ChangeConfig


class SpacingConfig(StrictModel):
    """From which spacing on lengths follow it, and how far."""

    served: float = Field(
        STREET_SPACING,
        gt=0,
        description="Largest point spacing up to which the configured lengths are used unchanged [m]",
    )
    cell: float = Field(
        1.2,
        gt=0,
        description="Smallest cell edge as a multiple of the point spacing, so that neighbours on one "
        "surface are connected",
    )
    same: float = Field(
        1.6,
        gt=0,
        description="Distance within which the other epoch occupies a place, as a multiple of the point "
        "spacing",
    )
    plane: float = Field(
        2.4,
        gt=0,
        description="Radius of normals and of the level of detection as a multiple of the point spacing",
    )


_NOMINAL = NUMBERS.sparse.nominal_leaf
_SEMANTICS = ("cluster_voxel",)
_BUILDINGS = ("plane_cell", "roof_cell", "touch", "wire_touch", "attach", "edge", "contact")
_VEHICLES = ("truck_gap", "split_gap", "clear_gap")
_INSTANCES = ("building_gap", "vegetation_gap", "foliage_voxel", "crown_cell", "mobile_gap", "other_gap")


def at_spacing(config: ChangeConfig, spacing: float) -> ChangeConfig:
    """Return the configuration for a pair of which the sparser cloud has a spacing [m].

    Lengths stay as they are up to ``config.spacing.served``, and where the spacing is not known (infinite).
    """
    rule, instances = config.spacing, config.instances.model_copy(update={"leaf": config.leaf})
    if spacing <= rule.served or math.isinf(spacing):
        return config.model_copy(update={"instances": instances})

    def raised(part: StrictModel, names: tuple[str, ...], most: float) -> dict[str, float]:
        lengths = {name: float(getattr(part, name)) for name in names}
        return {name: max(at, min(at / rule.served, most) * spacing) for name, at in lengths.items()}

    semantics = config.semantics
    smallest = max(config.leaf, _NOMINAL * spacing / rule.served)
    return config.model_copy(
        update={
            "semantics": semantics.model_copy(
                update={
                    **raised(semantics, _SEMANTICS, rule.cell),
                    **raised(semantics, ("sparse_reach",), math.inf),
                    "buildings": semantics.buildings.model_copy(
                        update=raised(semantics.buildings, _BUILDINGS, rule.cell)
                    ),
                    "vehicles": semantics.vehicles.model_copy(
                        update=raised(semantics.vehicles, _VEHICLES, rule.cell)
                    ),
                }
            ),
            "instances": instances.model_copy(
                update={**raised(instances, _INSTANCES, rule.cell), "leaf": smallest}
            ),
            "lod": config.lod.model_copy(update=raised(config.lod, ("radius", "normal_radius"), rule.plane)),
            "plants": config.plants.model_copy(update=raised(config.plants, ("shell",), math.inf)),
            "measures": config.measures.model_copy(update=raised(config.measures, ("same_high",), rule.same)),
            **raised(config, ("normal_radius",), rule.plane),
        }
    )
