"""The survey as written: bag, truth points, truth table."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from ouster.sdk.core import FrameBatcher, LidarFrame, LidarPacket, PacketFormat, SensorInfo, XYZLut
from scipy.spatial import cKDTree

from subiaco_geo import topics
from subiaco_geo.bags import BagReader, packet_from_cdr
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import transform_points
from subiaco_geo.trajectories import read_tum
from subiaco_sim.config import EpochChoice, MapErrorConfig, SimulationConfig
from subiaco_sim.drives import MAP_CRS, WORLD, first_points, lidar_of, plan_survey, scans_of
from subiaco_sim.fused import MapFuser
from subiaco_sim.labels import label_scene
from subiaco_sim.lidar import Lidar, column_times
from subiaco_sim.map_errors import MapWarp
from subiaco_sim.packets import PacketMaker
from subiaco_sim.scene import BUILDING
from subiaco_sim.survey import simulate

LABELS = {"Added", "Removed", "Increased", "Decreased", "Unchanged"}


def read_objects(folder: Path) -> list[dict[str, str]]:
    with (folder / "truth" / "objects.csv").open() as stream:
        return list(csv.DictReader(stream))


def decoded_frames(folder: Path, epoch: str) -> Iterator[tuple[SensorInfo, LidarFrame]]:
    with BagReader(folder / epoch) as bag:
        text = bag.deserialize(next(iter(bag.messages([topics.METADATA])))).data
        info = SensorInfo(text)
        layout, batcher, frame = PacketFormat(info), FrameBatcher(info), LidarFrame(info)
        for message in bag.messages([topics.LIDAR_PACKETS]):
            packet = LidarPacket(layout)
            packet.buf[:] = np.frombuffer(packet_from_cdr(message.raw), np.uint8)
            batcher.batch(packet, frame)
            if frame.complete():
                yield info, frame
                frame = LidarFrame(info)


@pytest.fixture(scope="module")
def frames(sample: Any) -> list[LidarFrame]:
    return [frame for _, frame in decoded_frames(sample.folder, "before")]


def test_every_scan_comes_back_through_the_sensor_makers_decoder_with_the_ranges_that_were_cast(
    sample: Any, frames: list[LidarFrame]
) -> None:
    drive = sample.survey.drives["before"]
    lidar = Lidar(drive.info, sample.survey.config.lidar, False)
    assert len(frames) == drive.scans == 40
    for scan, frame in zip(scans_of(sample.survey, drive, lidar), frames[:3], strict=False):
        assert frame.frame_id == scan.frame_id
        np.testing.assert_array_equal(frame.field("RANGE"), scan.first.range_mm)
        np.testing.assert_array_equal(frame.field("REFLECTIVITY"), scan.first.reflectivity)
        np.testing.assert_array_equal(frame.field("SIGNAL"), scan.first.signal)


def test_every_column_has_its_own_time_and_time_never_stands_still(
    sample: Any, frames: list[LidarFrame]
) -> None:
    times = np.concatenate([frame.timestamp for frame in frames]).astype(np.int64)
    assert (np.diff(times) > 0).all()
    assert set(np.diff(times)) <= {195312, 195313}
    start_ns = sample.survey.drives["before"].motion.start_ns
    np.testing.assert_array_equal(times[:512], column_times(start_ns, 0, 512))


def test_messages_arrive_in_order_with_the_rates_that_were_asked_for(sample: Any) -> None:
    with BagReader(sample.folder / "after") as bag:
        counts = {name: info.count for name, info in bag.topics.items()}
        arrivals = [message.log_time_ns for message in bag.messages()]
    assert counts[topics.LIDAR_PACKETS] == 40 * 32
    assert counts[topics.FIX] == 20
    assert counts[topics.IMU] == 420
    assert counts[topics.METADATA] == counts[topics.TF_STATIC] == 1
    assert np.all(np.diff(arrivals) >= 0)


def test_the_two_antennas_give_the_true_yaw_of_the_vehicle_with_its_covariance(sample: Any) -> None:
    motion = sample.survey.drives["after"].motion
    with BagReader(sample.folder / "after") as bag:
        found = [bag.deserialize(message) for message in bag.messages([topics.HEADING])]
    assert 15 < len(found) < 20  # none while the fix is single or lost
    times = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in found])
    turned = np.array([[m.orientation.z, m.orientation.w] for m in found])
    yaw = 2 * np.arctan2(turned[:, 0], turned[:, 1])
    off = (yaw - motion.angles(motion.seconds(times))[:, 0] + np.pi) % (2 * np.pi) - np.pi
    sigma = np.radians(sample.survey.config.gnss.heading_sigma_deg)
    assert 0.4 * sigma < off.std() < 2 * sigma
    assert np.abs(off).max() < 4 * sigma
    assert {m.orientation_covariance[8] for m in found} == {sigma**2}
    assert {m.header.frame_id for m in found} == {"base_link"}
    assert {(m.angular_velocity_covariance[0], m.linear_acceleration_covariance[0]) for m in found} == {
        (-1.0, -1.0)
    }


def test_a_decoded_scan_at_its_true_pose_lies_on_the_truth_points(
    sample: Any, frames: list[LidarFrame]
) -> None:
    """At rest one pose serves the whole scan, so the chain decoder, extrinsics, truth must close."""
    frame = frames[4]  # the vehicle moves off at 1 s
    xyz = np.asarray(XYZLut(sample.survey.drives["before"].info, False)(frame))[frame.field("RANGE") > 0]
    truth = read_tum(sample.folder / "before" / "truth" / "trajectory.tum")
    world = transform_points(truth.poses[4], xyz)
    points = np.load(sample.folder / "before" / "truth" / "points.npz")["xyz"]
    distance, _ = cKDTree(points - points[0]).query(world - points[0])
    assert np.percentile(distance, 99) < np.sqrt(3) * sample.survey.config.truth.leaf


@pytest.mark.parametrize("epoch", ["before", "after"])
def test_truth_points_lie_on_the_surfaces_of_their_epoch_within_the_range_noise(
    sample: Any, epoch: str
) -> None:
    points = np.load(sample.folder / epoch / "truth" / "points.npz")
    assert points["xyz"].dtype == np.float64
    assert points["xyz"][:, 1].min() > 6.4e6  # MGA northing
    local = WORLD.points_from_map(points["xyz"], MAP_CRS)
    gap = sample.survey.drives[epoch].compiled.distance_to_surface(local)
    noise = sample.survey.config.lidar
    sigma = noise.range_sigma + noise.range_sigma_slope * noise.max_range
    assert np.sqrt(np.mean(gap**2)) < sigma
    assert gap.max() < 6 * sigma


def test_every_label_occurs_and_nothing_changes_without_an_event(sample: Any) -> None:
    rows = read_objects(sample.folder)
    assert {row["label"] for row in rows} == LABELS
    assert {row["label"] for row in rows if row["class_name"] == "building"} == LABELS
    assert {row["label"] for row in rows if row["class_name"] == "vegetation"} == LABELS
    assert {row["label"] for row in rows if row["class_name"] == "mobile"} == {
        "Added",
        "Removed",
        "Unchanged",
    }
    assert {row["label"] for row in rows if row["class_name"] == "ground"} == LABELS - {"Added", "Removed"}
    quiet = {"", "another car", "re-roofed", "thin overlay", "small pit"}
    assert all(row["label"] == "Unchanged" for row in rows if row["event"] in quiet)
    assert all(row["label"] != "Unchanged" for row in rows if row["event"] not in quiet)


def test_things_that_stand_in_both_epochs_may_be_seen_in_one_alone_and_are_then_undecidable(
    sample: Any,
) -> None:
    standing = {i.object_id for i in sample.survey.scene.items if i.before and i.after}
    rows = [row for row in read_objects(sample.folder) if int(row["object_id"]) in standing]
    for epoch, other in (("before", "after"), ("after", "before")):
        alone = [row for row in rows if int(row[f"n_{epoch}"]) >= 5 and int(row[f"n_{other}"]) == 0]
        assert alone
        shares = [int(row[f"n_{epoch}_seen"]) / int(row[f"n_{epoch}"]) for row in alone]
        assert np.mean(shares) < 0.5


def test_points_carry_the_label_of_their_object_or_255(sample: Any) -> None:
    change_of = {int(row["object_id"]): int(row["change"]) for row in read_objects(sample.folder)}
    change_of[0] = 4
    for epoch in ("before", "after"):
        points = np.load(sample.folder / epoch / "truth" / "points.npz")
        expected = np.array([change_of[k] for k in points["object"].tolist()])
        seen = points["change"] != 255
        assert 0.5 < seen.mean() < 1.0
        np.testing.assert_array_equal(points["change"][seen], expected[seen])
    assert not (points["change"] == 1).any()  # nothing removed is left in the later epoch


def test_the_same_seed_gives_the_same_packets_and_another_seed_others(sample: Any, tmp_path: Path) -> None:
    config = sample.survey.config
    again = config.model_copy(update={"epoch": EpochChoice.AFTER})
    simulate(tmp_path / "again", again)
    first, second = (
        yaml.safe_load((folder / "truth" / "scene.yaml").read_text())
        for folder in (sample.folder, tmp_path / "again")
    )
    assert first["scene_hash"] == second["scene_hash"]
    assert len(first["epochs"]["after"]["packets_sha256"]) == 64
    assert first["epochs"]["after"]["packets_sha256"] == second["epochs"]["after"]["packets_sha256"]

    def first_packet(seed: int) -> bytes:
        survey = plan_survey(config.model_copy(update={"seed": seed}))
        scans = scans_of(
            survey, survey.drives["after"], Lidar(survey.drives["after"].info, config.lidar, False)
        )
        return next(PacketMaker(survey.drives["after"].info).packets(next(scans))).buf

    assert first_packet(4) != first_packet(3)


def test_fused_maps_carry_truth_and_what_the_drive_saw(tmp_path: Path) -> None:
    config = SimulationConfig(
        preset="easy",
        seed=3,
        duration=2.0,
        mode="512x10",
        ground_cell=0.8,
        epoch="before",
        maps_only=True,
        dual_return=True,
    )
    simulate(tmp_path / "maps", config)
    cloud = read_cloud(tmp_path / "maps" / "before" / "map.ply")
    assert cloud.crs == MAP_CRS
    assert {"object", "true_class", "true_change", "n", "intensity"} <= set(cloud.fields)
    voxels = np.floor(WORLD.points_from_map(cloud.world(), MAP_CRS) / config.map_leaf + 1e-6)
    assert len(np.unique(voxels, axis=0)) > 0.98 * len(cloud)
    assert (tmp_path / "maps" / "before" / "visibility.npz").is_file()
    assert not (tmp_path / "maps" / "before" / "bag").exists()


def test_duplicate_facades_stand_beside_the_buildings_of_the_middle_of_the_drive_alone(sample: Any) -> None:
    survey, drive = sample.survey, sample.survey.drives["before"]
    building = label_scene(survey.scene).semantic == BUILDING
    lidar = lidar_of(survey, drive)
    errors = (MapErrorConfig(), MapErrorConfig(duplicates=0.5))
    warps = [MapWarp(wrong, np.zeros(3), 3) for wrong in errors]
    fusers = [MapFuser(0.25, drive, warp, lidar.beams, building) for warp in warps]
    for scan in islice(scans_of(survey, drive, lidar), 0, None, 5):
        points = first_points(survey, lidar, scan)
        for fuser in fusers:
            fuser.add(scan, points)
    fused = [fuser.result() for fuser in fusers]
    facades = [building[object_id] for _, _, object_id, _ in fused]
    true, doubled = (count[facade].sum() for (_, _, _, count), facade in zip(fused, facades, strict=True))
    assert 1.3 < doubled / true < 1.7
    assert fused[1][3].sum() - fused[0][3].sum() == pytest.approx(doubled - true, rel=0.01)
    gaps = [
        drive.compiled.distance_to_surface(xyz[facade])
        for (xyz, _, _, _), facade in zip(fused, facades, strict=True)
    ]
    assert np.percentile(gaps[0], 98) < 0.15
    assert 0.15 < np.percentile(gaps[1], 98) <= 0.35


def test_an_output_that_exists_is_left_alone(sample: Any) -> None:
    with pytest.raises(InputError, match="exists already"):
        simulate(sample.folder, sample.survey.config)


@pytest.mark.parametrize("preset", ["castle", "moon"])
def test_a_preset_that_does_not_exist_is_refused_and_nothing_is_left(tmp_path: Path, preset: str) -> None:
    with pytest.raises(InputError, match="choose one of easy, default, hard, city"):
        simulate(tmp_path / "out", SimulationConfig(preset=preset))
    assert list(tmp_path.iterdir()) == []


def test_a_drive_longer_than_the_street_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="street is too short"):
        simulate(tmp_path / "out", SimulationConfig(preset="easy", duration=200.0))


def test_a_city_is_one_survey_a_loop_each_in_its_own_place_of_one_frame(tmp_path: Path) -> None:
    config = SimulationConfig(
        preset="city",
        seed=3,
        city_loops=2,
        duration=1.2,
        mode="512x10",
        ground_cell=2.0,
        epoch="before",
        maps_only=True,
    )
    simulate(tmp_path / "city", config)
    listed = yaml.safe_load((tmp_path / "city" / "truth" / "city.yaml").read_text())["loops"]
    assert listed == ["loop_01", "loop_02"]
    scenes = [
        yaml.safe_load((tmp_path / "city" / name / "truth" / "scene.yaml").read_text()) for name in listed
    ]
    assert scenes[0]["scene_hash"] != scenes[1]["scene_hash"]
    assert scenes[0]["simulator_hash"] == scenes[1]["simulator_hash"]
    starts = [
        read_tum(tmp_path / "city" / name / "before" / "truth" / "trajectory.tum").poses[0] for name in listed
    ]
    np.testing.assert_allclose(starts[1][0, 3] - starts[0][0, 3], 110.0, atol=1.0)  # the loops' pitch
