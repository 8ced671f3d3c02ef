"""Rules of the segmentation: ground, classes, objects, ghost trails by shape."""

from __future__ import annotations

from subiaco_change.method_rules.switches import Rule

_HERE = ("segmentation",)

SEGMENTATION_RULES: tuple[Rule, ...] = (
    Rule(
        "raised_surfaces",
        _HERE,
        "A roof or deck wider than the window of the ground filter is recognised by its edge: only what is"
        " built ends in a drop on nearly every side.",
        ("semantics.raised.area", "semantics.raised.drop", "semantics.raised.share"),
    ),
    Rule(
        "low_outliers",
        _HERE,
        "A cell far below all cells around it is a reflection, not ground.",
        ("semantics.ground.low_outlier", "semantics.ground.low_reach"),
    ),
    Rule(
        "continued_ground",
        _HERE,
        "A surface that the opening removed returns to the ground where most of its border continues the"
        " ground without a step: banks and terraces.",
        (
            "semantics.ground.run_step",
            "semantics.ground.run_slope",
            "semantics.ground.run_reach",
            "semantics.ground.run_area",
            "semantics.ground.run_share",
        ),
    ),
    Rule(
        "foot_of_wall",
        _HERE,
        "A cell with as many points in the next metre as near its lowest point is the foot of a wall and does"
        " not move the ground height.",
    ),
    Rule(
        "raised_ground",
        _HERE,
        "What is level, smooth and wide, and some decimetres above the ground beside it, is raised ground.",
        (
            "method_numbers.raised_ground.heights",
            "method_numbers.raised_ground.level",
            "method_numbers.raised_ground.roughness",
            "method_numbers.raised_ground.width",
            "method_numbers.raised_ground.area",
            "method_numbers.raised_ground.same_level",
        ),
    ),
    Rule(
        "rough_foot",
        _HERE,
        "Rough points just above the ground model belong to the foot of an object, not to the ground.",
        ("semantics.foot_roughness", "semantics.foot_height"),
    ),
    Rule(
        "sparse_foliage",
        _HERE,
        "Where points are sparse, foliage scatters less, and a lower limit applies.",
        ("semantics.sparse_scatter", "semantics.sparse_reach"),
    ),
    Rule(
        "trails_by_counts",
        _HERE,
        "In a map with counts of beams and without their times, a place that many beams passed for each that"
        " returned was occupied by a moving object, unless it is the edge of a standing one, or of a tree.",
        (
            "semantics.traffic.ratio",
            "semantics.traffic.spread_ratio",
            "semantics.traffic.core_share",
            "semantics.traffic.clear_share",
            "semantics.traffic.edge_length",
        ),
        guards=True,
    ),
    Rule(
        "still_blocks",
        _HERE,
        "A block of planar patches of which most points did not move is a building, although beams graze it.",
        ("semantics.traffic.block_share",),
        guards=True,
    ),
    Rule(
        "parked_beside_trails",
        _HERE,
        "In a row of parked vehicles each line of cells along the street ends at both ends of a vehicle, or"
        " the vehicle hides the ground; that of a trail goes on, over ground that was seen.",
        (
            "method_numbers.trail_swaths.shortest_parked",
            "method_numbers.trail_swaths.longest_parked",
            "method_numbers.trail_swaths.narrowest_parked",
        ),
    ),
    Rule(
        "trails_by_shape",
        _HERE,
        "In a cloud without beams, a swath as wide as a vehicle, many times as long and filled from side to"
        " side, on ground that was seen, with little just above it, is a ghost trail.",
        ("semantics.trail_shape.body_top", "semantics.trail_shape.foot"),
        guards=True,
    ),
    Rule(
        "trail_edges",
        _HERE,
        "Ragged edges beside a ghost trail belong to the trail.",
        ("semantics.trail_shape.edge", "semantics.trail_shape.edge_share"),
        guards=True,
    ),
    Rule(
        "trail_pieces",
        _HERE,
        "Small pieces in line with a known ghost trail continue the trail.",
        (
            "semantics.trail_shape.piece",
            "semantics.trail_shape.piece_length",
            "semantics.trail_shape.piece_gap",
            "semantics.trail_shape.piece_aside",
        ),
        guards=True,
    ),
    Rule(
        "thin_trails",
        _HERE,
        "Thin swaths on open ground, thicker than fences, are ghost trails of cyclists and people on foot.",
        ("semantics.trail_shape.thin_length", "semantics.trail_shape.thin_top"),
        guards=True,
    ),
    Rule(
        "wires",
        _HERE,
        "High, long, level and thin lines are wires, not foliage.",
        ("semantics.lines.wire_height", "semantics.lines.wire_length", "semantics.lines.wire_thick"),
    ),
    Rule(
        "poles",
        _HERE,
        "Upright, straight lines that stand clear over most of their length are poles, not trunks.",
        ("semantics.lines.pole_length", "semantics.lines.pole_clear", "semantics.lines.pole_straight"),
    ),
    Rule(
        "thin_runs",
        _HERE,
        "High, smooth and long runs of hard points are wires, not parts of the crowns around them.",
        ("semantics.buildings.wire_roughness", "semantics.buildings.wire_touch"),
    ),
    Rule(
        "wire_patches",
        _HERE,
        "A linear planar patch that hangs level or is narrow is a bundle of wires, not a roof.",
        (
            "semantics.buildings.wire_linearity",
            "semantics.buildings.wire_level",
            "semantics.buildings.wire_inner",
            "semantics.buildings.wire_rise",
        ),
    ),
    Rule(
        "palm_fronds",
        _HERE,
        "A rough, bent and linear patch high above the ground consists of palm fronds, not of a roof.",
        ("semantics.buildings.frond_linearity", "semantics.buildings.frond_bend"),
    ),
    Rule(
        "leafy_slopes",
        _HERE,
        "A rough, inclined patch far from its plane is foliage, not a roof: real crowns need this.",
        ("semantics.buildings.leafy_bend",),
    ),
    Rule(
        "leafy_patches",
        _HERE,
        "A small planar patch of scattered points is the side of a hedge, not a wall.",
        ("semantics.buildings.leafy_scatter", "semantics.buildings.leafy_area"),
    ),
    Rule(
        "rough_eaves",
        _HERE,
        "A wall may end below the height of a facade where rough eaves continue above the wall.",
        ("semantics.buildings.eaves",),
    ),
    Rule(
        "facade_parts",
        _HERE,
        "A small planar patch near a facade or roof is a part of the building.",
        ("semantics.buildings.part_area",),
    ),
    Rule(
        "thick_walls",
        _HERE,
        "A wall that a bent map holds as several sheets is too rough for a planar patch and is found in"
        " larger cells.",
        (
            "semantics.buildings.thick_cell",
            "semantics.buildings.thick_roughness",
            "semantics.buildings.thick_offset",
            "semantics.buildings.thick_area",
        ),
        guards=True,
    ),
    Rule(
        "roof_structures",
        _HERE,
        "What begins high above the ground over a building, and is as high as its roof, is a part of it: a"
        " chimney, a dormer, a set-back storey.",
        (
            "method_numbers.roof_structures.cell",
            "method_numbers.roof_structures.lowest",
            "method_numbers.roof_structures.share",
            "method_numbers.roof_structures.foot_quantile",
        ),
    ),
    Rule(
        "building_interiors",
        _HERE,
        "What lies behind a wall of a building as seen from everywhere on the survey path was seen through"
        " windows: it is a part of the building, and no plant.",
        (
            "method_numbers.building_interiors.cell",
            "method_numbers.building_interiors.sight",
            "method_numbers.building_interiors.sensor_step",
            "method_numbers.building_interiors.before_point",
            "method_numbers.building_interiors.deepest",
            "method_numbers.building_interiors.close",
            "method_numbers.building_interiors.hidden",
            "method_numbers.building_interiors.lowest_wall",
            "method_numbers.building_interiors.opening",
            "method_numbers.point_labels.interior_reach",
        ),
    ),
    Rule(
        "objects_under_roofs",
        _HERE,
        "An object below a roof with clearance above it is no part of the building: a car under a carport.",
        (
            "semantics.buildings.under_gap",
            "semantics.buildings.under_share",
            "semantics.buildings.under_points",
        ),
    ),
    Rule(
        "large_vehicles",
        _HERE,
        "A free-standing box as large as a truck, with two sides seen, is a vehicle or a shelter, not a"
        " building.",
        ("semantics.vehicles.truck_length", "semantics.vehicles.truck_width", "semantics.vehicles.truck_top"),
    ),
    Rule(
        "eaves_of_shelters",
        _HERE,
        "A box whose top stands out over its body is a shelter: vehicles narrow upwards.",
        ("semantics.vehicles.overhang", "semantics.vehicles.top_band"),
    ),
    Rule(
        "cabins",
        _HERE,
        "A plant of the size of a car that fills the rectangle around it and has a smaller roof is a car;"
        " objects that touch the car are thinner than the car.",
        (
            "semantics.vehicles.thinnest_car",
            "semantics.vehicles.cabin_outline",
            "semantics.vehicles.cabin_fill",
            "semantics.vehicles.cabin_share",
        ),
    ),
    Rule(
        "edges_of_vehicles",
        _HERE,
        "Rough points in the box around the smooth points of a vehicle are its edges, not leaves.",
        ("semantics.vehicles.edge",),
    ),
    Rule(
        "screens",
        _HERE,
        "An upright outline that hardly fills its rectangle and reaches the ground is a fence, no vehicle.",
        ("semantics.vehicles.screen_upright", "semantics.vehicles.screen_fill", "semantics.vehicles.wheels"),
    ),
    Rule(
        "one_sided_cars",
        _HERE,
        "A thin smooth thing as long as a car whose upper part leans inwards is the side of a car.",
        (
            "semantics.vehicles.side_hard",
            "semantics.vehicles.side_lean",
            "semantics.vehicles.side_window",
        ),
    ),
    Rule(
        "slabs",
        _HERE,
        "A low object that is mostly level is a raised bed, not a vehicle.",
        ("semantics.vehicles.slab_top", "semantics.vehicles.slab_level"),
    ),
    Rule(
        "clearance_of_vehicles",
        _HERE,
        "A vehicle has clearance around it; a candidate without clearance takes the class of its"
        " surroundings.",
        (
            "semantics.vehicles.clear_share",
            "semantics.vehicles.clear_share_wide",
            "semantics.vehicles.clear_width",
            "semantics.vehicles.clear_reach",
        ),
    ),
    Rule(
        "walls_beside_plants",
        _HERE,
        "A smooth upright plane that ends below a facade is a wall or a fence, also among plants.",
        ("semantics.buildings.part_area", "semantics.buildings.facade_slope"),
    ),
    Rule(
        "tiny_clusters",
        _HERE,
        "A low and narrow cluster is class other, because its features resemble foliage at any shape.",
        ("semantics.tiny_width", "semantics.tiny_top"),
    ),
    Rule(
        "row_houses_by_steps",
        _HERE,
        "A row of houses is split where its top height steps from one level stretch to another.",
        ("instances.terraces.step", "instances.terraces.width", "instances.terraces.level"),
    ),
    Rule(
        "passages",
        _HERE,
        "Houses are split at a passage between them: a gap in which the ground was seen.",
        ("instances.passages.length", "instances.passages.widest", "instances.passages.ground"),
    ),
    Rule(
        "row_houses_by_dips",
        _HERE,
        "Houses that a carport or gate joins are split where that is lowest.",
        ("instances.terraces.lowest",),
    ),
    Rule(
        "steps_in_depth",
        _HERE,
        "A step between row houses must show in the rows that both of its sides show, not in one roof alone.",
    ),
    Rule(
        "hedges_by_steps",
        _HERE,
        "Low, long foliage is split where one clipped top ends and another begins.",
        ("instances.hedges.step", "instances.hedge_top", "instances.hedge_slender"),
    ),
    Rule(
        "crowns_by_trunks",
        _HERE,
        "Two basins of a canopy that stand on a trunk each are two trees, however shallow the dip between.",
        ("instances.trunk_top", "instances.trunk_width"),
    ),
    Rule(
        "parked_rows",
        _HERE,
        "A cluster too large for a car is split into cars at the gaps that run through it.",
        ("instances.rows.gap", "instances.rows.length", "instances.rows.width", "instances.rows.car_length"),
    ),
)
