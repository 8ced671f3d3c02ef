"""Point spacing of a cloud on its surfaces, and lengths of the configuration raised to it (Decision 7).

A cell, a voxel or a clustering distance below the spacing of a cloud holds a point or none, so that
nothing touches anything. Every length serves clouds up to the spacing that the configuration names;
beyond, it is raised until it is so many spacings as it was there, or as many as it takes to join
points of one surface. The fewest points of an object fall with the square of the spacing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import small_gicp
from pydantic import Field

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

if TYPE_CHECKING:
    from subiaco_change.config import ChangeConfig
    from subiaco_change.objects.measures import MeasureConfig

_NEIGHBOURS = NUMBERS.spacing.neighbours
_SAMPLE = NUMBERS.spacing.sample
_NOMINAL = NUMBERS.sparse.nominal_leaf

#: Spacing of a street mapped at the working leaf, for which the radii in the configuration hold [m].
STREET_SPACING = NUMBERS.spacing.street_spacing


def neighbour_spacings(xyz: Floats) -> Floats:
    """Return the spacing (K,) [m] at points drawn evenly from a cloud (N, 3); empty below 17 points.

    A disc that reaches the k-th neighbour at a distance d holds k points, so that each has an area of
    pi d^2 / k. The spacing is the edge of the square of that area.
    """
    if len(xyz) <= _NEIGHBOURS:
        return np.zeros(0)
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    queries = np.ascontiguousarray(points[:: -(-len(points) // _SAMPLE)])
    tree = small_gicp.KdTree(small_gicp.PointCloud(points), num_threads=1)
    _, squared = tree.batch_knn_search(queries, _NEIGHBOURS + 1, num_threads=1)
    return np.asarray(np.sqrt(np.pi * np.asarray(squared)[:, -1] / _NEIGHBOURS))


def measure_spacing(xyz: Floats) -> float:
    """Return the median spacing [m] of a cloud (N, 3); infinite below 17 points."""
    found = neighbour_spacings(xyz)
    return float(np.median(found)) if len(found) else float("inf")


@dataclass(frozen=True)
class PointSpacing:
    """Median spacing of the points of both epochs at the working leaf [m]."""

    before: float
    after: float

    @property
    def coarser(self) -> float:
        """Spacing of the sparser epoch [m]: what a comparison of both can resolve."""
        return max(self.before, self.after)

    @property
    def scale(self) -> float:
        """Factor on radii and leaves that are meant for a mapped street, see :func:`spacing_scale`."""
        return spacing_scale(self.coarser)


def spacing_scale(*spacings: float) -> float:
    """Return the factor, 1 or more, by which the coarsest of these spacings [m] exceeds that of a street.

    A radius times this factor holds as many points of a surface as the radius does on a mapped street.
    A spacing that is not known (infinite) counts as that of a street.
    """
    known = [s for s in spacings if np.isfinite(s)]
    return max(1.0, *(s / STREET_SPACING for s in known)) if known else 1.0


def pair_spacing(before: Floats, after: Floats) -> PointSpacing:
    """Measure the spacing of two clouds (N, 3), (M, 3)."""
    return PointSpacing(measure_spacing(before), measure_spacing(after))


def joint_spacing(samples: Sequence[Floats]) -> float:
    """Return the median [m] of spacings measured on pieces of one cloud; infinite without any."""
    joined = np.concatenate([np.zeros(0), *samples])
    return float(np.median(joined)) if len(joined) else float("inf")


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
    crown: float = Field(
        3.6,
        gt=0,
        description="Smallest radius over which the canopy is smoothed before tops of crowns are searched, "
        "as a multiple of the point spacing of clouds measured from above",
    )
    filling: float = Field(
        5.0,
        ge=0,
        description="Mean number of points of the sparser epoch in the columns in which the tops of plants "
        "are compared; the columns are widened to it",
    )


def _patch_voxels(measures: MeasureConfig, spacing: float) -> float:
    """Return the voxels of a patch: a voxel of a sparse cloud stands for as much surface as a point."""
    return max(1.0, measures.patch_voxels * min(1.0, (measures.voxel / spacing) ** 2))


_SEMANTICS = ("cluster_voxel",)
_BUILDINGS = ("plane_cell", "roof_cell", "touch", "wire_touch", "attach", "edge", "contact")
_VEHICLES = ("truck_gap", "split_gap", "clear_gap")
_INSTANCES = ("building_gap", "vegetation_gap", "crown_cell", "mobile_gap", "other_gap")


def at_spacing(config: ChangeConfig, spacing: float, *, from_above: bool = False) -> ChangeConfig:
    """Return the configuration for a pair of which the sparser cloud has a spacing [m].

    Lengths stay as they are up to ``config.spacing.served``, and where the spacing is not known (infinite).
    Where both clouds were measured ``from_above``, beams end at any height of a crown, so that neighbouring
    points of one crown lie farther apart in height than from side to side.
    """
    rule, instances = config.spacing, config.instances.model_copy(update={"leaf": config.leaf})
    if spacing <= rule.served or math.isinf(spacing):
        return config.model_copy(update={"instances": instances})

    def raised(part: StrictModel, names: tuple[str, ...], most: float) -> dict[str, float]:
        lengths = {name: float(getattr(part, name)) for name in names}
        return {name: max(at, min(at / rule.served, most) * spacing) for name, at in lengths.items()}

    semantics = config.semantics
    crowns = {
        **raised(instances, ("density_voxel",), math.inf),
        **raised(instances, ("crown_radius",), rule.crown),
        "foliage_layers": spacing / rule.served,
    }
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
                update={
                    **raised(instances, _INSTANCES, rule.cell),
                    **raised(instances, ("foliage_voxel",), rule.same),
                    **(crowns if from_above else {}),
                    "leaf": smallest,
                }
            ),
            "lod": config.lod.model_copy(update=raised(config.lod, ("radius", "normal_radius"), rule.plane)),
            "plants": config.plants.model_copy(
                update={
                    **raised(config.plants, ("shell",), math.inf),
                    "tops": config.plants.tops.model_copy(update={"filling": rule.filling}),
                }
            ),
            "measures": config.measures.model_copy(
                update={
                    **raised(config.measures, ("same_high",), rule.same),
                    "patch_voxels": _patch_voxels(config.measures, spacing),
                }
            ),
            "evidence": config.evidence.model_copy(
                update={
                    **raised(config.evidence, ("shadow_radius",), rule.same),
                    **raised(config.evidence, ("shadow_ring",), rule.plane),
                }
            ),
            **raised(config, ("normal_radius",), rule.plane),
        }
    )
