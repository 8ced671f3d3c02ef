"""A simulated street, driven twice: packets in, one georeferenced map out, held against the truth."""

import numpy as np
import pytest
from conftest import TwoDrives

from subiaco_geo.frames import Floats
from subiaco_sim.drives import MAP_CRS, WORLD

pytestmark = pytest.mark.slow
NAMES = ("there", "back")


def errors(drives: TwoDrives, name: str) -> tuple[Floats, Floats]:
    """Position errors (N, 3) of a sequence and their stated sigmas (N, 3) [m]."""
    survey = drives.survey
    assert survey.trajectory is not None
    assert survey.uncertainty is not None
    mine = np.flatnonzero(np.array(survey.uncertainty.sequences) == name)
    times = survey.trajectory.times_ns[mine]
    error = survey.trajectory.positions[mine] - drives.truth[name].at(times)[:, :3, 3]
    sigma = np.sqrt(np.diagonal(survey.uncertainty.covariances[mine], axis1=1, axis2=2)[:, 3:])
    return error, sigma


@pytest.mark.parametrize("name", NAMES)
def test_each_drive_lies_within_centimetres_of_the_truth(two_drives: TwoDrives, name: str) -> None:
    error, _ = errors(two_drives, name)
    assert len(error) == 60
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.06


@pytest.mark.parametrize("name", NAMES)
def test_stated_sigmas_are_of_the_size_of_the_errors(two_drives: TwoDrives, name: str) -> None:
    error, sigma = errors(two_drives, name)
    assert 0.25 < np.sqrt((error**2 / sigma**2).mean()) < 1.5


def test_the_two_drives_meet_without_a_seam(two_drives: TwoDrives) -> None:
    there, back = (errors(two_drives, name)[0].mean(axis=0) for name in NAMES)
    assert np.linalg.norm(there - back) < 0.05


def test_both_drives_are_in_one_map_that_lies_on_the_true_surfaces(two_drives: TwoDrives) -> None:
    survey = two_drives.survey
    assert survey.cloud.crs == MAP_CRS
    assert sorted(survey.odometry) == sorted(NAMES)
    assert survey.info["sequences"] == list(NAMES)
    well_seen = np.flatnonzero(survey.cloud.fields["n"] >= 5)[::20]
    xyz = WORLD.points_from_map(survey.cloud.world()[well_seen], MAP_CRS)
    scene = two_drives.scene.drives["before"].compiled
    assert np.median(scene.distance_to_surface(xyz)) < 0.05  # six seconds hold the heading to 2 mrad


def test_no_packet_is_lost_and_the_manifest_tells_the_fixes_by_state(two_drives: TwoDrives) -> None:
    for name in NAMES:
        facts = two_drives.survey.manifest["sequences"][name]
        assert facts["packets"]["lost"] == 0
        fixed = facts["gnss"]["states"]["fixed"]
        assert fixed["rmse_horizontal_m"] < 0.05
        assert fixed["used"] > 20
