"""Wires and poles are followed through crowns; trunks, sparse facades and beds are none of them."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import ground_z, rectangle, tree

from subiaco_change.segmentation.buildings import planar_patches
from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.config import BuildingConfig
from subiaco_change.segmentation.wires_and_poles import LineConfig, find_lines
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic


def ground(rng):
    xyz = rectangle(rng, (-20, -15, 0), (40, 0, 0), (0, 30, 0))
    xyz[:, 2] = ground_z(xyz[:, 0], xyz[:, 1])
    return xyz


def wire(rng, y, height, low=-18.0, high=18.0):
    """A wire along x that sags by half a metre."""
    x = rng.uniform(low, high, int(6 * (high - low)))
    z = ground_z(x, y) + height + 0.5 * (x / 18.0) ** 2
    return np.column_stack([x, np.full(len(x), y), z]) + rng.normal(scale=0.02, size=(len(x), 3))


def post(rng, x, y, height):
    """A pole of 0.2 m."""
    n = int(60 * height)
    angle, z = rng.random(n) * 2 * np.pi, rng.random(n) * height
    return np.stack([x + 0.1 * np.cos(angle), y + 0.1 * np.sin(angle), ground_z(x, y) + z], axis=1)


def label(parts):
    """Class of the points of every part, at the working leaf."""
    xyz, owner = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    cloud = voxel_downsample(PointCloud(xyz, fields={"part": owner.astype(np.float32)}), 0.25)
    part, semantic = cloud.fields["part"], label_points(cloud, SemanticsConfig()).semantic
    return [semantic[np.abs(part - i) < 0.01] for i in range(len(parts))]


def share(semantic, kind):
    return float((semantic == kind).mean())


def test_wires_above_one_another_are_other_also_within_the_crown_that_they_pass_through():
    rng = np.random.default_rng(3)
    parts = [ground(rng), tree(rng, 0, 5, 8.0, 2.5), wire(rng, 5.0, 5.5), wire(rng, 5.0, 6.6)]
    found = label(parts)
    assert share(found[2], Semantic.OTHER) > 0.85
    assert share(found[3], Semantic.OTHER) > 0.85
    assert share(found[1], Semantic.VEGETATION) > 0.9


@pytest.mark.parametrize("seed", [4, 5])
def test_a_pole_that_passes_through_a_crown_is_other_and_the_trunk_of_a_tree_is_not(seed):
    rng = np.random.default_rng(seed)
    parts = [ground(rng), tree(rng, 0, 5, 6.5, 2.0), post(rng, 1.2, 5.0, 10.0), tree(rng, -10, -5, 9.0, 2.0)]
    found = label(parts)
    assert share(found[2], Semantic.OTHER) > 0.8
    assert share(found[1], Semantic.VEGETATION) > 0.85
    assert share(found[3], Semantic.VEGETATION) > 0.9


def test_columns_of_a_facade_seen_in_lines_a_metre_apart_are_no_poles():
    rng = np.random.default_rng(6)
    columns = [post(rng, x, 0.0, 9.0) for x in np.arange(-6, 6, 1.0)]
    xyz = np.concatenate(columns)
    free, far = np.ones(len(xyz), dtype=bool), np.full(len(xyz), 0.4)
    height = xyz[:, 2] - ground_z(xyz[:, 0], xyz[:, 1])
    none = np.zeros(len(xyz), dtype=bool)
    assert not find_lines(xyz, height, far, free, none, LineConfig()).any()
    single = columns[0]
    alone = slice(0, len(single))
    assert find_lines(single, height[alone], far[alone], free[alone], none[alone], LineConfig()).mean() > 0.9


def test_a_facade_has_height_where_wires_have_none():
    config, rng = BuildingConfig(), np.random.default_rng(7)
    facade = rectangle(rng, (0, 0, 3), (10, 0, 0), (0, 0, 6), 12)
    sheet = np.concatenate([wire(rng, 40.0, h, 0.0, 12.0) for h in (5.0, 5.4)])
    xyz = np.concatenate([facade, sheet])
    owner = np.repeat([0, 1], [len(facade), len(sheet)])
    normal = np.tile([0.0, 1.0, 0.0], (len(xyz), 1))
    near = np.argsort(np.linalg.norm(xyz[:, None] - xyz, axis=2), axis=1)[:, :9].astype(np.int32)

    class Flat:
        neighbours, normals = near, normal

    patches = planar_patches(xyz, Flat, np.ones(len(xyz), dtype=bool), 10.0, 0.3, 0.5)
    of = [np.bincount(patches.label[(owner == i) & (patches.label >= 0)]).argmax() for i in range(2)]
    assert patches.rise[of[0]] > config.wire_rise * 1.5
    assert patches.rise[of[1]] < config.wire_rise * 0.7
