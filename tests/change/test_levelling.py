"""A tilted local map is labelled level; what is handed on stays in its own frame."""

import numpy as np
import pytest
from alignment_scene import UP, street
from scenes import Scene
from scipy.spatial.transform import Rotation

from subiaco_change.config import ChangeConfig
from subiaco_change.level_of_detection.common_frame import levelled
from subiaco_change.pipeline import detect_changes
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.survey_map import SurveyMap

TILT = Rotation.from_euler("xy", (10.0, -6.0), degrees=True).as_matrix()


def test_a_tilted_local_cloud_is_turned_level_and_keeps_its_form():
    cloud = street(1)
    tilted = PointCloud(cloud.xyz @ TILT.T, fields={"normals": cloud.fields["normals"] @ TILT.T})
    level = levelled(tilted)
    ground = np.abs(cloud.fields["normals"][:, 2]) > 0.9
    assert np.allclose(level.fields["normals"][ground] @ UP, 1.0, atol=1e-4)
    some = slice(0, None, 5000)
    distances = [np.linalg.norm(c.xyz[some] - c.xyz[0], axis=1) for c in (tilted, level)]
    assert np.allclose(*distances)


def test_a_cloud_with_a_crs_or_a_street_that_merely_slopes_is_left_as_it_is():
    cloud = street(1)
    tilted = PointCloud(cloud.xyz @ TILT.T, crs="EPSG:7850")
    assert levelled(tilted) is tilted
    slope = PointCloud(cloud.xyz + np.outer(cloud.xyz[:, 0] * 0.02, UP))
    assert levelled(slope) is slope


@pytest.fixture(scope="module")
def tilted_pair():
    before = Scene(houses=[(-12, 13), (12, 13)], trees=[(0, -13)])
    after = Scene(houses=[(-12, 13), (12, -13)], trees=[(0, -13)])
    return [
        SurveyMap(PointCloud(scene.survey(seed).cloud.world() @ TILT.T))
        for seed, scene in ((1, before), (2, after))
    ]


def test_maps_tilted_by_12_degrees_give_the_changes_of_level_ones_in_the_frame_of_after(tilted_pair):
    config = ChangeConfig(evidence=EvidenceConfig(source="assumed"))
    result = detect_changes(*tilted_pair, config, transform=np.eye(4))
    houses = {r.change: TILT.T @ (r.x, r.y, r.z) for r in result.records if r.semantic is Semantic.BUILDING}
    assert set(houses) == {Change.UNCHANGED, Change.REMOVED, Change.ADDED}
    assert np.allclose(houses[Change.REMOVED][:2], (12, 13), atol=1.5)
    assert np.allclose(houses[Change.ADDED][:2], (12, -13), atol=1.5)
    low, high = tilted_pair[1].cloud.xyz.min(axis=0), tilted_pair[1].cloud.xyz.max(axis=0)
    assert np.allclose(result.after.world().min(axis=0), low, atol=0.3)
    assert np.allclose(result.after.world().max(axis=0), high, atol=0.3)
