"""Objects followed through three epochs."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import pytest
from shapely.geometry import box

from subiaco_change.history import HistoryStep, build_history, run_epochs
from subiaco_change.request import ChangeRequest
from subiaco_geo.errors import InputError

Row = tuple[str, str, str, str, str, float]


def table(*rows: Row) -> gpd.GeoDataFrame:
    """Rows of uid, class, label, ids before, ids after, and where the footprint begins."""
    uid, semantic, label, before, after, x = zip(*rows, strict=True)
    return gpd.GeoDataFrame(
        {
            "object_uid": uid,
            "class": semantic,
            "label": label,
            "id_before": before,
            "id_after": after,
            "confidence": 0.8,
        },
        geometry=[box(left, 0, left + 4, 4) for left in x],
    )


def follow(first: gpd.GeoDataFrame, second: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    steps = [HistoryStep("2019", "2022", first), HistoryStep("2022", "2025", second)]
    return build_history(steps).set_index("history_id")


def test_a_house_that_was_built_and_then_extended_is_one_object():
    history = follow(
        table(("a", "building", "Added", "", "7", 0)),
        table(("b", "building", "Increased", "7", "3", 0)),
    )
    row = history.loc["a"]
    assert len(history) == 1
    assert (row["first_seen"], row["last_seen"]) == ("2022", "2025")
    assert (row["appeared_after"], row["gone_by"]) == ("2019", "")
    assert row["changes"] == "2019 to 2022: Added; 2022 to 2025: Increased"
    assert row["object_uids"] == "a;b"


def test_a_tree_that_stood_and_was_felled_ends_with_the_epoch_that_saw_it_last():
    history = follow(
        table(("a", "vegetation", "Unchanged", "4", "9", 0)),
        table(("b", "vegetation", "Removed", "9", "", 0)),
    )
    row = history.loc["a"]
    assert (row["first_seen"], row["last_seen"], row["gone_by"]) == ("2019", "2022", "2025")


def test_an_object_that_the_middle_epoch_could_not_see_is_one_object_and_says_so():
    history = follow(
        table(("a", "building", "Unobserved", "4", "", 0)),
        table(("b", "building", "Unobserved", "", "6", 0.3), ("c", "building", "Unobserved", "", "8", 30)),
    )
    assert sorted(history.index) == ["a", "c"]
    row = history.loc["a"]
    assert (row["first_seen"], row["last_seen"], row["not_seen"]) == ("2019", "2025", "2022")
    assert row["changes"] == ""


def test_an_object_that_both_pairs_call_occupied_is_neither_new_nor_gone():
    history = follow(
        table(("a", "building", "Unchanged", "4", "", 0)),
        table(("b", "building", "Unchanged", "", "6", 0.3)),
    )
    row = history.loc["a"]
    assert len(history) == 1
    assert row["object_uids"] == "a;b"
    assert (row["first_seen"], row["last_seen"]) == ("2019", "2025")
    assert (row["appeared_after"], row["gone_by"], row["not_seen"]) == ("", "", "")


def test_two_rows_of_one_pair_at_one_place_that_is_occupied_in_both_are_one_object():
    history = follow(
        table(("a", "building", "Unchanged", "4", "", 0), ("b", "building", "Unchanged", "", "5", 0.2)),
        table(("c", "building", "Removed", "5", "", 0.2)),
    )
    assert list(history.index) == ["a"]
    assert history.loc["a", "object_uids"] == "a;b;c"
    assert history.loc["a", "gone_by"] == "2025"


def possible_ends(label: str, instance: str) -> set[tuple[str, str]]:
    """Return the ids before and after that a row of a label can have where it has one instance."""
    ends = {"Added": {("", instance)}, "Removed": {(instance, "")}}
    return ends.get(label, {(instance, ""), ("", instance)})


@pytest.mark.parametrize("first", ["Unchanged", "Unobserved", "Increased", "Decreased", "Added", "Removed"])
@pytest.mark.parametrize("second", ["Unchanged", "Unobserved", "Increased", "Decreased", "Added", "Removed"])
def test_a_history_claims_absence_only_where_a_pair_says_added_or_removed(first: str, second: str):
    for ends_first in possible_ends(first, "1"):
        for ends_second in possible_ends(second, "2"):
            history = follow(
                table(("a", "building", first, *ends_first, 0)),
                table(("b", "building", second, *ends_second, 50)),
            )
            for name, label in (("a", first), ("b", second)):
                row = history.loc[name]
                assert bool(row["appeared_after"]) == (label == "Added")
                assert bool(row["gone_by"]) == (label == "Removed")


def test_a_shed_that_was_replaced_by_another_is_two_objects():
    history = follow(
        table(("a", "building", "Removed", "4", "", 0), ("b", "building", "Added", "", "5", 0)),
        table(("c", "building", "Unchanged", "5", "1", 0)),
    )
    assert sorted(history.index) == ["a", "b"]
    assert history.loc["a", "gone_by"] == "2022"
    assert history.loc["b", "object_uids"] == "b;c"


def test_split_and_merged_objects_share_one_history_and_moving_things_have_none():
    history = follow(
        table(("a", "building", "Unchanged", "1;2", "3", 0), ("m", "mobile", "Added", "", "9", 50)),
        table(("b", "building", "Decreased", "3", "4", 0)),
    )
    assert list(history.index) == ["a"]


def test_ground_patches_stand_alone():
    history = follow(
        table(("a", "ground", "Increased", "", "", 0)), table(("b", "ground", "Decreased", "", "", 0))
    )
    assert sorted(history.index) == ["a", "b"]
    assert history.loc["b", "changes"] == "2022 to 2025: Decreased"


def test_two_epochs_of_one_name_are_refused_before_anything_is_run(tmp_path: Path):
    for name in ("x", "y"):
        (tmp_path / name / "map").mkdir(parents=True)
    epochs = [tmp_path / "x" / "map", tmp_path / "y" / "map", tmp_path / "x"]
    with pytest.raises(InputError, match="two epochs are called map"):
        run_epochs(epochs, ChangeRequest(before=epochs[0], after=epochs[-1], output=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
