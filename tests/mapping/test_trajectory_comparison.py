"""Two trajectories held against each other: figures known by hand, and what the verb leaves behind."""

import json

import numpy as np
import pytest

from subiaco_bringup.cli.main import run
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3
from subiaco_geo.trajectories import Trajectory, write_tum
from subiaco_mapping.map_quality.trajectory_comparison import compare, table


def circle(offset=(0.0, 0.0, 0.0)) -> Trajectory:
    """A turn of 120 m in a minute, ten poses a second."""
    angle = np.linspace(0, 2 * np.pi, 601)
    radius = 120 / (2 * np.pi)
    poses = np.array([exp_se3(np.array([0, 0, a, 0, 0, 0])) for a in angle])
    poses[:, :3, 3] = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + offset
    return Trajectory(np.arange(601) * 100_000_000, poses)


def test_an_offset_is_an_absolute_error_and_no_relative_one():
    found = compare(circle((3.0, 0.0, 4.0)), circle()).described()
    assert found["ape"]["space_m"]["rmse"] == pytest.approx(5.0)
    assert found["ape"]["vertical_m"]["max"] == pytest.approx(4.0)
    assert found["mean_offset_m"] == pytest.approx([3.0, 0.0, 4.0])
    assert list(found["rpe"]) == ["1 m", "10 m", "100 m"]
    assert all(one["translation_m"]["max"] < 1e-9 for one in found["rpe"].values())


def test_alignment_is_done_only_where_it_is_asked_for():
    moved = Trajectory(circle().times_ns, exp_se3(np.array([0.1, 0, 2.0, 5, -3, 1])) @ circle().poses)
    assert compare(moved, circle()).described()["ape"]["space_m"]["rmse"] > 1.0
    found = compare(moved, circle(), align=True).described()
    assert found["aligned"]
    assert found["ape"]["space_m"]["max"] < 1e-9
    assert found["ape"]["rotation_deg"]["max"] < 1e-5


def test_a_rise_of_one_percent_is_a_drift_of_one_percent():
    rising = circle()
    poses = rising.poses.copy()
    poses[:, 2, 3] += 0.01 * np.linspace(0, 120, 601)
    found = compare(Trajectory(rising.times_ns, poses), circle()).described()
    assert found["rpe"]["10 m"]["translation_percent"]["median"] == pytest.approx(1.0, rel=1e-3)


def test_stretches_longer_than_the_way_are_left_out():
    short = Trajectory(circle().times_ns[:60], circle().poses[:60])
    assert [one.length for one in compare(short, short).stretches] == [1.0, 10.0]


def test_trajectories_that_share_no_time_are_refused():
    late = Trajectory(circle().times_ns + 10**12, circle().poses)
    with pytest.raises(InputError, match="clock"):
        compare(late, circle())


def test_the_verb_leaves_table_figures_and_pictures(tmp_path, capsys):
    for name, trajectory in (("a", circle((0.0, 0.03, 0.04))), ("b", circle())):
        write_tum(tmp_path / f"{name}.tum", trajectory)
    words = ["trajectory", str(tmp_path / "a.tum"), str(tmp_path / "b.tum"), "-o", str(tmp_path / "out")]
    assert run(words) == 0
    told = capsys.readouterr().out
    figures = json.loads((tmp_path / "out/comparison.json").read_text())
    assert figures["ape"]["space_m"]["rmse"] == pytest.approx(0.05, abs=1e-4)
    assert told == table(figures) == (tmp_path / "out/comparison.txt").read_text()
    assert "APE space [m]" in told
    assert "RPE over 100 m translation [%]" in told
    for name in ("ape.png", "rpe.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")
    assert run(words) == 2, "an output that stands is not replaced"
