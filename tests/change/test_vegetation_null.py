"""Plants are judged against the unchanged plants of their pair, at equal point density."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_crown_outline import crown
from test_decisions import CONFIG

from subiaco_change.decisions.plant_decisions import decide_plant, place_was_free
from subiaco_change.decisions.plant_measures import (
    OutlineConfig,
    PlantConfig,
    compare_outlines,
    equal_density,
    free_shell,
    quantile_sigma,
)
from subiaco_change.decisions.vegetation_null import (
    PlantMeasures,
    VegetationNullConfig,
    fit_null,
    no_null,
    null_of,
    null_words,
)
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.known_space import KnownSpace
from subiaco_geo.codes import Change

NULL = VegetationNullConfig()
TREE = PlantMeasures(
    kind="crown", density=0.0, size=2.0, voxels=300, reach=2.0, outline=0.0, outline_sigma=0.03,
    top=0.0, volume=0.0, surface=0.0, rise=math.nan, rise_sigma=math.nan,
)  # fmt: skip
HEDGE = replace(TREE, kind="hedge", rise=0.0, rise_sigma=0.02, height=2.0)


def street(count, shift, scatter, changed=(), seed=0, slope=0.0):
    """Crowns whose outlines moved by ``shift`` on average, and by ``slope`` more per log density ratio."""
    rng = np.random.default_rng(seed)
    density = rng.uniform(-0.5, 0.5, count)
    moved = shift + slope * density + rng.normal(scale=scatter, size=count)
    plants = [replace(TREE, outline=m, density=d) for m, d in zip(moved, density, strict=True)]
    return [*plants, *(replace(TREE, outline=m) for m in changed)]


def label(plant, null):
    return decide_plant(plant, 0.03, CONFIG, null)


@pytest.mark.parametrize(("height", "rise", "change"), [
    (6.0, 0.4, Change.INCREASED), (16.0, 0.4, Change.UNCHANGED), (16.0, -0.8, Change.DECREASED),
])  # fmt: skip
def test_the_top_of_a_tall_plant_must_change_by_a_share_of_its_height(height, rise, change):
    tree = replace(TREE, height=height, rise=rise, rise_sigma=0.05, outline_sigma=0.02)
    assert label(tree, no_null(NULL)).change is change
    with rules_switched_off(["tops_of_tall_plants"]):
        assert label(tree, no_null(NULL)).change is not Change.UNCHANGED


@pytest.mark.parametrize(("height", "rise", "grew"), [
    (1.3, 0.24, True), (1.3, 0.15, False), (2.5, 0.24, False), (2.5, 0.31, True),
])  # fmt: skip
def test_a_hedge_grows_by_a_share_of_its_height_that_is_a_change_of_its_volume(height, rise, grew):
    hedge = replace(HEDGE, height=height, rise=rise, rise_sigma=0.02)
    null = replace(no_null(NULL), stated=NULL.stated.model_copy(update={"rise": 0.04}))
    for sign, change in ((1.0, Change.INCREASED), (-1.0, Change.DECREASED)):
        told = label(replace(hedge, rise=sign * rise), null).change
        assert told is (change if grew else Change.UNCHANGED)
    with rules_switched_off(["volume_of_hedges"]):
        assert (label(hedge, null).change is Change.INCREASED) == (rise > CONFIG.vegetation.height)


@pytest.mark.parametrize("shift", [0.25, -0.25])
def test_a_shift_that_all_crowns_of_a_pair_share_is_no_change_and_one_beyond_is(shift):
    null = fit_null(street(40, shift, 0.06), NULL)
    rest = label(replace(TREE, outline=1.3 * shift, rise=0.0, rise_sigma=0.02), null)
    assert rest.change is Change.UNCHANGED
    assert label(replace(TREE, outline=1.3 * shift), null).sigmas == 0.0  # nobody saw its top
    grown = label(replace(TREE, outline=0.6), null)
    pruned = label(replace(TREE, outline=-0.6), null)
    assert (grown.change, pruned.change) == (Change.INCREASED, Change.DECREASED)
    assert "the other 39 crowns of this pair by" in grown.reason
    assert "excess" in grown.reason
    assert grown.sigmas > 0 > rest.sigmas


@pytest.mark.parametrize("seed", range(5))
def test_hedges_that_changed_do_not_widen_the_scatter_of_the_others_even_where_nearly_half_did(seed):
    rng = np.random.default_rng(seed)
    same = rng.normal(0.02, 0.03, 10)
    cut_or_grown = np.array([-0.56, -0.45, 0.52, 0.43, -0.38, 0.36, -0.47, 0.55])
    hedges = [replace(HEDGE, top=float(top)) for top in [*same, *cut_or_grown]]
    expected = fit_null(hedges, NULL).expected(HEDGE, "top")
    assert expected.sd <= 0.1
    assert abs(expected.shift) <= 0.05
    assert (np.abs(cut_or_grown - expected.shift) > NULL.certain * expected.sd).all()


@pytest.mark.parametrize("seed", range(5))
def test_hedges_of_which_more_than_half_changed_scatter_as_the_crowns_of_their_pair_do(seed):
    rng = np.random.default_rng(seed)
    crowns = [replace(TREE, rise=float(r), rise_sigma=0.03) for r in rng.normal(0.05, 0.04, 60)]
    rises = [*rng.normal(0.02, 0.04, 11), *rng.uniform(0.25, 0.65, 6), *rng.uniform(-0.65, -0.25, 7)]
    hedges = [replace(HEDGE, rise=float(r), rise_sigma=0.05) for r in rises]
    assert fit_null([*crowns, *hedges], NULL).expected(HEDGE, "rise").sd <= 0.1


@pytest.mark.parametrize("seed", range(5))
def test_hedges_that_scatter_more_than_the_crowns_of_their_pair_are_measured_as_such(seed):
    rng = np.random.default_rng(seed)
    crowns = [replace(TREE, rise=float(r), rise_sigma=0.03) for r in rng.normal(0.0, 0.04, 60)]
    hedges = [replace(HEDGE, rise=float(r), rise_sigma=0.03) for r in rng.normal(0.0, 0.2, 30)]
    assert fit_null([*crowns, *hedges], NULL).expected(HEDGE, "rise").sd == pytest.approx(0.2, rel=0.35)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("sd", [0.05, 0.15, 0.3])
def test_a_wide_scatter_of_many_plants_without_a_change_is_measured_as_wide(sd, seed):
    rng = np.random.default_rng(seed)
    shifts = rng.normal(0.0, sd, 80)
    plants = [replace(TREE, outline=float(shift), outline_sigma=0.0) for shift in shifts]
    assert fit_null(plants, NULL).expected(TREE, "outline").sd == pytest.approx(sd, rel=0.3)


@pytest.mark.parametrize(("free", "claimed"), [(0.9, True), (0.65, False)])
def test_growth_is_claimed_only_where_the_earlier_survey_saw_the_place_free(free, claimed):
    tree = replace(TREE, top=1.5, surface=0.3, outline=0.6)
    grown = label(replace(tree, free_gained=free, free_lost=0.0), no_null(NULL))
    assert grown.change is (Change.INCREASED if claimed else Change.UNCHANGED)
    assert ("was free in the earlier survey" in grown.reason) != claimed
    less = replace(tree, top=-1.5, surface=-0.3, outline=-tree.outline, free_gained=0.0, free_lost=free)
    assert label(less, no_null(NULL)).change is (Change.DECREASED if claimed else Change.UNCHANGED)


@pytest.mark.parametrize("sign", [1, -1])
def test_tops_that_moved_need_no_free_surface(sign):
    moved = replace(HEDGE, rise=sign * 0.5, free_gained=0.5, free_lost=0.5)
    changed = Change.INCREASED if sign > 0 else Change.DECREASED
    assert label(moved, no_null(NULL)).change is changed
    assert place_was_free(label(moved, no_null(NULL)), moved, CONFIG) == 1.0
    section = replace(moved, section=sign * 0.5, section_gate=0.3, section_only=True)
    assert label(section, no_null(NULL)).change is Change.UNCHANGED


@pytest.mark.parametrize(("rise", "found"), [(1.5, Change.INCREASED), (-1.5, Change.DECREASED), (0.4, None)])
def test_without_a_level_of_detection_only_tops_beyond_their_own_error_are_claimed(rise, found):
    """A crown of so few points that no normal is known still has columns, and these their own error."""
    plant = replace(TREE, rise=rise, rise_sigma=0.2, surface=0.4, volume=0.4)
    decided = decide_plant(plant, math.inf, CONFIG, no_null(NULL))
    assert decided.change is (Change.UNOBSERVED if found is None else found)
    unknown = replace(plant, rise=math.nan)
    assert decide_plant(unknown, math.inf, CONFIG, no_null(NULL)).change is Change.UNOBSERVED


def test_surface_of_one_epoch_alone_is_what_has_nothing_of_the_other_near_it():
    """A crown of 2 m that grew to 2.4 m: places of the new shell are asked, places of the old are not."""
    small, large = crown(4000, 2.0, 1), crown(4000, 2.4, 2)

    def known_outside(places):
        return np.where(np.linalg.norm(places - (0.0, 0.0, 5.0), axis=1) > 2.2, 0.9, 0.0)

    assert free_shell(large, KnownSpace(small, known_outside), PlantConfig()) > 0.9
    assert free_shell(small, KnownSpace(large, known_outside), PlantConfig(shell=0.6)) == 0.5
    assert free_shell(large, KnownSpace(small, None), PlantConfig()) == 1.0


@pytest.mark.parametrize(("count", "least", "most"), [(3, 0.6, 0.6), (500, 0.9, 1.0)])
def test_many_places_are_surer_than_few_and_places_without_beams_never_are(count, least, most):
    leaves, nothing = crown(count, 2.0, 1), np.zeros((0, 3))
    together = free_shell(leaves, KnownSpace(nothing, lambda p: np.full(len(p), 0.6)), PlantConfig())
    assert least - 1e-9 <= together <= most + 1e-9
    assert free_shell(
        leaves, KnownSpace(nothing, lambda p: np.full(len(p), 0.5)), PlantConfig()
    ) == pytest.approx(0.5)


@pytest.mark.parametrize("seed", range(5))
def test_a_third_of_the_crowns_that_grew_do_not_pass_for_the_rest(seed):
    changed = np.random.default_rng(seed + 50).uniform(0.5, 0.9, 20)
    fit = fit_null(street(40, 0.15, 0.06, changed, seed), NULL).fits["crown/outline"]
    assert fit.coefficients[0] == pytest.approx(0.15, abs=0.04)
    assert fit.sd == pytest.approx(0.06, abs=0.035)


def test_a_shift_that_follows_the_density_ratio_is_subtracted_as_far_as_it_does():
    null = fit_null(street(80, 0.1, 0.03, slope=0.3, seed=3), NULL)
    low, high = (null.expected(replace(TREE, density=d), "outline").shift for d in (-0.4, 0.4))
    assert low == pytest.approx(-0.02, abs=0.03)
    assert high == pytest.approx(0.22, abs=0.03)
    beyond = null.expected(replace(TREE, density=5.0), "outline").shift
    assert beyond < 0.30  # no further than the crowns that were seen


def test_crowns_that_scatter_more_need_more_to_be_called_grown():
    plant = replace(TREE, outline=0.35)
    calm, unruly = (fit_null(street(40, 0.0, s), NULL) for s in (0.05, 0.2))
    assert label(plant, calm).change is Change.INCREASED
    assert label(plant, unruly).change is Change.UNCHANGED


def test_few_crowns_take_the_stated_scatter_and_say_so():
    null = fit_null(street(8, 0.2, 0.05), NULL)
    assert null == no_null(NULL)
    found = label(replace(TREE, outline=0.28), null)
    assert found.change is Change.UNCHANGED
    assert "too few crowns" in found.reason
    assert label(replace(TREE, outline=0.5), null).change is Change.INCREASED


def test_without_the_null_the_fixed_limits_decide_alone():
    fixed = VegetationNullConfig(enabled=False)
    null = fit_null(street(40, 0.25, 0.06), fixed)
    assert null.fits == {}
    assert label(replace(TREE, outline=0.3), null).change is Change.INCREASED
    assert label(replace(TREE, outline=0.15), null).change is Change.UNCHANGED


def test_hedges_are_not_compared_with_crowns_and_their_columns_decide():
    hedges = [replace(HEDGE, rise=r) for r in np.random.default_rng(1).normal(0.15, 0.04, 20)]
    null = fit_null([*street(30, 0.0, 0.05), *hedges], NULL)
    assert label(replace(HEDGE, rise=0.3), null).change is Change.UNCHANGED
    grown = label(replace(HEDGE, rise=0.6), null)
    assert grown.change is Change.INCREASED
    assert "hedges and shrubs" in grown.reason
    leaves = replace(HEDGE, rise=0.15, surface=0.3)
    assert label(leaves, null).change is Change.UNCHANGED
    assert "leaves differ" in label(leaves, null).reason
    assert "neither the top nor the outline" in label(leaves, null).reason
    assert "its top was not observed" in label(replace(leaves, rise=math.nan), null).reason
    assert label(replace(leaves, rise_of_part=0.6), null).change is Change.INCREASED
    assert label(replace(leaves, rise=math.nan, outline=math.nan), null).change is Change.INCREASED


@pytest.mark.parametrize(("base", "found"), [(-1.2, Change.DECREASED), (-0.4, Change.UNCHANGED)])
def test_a_crown_that_lost_surface_and_whose_base_rose_was_pruned_from_below(base, found):
    null = fit_null(street(30, 0.0, 0.05), NULL)
    lifted = replace(TREE, rise=0.0, rise_sigma=0.02, surface=-0.25, base=base, base_sigma=0.02)
    assert label(lifted, null).change is found
    assert label(replace(lifted, base=-base), null).change is Change.UNCHANGED
    assert label(replace(lifted, surface=-0.02), null).change is Change.UNCHANGED


@pytest.mark.parametrize("sign", [1, -1], ids=["grown", "cut"])
def test_surface_that_changed_on_one_side_of_a_crown_is_no_matter_of_leaves(sign):
    null = fit_null(street(30, 0.0, 0.05), NULL)
    leaves = replace(TREE, rise=0.0, rise_sigma=0.02, surface=0.3 * sign)
    on_side = {"gained_on_side": 0.2} if sign > 0 else {"lost_on_side": 0.2}
    other_side = {"lost_on_side": 0.2} if sign > 0 else {"gained_on_side": 0.2}
    assert label(leaves, null).change is Change.UNCHANGED
    assert label(replace(leaves, **other_side), null).change is Change.UNCHANGED
    found = label(replace(leaves, **on_side), null).change
    assert found is (Change.INCREASED if sign > 0 else Change.DECREASED)
    assert label(replace(leaves, surface=0.1 * sign, **on_side), null).change is Change.UNCHANGED


@pytest.mark.parametrize("sign", [1, -1], ids=["grown", "cut"])
def test_a_part_on_one_side_of_a_crown_must_exceed_what_other_crowns_show_and_no_more(sign):
    null = fit_null(street(30, 0.0, 0.02), NULL)
    less = replace(TREE, rise=0.0, rise_sigma=0.02, surface=0.13 * sign)
    on_side = {"gained_on_side": 0.2} if sign > 0 else {"lost_on_side": 0.2}
    assert label(less, null).change is Change.UNCHANGED
    found = label(replace(less, **on_side), null).change
    assert found is (Change.INCREASED if sign > 0 else Change.DECREASED)
    assert label(replace(less, surface=0.06 * sign, **on_side), null).change is Change.UNCHANGED


@pytest.mark.parametrize("rise", [0.6, -0.6])
def test_a_piece_of_a_hedge_changed_only_if_the_space_above_its_lower_tops_was_observed(rise):
    null = fit_null(street(30, 0.0, 0.05), NULL)
    piece = replace(HEDGE, section=rise, section_gate=0.3, section_only=True, rise=math.nan)
    moved = Change.INCREASED if rise > 0 else Change.DECREASED
    assert label(piece, null).change is moved
    unseen = label(replace(piece, tops_unseen=True), null)
    assert unseen.change is Change.UNCHANGED
    assert "the space above the lower tops was not observed: no change is claimed." in unseen.reason
    assert label(replace(piece, tops_unseen=True, section_only=False), null).change is moved


def leafless(count, loss):
    """Return trees that kept their extent; one in five lost up to ``loss`` of its surface in leaves."""
    calm = [replace(TREE, rise=0.0, rise_sigma=0.02, surface=v) for v in np.linspace(-0.03, 0.03, 4 * count)]
    bare = [replace(TREE, rise=0.05, rise_sigma=0.02, surface=-v) for v in np.linspace(0.1, loss, count)]
    return [*calm, *bare]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_of_surface_that_leaves_alone_caused_in_the_pair_is_none(sign):
    plants = [replace(p, surface=-sign * p.surface) for p in leafless(10, 0.3)]
    null = fit_null(plants, NULL)
    assert null.fits["crown/surface"].sd < 0.06
    pruned = replace(TREE, rise=0.0, outline=0.12 * sign, surface=0.2 * sign)
    assert label(pruned, null).change is Change.UNCHANGED
    assert label(pruned, fit_null(plants[:40], NULL)).change is not Change.UNCHANGED
    assert label(replace(pruned, surface=0.5 * sign), null).change is not Change.UNCHANGED
    kept = [replace(p, outline=0.4, rise=0.4) for p in plants[40:]]
    assert fit_null([*plants[:40], *kept], NULL).fits["crown/surface"].leaves < 0.05


def test_few_points_of_some_plants_do_not_widen_the_scatter_of_the_others():
    rng = np.random.default_rng(3)
    known = [replace(TREE, rise=r, rise_sigma=0.03) for r in rng.normal(0.05, 0.04, 24)]
    poor = [replace(TREE, rise=r, rise_sigma=0.4) for r in rng.normal(0.05, 0.4, 24)]
    null = fit_null([*known, *poor], NULL)
    assert null.fits["crown/rise"].sd < 0.08
    grown = replace(TREE, rise=0.45)
    assert label(replace(grown, rise_sigma=0.03), null).change is Change.INCREASED
    assert label(replace(grown, rise_sigma=0.4), null).change is Change.UNCHANGED


def test_a_share_of_few_voxels_is_no_evidence():
    shrub = replace(HEDGE, rise=math.nan, outline=math.nan, surface=0.22)
    calm = fit_null([replace(HEDGE, surface=v) for v in np.linspace(-0.03, 0.03, 15)], NULL)
    assert label(replace(shrub, voxels=300), calm).change is Change.INCREASED
    assert label(replace(shrub, voxels=8), calm).change is Change.UNCHANGED


def test_a_measure_against_the_direction_of_its_excess_claims_nothing():
    null = fit_null(street(40, 0.6, 0.05), NULL)
    assert label(replace(TREE, outline=0.1), null).change is Change.UNCHANGED
    assert label(replace(TREE, outline=-0.2), null).change is Change.DECREASED


def test_a_top_that_no_surface_carries_is_no_change_and_says_why():
    found = label(replace(TREE, outline=math.nan, top=0.8, surface=0.02), no_null(NULL))
    assert found.change is Change.UNCHANGED
    assert "changed by only" in found.reason


@pytest.mark.parametrize(
    ("surface", "changed", "limit"),
    [
        (-1.91, "-98 %", "14 %"),
        (0.5, "+67 %", "16 %"),
        (-0.5, "-40 %", "14 %"),
        (1.9, "more than +1000 %", "16 %"),
    ],
)
def test_a_reason_states_what_share_of_its_earlier_surface_a_plant_gained_or_lost(surface, changed, limit):
    """Measured is the share of the mean of both surveys, of which nothing can lose more than 200 %."""
    reason = label(replace(TREE, outline=math.nan, surface=surface, voxels=10_000), no_null(NULL)).reason
    assert f"the surface changed by {changed}, " in reason
    assert f"exceeds the limit of {limit}: " in reason


@given(st.permutations(list(range(24))))
@settings(max_examples=15, deadline=None)
def test_the_null_does_not_depend_on_the_order_of_the_tiles(order):
    plants = street(20, 0.1, 0.05, (0.6, 0.7, -0.5, 0.9))
    assert fit_null([plants[i] for i in order], NULL) == fit_null(plants, NULL)


def test_a_null_survives_being_written_and_read():
    null = fit_null(street(30, 0.1, 0.05), NULL)
    assert null_of(null_words(null), NULL) == null


@pytest.mark.parametrize("share", [0.6, 0.35])
def test_the_denser_epoch_is_thinned_to_the_density_of_the_other_where_both_have_points(share):
    rng = np.random.default_rng(4)
    dense = rng.uniform(-2, 2, (4000, 3))
    sparse = rng.uniform(-2, 2, (4000, 3))[: int(4000 * share)]
    before, after, density = equal_density(dense, sparse, PlantConfig())
    assert density == pytest.approx(math.log(share), abs=0.1)
    assert len(before) == pytest.approx(len(after), rel=0.1)
    assert len(after) == len(sparse)


def test_a_plant_that_grew_is_not_taken_for_one_that_is_denser():
    rng = np.random.default_rng(6)
    small, large = rng.uniform(-1, 1, (1000, 3)), rng.uniform(-2, 2, (8000, 3))
    assert equal_density(small, large, PlantConfig())[2] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_at_equal_density_a_crown_with_a_third_of_the_points_keeps_its_outline(seed):
    before, after, _ = equal_density(crown(2400, 2.0, seed), crown(800, 2.0, seed + 10), PlantConfig())
    assert abs(compare_outlines(before, after, OutlineConfig()).shift) < 0.05


def test_a_top_that_few_voxels_or_a_ragged_crown_tell_is_no_growth():
    """The top rose by 0.45 m, with a quarter of the surface new."""
    null = no_null(NULL)
    grown = replace(TREE, outline=math.nan, top=0.45, surface=0.25, free_gained=0.9)
    assert label(replace(grown, top_sigma=0.05), null).change is Change.INCREASED
    ragged = label(replace(grown, top_sigma=0.2, surface=0.12), null)
    assert ragged.change is Change.UNCHANGED
    assert label(replace(grown, top=-0.45, surface=-0.12, top_sigma=0.2), null).change is Change.UNCHANGED


@pytest.mark.parametrize("count", [30, 100, 400])
def test_the_standard_error_of_a_top_is_its_scatter_over_samples_of_pairs(count):
    rng = np.random.default_rng(count)
    samples = np.repeat(rng.triangular(0.0, 4.0, 5.0, (300, count // 2)), 2, axis=1)
    scatter = np.quantile(samples, 0.95, axis=1).std()
    stated = np.median([quantile_sigma(sample, 0.95) for sample in samples])
    assert 0.5 * scatter < stated < 1.7 * scatter


@pytest.mark.parametrize(("rise", "verb"), [(0.304, "exceeds"), (0.296, "does not exceed")])
def test_an_excess_that_rounds_to_its_limit_is_told_with_a_further_digit(rise, verb):
    null = fit_null([], NULL)
    reason = label(replace(TREE, rise=rise, rise_sigma=0.001, surface=0.0), null).reason
    assert f"The excess of +{rise:.3f} m {verb} the limit of 0.300 m" in reason
