"""A run in tiles: one table whatever the order, the workers and the history; objects whole across tiles."""

import shutil
from functools import cache

import numpy as np
import pytest
from scenes import Scene

from subiaco_change.config import ChangeConfig
from subiaco_change.outputs.table import build_table, table_hash
from subiaco_change.pipeline import detect_changes
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.work.executors import InProcess, LocalPool
from subiaco_geo.work.store import DiskStore
from subiaco_geo.work.task_runner import TaskRunner, stages_from

IDENTITY = np.eye(4)
#: Small tiles, so that a street of 70 m has several; a house and a hedge stand across their edges.
CONFIG = ChangeConfig.model_validate({"tiles": {"size": 40}})
BEFORE = Scene(houses=[(-22, 13), (0, 13), (22, 13)], trees=[(-8, -13), (8, -13, 5.0, 1.5)], cars=[(-15, 0)])
AFTER = Scene(
    houses=[(-22, 13), (0, 13, 10, 8, 8.0)],
    trees=[(-8, -13), (8, -13, 5.0, 1.5), (17, -13)],
    cars=[(12, 1)],
    lift=lambda x, y: 0.25 * ((abs(y + 4.75) < 0.75) & (abs(x) < 15)),
)


class Backwards(InProcess):
    """Does the last task first."""

    def run(self, store, tasks):
        """Do the tasks from the last to the first."""
        yield from super().run(store, tasks[::-1])


@cache
def pair():
    return SurveyMap(BEFORE.survey(1).cloud), SurveyMap(AFTER.survey(2).cloud)


def run(runner=None, **options):
    return detect_changes(*pair(), CONFIG, transform=IDENTITY, runner=runner, **options)


def hash_of(result):
    return table_hash(build_table(result.records, None))


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Stages of one run, and its result."""
    folder = tmp_path_factory.mktemp("run") / "stages"
    return folder, run(TaskRunner(DiskStore(folder)))


def test_changes_across_the_edges_of_tiles_are_found_whole(kept):
    found = {
        (r.semantic, r.change): r
        for r in kept[1].records
        if r.change not in (Change.UNCHANGED, Change.NOT_REPORTED)
    }
    raised = found[Semantic.BUILDING, Change.INCREASED]
    assert np.hypot(raised.x, raised.y - 13) < 2.0
    assert raised.footprint.area > 60.0  # the house of 10 m x 8 m stands on the edge between two tiles
    gone = found[Semantic.BUILDING, Change.REMOVED]
    assert np.hypot(gone.x - 22, gone.y - 13) < 2.0
    strip = found[Semantic.GROUND, Change.INCREASED]
    assert strip.footprint.area == pytest.approx(45.0, abs=8.0)
    assert strip.n_before > 100
    assert strip.n_after > 100


def test_points_of_every_tile_carry_the_id_of_their_row(kept):
    result = kept[1]
    for record in result.records:
        for cloud, count in ((result.before, record.n_before), (result.after, record.n_after)):
            assert np.count_nonzero(cloud.fields["instance"] == record.object_id) == count


def test_the_table_is_the_same_backwards_and_by_two_workers(kept, tmp_path):
    expected = hash_of(kept[1])
    assert hash_of(run(TaskRunner(executor=Backwards()))) == expected
    pool = LocalPool(2, ("subiaco_change.tiling.run",))
    assert hash_of(run(TaskRunner(DiskStore(tmp_path), pool))) == expected
    pool.close()


def test_a_run_that_was_stopped_goes_on_where_it_was(kept, tmp_path):
    folder = tmp_path / "stages"
    shutil.copytree(kept[0], folder)
    for stage in ("compare", "labels", "patches"):
        shutil.rmtree(folder / stage)
    for path in sorted((folder / "semantics").iterdir())[::2]:
        path.unlink()
    runner = TaskRunner(DiskStore(folder))
    assert hash_of(run(runner)) == hash_of(kept[1])
    done = {(spent.stage, spent.name) for spent in runner.spent}
    assert {stage for stage, _ in done} == {"semantics", "compare", "labels", "patches"}
    assert runner.kept > len(done)


def test_another_setting_redoes_only_what_rests_on_it(kept, tmp_path):
    folder = tmp_path / "stages"
    shutil.copytree(kept[0], folder)
    runner = TaskRunner(DiskStore(folder))
    other = CONFIG.model_copy(
        update={"ground": CONFIG.ground.model_copy(update={"area": 60.0, "small_area": 60.0})}
    )
    result = detect_changes(*pair(), other, transform=IDENTITY, runner=runner)
    assert {spent.stage for spent in runner.spent} == {"ground", "threshold_components", "patches", "labels"}
    assert not [r for r in result.records if r.semantic is Semantic.GROUND]


def test_stages_from_one_on_are_done_again(kept, tmp_path):
    folder = tmp_path / "stages"
    shutil.copytree(kept[0], folder)
    runner = TaskRunner(DiskStore(folder), redo=stages_from(("semantics", "compare", "labels"), "compare"))
    assert hash_of(run(runner)) == hash_of(kept[1])
    assert {spent.stage for spent in runner.spent} == {"compare", "labels"}


def test_given_classes_and_objects_are_taken_as_they_are(kept):
    """What a run found, given back to another, leads to the same changes."""
    result = kept[1]
    clouds = []
    for cloud in (result.before, result.after):
        instance = np.full(len(cloud), -1, dtype=np.int32)
        for number, record in enumerate(result.records):
            if record.semantic is not Semantic.GROUND:
                instance[cloud.fields["instance"] == record.object_id] = number
        fields = {"semantic": cloud.fields["semantic"], "instance": instance}
        clouds.append(SurveyMap(PointCloud(cloud.xyz, cloud.origin, cloud.crs, fields)))
    again = detect_changes(*clouds, CONFIG, transform=IDENTITY, given=("semantic", "instance"))
    said = [
        sorted(
            (r.semantic, r.change)
            for r in found.records
            if r.change not in (Change.UNCHANGED, Change.NOT_REPORTED)
        )
        for found in (result, again)
    ]
    assert said[0] == said[1]


def test_a_given_field_that_is_missing_is_named():
    with pytest.raises(InputError, match="before: no point field 'semantic'"):
        run(given=("semantic",))


@pytest.mark.parametrize("count", [1, 40])
def test_a_tile_with_hardly_a_point_is_labelled_too(count, kept, tmp_path):
    """Corners of a city hold a few points: they end as something, and stop nothing."""
    folder = tmp_path / "stages"
    shutil.copytree(kept[0], folder)
    rng = np.random.default_rng(count)
    few = rng.uniform(0, 3, (count, 3)) + np.array([90.0, 10.0, 0.0])
    before, after = pair()
    more = PointCloud(np.concatenate([before.cloud.xyz, few]), before.cloud.origin)
    runner = TaskRunner(DiskStore(folder))
    result = detect_changes(SurveyMap(more), after, CONFIG, transform=IDENTITY, runner=runner)
    assert runner.kept > 0
    alone = result.before.xyz[:, 0] > 80
    assert 1 <= np.count_nonzero(alone) <= count
    assert set(result.before.fields["change"][alone]) <= {Change.UNOBSERVED, Change.UNCHANGED, Change.REMOVED}
