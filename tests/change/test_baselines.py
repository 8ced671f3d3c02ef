"""Simple methods on a street whose changes are known."""

import numpy as np
import pytest
from scenes import Scene

from subiaco_evaluation.baseline_run import METHODS, compare_pair, detect_simply
from subiaco_evaluation.baselines.cells import clean, make_pair
from subiaco_evaluation.baselines.config import DsmConfig
from subiaco_evaluation.baselines.dsm import difference_surfaces
from subiaco_evaluation.baselines.pair_preparation import prepare_pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError, RegistrationError
from subiaco_geo.survey_map import SurveyMap

IDENTITY = np.eye(4)
CONFIG = BaselineConfig()


def embankment(x, y):
    """Ground filled up by 0.8 m over 8 m x 8 m."""
    return 0.8 * ((abs(x + 22) < 4) & (abs(y + 12) < 4))


BEFORE = Scene(houses=[(-22, 13), (-8, 13), (8, 13, 10, 8, 8.0), (22, 13)], trees=[(0, -13)], cars=[(-15, 0)])
AFTER = Scene(
    houses=[(-22, 13), (8, 13, 10, 8, 5.0), (22, 13, 10, 8, 8.0), (20, -13)],
    trees=[(0, -13)],
    cars=[(-15, 0)],
    lift=embankment,
)
# Place, epoch whose points are looked at, label.
KNOWN = {
    "new house": (20, -13, "after", Change.ADDED),
    "demolished house": (-8, 13, "before", Change.REMOVED),
    "storey added": (22, 13, "after", Change.INCREASED),
    "storey taken away": (8, 13, "before", Change.DECREASED),
    "ground filled up": (-22, -12, "after", Change.INCREASED),
    "same house": (-22, 13, "after", Change.UNCHANGED),
    "same tree": (0, -13, "after", Change.UNCHANGED),
}


@pytest.fixture(scope="module")
def pair():
    return prepare_pair(BEFORE.survey(1), AFTER.survey(2), CONFIG, IDENTITY)[0]


@pytest.fixture(scope="module", params=list(METHODS))
def found(request, pair):
    return compare_pair(pair, request.param, CONFIG)


@pytest.fixture(scope="module")
def quiet_pair():
    return prepare_pair(BEFORE.survey(3), BEFORE.survey(4), CONFIG, IDENTITY)[0]


def commonest(cloud, x, y, reach=1.5):
    """The label most points in the middle of a place carry, of its highest 0.5 m."""
    near = (abs(cloud.xyz[:, :2] - (x, y)) < reach).all(axis=1)
    near &= cloud.xyz[:, 2] > cloud.xyz[near, 2].max() - 0.5
    return Change(int(np.bincount(np.asarray(cloud.fields["change"])[near]).argmax()))


@pytest.mark.parametrize("place", list(KNOWN))
def test_every_method_names_what_is_plain_to_see(found, place):
    x, y, epoch, change = KNOWN[place]
    assert commonest(getattr(found, epoch), x, y) is change


def test_every_patch_is_a_row_and_its_points_carry_its_number_and_label(found):
    assert {r.change for r in found.records} >= {
        Change.ADDED,
        Change.REMOVED,
        Change.INCREASED,
        Change.DECREASED,
    }
    for epoch in ("before", "after"):
        cloud = getattr(found, epoch)
        for record in found.records:
            mine = np.asarray(cloud.fields["instance"]) == record.object_id
            assert mine.sum() == getattr(record, f"n_{epoch}")
            assert set(np.asarray(cloud.fields["change"])[mine]) <= {record.change}


def test_added_lies_in_after_alone_and_removed_in_before_alone(found):
    assert not (np.asarray(found.before.fields["change"]) == Change.ADDED).any()
    assert not (np.asarray(found.after.fields["change"]) == Change.REMOVED).any()


def test_the_row_of_a_new_house_measures_it(found):
    rows = [r for r in found.records if r.change is Change.ADDED and np.hypot(r.x - 20, r.y + 13) < 1.0]
    house = max(rows, key=lambda r: r.footprint.area)
    assert house.footprint.area == pytest.approx(80.0, abs=25.0)
    assert house.delta_h_m == pytest.approx(5.0, abs=0.2)
    assert house.n_before == 0
    assert house.semantic is Semantic.OTHER
    assert house.evidence == "assumed"


@pytest.mark.parametrize("method", METHODS)
def test_where_nothing_changed_hardly_anything_is_claimed(quiet_pair, method):
    result = compare_pair(quiet_pair, method, CONFIG)
    codes = np.concatenate([np.asarray(c.fields["change"]) for c in (result.before, result.after)])
    assert (codes < Change.UNCHANGED).mean() < 0.01


@pytest.mark.parametrize("method", ["dsm", "c2c"])
def test_swapping_the_epochs_swaps_the_labels(pair, method):
    swapped = {Change.ADDED: Change.REMOVED, Change.INCREASED: Change.DECREASED}
    swapped |= {v: k for k, v in swapped.items()} | {c: c for c in (Change.UNCHANGED, Change.UNOBSERVED)}
    forth = compare_pair(pair, method, CONFIG)
    mirrored = make_pair(pair.after.cloud, pair.before.cloud, pair.registration, CONFIG)
    back = compare_pair(mirrored, method, CONFIG)
    expected = [swapped[Change(int(code))] for code in np.asarray(forth.after.fields["change"])]
    same = np.asarray(back.before.fields["change"]) == np.array(expected)
    assert same.mean() > 0.999  # an equal share of both epochs is a tie, which goes upwards


def shifted(survey, offset):
    return SurveyMap(PointCloud(survey.cloud.xyz, np.array(offset), "EPSG:7850"))


@pytest.mark.parametrize("method", ["dsm"])
def test_labels_do_not_depend_on_where_in_the_world_the_street_lies(pair, method):
    offset = (392_000.0, 6_464_000.0, 10.0)
    surveys = (shifted(BEFORE.survey(1), offset), shifted(AFTER.survey(2), offset))
    far = prepare_pair(*surveys, CONFIG, IDENTITY)[0]
    here, there = compare_pair(pair, method, CONFIG), compare_pair(far, method, CONFIG)
    equal = np.asarray(here.after.fields["change"]) == np.asarray(there.after.fields["change"])
    assert equal.mean() > 0.999
    assert there.records[0].x - offset[0] == pytest.approx(here.records[0].x, abs=0.5)


@pytest.mark.parametrize(
    ("voids", "expected"),
    [("unobserved", Change.UNOBSERVED), ("unchanged", Change.UNCHANGED), ("ground", Change.ADDED)],
)
def test_surface_models_treat_cells_without_points_as_they_are_told(voids, expected):
    hidden = BEFORE.survey(1).cloud
    hole = (abs(hidden.xyz[:, :2] - (20, -13)) < (5, 4)).all(axis=1)
    config = CONFIG.model_copy(update={"dsm": DsmConfig(voids=voids)})
    pair = prepare_pair(SurveyMap(hidden.select(~hole)), AFTER.survey(2), config, IDENTITY)[0]
    code = difference_surfaces(pair, config).code
    row, column = np.divmod(pair.grid.flat(np.array([[20.0, -13.0, 0.0]]))[0], pair.grid.shape[1])
    assert code[row, column] == expected


def test_specks_and_slivers_are_cleaned_away():
    mask = np.zeros((20, 20), dtype=bool)
    mask[2, 2] = mask[5, 3:12] = True
    mask[10:15, 10:15] = True
    opened = clean(mask, DsmConfig(opening=1, min_area=1.0), 0.5)
    assert opened.sum() == 25
    assert clean(mask, DsmConfig(opening=0, min_area=2.0), 0.5).sum() == 25 + 9
    assert clean(mask, DsmConfig(opening=0, min_area=7.0), 0.5).sum() == 0


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(InputError, match="dsm, nn, m3c2, c2c"):
        detect_simply(BEFORE.survey(1), AFTER.survey(2), "magic", CONFIG, transform=IDENTITY)


def test_a_transform_that_leaves_no_overlap_is_refused():
    away = np.eye(4)
    away[0, 3] = 500.0
    with pytest.raises(RegistrationError, match="do not overlap"):
        detect_simply(BEFORE.survey(1), AFTER.survey(2), "dsm", CONFIG, transform=away)


def test_too_many_cells_are_refused_with_a_remedy(pair):
    config = CONFIG.model_copy(update={"cells": CONFIG.cells.model_copy(update={"cell": 0.001})})
    with pytest.raises(InputError, match=r"cells\.cell"):
        make_pair(pair.before.cloud, pair.after.cloud, pair.registration, config)
