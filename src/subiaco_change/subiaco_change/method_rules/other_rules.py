"""Rules of plants, of the ground and of single points."""

from __future__ import annotations

from subiaco_change.method_rules.switches import Rule

_PLANTS = ("comparison", "plants")
_GROUND = ("ground",)
_POINTS = ("labels",)

PLANT_RULES: tuple[Rule, ...] = (
    Rule(
        "equal_density",
        ("comparison",),
        "The denser epoch of a plant is thinned to the density of the other before outlines are compared.",
        ("plants.voxel", "plants.shared"),
        guards=True,
    ),
    Rule(
        "unchanged_plants_of_the_pair",
        ("plants",),
        "A plant is judged against what the unchanged plants of the same pair differ by (Decision 18).",
        ("plants.null_model.plants", "plants.null_model.certain", "plants.null_model.slope"),
        guards=True,
    ),
    Rule(
        "leaves_of_the_pair",
        _PLANTS,
        "The surface and the volume of a plant changed by more than those of nearly all plants of the pair"
        " that kept their extent.",
        ("method_numbers.vegetation_null.stayed", "method_numbers.vegetation_null.most_of_leaves"),
        guards=True,
    ),
    Rule(
        "own_error_of_plants",
        _PLANTS,
        "A plant of few voxels scatters by its own count, however little the plants of the pair scatter.",
        guards=True,
    ),
    Rule(
        "tops_of_columns",
        ("comparison",),
        "The tops of its columns, at equal point density, tell how a plant grew; voxels do not resolve that.",
        (
            "plants.tops.cell",
            "plants.tops.points",
            "plants.tops.upper",
            "plants.tops.patch",
            "plants.tops.part",
        ),
    ),
    Rule(
        "tops_of_tall_plants",
        _PLANTS,
        "The top of a tall plant must change by a share of its height: beams meet a high top from afar, with"
        " wide gaps between them.",
        ("decisions.vegetation.height_share",),
    ),
    Rule(
        "volume_of_hedges",
        _PLANTS,
        "The tops of a hedge tell its volume: a rise by the share of its height that is a change of volume is"
        " one, where the pair's hedges do not scatter as much.",
        ("decisions.vegetation.volume",),
    ),
    Rule(
        "space_above_tops",
        ("comparison",),
        "The tops of a plant count where the epoch with the lower top observed free space above that top.",
        ("plants.tops.known", "plants.tops.above", "plants.tops.free"),
        guards=True,
    ),
    Rule(
        "common_view_of_crowns",
        ("comparison",),
        "The tops of a column are compared from points above the lowest of both epochs: of a crown behind a "
        "house, one survey saw the top alone, and all of its points lie high.",
        guards=True,
    ),
    Rule(
        "unseen_tops_of_plants",
        _PLANTS,
        "Where the epochs share columns of a plant, but did not observe the space above them, the highest"
        " voxels do not tell how its top changed, nor do those of a piece of a hedge.",
        ("plants.tops.known",),
        guards=True,
    ),
    Rule(
        "outline_of_plants",
        _PLANTS,
        "The median outline of a crown is compared before its top, volume and surface.",
        ("decisions.vegetation.outline",),
    ),
    Rule(
        "extent_carries_surface",
        _PLANTS,
        "New or lost surface of a plant whose tops, outline and base stayed, and of which no side is missing,"
        " is a matter of leaves.",
        (
            "decisions.vegetation.followed",
            "decisions.vegetation.base",
            "decisions.vegetation.side",
            "plants.base_columns",
            "plants.base_clearance",
            "plants.side_depth",
            "plants.side_adjoins",
            "plants.one_sided",
        ),
        guards=True,
    ),
    Rule(
        "surface_carries_change",
        _PLANTS,
        "A change of the top or volume of a plant needs new or lost surface that carries the change.",
        ("decisions.vegetation.min_net_change",),
        guards=True,
    ),
    Rule(
        "surface_was_free",
        _PLANTS,
        "A plant changed only where the place of its new or lost surface was free in the other survey.",
        ("decisions.min_free_surface",),
        guards=True,
    ),
)

GROUND_RULES: tuple[Rule, ...] = (
    Rule(
        "bridged_cells",
        _GROUND,
        "An empty cell takes the height of its neighbours relative to a smooth surface through both epochs.",
        ("ground.bridge",),
    ),
    Rule(
        "closed_gaps",
        _GROUND,
        "Occluded gaps between changed cells are filled and count towards the area.",
        ("ground.closing",),
    ),
    Rule(
        "half_height_edge",
        _GROUND,
        "The edge of a changed patch lies where half of its height is reached.",
    ),
    Rule(
        "pit_walls",
        _GROUND,
        "Points under the other epoch's ground are the wall of a pit, whose near edge hides its floor.",
        tuple(
            f"method_numbers.ground_cells.{name}"
            for name in ("wall_points", "wall_share", "wall_top", "wall_depth", "floor_reach", "dense_share")
        ),
    ),
    Rule(
        "seen_below_ground",
        _GROUND,
        "Where counted beams went on half a metre below the ground of the other epoch, and no ground was met,"
        " lies the hidden floor of a pit.",
        ("method_numbers.ground_cells.seen_below",),
    ),
    Rule(
        "possible_area",
        _GROUND,
        "Occluded cells around a patch count towards its area.",
    ),
    Rule(
        "deep_patches",
        _GROUND,
        "A patch below the limit of area is reported where it moved as much ground as the smallest patch"
        " above that limit.",
        ("ground.small_area",),
    ),
    Rule(
        "measured_patches",
        _GROUND,
        "A patch is claimed only where both epochs measured enough of its cells.",
        ("ground.measured_share",),
        guards=True,
    ),
    Rule(
        "coinciding_ground",
        _GROUND,
        "Ground of one epoch that coincides with points of the other, of any class, did not move.",
        ("ground.same_surface", "ground.same_share"),
        guards=True,
    ),
    Rule(
        "other_surface",
        _GROUND,
        "Ground did not move where the other epoch holds the same surface under another class.",
        ("ground.same_surface", "ground.same_beside", "ground.same_above", "ground.same_share"),
        guards=True,
    ),
    Rule(
        "ground_of_moving_objects",
        _GROUND,
        "Low parts of a moving object that pass for ground are left out.",
        guards=True,
    ),
    Rule(
        "level_of_patches",
        _GROUND,
        "The noise of single points averages out over a patch; what the ground around has in common stays.",
        (
            "method_numbers.ground_change.noise_reach",
            "method_numbers.ground_change.noise_block",
            "method_numbers.ground_change.lod_cells",
        ),
    ),
    Rule(
        "noise_around_patches",
        _GROUND,
        "The level of detection of a thinly seen patch is at least the scatter of the blocks around it.",
        ("method_numbers.ground_change.noise_reach", "method_numbers.ground_change.noise_block"),
        guards=True,
    ),
)

POINT_RULES: tuple[Rule, ...] = (
    Rule(
        "ground_between_rings",
        _POINTS,
        "Ground with points of the other epoch on three of its four sides was seen by that epoch.",
        ("evidence.ground_between", "method_numbers.point_labels.surrounding_points"),
    ),
    Rule(
        "points_of_no_object",
        _POINTS,
        "Points too few for an object are Unchanged only where the other epoch holds points too. Elsewhere"
        " they belong to the changed object that they touch: the eaves of a removed house were removed too.",
        ("measures.voxel",),
    ),
)
