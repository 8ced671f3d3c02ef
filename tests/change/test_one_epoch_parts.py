"""Parts of an instance that stand in one epoch alone, and wings that belong to a building."""

from dataclasses import replace

import numpy as np
import pytest
from test_measures import block, voxels, walls

from subiaco_change.association.config import AssociationConfig, PartConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.object_decision import (
    ObjectRules,
    decide_floating_line,
    decide_misclassified_ground,
    decide_object,
)
from subiaco_change.decisions.split_merge import (
    join_building_extensions,
    part_hardly_overlapping,
    split_multi_body_matches,
    split_row_houses,
    unify_classes,
)
from subiaco_change.instance_splitting.building_extensions import (
    find_building_extensions,
    is_smooth_surface,
    rectangularity,
)
from subiaco_change.instance_splitting.merged_instances import split_by_bodies
from subiaco_change.instance_splitting.one_epoch_parts import split_one_epoch_parts
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.column_volumes import NO_COLUMNS, OpenGround, ground_columns
from subiaco_change.objects.measures import MeasureConfig, Measures
from subiaco_change.objects.voxel_objects import ObjectInstance, Voxels
from subiaco_geo.codes import Change, Semantic

CONFIG = PartConfig()
CROSSED = Measures(
    iou=0.0, d_perp=0.0, delta_c=0.0, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=1.0,
    gone_share=0.0, new_share=1.0, observed_fraction=1.0, observed_voxels=50, net_changed_fraction=2.0,
)  # fmt: skip


def obj(pieces, instance=3):
    """An instance of (voxel places, whether the other epoch holds them), four points a voxel."""
    xyz = np.concatenate([np.asarray(p, dtype=float) for p, _ in pieces])
    occupied_in_other = np.concatenate([np.full(len(p), flag) for p, flag in pieces])
    made = voxels(xyz, instance)
    held = Voxels(
        *(
            getattr(made, n) if n != "occupied_in_other" else occupied_in_other
            for n in Voxels.__dataclass_fields__
        )
    )
    points = np.repeat(xyz, 4, axis=0)
    return ObjectInstance(instance, Semantic.VEGETATION, 0.8, np.arange(len(points)), held, 0.03, points)


def test_a_new_hedge_that_touches_an_old_one_is_an_object_of_its_own():
    old, new = block((0, 0, 0), (5, 1, 1.5)), block((5, 0, 0), (8, 1, 1.5))
    parts = split_one_epoch_parts([obj([(old, True), (new, False)])], CONFIG)
    assert [p.instance for p in parts] == [3, 4]
    assert [len(p.voxels) for p in parts] == [len(old), len(new)]
    assert sorted(np.concatenate([p.points for p in parts])) == list(range(4 * (len(old) + len(new))))
    assert parts[1].xyz[:, 0].min() > 5


def test_the_top_of_a_grown_hedge_stays_with_it():
    old, top = block((0, 0, 0), (5, 1, 1.5)), block((0, 0, 1.5), (5, 1, 3.0))
    assert len(split_one_epoch_parts([obj([(old, True), (top, False)])], CONFIG)) == 1


def test_a_shell_around_a_crown_stays_with_it():
    crown = block((-2, -2, 3), (2, 2, 6))
    shell = block((-3, -3, 3), (3, 3, 6))
    shell = shell[(abs(shell[:, :2]) > 2).any(axis=1)]
    assert len(split_one_epoch_parts([obj([(crown, True), (shell, False)])], CONFIG)) == 1


def test_an_object_that_stands_in_one_epoch_alone_is_not_parted():
    whole = obj([(block((0, 0, 0), (5, 1, 1.5)), False)])
    rest = obj([(block((0, 0, 0), (5, 1, 1.5)), False), (block((5, 0, 0), (5.5, 0.5, 0.5)), True)])
    for single in (whole, rest):
        assert split_one_epoch_parts([single], CONFIG) == [single]


@pytest.mark.parametrize(
    ("end", "top", "parts"),
    [(8, 6.0, 2), (8, 4.0, 2), (5.5, 4.0, 1)],
    ids=["a tree", "a lower tree", "the side of a crown"],
)
def test_a_crown_that_touches_another_is_a_tree_if_it_has_a_top_of_its_own(end, top, parts):
    """Parked cars hide both trunks up to 1.5 m."""
    standing = block((0, 0, 1.5), (4, 4, 5))
    beside = block((4, 0, 1.5), (end, 4, top))
    made = obj([(standing, True), (beside, False)])
    assert len(split_one_epoch_parts([made], CONFIG)) == parts
    with rules_switched_off(["hidden_trunks"]):
        assert len(split_one_epoch_parts([made], CONFIG)) == 1


@pytest.mark.parametrize(
    ("end", "top", "joined"), [(8, 7.0, True), (5.5, 4.0, False)], ids=["a tree", "the side of a crown"]
)
def test_a_felled_tree_is_one_object_with_its_trunk_though_leaves_hid_what_joins_both(end, top, joined):
    """Its crown touches that of a tree that still stands. A bin below a trimmed crown is no trunk."""
    standing, crown = block((0, 0, 1.5), (4, 4, 5)), block((4, 0, 3.0), (end, 4, top))
    below = block((4.5, 1, 0), (5.5, 2, 1.5))
    made = obj([(standing, True), (crown, False), (below, False)])
    rest, *parts = split_one_epoch_parts([made], CONFIG)
    assert [len(p.voxels) for p in parts] == [len(below) + (len(crown) if joined else 0)]
    assert len(rest.voxels) == len(standing) + (0 if joined else len(crown))


@pytest.mark.parametrize(("left", "parts"), [(3.0, 2), (0.5, 1)], ids=["a garage", "a gate post"])
def test_what_is_left_of_a_house_is_an_object_however_large_the_house_was(left, parts):
    house, garage = walls(25, 20, 8), np.add(walls(left, left, 2.5), (25, 0, 0))
    assert len(garage) < CONFIG.remainder * len(house)
    assert len(split_one_epoch_parts([obj([(house, False), (garage, True)])], CONFIG)) == parts


def test_a_bin_under_a_crown_is_an_object_of_its_own():
    crown, trunk, bin_ = (
        block((-2, -2, 2), (2, 2, 5)),
        block((0, 0, 0), (0.5, 0.5, 2)),
        block((1, 1, 0), (2, 2, 1)),
    )
    parts = split_one_epoch_parts([obj([(crown, True), (trunk, True), (bin_, False)])], CONFIG)
    assert [len(p.voxels) for p in parts] == [len(crown) + len(trunk), len(bin_)]
    assert parts[1].voxels.height.max() < 1.0


def test_a_kerb_told_wrong_is_no_part():
    hedge, kerb = block((0, 0, 0), (5, 1, 1.5)), block((5, 0, 0), (9, 1, 0.5))
    assert len(split_one_epoch_parts([obj([(hedge, True), (kerb, False)])], CONFIG)) == 1


@pytest.mark.parametrize(
    ("left", "hidden_went"),
    [(1.0, True), (1.5, False), (8.0, False)],
    ids=["a gate", "a narrow house", "a house"],
)
def test_what_nobody_saw_goes_with_what_is_gone_if_little_is_left(left, hidden_went):
    rest, gone = block((0, 0, 0), (left, 2, 3)), block((left, 0, 0), (left + 2, 2, 3))
    hidden = block((0, 2, 0), (left + 2, 4, 3))  # behind both
    made = obj([(rest, True), (gone, False), (hidden, False)])
    seen = np.repeat([True, True, False], [len(rest), len(gone), len(hidden)])
    made = replace(made, voxels=replace(made.voxels, observed=seen))
    kept, part = split_one_epoch_parts([made], CONFIG)
    behind_the_rest = len(block((0, 2, 0), (left, 4, 3)))
    assert len(kept.voxels) == len(rest) + (0 if hidden_went else behind_the_rest)
    assert len(part.voxels) == len(made.voxels) - len(kept.voxels)


def test_parting_is_left_out_on_request():
    both = obj([(block((0, 0, 0), (5, 1, 1.5)), True), (block((5, 0, 0), (8, 1, 1.5)), False)])
    assert split_one_epoch_parts([both], PartConfig(points=0)) == [both]


def moved(xyz, x):
    return voxels(np.add(xyz, (x, 0.0, 0.0)))


NONE = voxels(np.zeros((0, 3)))
HOUSE, WING = walls(10, 8, 5), walls(4, 6, 4)


def test_a_wing_built_onto_a_house_belongs_to_it_and_one_taken_from_it_too():
    house = (voxels(HOUSE), voxels(HOUSE))
    assert find_building_extensions([house, (NONE, moved(WING, 10))], CONFIG) == {1: 0}
    assert find_building_extensions([(moved(WING, 10), NONE), house], CONFIG) == {0: 1}


@pytest.mark.parametrize(("x", "body"), [(14, WING), (10, walls(14, 10, 6))], ids=["apart", "larger"])
def test_what_stands_apart_or_is_larger_is_no_wing(x, body):
    assert find_building_extensions([(voxels(HOUSE), voxels(HOUSE)), (NONE, moved(body, x))], CONFIG) == {}


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
def test_a_house_is_as_large_as_the_survey_that_saw_more_of_it_shows(taken_away):
    """The survey that has the wing saw no more than the front of the house beside it."""
    front = voxels(HOUSE[HOUSE[:, 1] < 0.5])
    for seen, wing in ((front, True), (voxels(HOUSE), True)):
        pair = [(voxels(HOUSE), seen), (NONE, moved(WING, 10))]
        pair = [side[::-1] for side in pair] if taken_away else pair
        assert (find_building_extensions(pair, CONFIG) == {1: 0}) == wing
    small = [(front, front), (NONE, moved(walls(14, 10, 5), 10))]
    assert find_building_extensions(small, CONFIG) == {}


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
@pytest.mark.parametrize(("begins", "x", "wing"), [(5.0, 3.5, True), (0.0, 3.5, False), (5.0, 12.0, False)])
def test_a_storey_set_back_from_all_walls_is_of_the_house_whose_roof_nobody_saw(begins, x, wing, taken_away):
    """It begins above a room and over the house; walls on the ground, or beside the house, are none."""
    storey = np.add(walls(3, 3, 2.5), (x, 2.5, begins))
    pair = (voxels(storey), NONE) if taken_away else (NONE, voxels(storey))
    found = find_building_extensions([(voxels(HOUSE), voxels(HOUSE)), pair], CONFIG)
    assert (found == {1: 0}) == wing
    with rules_switched_off(["storeys_set_back"]):
        assert find_building_extensions([(voxels(HOUSE), voxels(HOUSE)), pair], CONFIG) == {}


def test_what_is_lower_than_a_room_is_no_wing():
    house, body = (voxels(HOUSE), voxels(HOUSE)), walls(3, 3, 2.2)
    assert find_building_extensions([house, (NONE, moved(body, 10))], CONFIG) == {}
    assert find_building_extensions([(moved(body, 10), NONE), house], CONFIG) == {}


def test_a_house_that_touches_its_neighbour_with_a_corner_alone_is_no_wing():
    """Of 8 m by 8 m: wall to wall it may be a wing of the house, corner to corner it is another house."""
    house = (voxels(HOUSE), voxels(HOUSE))
    for place, wing in (((10.0, 0.0, 0.0), True), ((10.5, 8.5, 0.0), False)):
        beside = voxels(np.add(walls(8, 8, 4), place))
        assert bool(find_building_extensions([house, (beside, NONE)], CONFIG)) == wing


def test_a_wing_in_the_gap_between_two_houses_belongs_to_the_one_that_it_touches():
    """More of its places are in reach of the neighbour, at half a metre, than of its own house, at none."""
    wing = voxels(np.add(walls(6, 6, 4), (10.0, 0.0, 0.0)))
    own, neighbour = (voxels(np.add(HOUSE, place)) for place in ((0.0, -6.5, 0.0), (16.5, -6.0, 0.0)))
    for pair in ((NONE, wing), (wing, NONE)):
        assert find_building_extensions([(neighbour, neighbour), (own, own), pair], CONFIG) == {2: 1}
        assert find_building_extensions([(own, own), (neighbour, neighbour), pair], CONFIG) == {2: 0}


def test_a_wing_that_fills_the_gap_between_two_houses_leans_on_the_nearer_one():
    """Its long sides run along both."""
    own, wing = (voxels(HOUSE), voxels(HOUSE)), (NONE, moved(walls(4, 8, 4), 10))
    neighbour = moved(HOUSE, 14.5)
    assert find_building_extensions([own, (neighbour, neighbour), wing], CONFIG) == {2: 0}


def open_between(left, right):
    """Ground that both epochs saw between two walls."""
    return OpenGround(NO_COLUMNS, NO_COLUMNS, (lambda p: (p[:, 0] > left) & (p[:, 0] < right),) * 2)


@pytest.mark.parametrize(("gap", "wing"), [(0.0, True), (0.7, False)])
def test_a_new_house_with_an_open_gap_to_its_neighbour_is_no_wing_of_it(gap, wing):
    house, new = (voxels(HOUSE), voxels(HOUSE)), (NONE, moved(walls(6, 8, 4), 10 + gap))
    assert bool(find_building_extensions([house, new], CONFIG, open_between(10, 10 + gap))) == wing
    assert find_building_extensions([house, new], CONFIG) == {1: 0}, "nobody saw that the gap was open"


def test_a_wing_between_its_house_and_an_open_gap_to_the_next_house_is_a_wing():
    """It lies along the next house with its longer side, 0.6 m away, and touches its own with an end."""
    house, wing = (voxels(HOUSE), voxels(HOUSE)), (NONE, moved(walls(6, 4, 4), 10))
    beyond = (voxels(np.add(walls(14, 10, 5), (8.0, -10.75, 0.0))),) * 2
    gap = OpenGround(NO_COLUMNS, NO_COLUMNS, (lambda p: (p[:, 1] > -0.75) & (p[:, 1] < 0),) * 2)
    assert find_building_extensions([house, wing, beyond], CONFIG, gap) == {1: 0}


@pytest.mark.parametrize(("top", "wing"), [(1.75, False), (3.0, True)], ids=["a fence", "a wall"])
def test_a_new_house_that_a_fence_joins_to_its_neighbour_is_no_wing_of_it(top, wing):
    link = block((10.0, 4.0, 0.0), (10.8, 4.25, top))
    house = np.add(walls(6, 8, 4), (10.8, 0.0, 0.0))
    new = (NONE, voxels(np.concatenate([house, link])))
    found = find_building_extensions([(voxels(HOUSE), voxels(HOUSE)), new], CONFIG, open_between(10.0, 10.8))
    assert bool(found) == wing


def test_a_house_between_two_others_is_no_wing_of_either():
    ends = [(moved(HOUSE, x), moved(HOUSE, x)) for x in (0, 16)]
    middle = (moved(walls(6, 8, 4), 10), NONE)
    assert find_building_extensions([*ends, middle], CONFIG) == {}
    with rules_switched_off(["part_between_buildings"]):
        assert list(find_building_extensions([*ends, middle], CONFIG)) == [2]


def test_a_house_that_leans_on_one_neighbour_more_than_on_the_other_is_no_wing():
    first = voxels(np.concatenate([HOUSE, np.add(walls(3, 2, 5), (10, 8, 0))]))
    last, middle = moved(walls(10, 4, 5), 13), np.add(walls(3, 8, 4), (10, 0, 0))
    assert find_building_extensions([(first, first), (last, last), (voxels(middle), NONE)], CONFIG) == {}


@pytest.mark.parametrize(("gap", "wing"), [(0.7, False), (0.05, True)], ids=["an open gap", "a wing"])
def test_eaves_over_an_open_gap_join_no_garage_to_the_house(gap, wing):
    eaves, garage = block((10.0, 0.0, 3.0), (10.5, 8.0, 3.25)), np.add(walls(6, 6, 2.8), (10 + gap, 0, 0))
    house, built = (
        replace(made, normal=np.tile([0.0, 1.0, 0.0], (len(made), 1)))
        for made in (voxels(HOUSE), voxels(garage))
    )
    house = house.add(voxels(eaves))
    found = find_building_extensions([(house, house), (NONE, built)], CONFIG, open_between(10.0, 10 + gap))
    assert bool(found) == wing


@pytest.mark.parametrize(("eaves", "wing"), [(4.5, False), (2.5, True)], ids=["above", "at its wall"])
@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
def test_edges_of_eaves_high_above_a_garage_join_it_to_no_house(eaves, wing, taken_away):
    """The edge of a roof is as steep as a wall; the wall below it is 0.7 m from the garage."""
    edge = block((10.25, 0.0, eaves), (10.5, 8.0, eaves + 0.25))
    house = voxels(np.concatenate([HOUSE, edge]))
    garage = voxels(np.add(walls(6, 6, 2.8), (10.7, 0.0, 0.0)))
    pair = (garage, NONE) if taken_away else (NONE, garage)
    found = find_building_extensions([(house, house), pair], CONFIG, open_between(10.0, 10.9))
    assert bool(found) == wing


@pytest.mark.parametrize(("side", "height", "wing"), [(3, 3.0, True), (8, 4.5, False)], ids=["wing", "house"])
def test_a_house_that_a_carport_links_to_its_neighbour_was_no_wing_of_it(side, height, wing):
    """A wing of a wing is smaller than the wing."""
    house, carport = (voxels(HOUSE), voxels(HOUSE)), (moved(walls(4, 4, 3), 10), NONE)
    beyond = (moved(walls(side, side, height), 14), NONE)
    assert find_building_extensions([house, carport, beyond], CONFIG) == ({1: 0, 2: 0} if wing else {1: 0})


def facing(made, occupied_in_other):
    """Voxels of a house with the normals of the wall at x = 10 m, which the other epoch has or has not."""
    normal = np.where(made.xyz[:, :1] > 9.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    return replace(made, normal=normal, occupied_in_other=np.full(len(made), occupied_in_other))


@pytest.mark.parametrize(("seen", "wing"), [(True, False), (False, True)])
def test_what_stands_before_a_wall_that_both_surveys_saw_is_no_wing_of_the_house(seen, wing):
    """Scaffolding hides no wall; a wing hides the wall that it was built onto."""
    house, layer = facing(voxels(HOUSE), seen), moved(walls(1.5, 7.5, 4), 10)
    assert bool(find_building_extensions([(house, house), (NONE, layer)], CONFIG)) == wing
    with rules_switched_off(("layers_before_walls",)):
        assert find_building_extensions([(house, house), (NONE, layer)], CONFIG) == {1: 0}


def test_a_garden_wall_that_is_of_one_object_with_a_house_makes_no_wing_of_it():
    """Between a wing of one house and the next house stands a wall of 1.8 m, of the next house's object."""
    own = voxels(HOUSE)
    garden_wall = np.add(walls(0.5, 8, 1.8), (15.5, 0.0, 0.0))
    next_house = voxels(np.concatenate([np.add(HOUSE, (20.0, 0.0, 0.0)), garden_wall]))
    wing = (NONE, moved(walls(4.5, 8, 3), 10.5))
    assert find_building_extensions([(next_house, next_house), (own, own), wing], CONFIG) == {2: 1}


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
@pytest.mark.parametrize(
    ("closed", "met", "wing"), [(False, True, False), (True, True, True), (False, False, True)]
)
def test_a_roof_on_posts_is_no_wing_where_the_ground_below_it_was_met(closed, met, wing, taken_away):
    """A wing with closed sides, and a roof whose sides nobody saw, may hold rooms."""
    roof = block((10.0, 0.0, 2.25), (13.0, 6.0, 2.75))
    posts = [block((12.5, y, 0.0), (12.75, y + 0.25, 2.25)) for y in (0.0, 5.5)]
    sides = np.add(walls(3, 6, 2.5), (10.0, 0.0, 0.0))
    part = voxels(np.concatenate([roof, *([sides] if closed else posts)]))
    x, y = np.meshgrid(np.arange(9.75, 13.5, 0.25), np.arange(-0.25, 6.5, 0.25))
    seen = ground_columns(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), 0.5)
    pair, columns = (NONE, part), (NO_COLUMNS, seen if met else NO_COLUMNS)
    if taken_away:
        pair, columns = pair[::-1], columns[::-1]
    found = find_building_extensions([(voxels(HOUSE), voxels(HOUSE)), pair], CONFIG, OpenGround(*columns))
    assert bool(found) == wing
    if not wing:
        with rules_switched_off(("open_roofs",)):
            assert find_building_extensions(
                [(voxels(HOUSE), voxels(HOUSE)), pair], CONFIG, OpenGround(*columns)
            )


def test_a_crown_beside_a_house_is_no_wing_of_it_however_smooth_its_foliage():
    rng = np.random.default_rng(5)
    way = rng.normal(size=(600, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    crown = replace(voxels(3 * way + (0, 0, 5)), normal=way)
    assert not is_smooth_surface(crown)
    assert rectangularity(way) < 0.2
    assert rectangularity(voxels(HOUSE).normal) > 0.9


def test_a_shed_left_inside_the_outline_of_a_house_that_is_gone_is_no_rest_of_it():
    for height, rest in ((3.0, True), (2.0, False)):
        inside, house = voxels(np.add(walls(3, 3, height), (4.0, 1.0, 0.0))), voxels(HOUSE)
        assert bool(find_building_extensions([(inside, inside), (house, NONE)], CONFIG)) == rest


def test_a_part_keeps_the_beams_of_its_own_points():
    old, new = block((0, 0, 0), (3, 1, 1.5)), block((3, 0, 0), (6, 1, 1.5))
    whole = obj([(old, True), (new, False)])
    beams = np.repeat([0.2, 9.0], [4 * len(old), 4 * len(new)])
    rest, part = split_one_epoch_parts([replace(whole, passed=beams)], PartConfig(points=1))
    assert rest.passed.max() == 0.2
    assert part.passed.min() == 9.0


def test_a_wing_larger_than_what_is_left_of_its_house_stands_round_it():
    left = moved(walls(3, 8, 4), 0)
    gone = moved(walls(3, 9, 6), 1.0)
    assert find_building_extensions([(left, left), (gone, NONE)], CONFIG) == {1: 0}


def test_walls_are_built_and_cars_and_leaves_are_not():
    wall = voxels(walls(6, 6, 4))
    rng = np.random.default_rng(0)
    turned = rng.normal(size=(len(wall), 3))
    leaves = replace(wall, normal=turned / np.linalg.norm(turned, axis=1, keepdims=True))
    assert is_smooth_surface(wall)
    assert not is_smooth_surface(leaves)
    assert not is_smooth_surface(voxels(walls(4, 2, 1.5)))


def crown(x, occupied_in_other, number):
    part = obj([(block((x, 0, 2), (x + 4, 4, 6)), occupied_in_other)])
    return replace(part, instance=number)


def test_crowns_that_one_epoch_holds_apart_are_told_apart_in_the_other():
    joined = replace(
        obj([(block((0, 0, 2), (4, 4, 6)), True), (block((4, 0, 2), (8, 4, 6)), True)]), instance=0
    )
    two = [crown(0, True, 0), crown(4, True, 1)]
    pieces = split_by_bodies([joined], two, AssociationConfig(), 2)
    assert [len(b[0].voxels) for b, _ in pieces] == [len(a[0].voxels) for _, a in pieces]
    assert [b[0].xyz[:, 0].max() < 4 for b, _ in pieces] == [True, False]
    assert [b[0].instance for b, _ in pieces] == [0, 2]


def test_a_roof_over_its_walls_and_a_small_fragment_are_no_bodies_of_their_own():
    low, high = (obj([(block((0, 0, z), (4, 4, z + 2)), True)]) for z in (0, 2))
    crumb = obj([(block((5, 0, 0), (5.5, 0.5, 0.5)), True)])
    assert len(split_by_bodies([low], [low, high, crumb], AssociationConfig(), 9)) == 1


@pytest.mark.parametrize(
    ("semantic", "height", "flat"),
    [
        (Semantic.OTHER, 0.5, True),
        (Semantic.OTHER, 1.5, False),
        (Semantic.MOBILE, 0.5, True),
        (Semantic.MOBILE, 1.0, False),
        (Semantic.BUILDING, 0.5, False),
    ],
    ids=["a strip of new paving", "a runner", "road that passed for a car", "a car's floor", "a terrace"],
)
def test_what_lies_flat_is_left_to_the_ground(semantic, height, flat):
    slab = obj([(block((0, 0, 0), (8, 2, height)), False)])
    decision = decide_misclassified_ground(semantic, [slab])
    assert (decision is not None) == flat
    assert decision is None or decision.change is Change.NOT_REPORTED


def test_a_low_wall_does_not_lie_flat():
    wall = obj([(block((0, 0, 0), (8, 0.5, 0.5)), False)])
    sideways = replace(wall.voxels, normal=np.tile([0.0, 1.0, 0.0], (len(wall.voxels), 1)))
    assert decide_misclassified_ground(Semantic.OTHER, [replace(wall, voxels=sideways)]) is None


def test_a_house_that_lost_most_of_itself_is_one_with_what_is_left_inside_its_outline():
    front, old = walls(10, 1, 4), np.add(walls(10, 9, 6), (0, 1, 0))
    left = np.concatenate([front, np.add(walls(6, 7, 3), (2, 1, 0))])
    assert find_building_extensions([(voxels(front), voxels(left)), (voxels(old), NONE)], CONFIG) == {1: 0}


def house_instance(xyz, number, held=True):
    """A building of voxels on walls; all or none of it is held by the other epoch."""
    return replace(obj([(xyz, held)]), instance=number, semantic=Semantic.BUILDING)


def outside(*boxes):
    """Tell which places lie outside of boxes (west, east, south, north) [m]."""

    def empty(xyz):
        inside = [
            (xyz[:, 0] > w) & (xyz[:, 0] < e) & (xyz[:, 1] > s) & (xyz[:, 1] < n) for w, e, s, n in boxes
        ]
        return ~np.any(inside, axis=0)

    return empty


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
@pytest.mark.parametrize("cut_off", [False, True], ids=["within the instance", "a part of its own"])
def test_a_wing_that_closes_the_gap_to_the_next_house_extends_the_house_it_adjoins_most(taken_away, cut_off):
    first, second = walls(10, 8, 5), np.add(walls(9, 8, 5), (12.5, 2, 0))
    wing = np.add(walls(2, 7, 4), (10.25, 0, 0))
    apart = [house_instance(first, 0), house_instance(second, 1)]
    if cut_off:
        merged = [house_instance(np.concatenate([first, second]), 0), house_instance(wing, 1, held=False)]
    else:
        pieces = [(first, True), (second, True), (wing, False)]
        merged = [replace(obj(pieces), instance=0, semantic=Semantic.BUILDING)]
    without, with_wing = outside((0, 10, 0, 8), (12.5, 21.5, 2, 10)), outside((0, 21.5, 0, 10))
    free = (with_wing, without) if taken_away else (without, with_wing)
    ground = OpenGround(NO_COLUMNS, NO_COLUMNS, free)
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig(), ground=ground)
    sides = (merged, apart) if taken_away else (apart, merged)
    kept = [[t for t in side if t.voxels.occupied_in_other.any()] for side in sides]
    lost = [[t for t in side if not t.voxels.occupied_in_other.any()] for side in sides]
    pairs = [kept, lost] if cut_off else [kept]
    matched = [decide_object(b, a, Semantic.BUILDING, rules) for b, a in pairs]
    told = join_building_extensions(split_multi_body_matches(matched, rules), rules)
    changed = Change.DECREASED if taken_away else Change.INCREASED
    assert sorted(change.decision.change for change in told) == sorted([changed, Change.UNCHANGED])
    larger = next(change for change in told if change.decision.change is changed)
    places = np.concatenate([t.voxels.xyz for t in (*larger.before, *larger.after)])
    assert places[:, 0].min() < 1
    assert places[:, 0].max() < 12.5


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
def test_the_rear_of_a_wing_that_the_house_hides_is_a_row_of_its_own(taken_away):
    """Of a wing 6 m deep the survey without it saw the place of the first 2 m."""
    wing = np.add(walls(4, 6, 4), (10, 0, 0))
    near = wing[:, 1] < 2.0
    front, hidden = house_instance(wing[near], 1, held=False), house_instance(wing[~near], 2, held=False)
    unseen = np.zeros(np.count_nonzero(~near), dtype=bool)
    rear = replace(hidden, voxels=replace(hidden.voxels, observed=unseen))
    house = [house_instance(HOUSE, 0)]
    free = (outside((0, 10, 0, 8), (10, 30, 2, 30)), outside((0, 10, 0, 8), (10, 14, 0, 6)))
    ground = OpenGround(NO_COLUMNS, NO_COLUMNS, free[::-1] if taken_away else free)
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig(), ground=ground)
    pairs = [(house, house), *(([part], []) if taken_away else ([], [part]) for part in (front, rear))]
    told = join_building_extensions([decide_object(*p, Semantic.BUILDING, rules) for p in pairs], rules)
    assert [change.decision.change for change in told] == [Change.UNCHANGED, Change.UNOBSERVED]


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
@pytest.mark.parametrize(("width", "own_row"), [(4.5, True), (2.0, False)])
def test_a_house_of_a_row_of_which_only_the_front_was_seen_has_a_row_of_its_own(taken_away, width, own_row):
    first = walls(10, 12, 6)
    second = np.add(walls(10, 12, 6), (10 + width + 0.5, 0, 0))
    front = np.add(block((0, 0, 0), (width, 0.5, 4)), (10.25, 0, 0))
    apart = [house_instance(first, 0), house_instance(second, 1)]
    row = house_instance(np.concatenate([first, second]), 0)
    part = house_instance(front, 1, held=False)
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    lone = ([part], []) if taken_away else ([], [part])
    both = ([row], apart) if taken_away else (apart, [row])
    matched = [decide_object(*both, Semantic.BUILDING, rules), decide_object(*lone, Semantic.BUILDING, rules)]
    assert matched[1].decision.change is (Change.REMOVED if taken_away else Change.ADDED)
    told = split_row_houses(join_building_extensions(matched, rules), rules)
    rows = [change for change in told if change.decision.change is matched[1].decision.change]
    assert len(rows) == int(own_row)
    kept = [sum(len(t.voxels) for c in found for t in (*c.before, *c.after)) for found in (matched, told)]
    assert kept[0] == kept[1]


@pytest.mark.parametrize("taken_away", [False, True], ids=["built", "taken away"])
@pytest.mark.parametrize(
    ("width", "depth", "own_row"),
    [(3.5, 8.0, False), (6.0, 4.0, False), (6.0, 8.0, True), (11.0, 4.0, True)],
)
def test_a_narrow_or_shallow_body_at_the_end_of_a_house_is_its_wing(taken_away, width, depth, own_row):
    """Its epoch holds it apart, so that what changed has a row of its own if it is a house of a row."""
    house = house_instance(walls(12, 8, 5), 0)
    part = house_instance(np.add(walls(width, depth, 5), (12.25, 0, 0)), 1, held=False)
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    lone = ([part], []) if taken_away else ([], [part])
    matched = [decide_object(*pair, Semantic.BUILDING, rules) for pair in (([house], [house]), lone)]
    told = split_row_houses(join_building_extensions(matched, rules), rules)
    labels = sorted(change.decision.change.label for change in told)
    alone = "Removed" if taken_away else "Added"
    assert len(told) == 1 + own_row
    assert (labels == [alone, "Unchanged"]) == own_row


@pytest.mark.parametrize("x", [0.0, 0.7, 200.3])
@pytest.mark.parametrize(("gap", "wing"), [(2.0, True), (4.0, False)])
def test_a_part_between_remains_of_a_house_is_a_wing_where_they_lie_closer_than_a_house_is_wide(gap, wing, x):
    """Whether the remains are one house does not depend on where the origin of the coordinates lies."""
    rest = np.concatenate([HOUSE, np.add(walls(4, 4, 5), (10 + gap, 0, 0))])
    lost = np.add(walls(gap, 6, 5), (10, 0, 0))
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    house, part = (
        house_instance(np.add(xyz, (x, 0, 0)), number, held)
        for number, (xyz, held) in enumerate(((rest, True), (lost, False)))
    )
    matched = [decide_object(*pair, Semantic.BUILDING, rules) for pair in (([house], [house]), ([part], []))]
    told = split_row_houses(join_building_extensions(matched, rules), rules)
    assert (Change.REMOVED in {change.decision.change for change in told}) == (not wing)


@pytest.mark.parametrize(
    ("places", "beside", "floats"),
    [
        (((0, 0, 1.0), (3, 0.5, 1.2)), None, True),
        (((0, 0, 1.0), (3, 0.5, 1.2)), (3.5, 0.0, 1.0), False),
        (((0, 0, 1.0), (3, 0.5, 1.2)), (5.5, 0.0, 1.0), True),
        (((0, 0, 0.0), (3, 0.5, 0.2)), None, False),
        (((0, 0, 1.0), (3, 0.5, 2.5)), None, False),
        (((0, 0, 6.0), (3, 0.5, 6.2)), None, False),
    ],
    ids=["a line in the air", "held by a post", "a post far off", "on the ground", "high", "a wire"],
)
def test_nothing_is_claimed_of_a_scan_line_that_floats(places, beside, floats):
    line = obj([(block(*places), False)])
    standing = line.xyz if beside is None else np.concatenate([line.xyz, [beside]])
    decision = decide_floating_line([line], standing, DecisionConfig())
    assert (decision is not None) is floats
    if decision is not None:
        assert decision.change is Change.UNOBSERVED
        assert "nothing is claimed" in decision.reason


def test_a_crown_beside_a_house_is_no_wing_and_a_roof_on_it_is_one():
    crown = np.array([p for p in walls(3, 3, 5) if p[2] > 4.2])
    house = (voxels(HOUSE), voxels(HOUSE))
    assert find_building_extensions([house, (NONE, moved(crown, 10.5))], CONFIG) == {}
    assert find_building_extensions([house, (NONE, moved(np.add(crown, (0, 0, 2)), 5.0))], CONFIG) == {1: 0}


def other(xyz):
    return replace(obj([(xyz, False)]), semantic=Semantic.OTHER)


@pytest.mark.parametrize(
    ("size", "labels"),
    [
        ((8.0, 0.5, 1.5), [Change.REMOVED, Change.ADDED]),
        ((0.5, 0.5, 6.0), [Change.REMOVED, Change.ADDED]),
        ((2.0, 0.5, 1.0), [Change.NOT_REPORTED]),
    ],
    ids=["a wall beside a former fence", "a pole beside its place", "a bench"],
)
def test_what_people_do_not_move_was_removed_and_is_new(size, labels):
    before, after = other(block((0, 0, 0), size)), other(np.add(block((0, 0, 0), size), (0, 1.0, 0)))
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    told = part_hardly_overlapping([decide_object((before,), (after,), Semantic.OTHER, rules)], rules)
    assert [change.decision.change for change in told] == labels


def all_but(corner, size):
    """Tell that all places but those in a box were seen free."""
    return lambda xyz: ((xyz < corner) | (xyz > np.add(corner, size))).any(axis=1)


@pytest.mark.parametrize(
    ("corner", "labels"),
    [((3.0, 3.0), [Change.INCREASED]), ((14.0, 3.0), [Change.UNOBSERVED, Change.ADDED])],
    ids=["around the old one", "beside the old one"],
)
def test_a_house_that_was_replaced_by_a_larger_one_around_it_grew(corner, labels):
    small, large = (
        np.concatenate([walls(*size), block((0, 0, size[2] - 0.5), size)])
        for size in ((6, 5, 4), (12, 12, 7))
    )
    small = obj([(np.add(small, (*corner, 0)), False)])
    hidden = replace(small.voxels, observed=np.zeros(len(small.voxels), dtype=bool))
    before = replace(small, semantic=Semantic.BUILDING, voxels=hidden)
    after = replace(obj([(large, False)]), semantic=Semantic.BUILDING)
    ground = OpenGround(
        NO_COLUMNS, NO_COLUMNS, (all_but((*corner, 0), (6, 5, 4)), all_but((0, 0, 0), (12, 12, 7)))
    )
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig(), ground=ground)
    told = part_hardly_overlapping([decide_object((before,), (after,), Semantic.BUILDING, rules)], rules)
    assert [change.decision.change for change in told] == labels


def test_wires_of_which_each_survey_saw_another_part_stayed():
    both = block((8.0, 0, 6.0), (30.0, 0.5, 6.5)), True
    ends = [(np.add(block((0, 0, 6.0), (8.0, 0.5, 6.5)), (begin, 0, 0)), False) for begin in (0.0, 30.0)]
    before, after = (replace(obj([both, end]), semantic=Semantic.OTHER) for end in ends)
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    told = decide_object((before,), (after,), Semantic.OTHER, rules)
    assert told.measures.delta_c > rules.decisions.mobile.shift
    assert told.decision.change is Change.UNCHANGED
    assert "saw different parts" in told.decision.reason
    with rules_switched_off(["fixed_objects"]):
        moved_away = decide_object((before,), (after,), Semantic.OTHER, rules)
    assert moved_away.decision.change is Change.NOT_REPORTED


@pytest.mark.parametrize(("score", "semantic"), [(0.9, Semantic.VEGETATION), (0.5, Semantic.MOBILE)])
def test_objects_of_both_epochs_in_one_place_take_the_class_of_the_better_score(score, semantic):
    plant, vehicle = (
        replace(obj([(block((0, 0, 0), (4, 2, 1.5)), True)]), semantic=own, score=points)
        for own, points in ((Semantic.VEGETATION, score), (Semantic.MOBILE, 0.7))
    )
    for pair in ([plant], [vehicle]), ([vehicle], [plant]):
        found = unify_classes(*pair, AssociationConfig(), 0.25)
        assert [side[0].semantic for side in found] == [semantic] * 2


@pytest.mark.parametrize("taken_away", [True, False])
def test_a_wing_is_of_its_house_although_a_fence_ran_along_it(taken_away):
    """The fence stands in both epochs, and one of them holds fence and wing for one object."""
    fence = np.add(walls(0.5, 6, 1.5), (14.0, 1.0, 0.0))
    whole = house_instance(np.concatenate([HOUSE, np.add(WING, (10.0, 0.0, 0.0)), fence]), 0)
    assert len(whole.voxels) > len(fence)
    both = house_instance(HOUSE, 1)
    wing_and_fence = np.concatenate([np.add(WING, (10.0, 0.0, 0.0)), fence])
    large, low = house_instance(wing_and_fence, 2), house_instance(fence, 3)
    sides = ((large,), (low,)) if taken_away else ((low,), (large,))
    rules = ObjectRules(MeasureConfig(), AssociationConfig(), DecisionConfig())
    changes = [
        decide_object((both,), (both,), Semantic.BUILDING, rules),
        decide_object(*sides, Semantic.BUILDING, rules),
    ]
    (told,) = join_building_extensions(changes, rules)
    assert {t.instance for t in (*told.before, *told.after)} == {1, 2, 3}


def facade(length, tall):
    """A wall along x that faces the street at y < 0, as in both epochs."""
    wall = voxels(block((0, 0, 0), (length, 0.5, tall)))
    return replace(wall, normal=np.tile([0.0, -1.0, 0.0], (len(wall), 1)))


@pytest.mark.parametrize(("begins", "parts"), [(0.0, 2), (1.5, 2), (2.5, 1)])
def test_scaffolding_that_shares_columns_with_the_wall_behind_it_is_an_object_of_its_own(begins, parts):
    wall = facade(8.0, 5.0)
    boards = voxels(block((1.0, -0.5, begins), (7.0, 0.5, 4.5)) - (0.0, 0.05, 0.0), occupied_in_other=False)
    held = wall.add(replace(boards, owner=np.zeros(len(boards), np.int64)))
    points = np.repeat(held.xyz, 4, axis=0)
    house = ObjectInstance(0, Semantic.BUILDING, 0.8, np.arange(len(points)), held, 0.03, points)
    assert len(split_one_epoch_parts([house], CONFIG)) == parts
    with rules_switched_off(["layers_before_walls"]):
        assert len(split_one_epoch_parts([house], CONFIG)) == 1


@pytest.mark.parametrize(("depth", "joined"), [(1.0, {1: 0}), (-1.0, {})], ids=["behind", "before"])
def test_walls_of_a_house_behind_the_facade_of_the_larger_one_that_replaced_it_are_of_it(depth, joined):
    """The facade stands in both epochs; before it the walls would be scaffolding."""
    front, larger = facade(12.0, 4.0), walls(12, 10, 6)
    after = front.add(voxels(larger[larger[:, 1] > 0.5], occupied_in_other=False))
    old = voxels(block((2, depth, 0), (10, depth + 0.5, 4)), occupied_in_other=False)
    assert find_building_extensions([(front, after), (old, NONE)], CONFIG) == joined


@pytest.mark.parametrize(("semantic", "kept"), [(Semantic.BUILDING, 0), (Semantic.VEGETATION, 8)])
def test_what_stood_in_both_epochs_within_the_outline_of_a_new_house_is_of_the_house(semantic, kept):
    """One instance holds the new house and its neighbour 3 m away; a tree stood where its corner is."""
    new, neighbour = walls(10, 8, 6), np.add(block((0, 0, 0), (6, 1, 3)), (13, 0, 0))
    corner = (new[:, 0] < 1) & (new[:, 1] < 1) & (new[:, 2] < 4)
    both = obj([(new[~corner], False), (new[corner], True), (neighbour, True)])
    rest, house = split_one_epoch_parts([replace(both, semantic=semantic)], CONFIG)
    assert np.count_nonzero(rest.voxels.xyz[:, 0] < 10) == kept * (np.count_nonzero(corner) // 8)
    assert np.count_nonzero(house.voxels.xyz[:, 0] > 10) == 0


@pytest.mark.parametrize(
    ("beside", "parts"),
    [((5.3, 1.8, 1.4), 1), ((8.5, 1.8, 1.4), 2), ((5.0, 0.6, 1.4), 2)],
    ids=["its end", "another car", "a bin"],
)
def test_the_end_of_a_vehicle_is_of_it_where_a_shorter_one_stood_in_its_place(beside, parts):
    """Stretched: a vehicle of 4 m that both epochs have, and what one alone has up to another length."""
    car, more = block((0, 0, 0), (4.0, 1.8, 1.4)), block((4.0, 0, 0), beside)
    whole = replace(obj([(car, True), (more, False)]), semantic=Semantic.MOBILE)
    assert len(split_one_epoch_parts([whole], CONFIG)) == parts


@pytest.mark.parametrize(("aside", "parts"), [(0.0, 1), (11.0, 2)], ids=["its facade", "a house beside it"])
def test_a_house_of_which_the_facade_alone_is_left_is_one_object_with_the_facade(aside, parts):
    """The roof with its eaves and the side walls are gone; the facade is a fifth of what was seen."""
    house = walls(10, 8, 5)
    front = house[:, 1] < 0.5
    gone = np.concatenate([house[~front], block((0, -0.5, 5), (10, 8, 5.25))])
    left = np.add(house[front], (aside, 0, 0))
    both = replace(obj([(gone, False), (left, True)]), semantic=Semantic.BUILDING)
    assert len(split_one_epoch_parts([both], CONFIG)) == parts


@pytest.mark.parametrize(("tall", "garage", "wing"), [(6.0, 2.5, False), (6.0, 5.0, True), (3.0, 2.5, True)])
def test_a_new_house_that_touches_the_garage_of_its_neighbour_alone_is_no_wing_of_it(tall, garage, wing):
    body = np.concatenate([walls(12, 10, 6), np.add(walls(3, 5, garage), (12, 0, 0))])
    new = moved(walls(8, 8, tall), 15.4)
    found = find_building_extensions([(voxels(body), voxels(body)), (NONE, new)], CONFIG)
    assert found == ({1: 0} if wing else {})
