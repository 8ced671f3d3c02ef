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

from subiaco_geo.config import StrictModel

#: What a cell is that has no points in one epoch: not comparable (255), bare ground there, or Unchanged.
Voids = Literal["unobserved", "ground", "unchanged"]


class CellConfig(StrictModel):
    """From single points or heights to labelled cells; the same for every method."""

    cell: float = Field(
        0.5, gt=0, description="Edge of the cells in which baselines decide [m] (published protocol)"
    )
    share: float = Field(
        0.3,
        gt=0,
        le=1,
        description="Smallest fraction of changed points of an epoch for a cell to be changed (published "
        "protocol)",
    )
    thing_height: float = Field(
        0.5,
        gt=0,
        description="Height above the ground of its own epoch from which a point belongs to an object [m]",
    )
    paint: Literal["cell", "surface"] = Field(
        "surface",
        description="Points that take the label of a changed cell: all of them, or only points of the "
        "surface that changed",
    )


class DsmConfig(StrictModel):
    """Difference of digital surface models: highest point per cell."""

    threshold: float = Field(
        0.15, gt=0, description="Smallest height difference that is a change [m] (tuned)"
    )
    opening: int = Field(
        0,
        ge=0,
        description="Radius of the morphological opening of changed cells [cells]; 0 for none (tuned)",
    )
    min_area: float = Field(4.0, ge=0, description="Smallest contiguous area of a change [m2] (tuned)")
    voids: Voids = Field("ground", description="Label of a cell without points in one epoch (tuned)")


class NearestConfig(StrictModel):
    """Nearest-neighbour differencing against a level of detection."""

    lod_factor: float = Field(
        1.2, ge=0, description="Limit of a change as a multiple of the level of detection (paper)"
    )
    minimum: float = Field(0.35, ge=0, description="Smallest point distance that is a change [m] (tuned)")
    radius: float = Field(
        1.0, gt=0, description="Radius of the neighbourhood for the level of detection [m] (paper)"
    )
    noise: float = Field(
        0.01,
        ge=0,
        description="Smallest roughness term of an epoch in the level of detection [m]; equals that of "
        "the full method",
    )
    opening: int = Field(
        0,
        ge=0,
        description="Radius of the morphological opening of changed cells [cells]; 0 for none (tuned)",
    )
    min_area: float = Field(4.0, ge=0, description="Smallest contiguous area of a change [m2] (tuned)")
    voids: Voids = Field(
        "ground", description="Label of a changed cell without points in the other epoch (tuned)"
    )


class CloudToCloudConfig(StrictModel):
    """Nearest-neighbour distance (C2C) against one fixed threshold."""

    threshold: float = Field(
        0.75,
        gt=0,
        description="Smallest cloud-to-cloud distance that is a change [m]; as tuned for the "
        "nearest-neighbour baseline",
    )
    opening: int = Field(
        0,
        ge=0,
        description="Radius of the morphological opening of changed cells [cells]; 0 for none; as for the "
        "nearest-neighbour baseline",
    )
    min_area: float = Field(
        4.0,
        ge=0,
        description="Smallest contiguous area of a change [m2]; as for the nearest-neighbour baseline",
    )
    voids: Voids = Field(
        "unchanged",
        description="Label of a changed cell without points in the other epoch; as for the "
        "nearest-neighbour baseline",
    )


class M3c2Config(StrictModel):
    """M3C2 (Lague, Brodu and Leroux 2013) against its own level of detection."""

    normal_radius: float = Field(
        2.0, gt=0, description="Radius in which normals are estimated (half of D) [m] (common practice)"
    )
    radius: float = Field(1.0, gt=0, description="Radius of the projection cylinder (half of d) [m] (paper)")
    half_length: float = Field(
        1.0, gt=0, description="Half length of the projection cylinder in either epoch [m] (tuned)"
    )
    min_count: int = Field(
        4,
        ge=1,
        description="Number of points in the cylinder below which no distance is computed (Lague et al.)",
    )
    noise: float = Field(
        0.0, ge=0, description="Smallest value of s / sqrt(N) [m]; the published form has none"
    )
    minimum: float = Field(
        0.10, ge=0, description="Smallest M3C2 distance that is a change [m] (limit of the paper, tuned)"
    )
    no_counterpart: Literal["unchanged", "changed"] = Field(
        "changed", description="Label of a point whose cylinder is empty in the other epoch (tuned)"
    )
    opening: int = Field(
        1,
        ge=0,
        description="Radius of the morphological opening of changed cells [cells]; 0 for none (tuned)",
    )
    min_area: float = Field(1.0, ge=0, description="Smallest contiguous area of a change [m2] (tuned)")
    voids: Voids = Field(
        "ground", description="Label of a changed cell without points in the other epoch (tuned)"
    )
