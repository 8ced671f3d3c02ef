"""A dry run does the largest tiles and scales what they take to all points."""

import numpy as np
import pytest
from scenes import Scene

from subiaco_change.config import ChangeConfig
from subiaco_change.dry_run import Sample, dry_run, estimate
from subiaco_change.job import disk_bytes
from subiaco_change.request import ChangeRequest
from subiaco_change.tiling.run import ChangeRun
from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.sources import LoadedEpoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.work.task_runner import TaskRunner
from subiaco_geo.work.tasks import peak_mib

ORIGIN = np.array([390_000.0, 6_464_000.0, 0.0])


def request_of(tmp_path, **options):
    return ChangeRequest.of(before=tmp_path / "a", after=tmp_path / "b", output=tmp_path / "c", **options)


def sample_of(**values):
    taken = {"taken": ["0_0", "0_1"], "taken_points": 400_000}
    return Sample(1, tiles=40, points=4_000_000, inputs=6_000_000, **taken, **values)


COSTS = {
    "registration": {"cpu_s": 3.0, "peak_mib": 500.0},
    "semantics": {"cpu_s": 8.0, "peak_mib": 700.0},
    "trails": {"cpu_s": 5.0, "peak_mib": 300.0},
}


def test_tiles_scale_with_points_and_the_registration_only_to_its_limit(tmp_path):
    found = estimate(sample_of(done={"trails": 5.0}), COSTS, 20.0, 6.0, request_of(tmp_path, workers=4))
    alone, registration, shared = 20.0 + 60.0, 3.0 * 5.0, 5.0 + 80.0
    assert found.alone_s == pytest.approx(alone)
    assert found.cpu_s == pytest.approx(alone + registration + shared)
    assert found.wall_s == pytest.approx(alone + registration + shared / 4)
    assert found.memory_mib == pytest.approx(peak_mib() + 4 * 700.0, rel=0.01)
    assert (found.tiles, found.taken, found.points) == (40, 2, 4_000_000)


def test_seconds_of_tasks_that_this_process_does_itself_count_once(tmp_path):
    apart = estimate(sample_of(done={"trails": 5.0}), COSTS, 20.0, 6.0, request_of(tmp_path, workers=2))
    here = estimate(sample_of(done={"trails": 5.0}), COSTS, 25.0, 17.0, request_of(tmp_path, workers=1))
    assert here.cpu_s == pytest.approx(apart.cpu_s)
    assert here.wall_s == pytest.approx(here.cpu_s)
    assert here.memory_mib == pytest.approx(peak_mib(), rel=0.01)


def test_an_estimate_names_time_memory_disk_and_what_it_rests_on(tmp_path):
    said = estimate(sample_of(), COSTS, 20.0, 6.0, request_of(tmp_path)).text()
    for part in (
        "CPU s",
        "min by the clock",
        "GB of memory",
        "1.4 GB of disk",
        "40 tiles",
        "on 2 tiles",
    ):
        assert part in said


def cut_run(crs):
    """Cut two epochs of five tiles of 40 m in a row; the fourth has the most points."""
    rng = np.random.default_rng(5)
    parts = [
        rng.uniform((40.0 * k, 0, 0), (40.0 * (k + 1), 40, 5), (count, 3))
        for k, count in enumerate((200, 200, 300, 900, 400))
    ]
    cloud = PointCloud(np.concatenate(parts), ORIGIN, crs)
    run = ChangeRun(TaskRunner(), ChangeConfig.model_validate({"tiles": {"size": 40}}))
    run.cut([LoadedEpoch(SurveyMap(cloud)), LoadedEpoch(SurveyMap(cloud))])
    return run


def test_the_tile_with_the_most_points_and_its_neighbours_are_taken():
    run, sample = cut_run("EPSG:7850"), Sample(1)
    sample.begin(run)
    assert sample.taken == [f"{int(ORIGIN[0]) // 40 + k}_{int(ORIGIN[1]) // 40}" for k in (2, 3, 4)]
    assert (sample.tiles, len(run.clouds["before"]), len(run.clouds["after"])) == (5, 3, 3)
    assert 0.95 * 4000 < sample.points <= 4000
    assert sample.taken_points / sample.points == pytest.approx(0.8, abs=0.02)


def test_clouds_without_crs_have_no_largest_tiles():
    with pytest.raises(InputError, match="run the whole"):
        Sample(1).begin(cut_run(None))


def test_a_dry_run_does_the_largest_tile_and_leaves_nothing(tmp_path):
    paths = []
    for name, scene, seed in (("a", Scene(trees=[(-8, -13)]), 1), ("b", Scene(houses=[(0, 13)]), 2)):
        cloud = scene.survey(seed).cloud
        paths.append(tmp_path / f"{name}.ply")
        write_cloud(paths[-1], PointCloud(cloud.xyz, ORIGIN, "EPSG:7850"))
    request = ChangeRequest.of(
        before=paths[0],
        after=paths[1],
        output=tmp_path / "out",
        transform="identity",
        config=ChangeConfig.model_validate({"tiles": {"size": 40}, "second_registration": False}),
    )
    found = dry_run(request, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]
    assert 0 < found.taken <= found.tiles
    assert found.cpu_s >= found.alone_s > 0.0
    assert found.wall_s == pytest.approx(found.cpu_s)
    inputs = sum(len(read_cloud(path)) for path in paths)
    assert found.disk_bytes == sum(disk_bytes(found.points, inputs, ChangeConfig()))
