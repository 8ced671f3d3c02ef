"""Settings of the segmentation: buildings and vehicles."""

from __future__ import annotations

from pydantic import Field

from subiaco_change.segmentation.features import EigenFeatureConfig
from subiaco_change.segmentation.object_rows import RowConfig
from subiaco_geo.config import StrictModel


class BuildingConfig(StrictModel):
    """Which planes are buildings, and what belongs to them; heights are above the local ground model."""

    max_linearity: float = Field(
        0.92,
        gt=0,
        lt=1,
        description="Largest linearity of a point that may join a planar patch [1]; points along lines "
        "have no normal",
    )
    plane_angle_deg: float = Field(
        10.0,
        gt=0,
        description="Largest angle between the normals of neighbouring points of one planar patch [deg] "
        "(paper)",
    )
    plane_offset: float = Field(
        0.08,
        gt=0,
        description="Largest distance of a point from its neighbour's plane within one planar patch [m] "
        "(paper)",
    )
    plane_area: float = Field(
        6.0,
        gt=0,
        description="Smallest area of a planar patch that is a facade or a roof by itself [m2] (paper)",
    )
    plane_cell: float = Field(
        0.5, gt=0, description="Edge of the cells in which the area of a planar patch is counted [m]"
    )
    wire_height: float = Field(
        4.0,
        gt=0,
        description="Height above ground above which linear points and patches can be wires or palm "
        "fronds [m]",
    )
    wire_linearity: float = Field(
        0.42, gt=0, lt=1, description="Mean linearity above which a planar patch can be a bundle of wires [1]"
    )
    wire_level: float = Field(
        0.97,
        gt=0,
        lt=1,
        description="Vertical component of a patch normal above which a bundle of wires hangs level [1]; "
        "roofs are pitched",
    )
    wire_inner: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of the cells of a patch with four occupied neighbours; below it, the patch "
        "may be wires",
    )
    wire_rise: float = Field(
        1.0,
        gt=0,
        description="Largest standard deviation of the heights in a bundle of wires [m]; sparse facades "
        "have more",
    )
    frond_linearity: float = Field(
        0.36,
        gt=0,
        lt=1,
        description="Mean linearity above which a rough, bent patch consists of palm fronds [1]",
    )
    frond_bend: float = Field(
        0.1,
        gt=0,
        description="Root mean square distance from its plane above which a patch can consist of palm "
        "fronds [m]",
    )
    frond_roughness: float = Field(
        0.04,
        gt=0,
        description="Median roughness above which a patch can be palm fronds or foliage instead of a roof "
        "[m]",
    )
    wire_roughness: float = Field(
        0.045, gt=0, description="Largest roughness of a point that belongs to a wire [m]"
    )
    wire_length: float = Field(4.0, gt=0, description="Shortest horizontal extent of a run of wires [m]")
    wire_touch: float = Field(
        0.4,
        gt=0,
        description="Edge of the voxels in which points of wires are connected into one component [m]",
    )
    leafy_scatter: float = Field(
        0.18,
        gt=0,
        lt=1,
        description="Mean sqrt(l3 / l1) above which a small planar patch is the side of a hedge, not a "
        "wall [1]",
    )
    leafy_bend: float = Field(
        0.2,
        gt=0,
        description="Root mean square distance from its plane above which a rough, inclined patch is "
        "foliage, not a roof [m]",
    )
    leafy_area: float = Field(
        25.0,
        gt=0,
        description="Area of a planar patch from which scattered points no longer make the patch foliage "
        "[m2]",
    )
    facade_slope: float = Field(
        0.25,
        gt=0,
        description="Largest vertical component of the normal of a facade [1] (paper); raise it to accept "
        "inclined walls",
    )
    thick: EigenFeatureConfig = EigenFeatureConfig(neighbours=24, radius=1.5)
    thick_cell: float = Field(
        0.5,
        gt=0,
        description="Edge of the voxels in which a wall that was mapped as several sheets is averaged to "
        "one [m]",
    )
    thick_roughness: float = Field(
        0.16,
        gt=0,
        description="Largest roughness, over a radius of 1.5 m, of a wall that was mapped as several "
        "sheets [m]",
    )
    thick_offset: float = Field(
        0.25,
        gt=0,
        description="Largest distance between neighbouring voxel means of a wall that was mapped as "
        "several sheets [m]",
    )
    thick_area: float = Field(
        12.0, gt=0, description="Smallest area of a wall that was mapped as several sheets [m2]"
    )
    facade_top: float = Field(
        2.3,
        gt=0,
        description="Height above ground that a facade must reach [m]; lower walls become class other",
    )
    eaves: float = Field(
        0.35,
        ge=0,
        description="Distance below facade_top at which a wall may end if rough eaves continue above the "
        "wall [m]",
    )
    facade_share: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Fraction of the points of a facade that must lie where a wall reaches facade_top",
    )
    part_area: float = Field(
        2.0,
        gt=0,
        description="Smallest area of a planar patch that joins a larger facade or roof near it [m2]",
    )
    roof_height: float = Field(
        2.0,
        gt=0,
        description="Median height above ground above which any planar patch that is not upright is a "
        "roof [m] (method C3)",
    )
    roof_level: float = Field(
        0.5, gt=0, lt=1, description="Smallest vertical component of the normal of a roof point [1]"
    )
    roof_cell: float = Field(0.5, gt=0, description="Edge of the cells of the footprint of roofs [m]")
    chimney: float = Field(
        1.2, ge=0, description="Height above a roof up to which points belong to the building [m]"
    )
    under_gap: float = Field(
        0.3,
        gt=0,
        description="Clearance below a roof above which an object under the roof, a car for instance, is "
        "separate [m]",
    )
    under_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Largest fraction of the points of an object under a roof that may have roof posts "
        "above them",
    )
    under_points: int = Field(
        15, gt=0, description="Smallest number of points of a separate object under a roof"
    )
    touch: float = Field(
        0.25,
        gt=0,
        description="Edge of the voxels in which points of one object at a building are connected [m]",
    )
    attach: float = Field(
        1.0,
        ge=0,
        description="Distance from a building within which smooth small parts join the building [m]",
    )
    edge: float = Field(
        0.7,
        ge=0,
        description="Distance from a building within which points that look like foliage join the "
        "building [m]",
    )
    contact: float = Field(
        0.5,
        ge=0,
        description="Distance from a building within which points of fences and plants that extend "
        "farther join it [m]",
    )


class VehicleConfig(StrictModel):
    """Boxes of vehicles; heights are above the local ground model."""

    truck_length: float = Field(13.0, gt=0, description="Longest length of a truck or bus [m]")
    truck_width: float = Field(3.3, gt=0, description="Widest width of a truck or bus [m]")
    truck_min_width: float = Field(
        0.8, gt=0, description="Smallest observed width of a truck or bus [m]; a free-standing wall has less"
    )
    truck_top: float = Field(3.8, gt=0, description="Largest height above ground of a truck or bus [m]")
    truck_gap: float = Field(
        0.4,
        gt=0,
        description="Edge of the cells, seen from above, in which points of a truck are connected [m]",
    )
    truck_planes: float = Field(
        0.25,
        ge=0,
        le=1,
        description="Smallest fraction of the points of a truck that lie in planar patches as large as a "
        "facade",
    )
    trunk_linearity: float = Field(
        0.8,
        gt=0,
        le=1,
        description="Linearity above which a point next to a truck belongs to a tree trunk or a pole [1]",
    )
    truck_edge: float = Field(
        0.7, ge=0, description="Distance from a truck within which small parts join the truck [m]"
    )
    wheels: float = Field(
        0.68,
        gt=0,
        description="Largest ratio of point density near the ground to that at 1 m height for a truck, "
        "which is open between its wheels",
    )
    mobile_length: float = Field(
        5.5, gt=0, description="Longest length of a vehicle that is no truck [m] (paper: 5 m)"
    )
    car_length: float = Field(3.2, gt=0, description="Smallest length of a car [m]")
    car_width: float = Field(2.4, gt=0, description="Largest width of a car [m]")
    bonnet: float = Field(
        1.0, gt=0, description="Length of the low stretch between the cabins of two cars in a row [m]"
    )
    mobile_height: float = Field(
        3.0, gt=0, description="Largest height above ground of a vehicle that is no truck [m] (paper)"
    )
    mobile_top: float = Field(
        2.6,
        gt=0,
        description="Height above ground below which vehicles are searched, to keep tree crowns out [m]",
    )
    mobile_hard: float = Field(
        0.4,
        ge=0,
        le=1,
        description="Smallest fraction of the points of a vehicle that are not foliage; half of it "
        "suffices for a car-sized box",
    )
    split_band: float = Field(
        0.3,
        ge=0,
        description="Height above ground of the lowest band, which is left out to separate vehicles from "
        "hedges [m]",
    )
    split_gap: float = Field(
        0.3,
        gt=0,
        description="Edge of the cells, seen from above, in which points of one vehicle are connected [m]",
    )
    rows: RowConfig = RowConfig()
    edge: float = Field(
        0.3,
        ge=0,
        description="Distance from the box around the points of a vehicle up to which rough points are its "
        "edges [m]",
    )
    mobile_volume: float = Field(
        60.0,
        gt=0,
        description="Largest volume of the bounding box of a vehicle that is no truck [m3] (paper)",
    )
    mobile_min_width: float = Field(
        0.8, gt=0, description="Smallest width of a vehicle [m]; narrower objects are posts and fences"
    )
    overhang: float = Field(
        0.15,
        ge=0,
        description="Distance by which the top must project beyond the body for an object to be a shelter "
        "with eaves [m]",
    )
    top_band: float = Field(
        0.35,
        gt=0,
        description="Height of the uppermost band whose width is compared with the width of the body [m]",
    )
    car_top: float = Field(2.2, gt=0, description="Largest height above ground of a car [m]")
    car_body: float = Field(
        1.2,
        gt=0,
        description="Height above ground below which the points of a car show its body, seen from above [m]",
    )
    thinnest_car: float = Field(
        1.5, gt=0, description="Width from which a part of what looks like plants may be a car [m]"
    )
    car_hole: float = Field(
        1.1, ge=0, description="Largest gap between the points of a car, seen from above [m2]"
    )
    car_stray: float = Field(
        0.01,
        ge=0,
        lt=0.5,
        description="Fraction of the points on each side of a car that may belong to another object",
    )
    cabin_outline: float = Field(
        0.88,
        gt=0,
        le=1,
        description="Smallest area of the convex outline of a car that looks like a plant, as a fraction of "
        "the rectangle around it, seen from above",
    )
    cabin_fill: float = Field(
        0.75,
        gt=0,
        le=1,
        description="Smallest fraction of the rectangle around a car that looks like a plant in which it has "
        "points, seen from above; pieces of ghost trails have fewer",
    )
    cabin_share: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Area of the uppermost band of a car-sized plant, as a fraction of its whole area, below "
        "which the band is the roof of a car",
    )
    leafy: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of foliage points from which a vehicle candidate without clearance is a plant",
    )
    clear_gap: float = Field(
        0.4, gt=0, description="Edge of the voxels in which points of one vehicle candidate are connected [m]"
    )
    clear_reach: float = Field(
        0.8,
        gt=0,
        description="Distance around a vehicle candidate in which its clearance from other objects is "
        "measured [m]",
    )
    clear_cell: float = Field(
        0.25,
        gt=0,
        description="Edge of the cells in which the clearance around a vehicle candidate is counted [m]",
    )
    clear_height: float = Field(
        0.4,
        gt=0,
        description="Height above ground from which a point blocks a cell around a vehicle candidate [m]",
    )
    clear_share: float = Field(
        0.4,
        gt=0,
        le=1,
        description="Fraction of blocked cells around a candidate narrower than clear_width above which "
        "it is no vehicle",
    )
    clear_share_wide: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of blocked cells around a candidate at least clear_width wide above which "
        "it is no vehicle",
    )
    clear_width: float = Field(
        1.4, gt=0, description="Width from which a vehicle candidate is as wide as a car [m]"
    )
    slab_top: float = Field(
        1.25,
        gt=0,
        description="Height above ground below which a vehicle candidate may be a raised bed or a terrace "
        "[m]",
    )
    slab_level: float = Field(
        0.3,
        gt=0,
        le=1,
        description="Fraction of level points above which a low vehicle candidate is a raised bed or a "
        "terrace",
    )
    screen_upright: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Fraction of wall points in the upper half above which a box may be a set of fences",
    )
    screen_fill: float = Field(
        0.38, gt=0, le=1, description="Largest fraction of its bounding rectangle that a set of fences fills"
    )
    van_top: float = Field(
        1.9,
        gt=0,
        description="Height above ground from which two upright sides that are open between wheels are those "
        "of a van, not fences [m]",
    )
    side_hard: float = Field(
        0.7,
        gt=0,
        le=1,
        description="Smallest fraction of the points of the side of a car, seen alone, that are not foliage",
    )
    side_lean: float = Field(
        0.12,
        gt=0,
        description="Distance by which the windows of a car, seen from one side alone, lean inwards from its "
        "body [m]",
    )
    side_window: float = Field(
        0.75,
        gt=0,
        lt=1,
        description="Height from which the side of a car consists of windows, as a fraction of its height",
    )
