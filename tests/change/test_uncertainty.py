"""sigma_reg as a field: it sees drift, shear and doubled facades, and carries pose covariances."""

import numpy as np
import pytest
from alignment_scene import UP, rigid, street
from assembled_run import place, sigma_field

from subiaco_change.level_of_detection.alignment_corrections import PlacingConfig
from subiaco_change.level_of_detection.displacement_lod import LodConfig, combine, measure_displacements
from subiaco_change.level_of_detection.registration_uncertainty import (
    EpochPoseErrors,
    UncertaintyConfig,
    pose_errors,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.trajectories import Trajectory

EAST = np.array([1.0, 0.0, 0.0])
NORTH = np.array([0.0, 1.0, 0.0])


def field(before, after, registration=None, **settings):
    clouds = before, after
    config = UncertaintyConfig(**settings.pop("config", {}))
    return sigma_field(clouds, registration or rigid(), config, **settings)


def at(sigma, x, y, normal):
    return float(sigma.at(np.array([[x, y, 1.0]]), normal[None])[0])


def within(x0, x1):
    return lambda xyz: ((xyz[:, 0] > x0) & (xyz[:, 0] < x1)).astype(float)


def test_epochs_that_fit_leave_little_beyond_the_noise_of_their_points():
    sigma = field(street(1), street(2), config={"floor": 0.0})
    assert np.quantile(sigma.bias, 0.9) < 0.003
    assert at(sigma, 80, 30, UP) < 0.004


def test_a_local_shear_shows_where_it_is_and_nowhere_else():
    sheared = street(1, lambda p: np.outer(0.06 * within(40, 80)(p), NORTH))
    sigma = field(sheared, street(2))
    assert at(sigma, 60, 12, NORTH) == pytest.approx(0.06, abs=0.015)
    assert at(sigma, 130, 12, NORTH) < 0.01
    assert at(sigma, 60, 30, UP) < 0.01  # the ground lies where it lay


def test_a_drift_of_the_ground_shows_along_the_vertical_only():
    risen = street(1, lambda p: np.outer(0.04 * within(100, 160)(p) * (p[:, 2] < 0.5), UP))
    sigma = field(risen, street(2))
    assert at(sigma, 130, 30, UP) == pytest.approx(0.04, abs=0.01)
    assert at(sigma, 130, 12, NORTH) < 0.01
    assert at(sigma, 30, 30, UP) < 0.01


def test_facades_that_stand_twice_widen_it_near_them():
    plain = street(1)
    wall = (plain.xyz[:, 2] > 0.3) & (plain.xyz[:, 0] < 60) & (np.abs(plain.fields["normals"][:, 1]) > 0.5)
    double = PointCloud(
        np.vstack([plain.xyz, plain.xyz[wall] + 0.12 * NORTH]),
        fields={"normals": np.vstack([plain.fields["normals"], plain.fields["normals"][wall]])},
    )
    sigma = field(double, street(2))
    assert at(sigma, 30, 12, NORTH) > 3 * at(sigma, 130, 12, NORTH)
    assert at(sigma, 30, 12, NORTH) > 0.02


def test_a_real_change_of_some_surfaces_does_not_pass_for_uncertainty():
    dug = street(1, lambda p: np.outer(0.3 * ((p[:, 0] % 20 < 8) & (p[:, 1] > 20) & (p[:, 1] < 30)), UP))
    sigma = field(dug, street(2))
    assert at(sigma, 70, 40, UP) < 0.02


def test_known_changes_are_left_out_entirely():
    moved = street(1, lambda p: np.outer(0.2 * within(40, 80)(p), UP))
    changed = within(35, 85)(moved.xyz) > 0
    other = street(2)
    sigma = field(moved, other, exclude=(changed, within(35, 85)(other.xyz) > 0))
    assert at(sigma, 60, 30, UP) < 0.02


def test_means_under_a_drift_of_short_waves_exceed_the_lod_as_rarely_as_it_says():
    rng = np.random.default_rng(7)
    waves = rng.normal(0, 1, (40, 2)) * (2 * np.pi / rng.uniform(8, 25, (40, 1)))
    phases = rng.uniform(0, 2 * np.pi, 40)

    def drift(p):
        rise = 0.012 * np.sqrt(2 / 40) * np.cos(p[:, :2] @ waves.T + phases).sum(axis=1)
        return np.outer(rise, UP)

    before, after = street(1, drift), street(2)
    sigma = field(before, after, config={"floor": 0.0})
    found = measure_displacements(before, after, LodConfig())
    lies = (np.abs(before.fields["normals"][:, 2]) > 0.9) & np.isfinite(found.distance)
    _, first = np.unique(np.floor(before.xyz[lies, :2] / 2.5).astype(int), axis=0, return_index=True)
    chosen = np.flatnonzero(lies)[first]
    stated = sigma.at(before.xyz[chosen], before.fields["normals"][chosen])
    lod = combine(found.variance[chosen], stated, "quadrature")
    assert len(chosen) > 1000
    assert 0.92 < np.mean(np.abs(found.distance[chosen]) <= lod) < 0.98
    bare = combine(found.variance[chosen], 0.0, "quadrature")
    assert np.mean(np.abs(found.distance[chosen]) <= bare) < 0.75


def test_the_transform_counts_more_the_farther_a_point_is_from_its_centre():
    registration = rigid()
    registration.pose_std[1] = 1e-3  # rad about north: the ends of the street rise and fall
    sigma = field(street(1), street(2), registration)
    assert at(sigma, 155, 30, UP) == pytest.approx(0.075, rel=0.05)
    assert at(sigma, 80, 30, UP) < 0.005


def test_pose_covariances_of_both_epochs_join_in_quadrature():
    covariance = np.zeros((1, 6, 6))
    covariance[0, 5, 5], covariance[0, 2, 2] = 0.03**2, 0.001**2
    one = EpochPoseErrors(np.array([[80.0, 30.0, 0.0]]), covariance)
    two = EpochPoseErrors(np.array([[80.0, 30.0, 0.0]]), covariance * (4 / 3) ** 2)
    plain, both = (field(street(1), street(2), poses=p, config={"floor": 0.0}) for p in ((), (one, two)))
    assert at(both, 80, 30, UP) == pytest.approx(np.hypot(at(plain, 80, 30, UP), 0.05), rel=0.01)
    # a yaw of 1 mrad (and 4/3 of that) moves a wall 20 m ahead sideways
    walls = np.sqrt(at(both, 100, 30, NORTH) ** 2 - at(plain, 100, 30, NORTH) ** 2)
    assert walls == pytest.approx(0.02 * 5 / 3, rel=0.02)


def test_pose_covariances_turn_into_the_common_frame():
    covariance = np.diag([0, 0, 0, 0.04**2, 0.01**2, 0.02**2])[None]
    turn = np.array([[0.0, -1, 0, 100], [1, 0, 0, 50], [0, 0, 1, 0], [0, 0, 0, 1]])
    errors = pose_errors(np.array([[5.0, 0.0, 2.0]]), covariance, turn)
    assert np.allclose(errors.positions, [[100.0, 55.0, 2.0]])
    there = np.array([[100.0, 55.0, 2.0]])
    assert np.sqrt(errors.variance(there, NORTH[None]))[0] == pytest.approx(0.04)
    assert np.sqrt(errors.variance(there, EAST[None]))[0] == pytest.approx(0.01)


@pytest.mark.parametrize("heeded", [True, False])
def test_a_run_heeds_the_pose_covariances_of_a_map_unless_told_not_to(heeded):
    clouds = street(1, length=40.0), street(2, length=40.0)
    poses = np.eye(4)[None].repeat(2, axis=0)
    poses[:, :3, 3] = [(10.0, 30.0, 2.0), (30.0, 30.0, 2.0)]
    times = np.array([10, 20])
    covariances = np.diag([0, 0, 0, 0.04**2, 0.04**2, 0.04**2])[None].repeat(2, axis=0)
    known = PoseUncertainty(times, ["a", "a"], covariances)
    surveys = SurveyMap(clouds[0], Trajectory(times, poses), uncertainty=known), SurveyMap(clouds[1])
    nothing = tuple(np.zeros(len(c), dtype=bool) for c in clouds)
    config = PlacingConfig(uncertainty=UncertaintyConfig(pose_covariance=heeded))
    found = place(clouds, rigid(), nothing, nothing, config, LodConfig(), surveys)
    assert (at(found.sigma, 20, 30, UP) > 0.039) == heeded
    assert (np.median(found.lods[0][np.isfinite(found.lods[0])]) > 0.07) == heeded


def test_an_epoch_that_states_no_poses_is_never_better_known_than_one_that_does():
    clouds = street(1, length=40.0), street(2, length=40.0)
    poses = np.eye(4)[None].repeat(2, axis=0)
    poses[:, :3, 3] = [(10.0, 30.0, 2.0), (30.0, 30.0, 2.0)]
    times = np.array([10, 20])
    nothing = tuple(np.zeros(len(c), dtype=bool) for c in clouds)

    def sigma(*stated):
        surveys = []
        for cloud, size in zip(clouds, stated, strict=True):
            known = None
            if size is not None:
                covariance = np.diag([0, 0, 0, size**2, size**2, size**2])[None].repeat(2, axis=0)
                known = PoseUncertainty(times, ["a", "a"], covariance)
            surveys.append(SurveyMap(cloud, Trajectory(times, poses), uncertainty=known))
        found = place(clouds, rigid(), nothing, nothing, PlacingConfig(), LodConfig(), tuple(surveys))
        return at(found.sigma, 20, 30, UP)

    bare = sigma(None, None)
    assert bare == pytest.approx(np.hypot(0.04, 0.04), rel=0.05)
    assert sigma(0.03, 0.03) < sigma(0.03, None) < bare
    assert sigma(0.2, None) == pytest.approx(sigma(0.2, 0.2), rel=0.01)


def test_the_floor_holds_where_nothing_is_known():
    empty = PointCloud(np.array([[0.0, 0.0, 0.0]]), fields={"normals": UP[None]})
    sigma = field(empty, empty, config={"floor": 0.004})
    assert at(sigma, 0, 0, UP) >= 0.004
