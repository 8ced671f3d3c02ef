"""Rules of the comparison of objects: occupancy, splitting and merging, buildings, moving objects."""

from __future__ import annotations

from subiaco_change.method_rules.switches import Rule

_HERE = ("comparison",)

OCCUPANCY_RULES: tuple[Rule, ...] = (
    Rule(
        "occupied_by_ground",
        _HERE,
        "A place beside ground of the other epoch at the same height is occupied: one epoch's low plant is"
        " the other's bank.",
        ("measures.foot", "method_numbers.voxel_objects.ground_neighbours"),
    ),
    Rule(
        "trails_do_not_stand",
        _HERE,
        "A ghost trail, recognised by beams, does not occupy its place in the other epoch.",
        ("method_numbers.voxel_objects.passes_per_return",),
        guards=True,
    ),
    Rule(
        "trails_occupy_what_they_touch",
        _HERE,
        "Loose points of traffic occupy what they touch: their spacing is not that of a sampled surface.",
        ("measures.same_low",),
    ),
    Rule(
        "porous_absence",
        _HERE,
        "A beam that crosses the place of a porous object proves less than one that crosses a wall.",
        ("method_numbers.absence.least_doubt",),
        guards=True,
    ),
    Rule(
        "view_height",
        _HERE,
        "What is higher than the view of the other survey reached is no new or lost surface of a plant whose"
        " top is not seen.",
        (
            "method_numbers.view_of_crowns.every_view",
            "method_numbers.view_of_crowns.beside_plant",
            "method_numbers.view_of_crowns.cut_depth",
            "method_numbers.view_of_crowns.cut_share",
            "method_numbers.view_of_crowns.goes_on_share",
        ),
        guards=True,
    ),
    Rule(
        "enclosed_volume",
        _HERE,
        "A building of one epoch alone is claimed only where it encloses a volume by the nearer bound: beams"
        " along a wall do not show what lies behind it.",
        ("decisions.least_volume",),
        guards=True,
    ),
    Rule(
        "probably_free",
        _HERE,
        "An object of one epoch is claimed only where the place was free in the other with a high"
        " probability.",
        ("decisions.min_free",),
        guards=True,
    ),
    Rule(
        "misclassified_ground",
        _HERE,
        "A low, level object of one epoch is ground with a wrong class, which is compared separately.",
        (
            "method_numbers.object_decision.flat_top",
            "method_numbers.object_decision.laid_top",
            "method_numbers.object_decision.level_normal",
        ),
        guards=True,
    ),
    Rule(
        "floating_scan_line",
        _HERE,
        "A flat line of points above the ground that touches nothing is a single scan line of something that"
        " passed: no object floats.",
        (
            "method_numbers.object_decision.floating",
            "method_numbers.object_decision.line_height",
            "method_numbers.object_decision.held",
        ),
        guards=True,
    ),
)

MOVING_OBJECT_RULES: tuple[Rule, ...] = (
    Rule(
        "trail_of_one_epoch",
        _HERE,
        "An object of one epoch that probably moved, or that many beams passed, is a ghost trail.",
        ("decisions.trail_moved", "decisions.trail_uncertain", "decisions.trail_passes"),
        guards=True,
    ),
    Rule(
        "strip_on_road",
        _HERE,
        "A strip of one epoch as wide as a vehicle and longer than one is a trail where the road beneath"
        " it was seen.",
        (
            "method_numbers.trail_shapes.strip_length",
            "method_numbers.trail_shapes.strip_width",
            "method_numbers.trail_shapes.road_beneath",
            "method_numbers.trail_shapes.trail_width",
        ),
        guards=True,
    ),
    Rule(
        "cabins_stand",
        _HERE,
        "A vehicle of one epoch with a bonnet and a cabin stood: in a cloud without counts of beams, neither"
        " its shape nor the ground beneath makes it a ghost trail.",
        ("semantics.vehicles.cabin_share",),
    ),
    Rule(
        "trail_in_pieces",
        _HERE,
        "Nothing is claimed of an object of one epoch in a row of pieces as wide as a vehicle and longer than"
        " one, on ground that was seen, in a cloud without counts of beams.",
        (
            "method_numbers.trail_in_pieces.beyond",
            "method_numbers.trail_in_pieces.gentle_bend",
            "method_numbers.trail_in_pieces.gap",
            "method_numbers.trail_in_pieces.half_width",
            "method_numbers.trail_in_pieces.rim_share",
            "method_numbers.trail_in_pieces.aside",
            "method_numbers.trail_in_pieces.fewest_points",
            "method_numbers.trail_in_pieces.taller",
            "method_numbers.trail_in_pieces.road",
            "method_numbers.trail_shapes.strip_length",
            "method_numbers.trail_shapes.strip_width",
        ),
        guards=True,
    ),
    Rule(
        "ground_shines_through",
        _HERE,
        "What neither fills its place nor hides the ground beneath is claimed with a low confidence, in a"
        " cloud without counts of beams: traffic was elsewhere while most beams came.",
        (
            "method_numbers.trail_shapes.opaque_points",
            "method_numbers.trail_shapes.ground_beneath",
        ),
        guards=True,
    ),
    Rule(
        "hides_no_ground",
        _HERE,
        "Nothing is claimed of what has few points and hides none of the ground beneath, in a cloud without"
        " counts of beams.",
        (
            "method_numbers.trail_shapes.opaque_points",
            "method_numbers.trail_shapes.ground_unhidden",
        ),
        guards=True,
    ),
    Rule(
        "shows_no_side",
        _HERE,
        "Nothing is claimed of what has fewer points than one of its sides would have, on ground that was"
        " seen, in a cloud without counts of beams.",
        (
            "method_numbers.trail_shapes.side_points",
            "method_numbers.trail_shapes.ground_shown",
        ),
        guards=True,
    ),
    Rule(
        "person_on_the_way",
        _HERE,
        "Nothing is claimed of a strip as thin and as tall as a person in a cloud without counts of beams.",
        (
            "method_numbers.trail_shapes.person_width",
            "method_numbers.trail_shapes.person_top",
            "method_numbers.trail_shapes.person_ground",
            "method_numbers.trail_shapes.walked_length",
        ),
        guards=True,
    ),
    Rule(
        "trail_in_lane",
        _HERE,
        "In a lane with a known ghost trail fewer passing beams make an object a ghost trail.",
        (
            "decisions.trail_passes_lane",
            "method_numbers.dynamic_objects.lane_reach",
            "method_numbers.dynamic_objects.lane_share",
        ),
        guards=True,
    ),
    Rule(
        "trail_seen_through",
        _HERE,
        "Of a high object that its own survey saw from both sides fewer passing beams make a ghost trail.",
        ("decisions.trail_passes_high", "decisions.trail_high", "decisions.trail_through"),
        guards=True,
    ),
    Rule(
        "higher_than_vehicles",
        _HERE,
        "What is higher than road vehicles did not move while it was mapped.",
        ("decisions.vehicle_top", "decisions.vehicle_above"),
        guards=True,
    ),
    Rule(
        "wider_than_vehicles",
        _HERE,
        "Where the times of beams tell nothing, walls farther apart than the sides of a vehicle stood still.",
        ("decisions.vehicle_width",),
    ),
    Rule(
        "claim_in_driven_lane",
        _HERE,
        "What one epoch alone holds in the lane that a survey vehicle drove through is seldom a lasting"
        " change.",
        (
            "decisions.lane_confidence",
            "method_numbers.driven_lane.half_width",
            "method_numbers.driven_lane.beyond",
            "method_numbers.driven_lane.share",
        ),
        guards=True,
    ),
    Rule(
        "stood_and_free",
        _HERE,
        "A change needs both that the object stood and that its place was free: the probabilities multiply.",
        guards=True,
    ),
    Rule(
        "lane_crossed_by_traffic",
        _HERE,
        "What one epoch alone holds in the lane of a survey vehicle is traffic where moving objects crossed"
        " most of its place.",
        (
            "method_numbers.driven_lane.crossed_share",
            "method_numbers.driven_lane.crossed_column",
            "method_numbers.driven_lane.crossed_probability",
        ),
        guards=True,
    ),
    Rule(
        "confidence_of_brief_objects",
        _HERE,
        "The confidence in an object of one epoch is at most the probability that the object stood still.",
        guards=True,
    ),
)

SPLITTING_RULES: tuple[Rule, ...] = (
    Rule(
        "parts_of_one_epoch",
        _HERE,
        "A part of an instance that stands on the ground in one epoch alone is an object of its own, which"
        " is never matched; parts of neighbouring instances that touch are one object.",
        (
            "association.parts.points",
            "association.parts.gap",
            "association.parts.length",
            "association.parts.foot",
            "association.parts.top",
            "association.parts.whole",
            "association.parts.remainder",
            "method_numbers.one_epoch_parts.far_share",
            "method_numbers.one_epoch_parts.vehicle_end",
            "method_numbers.one_epoch_parts.remains_inside",
        ),
    ),
    Rule(
        "hidden_trunks",
        _HERE,
        "A tree whose trunk parked cars or leaves hide is known by a top of its own: the trimmed side of a"
        " crown has none.",
        ("association.parts.hidden_foot", "method_numbers.felled_crowns.top_reach"),
    ),
    Rule(
        "remaining_object",
        _HERE,
        "The remainder of an instance may be a small fraction of the instance if the remainder is as large as"
        " an object.",
        ("method_numbers.one_epoch_parts.object_voxels",),
    ),
    Rule(
        "felled_crowns",
        _HERE,
        "A crown in whose place the other epoch, measured from above, met the ground with more beams than"
        " pass through standing crowns is an object of its own, which is never matched.",
        (
            "method_numbers.felled_crowns.tall",
            "method_numbers.felled_crowns.cleared",
            "method_numbers.felled_crowns.beside",
            "method_numbers.felled_crowns.grown",
            "method_numbers.felled_crowns.joined",
            "method_numbers.felled_crowns.neighbours",
            "method_numbers.felled_crowns.chance",
            "method_numbers.felled_crowns.fewest_points",
            "method_numbers.felled_crowns.top_reach",
        ),
    ),
    Rule(
        "trees_over_shrubs",
        _HERE,
        "A tree of one epoch over a shrub of both is an object of its own, which is never matched, where the"
        " other epoch has nothing higher than the shrub.",
        (
            "association.parts.top",
            "method_numbers.trees_over_shrubs.shrub_height",
            "method_numbers.trees_over_shrubs.tree_height",
            "method_numbers.trees_over_shrubs.times_higher",
            "method_numbers.trees_over_shrubs.top_quantile",
            "method_numbers.trees_over_shrubs.free_share",
            "method_numbers.trees_over_shrubs.observed_share",
            "method_numbers.trees_over_shrubs.view_share",
            "method_numbers.trees_over_shrubs.crown_width",
        ),
    ),
    Rule(
        "closed_vehicles",
        _HERE,
        "What lies inside a vehicle of the other epoch stands in both: beams through its windows do not show"
        " that its inside was free.",
        (
            "method_numbers.vehicle_bodies.width",
            "method_numbers.vehicle_bodies.length",
            "method_numbers.vehicle_bodies.top_share",
        ),
        guards=True,
    ),
    Rule(
        "places_seen_free",
        _HERE,
        "A place that beams of the other epoch crossed is free although points of that epoch lie near, unless"
        " they lie on a smooth surface that continues there.",
        (
            "method_numbers.places_seen_free.free_probability",
            "method_numbers.places_seen_free.neighbours",
            "method_numbers.places_seen_free.smooth_normals",
        ),
    ),
    Rule(
        "unseen_belongs_to_most",
        _HERE,
        "Space that the other survey did not see belongs to the part that is gone, where little is left.",
        ("method_numbers.one_epoch_parts.little_left",),
    ),
    Rule(
        "one_class_one_place",
        _HERE,
        "Objects of two epochs that mostly coincide have one class, that of the better score.",
        ("association.same_place",),
    ),
    Rule(
        "hardly_overlapping",
        _HERE,
        "Objects of a match that overlap too little to be compared are decided apart, and so are a house and"
        " the fence or container that is in its place in the other epoch. A house around the place of a"
        " smaller one, which it hides, is no house of its own.",
        (
            "decisions.building.min_iou",
            "decisions.vegetation.min_iou",
            "measures.carving.room",
            "method_numbers.split_merge.inside_share",
            "method_numbers.split_merge.least_observed",
            "method_numbers.split_merge.remains",
        ),
    ),
    Rule(
        "fixed_objects",
        _HERE,
        "An object of class other that is longer or taller than movable objects was not moved: it stayed, or"
        " one was removed, and another is new.",
        ("decisions.mobile.longest", "decisions.mobile.tallest"),
    ),
    Rule(
        "multi_body_matches",
        _HERE,
        "Bodies that one epoch holds apart are decided one by one where their labels differ.",
        ("association.apart", "association.stacked"),
    ),
    Rule(
        "row_houses_at_walls",
        _HERE,
        "A row of houses is split at the walls that either epoch shows, and where one of its houses was"
        " removed, is new, or was built upon or taken off, where its houses changed differently.",
        (
            "method_numbers.rows_of_houses.shared_columns",
            "method_numbers.rows_of_houses.house_front",
            "method_numbers.changed_houses.room_height",
            "method_numbers.changed_houses.foot_height",
            "method_numbers.changed_houses.changed_share",
            "method_numbers.changed_houses.clear_share",
            "method_numbers.changed_houses.gone_share",
            "method_numbers.changed_houses.left_columns",
            "method_numbers.changed_houses.quiet_quantile",
            "method_numbers.changed_houses.part_of_usual",
            "method_numbers.changed_houses.sudden_step",
            "method_numbers.changed_houses.least_top",
            "method_numbers.changed_houses.garage_height",
            "method_numbers.changed_houses.houses_of_row",
            "method_numbers.changed_houses.half_of_pair",
            "method_numbers.changed_houses.pair_front",
            "method_numbers.changed_houses.narrow_front",
            "method_numbers.changed_houses.end_front",
            "method_numbers.changed_houses.wall_reach",
            "method_numbers.changed_houses.same_top",
            "method_numbers.changed_houses.tall_top",
            "method_numbers.changed_houses.tall_half",
            "method_numbers.changed_houses.neighbour_share",
            "method_numbers.changed_houses.across_row",
        ),
    ),
    Rule(
        "parts_of_long_buildings",
        _HERE,
        "The part of a long building along which one survey alone has surfaces that the other would have met"
        " is an object of its own: a house of a row was reshaped or has a wing.",
        (
            "method_numbers.changed_houses.confirmed_voxels",
            "method_numbers.changed_houses.confirmed_gap",
            "method_numbers.changed_houses.part_depth",
            "method_numbers.changed_houses.rest_share",
            "method_numbers.changed_houses.rest_length",
        ),
    ),
    Rule(
        "standing_trunks",
        _HERE,
        "A tree of one epoch over a trunk that both epochs have was cut down to the trunk, or grew from it.",
        (
            "method_numbers.standing_trunks.width",
            "method_numbers.standing_trunks.foot",
            "method_numbers.standing_trunks.least_top",
            "method_numbers.standing_trunks.crown",
            "method_numbers.standing_trunks.reach",
        ),
    ),
    Rule(
        "hedge_sections",
        _HERE,
        "A section of a hedge whose tops moved is a row of its own.",
        (
            "method_numbers.hedge_sections.section_columns",
            "method_numbers.hedge_sections.section_length",
            "method_numbers.hedge_sections.observed_share",
        ),
    ),
    Rule(
        "space_above_sections",
        _HERE,
        "A section of a hedge moved only where the epoch with the lower tops observed free space above them.",
        ("plants.tops.above", "plants.tops.free", "method_numbers.hedge_sections.observed_share"),
        guards=True,
    ),
    Rule(
        "fences_by_tops",
        _HERE,
        "A section of a fence, wall or other fixed object whose tops moved grew or shrank.",
        ("decisions.mobile.height",),
    ),
    Rule(
        "whole_hedges",
        _HERE,
        "A hedge of which nearly all columns moved alike is one row.",
        ("method_numbers.split_merge.whole_share",),
    ),
    Rule(
        "building_extensions",
        _HERE,
        "A part that touches a building and exists in one epoch alone is an extension of the building; a"
        " house that touches the garage of the building alone is none.",
        (
            "association.parts.touch",
            "association.parts.subordinate",
            "method_numbers.changed_houses.garage_height",
            "method_numbers.changed_houses.least_top",
        ),
    ),
    Rule(
        "smooth_extensions",
        _HERE,
        "A smooth part taller than a car, with the faces of a rectangle, may be an extension although it"
        " passed for a vehicle or a plant.",
        (
            "method_numbers.building_extensions.car_height",
            "method_numbers.building_extensions.normal_neighbours",
            "method_numbers.building_extensions.smoothness",
            "method_numbers.building_extensions.facing",
            "method_numbers.building_extensions.sloped",
        ),
    ),
    Rule(
        "layers_before_walls",
        _HERE,
        "An object close before a wall that both surveys saw hides no wall: scaffolding and awnings are no"
        " volume of a building, and no extension.",
        (
            "method_numbers.layers.depth",
            "method_numbers.layers.front",
            "method_numbers.layers.ahead",
            "method_numbers.layers.wall_normal",
            "method_numbers.layers.nearest_walls",
            "method_numbers.layers.share",
        ),
    ),
    Rule(
        "gap_beside_house",
        _HERE,
        "A building with an open gap to its neighbour, or that hangs on it by something smaller than itself,"
        " is no extension of the neighbour.",
        (
            "method_numbers.building_extensions.joint",
            "method_numbers.space_carving.roof_normal",
            "method_numbers.building_extensions.open_gap",
            "method_numbers.building_extensions.fence_height",
            "method_numbers.building_extensions.foot",
        ),
    ),
    Rule(
        "storeys_set_back",
        _HERE,
        "A building that begins above a room and lies over another one is a storey of it, set back from its"
        " walls.",
        (
            "method_numbers.roof_structures.lowest",
            "method_numbers.roof_structures.foot_quantile",
            "method_numbers.roof_structures.share",
        ),
    ),
    Rule(
        "part_between_buildings",
        _HERE,
        "A part that touches a second building too is no extension of either.",
        ("method_numbers.building_extensions.second_contact",),
    ),
    Rule(
        "part_as_large_as_building",
        _HERE,
        "A part as large as its building is the building itself where the building's walls stand inside it.",
        ("method_numbers.building_extensions.host_inside", "method_numbers.building_extensions.party_wall"),
    ),
    Rule(
        "crown_beside_building",
        _HERE,
        "A part that begins high above the ground beside a building is a crown, not an extension.",
        ("method_numbers.building_extensions.underside",),
    ),
    Rule(
        "open_roofs",
        _HERE,
        "A roof on posts, with the ground seen below it, is a carport or a pergola: no extension of the"
        " building beside it, and claimed although it encloses nothing.",
        (
            "method_numbers.building_extensions.roof_band",
            "method_numbers.building_extensions.roof_share",
            "method_numbers.building_extensions.bare_share",
        ),
    ),
    Rule(
        "hidden_walls",
        _HERE,
        "A wall within the outline of a changed building that the other epoch hardly saw joins its row.",
        (
            "method_numbers.split_merge.wall_reach",
            "method_numbers.split_merge.inside_share",
            "method_numbers.split_merge.least_observed",
        ),
    ),
    Rule(
        "hanging_parts",
        _HERE,
        "What begins high above the ground over a building joins its row: a chimney, a dormer, a ceiling seen"
        " through a window.",
        (
            "method_numbers.roof_structures.cell",
            "method_numbers.roof_structures.lowest",
            "method_numbers.roof_structures.share",
        ),
    ),
)

BUILDING_RULES: tuple[Rule, ...] = (
    Rule(
        "sign_certain",
        _HERE,
        "The change of a building is claimed only where the nearer bound of its interval lies on the same"
        " side.",
        ("decisions.building.certain",),
        guards=True,
    ),
    Rule(
        "sign_by_surface",
        _HERE,
        "Walls of one epoch alone, whose place the other saw free on both sides, tell the sign of a"
        " change of volume: its nearer bound may then be as small as zero.",
        ("decisions.building.sign_surface", "decisions.building.sign_depth"),
    ),
    Rule(
        "unseen_opposes_nothing",
        _HERE,
        "Where one survey did not look a building may have grown, or shrunk; that is no evidence against the"
        " opposite change that was seen.",
    ),
    Rule(
        "volume_supports_height",
        _HERE,
        "A change of height of a building needs volume, or new or former walls, that carry the change, and a"
        " change of volume whose middle is not the opposite.",
        (
            "decisions.building.height_volume",
            "decisions.building.height_surface",
            "method_numbers.rules.opposed_height",
        ),
    ),
    Rule(
        "surface_of_both_epochs",
        _HERE,
        "A surface of the other epoch that an epoch has too, sampled elsewhere, counts as its own.",
    ),
    Rule(
        "surfaces_not_refuted",
        _HERE,
        "A surface that one epoch has above those of the other may have stood in both, unless most of its"
        " places were seen free: beams along a wall cross the wall's columns in front of it.",
        ("method_numbers.space_carving.observed_share", "method_numbers.space_carving.free_share"),
        guards=True,
    ),
    Rule(
        "cells_beside_surfaces",
        _HERE,
        "A cell beside a surface is not asked whether it is free: beams pass between the voxels of a wall.",
        ("method_numbers.space_carving.roof_normal",),
    ),
    Rule(
        "behind_new_walls",
        _HERE,
        "Space behind two walls of one epoch that the other lacks is solid.",
        ("measures.carving.room",),
    ),
    Rule(
        "inside_of_buildings",
        _HERE,
        "What is free between walls on all sides is the inside of a building, seen through its windows;"
        " between walls on three sides it makes no yard where the fourth was not seen to be open.",
        ("method_numbers.space_carving.room_sides",),
    ),
    Rule(
        "thin_volumes",
        _HERE,
        "A change of volume thinner than two cells is noise of surfaces.",
        ("measures.carving.thickness",),
    ),
    Rule(
        "lines_of_cells",
        _HERE,
        "What a survey does not know is counted where it adjoins a changed patch, not along a line of cells.",
        ("measures.carving.thickness",),
    ),
    Rule(
        "supported_volumes",
        _HERE,
        "A changed volume needs voxels of changed surface, whose place the other epoch observed.",
        ("measures.carving.support",),
    ),
    Rule(
        "capped_columns",
        _HERE,
        "The height rests on the columns with free space above their top, where these are many.",
        ("measures.carving.capped", "method_numbers.space_carving.fewest_columns"),
    ),
    Rule(
        "thin_changes",
        _HERE,
        "A roof of which most columns rose or fell together by less than what is carved changed its volume.",
        (
            "measures.carving.thickness",
            "measures.carving.known_top",
            "measures.carving.known_area",
            "method_numbers.space_carving.moved_share",
        ),
    ),
    Rule(
        "known_tops",
        _HERE,
        "The height rests on the columns whose tops both epochs know, where these are the highest ones.",
        (
            "measures.carving.known_top",
            "measures.carving.known_area",
            "method_numbers.space_carving.changed_columns",
        ),
    ),
    Rule(
        "roof_gap",
        _HERE,
        "The highest seen surface is the top of a column where free space begins soon above it.",
        ("measures.carving.roof_gap",),
    ),
    Rule(
        "unseen_tops",
        _HERE,
        "Tops of columns that no survey saw are interpolated along the walls before volumes are shared.",
    ),
)
