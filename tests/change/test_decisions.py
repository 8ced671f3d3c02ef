"""The rules of the decision table, one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.decisions.confidence import confidence, features, paper_score
from subiaco_change.decisions.confidence_config import ConfidenceConfig
from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.rules import decide
from subiaco_change.objects.measures import Measures
from subiaco_change.objects.space_carving import Interval
from subiaco_geo.codes import Change, Semantic

SAME = Measures(
    iou=0.9, d_perp=0.0, delta_c=0.1, delta_h=0.0, delta_v=0.0, delta_v_surface=0.0, volume=100.0,
    gone_share=0.0, new_share=0.0, observed_fraction=1.0, observed_voxels=500, net_changed_fraction=0.0,
)  # fmt: skip
CONFIG = DecisionConfig()


def label(semantic=Semantic.BUILDING, lod=0.03, before=True, after=True, **changes):
    return decided(semantic, lod, before, after, **changes).change


def decided(semantic=Semantic.BUILDING, lod=0.03, before=True, after=True, **changes):
    """Decide, with the volume that a change of height brings."""
    if not (before and after):
        changes.setdefault("delta_v", 50.0 if after else -50.0)  # what a building encloses
    changes.setdefault(
        "delta_v", 5.0 * np.sign(changes.get("delta_h", 0.0))
    )  # what a change of height carries
    return decide(semantic, before, after, replace(SAME, **changes), lod, CONFIG)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, Change.UNCHANGED),
        ({"delta_h": 0.49}, Change.UNCHANGED),
        ({"delta_h": 0.51}, Change.INCREASED),
        ({"delta_h": -0.51}, Change.DECREASED),
        ({"delta_v": 10.1}, Change.INCREASED),
        ({"delta_v": -10.1}, Change.DECREASED),
        ({"delta_h": 0.6, "delta_v": -20.0}, Change.DECREASED),
        ({"delta_h": -0.6, "delta_v": 20.0}, Change.INCREASED),
        ({"delta_h": 3.0, "iou": 0.10}, Change.UNCHANGED),  # no bounds say what became of it
    ],
)
def test_buildings_follow_the_table(changes, expected):
    assert label(**changes) is expected


@pytest.mark.parametrize(("before", "after", "sign"), [(True, False, -1.0), (False, True, 1.0)])
def test_a_building_of_one_survey_that_encloses_no_volume_is_a_piece_of_a_wall(before, after, sign):
    share = {"gone_share": 1.0} if before else {"new_share": 1.0}
    claimed = Change.REMOVED if before else Change.ADDED
    for volume, expected in ((0.0, Change.UNOBSERVED), (1.9, Change.UNOBSERVED), (2.1, claimed)):
        assert label(before=before, after=after, delta_v=sign * volume, **share) is expected
        fence = label(Semantic.OTHER, before=before, after=after, delta_v=sign * volume, **share)
        assert fence is claimed  # a fence encloses nothing
    found = decide(Semantic.BUILDING, before, after, replace(SAME, delta_v=0.0, **share), 0.03, CONFIG)
    assert "encloses 0.0 m³ (limit 2 m³)" in found.reason


def test_a_height_change_below_the_gate_is_not_claimed():
    assert label(delta_h=0.8, lod=0.7) is Change.UNCHANGED
    assert label(delta_h=0.9, lod=0.7) is Change.INCREASED


@pytest.mark.parametrize(
    ("height", "volume", "expected"),
    [
        ((0.51, 3.0), (0.0, 40.0), Change.INCREASED),
        ((0.24, 3.0), (4.9, 40.0), Change.UNCHANGED),
        ((0.0, 0.1), (9.0, 17.0), Change.INCREASED),
        ((0.0, 0.1), (-17.0, -9.0), Change.DECREASED),
        ((0.0, 0.1), (6.0, 13.0), Change.UNCHANGED),
        ((-0.1, 0.1), (10.1, 40.0), Change.INCREASED),
        ((-3.0, -0.51), (-40.0, 0.0), Change.DECREASED),
        ((-3.0, 3.0), (-40.0, 40.0), Change.UNCHANGED),
        ((0.6, 0.7), (-40.0, -20.0), Change.DECREASED),
        ((math.nan, math.nan), (11.0, 12.0), Change.INCREASED),
    ],
)
def test_a_label_of_a_building_needs_the_middle_beyond_its_limit_and_a_certain_sign(height, volume, expected):
    bounds = {"height_bounds": Interval(*height), "volume_bounds": Interval(*volume)}
    assert label(**bounds) is expected


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_change_of_height_tells_no_sign_that_the_middle_of_the_volume_opposes(sign):
    """A house was replaced by a lower one: the veranda rose, and nobody saw what is under the gable now."""

    def told(low, high):
        height, volume = Interval(0.7, 1.0), Interval(low, high)
        turned = (height, volume) if sign > 0 else (-height, -volume)
        return label(height_bounds=turned[0], volume_bounds=turned[1])

    grew = Change.INCREASED if sign > 0 else Change.DECREASED
    assert told(-82.0, 22.0) is Change.UNCHANGED
    assert told(-30.0, 22.0) is grew  # by less than half of the limit
    assert told(0.0, 22.0) is grew


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_walls_seen_free_on_both_sides_tell_the_sign_of_a_change_of_volume_unless_the_height_opposes(sign):
    """Of a wing most of the volume was not seen: its bounds are 1 and 40 %; its surface tells the sign."""

    def told(surface, opposite=0.0, height=(-0.1, 0.1), nearer=1.0, resolution=0.0):
        volume, areas = Interval(nearer, 40.0), (surface, opposite)
        if sign < 0:
            volume, height, areas = -volume, (-height[1], -height[0]), areas[::-1]
        names = zip(("gained_surface", "lost_surface"), areas, strict=True)
        bounds = {"height_bounds": Interval(*height), "volume_bounds": volume}
        return label(**bounds, volume_resolution=resolution, **dict(names))

    found = Change.INCREASED if sign > 0 else Change.DECREASED
    enough = CONFIG.building.sign_surface
    assert told(enough) is found
    assert told(0.9 * enough) is told(0.0, opposite=enough) is Change.UNCHANGED
    assert told(enough, nearer=-1.0) is Change.UNCHANGED
    assert told(enough, height=(-1.3, 0.05)) is Change.UNCHANGED
    assert told(enough, height=(-0.1, 1.5)) is Change.UNCHANGED  # the roof was not seen
    assert told(enough, resolution=2.0) is found  # -1 to 42 % is stated, and the surface beside it
    assert told(enough, height=(0.1, 0.4), resolution=2.0) is found


@pytest.mark.parametrize(("surface", "expected"), [(13.0, Change.INCREASED), (7.0, Change.UNCHANGED)])
def test_the_volume_of_the_limit_must_fit_behind_the_surfaces_that_tell_a_sign(surface, expected):
    """Behind 7 m² of a block of 700 m³, 70 m³ would be 10 m deep."""
    bounds = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": Interval(7.0, 280.0)}
    assert label(**bounds, volume=700.0, gained_surface=surface) is expected


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_may_have_changed_where_nobody_looked_does_not_oppose_what_was_seen(sign):
    """A wing of 11 to 16 % was demolished; where it hid the house, up to 31 % may have been built."""

    def told(seen=(11.0, 16.0), unseen=(0.0, 31.0), surface=0.0):
        lost, gained = Interval(*seen), Interval(*unseen)
        net = Interval(gained.low - lost.high, gained.high - lost.low)
        bounds = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": net, "gained_surface": surface}
        if sign > 0:
            bounds |= {"volume_bounds": -net, "gained_surface": 0.0, "lost_surface": surface}
            gained, lost = lost, gained
        return decided(**bounds, gained=gained, lost=lost)

    found, words = (Change.INCREASED, "gain of") if sign > 0 else (Change.DECREASED, "loss of")
    assert told().change is found
    assert (
        f"volume change {'-20% to +16%' if sign > 0 else '-16% to +20%'} (limit 10%; a {words}"
        in told().reason
    )
    assert told(unseen=(1.0, 31.0)).change is Change.UNCHANGED  # some of it is certain
    assert told(surface=CONFIG.building.sign_surface).change is Change.UNCHANGED  # its walls were seen
    assert told(seen=(3.0, 16.0)).change is Change.UNCHANGED  # the middle does not exceed the limit
    assert told(seen=(0.0, 31.0)).change is Change.UNCHANGED  # neither was seen


def test_a_label_that_rests_on_surfaces_says_so():
    bounds = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": Interval(1.0, 40.0)}
    reason = decided(**bounds, gained_surface=6.0).reason
    assert "6 m² of new walls stand where the earlier survey saw free space on both sides" in reason
    turned = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": Interval(-40.0, -1.0)}
    assert "6 m² of former walls stood where the later" in decided(**turned, lost_surface=6.0).reason
    sure = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": Interval(20.0, 40.0)}
    assert "walls stand" not in decided(**sure, gained_surface=6.0).reason


def test_a_building_of_which_both_surveys_share_nothing_is_decided_by_its_bounds():
    lost = {"height_bounds": Interval(-2.7, 0.0), "volume_bounds": Interval(-60.0, -15.0)}
    assert label(iou=0.0, **lost) is Change.DECREASED
    unknown = {"height_bounds": Interval(float("nan"), float("nan")), "volume_bounds": Interval(-60.0, -15.0)}
    assert label(iou=0.0, **unknown) is Change.UNCHANGED


def test_an_interval_that_straddles_its_limit_says_so_and_costs_confidence():
    def decided(volume):
        bounds = replace(SAME, height_bounds=Interval(0.0, 0.0), volume_bounds=volume)
        decision = decide(Semantic.BUILDING, True, True, bounds, 0.03, CONFIG)
        found = features(decision, bounds, Semantic.BUILDING, 0.9)
        return decision, confidence(decision, found, bounds, ConfidenceConfig())

    straddling, doubtful = decided(Interval(2.0, 12.0))
    clear, sure = decided(Interval(-1.0, 1.0))
    assert straddling.change is clear.change is Change.UNCHANGED
    assert "did not observe" in straddling.reason
    assert "did not observe" not in clear.reason
    assert doubtful < sure
    barely, clearly = decided(Interval(8.0, 20.0))[0], decided(Interval(15.0, 20.0))[0]
    assert barely.change is clearly.change is Change.INCREASED
    assert "did not observe" in barely.reason
    assert "did not observe" not in clearly.reason
    assert barely.sigmas < clearly.sigmas


def test_an_unchanged_building_that_one_survey_saw_in_part_says_that_its_rest_is_not_known():
    bounds = {"height_bounds": Interval(-0.1, 0.1), "volume_bounds": Interval(-3.0, 3.0)}
    partly = decided(**bounds, observed_fraction=0.53)
    assert partly.change is Change.UNCHANGED
    assert partly.reason.endswith(
        "Both surveys saw 53% of the building's surfaces: of the rest nothing is known."
    )
    assert decided(**bounds, observed_fraction=0.95).reason.endswith("no change is claimed.")
    grown = {"height_bounds": Interval(2.5, 3.0), "volume_bounds": Interval(20.0, 30.0)}
    assert "of the rest" not in decided(**grown, observed_fraction=0.53).reason


def test_a_change_of_height_that_no_volume_carries_is_none():
    bounds = {"height_bounds": Interval(5.3, 7.9), "volume_bounds": Interval(0.0, 0.0)}
    assert label(**bounds) is Change.UNCHANGED
    assert label(**bounds | {"volume_bounds": Interval(0.0, 30.0)}) is Change.INCREASED


def test_new_walls_without_volume_are_no_change_of_a_house():
    assert label(Semantic.BUILDING, net_changed_fraction=0.3) is Change.UNCHANGED


def test_no_level_of_detection_means_no_claim():
    assert label(delta_h=3.0, lod=math.inf) is Change.UNOBSERVED


def test_one_sided_objects_need_a_place_that_was_seen_empty():
    assert label(before=False, new_share=0.9) is Change.ADDED
    assert label(after=False, gone_share=0.9) is Change.REMOVED
    assert label(after=False, gone_share=0.2) is Change.UNCHANGED
    assert label(after=False, gone_share=0.9, observed_fraction=0.05) is Change.UNOBSERVED
    assert label(before=False, new_share=1.0, observed_voxels=2) is Change.UNOBSERVED


def test_moved_vehicles_are_left_out_of_the_report():
    assert label(Semantic.MOBILE) is Change.UNCHANGED
    assert label(Semantic.MOBILE, delta_c=2.1) is Change.NOT_REPORTED


def test_every_decision_gives_its_reason():
    taller = replace(SAME, delta_h=3.0, delta_v=40.0)
    assert (
        "Height change +3.00 to +3.00 m (limit 0.50 m)"
        in decide(Semantic.BUILDING, True, True, taller, 0.03, CONFIG).reason
    )


def test_confidence_never_falls_with_the_margin_or_with_the_size_of_what_was_seen():
    shipped = ConfidenceConfig()
    steep = shipped.reshaped.model_copy(update={"margin": 1.0, "size": 1.0})

    def trust(config, **changes):
        measures = replace(SAME, delta_v=5.0 if changes["delta_h"] > 0 else 0.0, **changes)
        decision = decide(Semantic.BUILDING, True, True, measures, 0.03, CONFIG)
        return confidence(decision, features(decision, measures, Semantic.BUILDING, 0.9), measures, config)

    for config in (shipped, shipped.model_copy(update={"reshaped": steep})):
        assert trust(config, delta_h=0.55) <= trust(config, delta_h=1.0) <= trust(config, delta_h=3.0) <= 1.0
        assert trust(config, delta_h=1.0, observed_voxels=20) <= trust(config, delta_h=1.0)
        assert trust(config, delta_h=0.45) < trust(config, delta_h=0.0)
    assert trust(config, delta_h=0.55) < trust(config, delta_h=1.0)
    assert trust(config, delta_h=1.0, observed_voxels=20) < trust(config, delta_h=1.0)


def test_the_papers_score_is_never_below_one_half_and_empty_where_it_has_no_weights():
    assert paper_score(Semantic.BUILDING, SAME, 0.03) >= 0.5
    assert paper_score(Semantic.BUILDING, replace(SAME, delta_h=3.0), 0.03) > 0.99
    assert math.isnan(paper_score(Semantic.MOBILE, SAME, 0.03))
