"""Sparse clouds: lengths follow the spacing, trees of a park are found, what is too little is Unobserved."""

from __future__ import annotations

import numpy as np
import pytest
from park_scene import make_park

from subiaco_change.config import ChangeConfig
from subiaco_change.outputs.rasters import COVERAGE, build_coverage
from subiaco_change.pipeline import detect_changes
from subiaco_change.point_spacing import at_spacing
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic

IDENTITY = np.eye(4)


def test_lengths_stay_as_they_are_for_clouds_as_dense_as_a_mapped_street():
    config = ChangeConfig()
    for spacing in (0.1, 0.25, config.spacing.served, float("inf")):
        assert at_spacing(config, spacing) == config


@pytest.mark.parametrize("spacing", [0.5, 0.8, 1.3])
def test_lengths_rise_with_the_spacing_and_the_fewest_points_fall_with_its_square(spacing):
    config = ChangeConfig()
    sparse, sparser = at_spacing(config, spacing), at_spacing(config, 1.5 * spacing)
    assert sparse.semantics.cluster_voxel == pytest.approx(
        max(0.4, min(0.4 / config.spacing.served, 1.2) * spacing)
    )
    assert sparser.instances.building_gap >= sparse.instances.building_gap >= config.instances.building_gap
    assert sparse.lod.radius >= 2.4 * spacing
    assert (sparser.instances.leaf / sparse.instances.leaf) ** 2 == pytest.approx(2.25)
    assert sparse.evidence.shadow_ring >= 2.4 * spacing
    assert sparser.evidence.shadow_radius >= sparse.evidence.shadow_radius >= config.evidence.shadow_radius
    assert sparse.instances.foliage_layers == 1.0
    above, higher = (at_spacing(config, s, from_above=True) for s in (spacing, 1.5 * spacing))
    assert higher.instances.foliage_layers == pytest.approx(1.5 * above.instances.foliage_layers)
    assert higher.instances.density_voxel > above.instances.density_voxel > sparse.instances.density_voxel


def test_voxels_of_a_sparse_cloud_are_patches_of_their_own_once_their_points_lie_a_metre_apart():
    patches = [at_spacing(ChangeConfig(), s).measures.patch_voxels for s in (0.3, 0.5, 0.7, 1.0, 1.4)]
    assert patches == pytest.approx([4.0, 4.0, 4.0 * (0.5 / 0.7) ** 2, 1.0, 1.0])


def of_trees(result, trees):
    """Labels of the plants that stand where trees do."""
    return [
        sorted(
            r.change.name
            for r in result.records
            if r.semantic is Semantic.VEGETATION and np.hypot(r.x - x, r.y - y) < max(2.0, radius)
        )
        for x, y, _, radius in trees
    ]


@pytest.fixture(scope="module")
def park():
    trees = make_park()
    return trees, detect_changes(trees.before(0.7), trees.after(0.7), ChangeConfig(), transform=IDENTITY)


def test_trees_of_a_park_with_a_point_in_half_a_square_metre_are_found_felled_planted_and_grown(park):
    trees, result = park
    assert all(found == ["REMOVED"] for found in of_trees(result, trees.felled))
    assert all(found and set(found) == {"ADDED"} for found in of_trees(result, trees.planted))
    grown = of_trees(result, trees.grown)
    assert sum(found == ["INCREASED"] for found in grown) >= 4, grown


def test_trees_that_stay_are_claimed_by_nothing(park):
    trees, result = park
    quiet = {"UNCHANGED", "UNOBSERVED"}
    assert all(found and set(found) <= quiet for found in of_trees(result, trees.same))
    claimed = [r for r in result.records if r.change.name not in quiet]
    assert len(claimed) <= len(trees.felled) + len(trees.planted) + len(trees.grown) + 1


def test_a_cell_that_both_epochs_sampled_without_a_decision_is_undecided_not_seen_by_one():
    def cloud(change):
        xyz = np.stack([np.linspace(0.1, 1.9, 8), np.full(8, 0.5), np.zeros(8)], axis=1)
        fields = {"change": np.full(8, change, np.uint8), "lod95": np.full(8, np.inf, np.float32)}
        return PointCloud(xyz, fields=fields)

    def area(before, after, name):
        code = next(code for code, known in COVERAGE.items() if known == name)
        return build_coverage(cloud(before), cloud(after)).area(code)

    assert area(Change.UNOBSERVED, Change.UNOBSERVED, "undecided") == 4.0
    assert area(Change.UNCHANGED, Change.UNCHANGED, "both") == 4.0
    assert area(Change.UNCHANGED, Change.UNOBSERVED, "both") == 4.0
