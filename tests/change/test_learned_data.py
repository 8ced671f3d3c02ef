"""What learned methods learn from: pyramids, cylinders, patches, labels; all of it without PyTorch."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from subiaco_evaluation.learned.config import PointNetworkConfig
from subiaco_evaluation.learned.curve import COLUMNS, write_curve
from subiaco_evaluation.learned.features import FEATURES, chosen_features, point_features
from subiaco_evaluation.learned.kernel_points import kernel_points
from subiaco_evaluation.learned.labels import IGNORED, class_shares, to_classes, to_codes
from subiaco_evaluation.learned.pyramids import (
    build_pyramid,
    cut_cylinder,
    nearest_across,
    pyramid_arrays,
    pyramid_of_arrays,
    voxel_means,
)
from subiaco_evaluation.learned.sampling import (
    CylinderSampler,
    PatchSampler,
    Place,
    clipped_noise,
    cut_pair,
    exchanged,
    grid_centres,
    network_input,
    patch_corners,
    turned,
    vary,
)
from subiaco_evaluation.learned.surveys import PointPair, RasterPair, vote
from subiaco_evaluation.learned.weights_file import find_weights, read_record, read_weights, write_weights
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError

SMALL = PointNetworkConfig(width=4, levels=3, neighbours=8, radius=6.0, features=())


def plane(seed, size=30.0, count=6000, height=0.0):
    """Points of a rough horizontal square."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, size, (count, 2)), height + rng.normal(0, 0.02, count)])


@pytest.fixture(scope="module")
def pyramid():
    return build_pyramid(plane(1), SMALL)


def test_a_voxel_is_the_mean_of_its_points():
    xyz = np.array([[0.1, 0.1, 0.0], [0.3, 0.1, 0.2], [0.9, 0.1, 0.0]])
    means, member = voxel_means(xyz, 0.5)
    assert np.allclose(means, [[0.2, 0.1, 0.1], [0.9, 0.1, 0.0]])
    assert member.tolist() == [0, 0, 1]


def test_neighbours_of_every_level_are_the_nearest_points_within_the_published_radius(pyramid):
    for index, level in enumerate(pyramid.levels):
        reach = 2.5 * 0.5 * 2**index
        row = len(level.xyz) // 2
        distance = np.linalg.norm(level.xyz - level.xyz[row], axis=1)
        expected = np.argsort(distance, kind="stable")[:8]
        expected = expected[distance[expected] <= reach]
        found = level.neighbours[row]
        assert set(found[found >= 0]) == set(expected)
        assert found[0] == row


def test_pooling_looks_into_the_finer_level_and_upsampling_into_the_coarser(pyramid):
    for index in (1, 2):
        level, finer = pyramid.levels[index], pyramid.levels[index - 1]
        some = level.pooled >= 0
        offset = finer.xyz[level.pooled] - level.xyz[:, None]
        assert np.linalg.norm(offset, axis=2)[some].max() <= 2.5 * 0.5 * 2 ** (index - 1)
        assert np.array_equal(finer.coarser, cKDTree(level.xyz).query(finer.xyz)[1])


def test_a_cylinder_is_what_a_search_in_the_cropped_cloud_would_give(pyramid):
    centre = np.array([15.0, 15.0, 0.0])
    cut = cut_cylinder(pyramid, centre, 6.0)
    first = pyramid.levels[0]
    inside = np.linalg.norm(first.xyz[:, :2] - 15.0, axis=1) <= 6.0
    assert np.array_equal(cut.picked, np.flatnonzero(inside))
    for level in cut.levels:
        assert level.neighbours.max() < len(level.xyz)
        assert (level.neighbours[:, 0] == np.arange(len(level.xyz))).all()
    border = np.linalg.norm(cut.levels[0].xyz[:, :2], axis=1) > 5.5
    fewer = (cut.levels[0].neighbours[border] < 0).sum() - (first.neighbours[cut.picked[border]] < 0).sum()
    assert fewer > 0  # neighbours outside are dropped
    assert all((level.coarser >= 0).all() for level in cut.levels[:-1])
    assert cut_cylinder(pyramid, np.array([500.0, 0.0, 0.0]), 6.0) is None


def test_the_nearest_reference_point_of_every_compared_point_is_found_at_every_level():
    pyramids = [build_pyramid(plane(seed, height=0.3 * seed), SMALL) for seed in (2, 3)]
    centre = np.array([10.0, 12.0, 0.0])
    cut = [cut_cylinder(p, centre, 6.0) for p in pyramids]
    for level, near in enumerate(nearest_across(*cut)):
        a, b = cut[0].levels[level].xyz, cut[1].levels[level].xyz
        assert np.array_equal(near, np.linalg.norm(b[:, None] - a[None], axis=2).argmin(axis=1))


def test_a_pyramid_survives_its_file(pyramid, tmp_path):
    np.savez(tmp_path / "p.npz", **pyramid_arrays(pyramid, "before"))
    with np.load(tmp_path / "p.npz") as arrays:
        back = pyramid_of_arrays(arrays, "before", 3)
    assert np.array_equal(back.member, pyramid.member)
    for a, b in zip(back.levels, pyramid.levels, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(vars(a).values(), vars(b).values(), strict=True))


def test_kernel_points_repel_each_other_at_the_published_mean_distance():
    points = kernel_points(25, 0.75)
    assert points.shape == (25, 3)
    assert np.allclose(points[0], 0.0)
    assert np.isclose(np.linalg.norm(points[1:], axis=1).mean(), 0.75)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + 9.0 * np.eye(25)
    assert apart.min() > 0.3
    assert np.array_equal(points, kernel_points(25, 0.75))


@given(st.lists(st.sampled_from([int(c) for c in Change]), min_size=1), st.sampled_from([0, 1]))
def test_classes_and_codes_are_inverse_where_the_epoch_can_carry_the_label(codes, epoch):
    codes = np.array(codes, dtype=np.uint8)
    classes = to_classes(codes, epoch)
    back = to_codes(classes, epoch)
    foreign = [Change.REMOVED if epoch else Change.ADDED, Change.UNOBSERVED]
    learned, moving = ~np.isin(codes, foreign), codes == Change.NOT_REPORTED
    assert np.array_equal(back[learned & ~moving], codes[learned & ~moving])
    assert (back[moving] == Change.UNCHANGED).all()
    assert (classes[~learned] == IGNORED).all()
    assert (back[~learned] == Change.UNOBSERVED).all()


def test_a_removed_point_of_before_is_what_an_added_point_of_after_is():
    before = to_classes(np.array([Change.REMOVED, Change.DECREASED, Change.INCREASED]), 0)
    after = to_classes(np.array([Change.ADDED, Change.INCREASED, Change.DECREASED]), 1)
    assert np.array_equal(before, after)


def test_shares_leave_out_what_is_ignored():
    assert class_shares(np.array([-1, 0, 0, 0, 2]), 4).tolist() == [0.75, 0.0, 0.25, 0.0]


def test_a_voxel_takes_the_commonest_label_of_its_points():
    classes, member = np.array([0, 2, 2, -1, -1, 3]), np.array([0, 0, 0, 0, 1, 2], dtype=np.int32)
    assert vote(classes, member, 3).tolist() == [2, IGNORED, 3]


def labelled_pair(seed):
    pyramids = tuple(build_pyramid(plane(seed + epoch), SMALL) for epoch in (0, 1))
    classes = [np.zeros(len(p.levels[0].xyz), dtype=np.int64) for p in pyramids]
    classes[1][:5] = 1  # one point in 600 is rare
    return PointPair(pyramids, tuple(classes))


def test_rare_classes_are_the_centre_as_often_as_common_ones():
    pairs = [labelled_pair(4), labelled_pair(6)]
    sampler = CylinderSampler(pairs, 6.0)
    places = sampler.draw(np.random.default_rng(0), 400)
    rare = [any(np.allclose(p.centre, x) for x in pairs[p.survey].pyramids[1].levels[0].xyz[:5])
            for p in places if p.epoch == 1]  # fmt: skip
    assert 140 < sum(rare) < 260
    assert {p.survey for p in places} == {0, 1}
    assert [p.centre.tolist() for p in places] == [
        p.centre.tolist() for p in sampler.draw(np.random.default_rng(0), 400)
    ]


def test_the_labelled_cloud_of_a_cylinder_is_that_of_the_epoch_that_was_drawn():
    pair = labelled_pair(8)
    sampler = CylinderSampler([pair], 6.0)
    for epoch in (0, 1):
        place = Place(0, epoch, np.array([15.0, 15.0, 0.0]))
        cylinder = sampler.cut(place)
        expected = cut_cylinder(pair.pyramids[epoch], place.centre, 6.0)
        assert np.array_equal(cylinder.compared.picked, expected.picked)
        assert np.array_equal(cylinder.classes, pair.classes[epoch][expected.picked])
    assert cut_pair(*pair.pyramids, np.array([99.0, 0.0, 0.0]), 6.0) is None


def test_validation_places_lie_evenly_over_both_epochs_of_every_survey():
    sampler = CylinderSampler([labelled_pair(4), labelled_pair(6)], 6.0)
    places = sampler.spread(np.random.default_rng(0), 1000)
    assert {(p.survey, p.epoch) for p in places} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    one = np.array([p.centre[:2] for p in places if (p.survey, p.epoch) == (1, 0)])
    assert cKDTree(one).query(one, k=2)[0][:, 1].min() >= 12.0
    few = sampler.spread(np.random.default_rng(0), 5)
    assert [p.centre.tolist() for p in few] == [p.centre.tolist() for p in places[:5]]


def test_features_describe_height_stability_and_shape_of_a_point():
    rng = np.random.default_rng(7)
    ground = np.column_stack([rng.uniform(0, 12, (8000, 2)), np.zeros(8000)])
    wall = np.column_stack([rng.uniform(0, 12, 4000), np.full(4000, 6.1), rng.uniform(0, 5, 4000)])
    clouds = ground, np.concatenate([ground, wall])
    before, after = (build_pyramid(cloud, SMALL) for cloud in clouds)
    found = dict(zip(FEATURES, point_features(after, before, clouds[1][:, 2]).T, strict=True))
    xyz = after.levels[0].xyz
    high = (xyz[:, 2] > 1.5) & (np.abs(xyz[:, 0] - 6.0) < 4.0)
    flat = (xyz[:, 2] < 0.01) & (np.abs(xyz[:, 1] - 6.0) > 2.5) & (np.abs(xyz[:, 0] - 6.0) < 4.0)
    flat &= np.abs(xyz[:, 1] - 6.0) < 4.5
    assert np.allclose(found["height"], xyz[:, 2], atol=1e-5)
    assert (found["stability"][flat] == 1.0).all()
    assert (found["stability"][high] == 0.0).all()
    assert found["verticality"][flat].min() > 0.99
    assert found["verticality"][high].max() < 0.05
    assert found["height_range"][flat].max() < 0.05
    assert found["height_range"][high].min() > 0.3
    assert np.median(found["planarity"][high]) > 0.3
    assert all(np.isfinite(column).all() for column in found.values())


def test_a_network_gets_the_features_that_its_settings_name():
    pyramid = build_pyramid(plane(1), SMALL)
    whole = replace(pyramid, features=point_features(pyramid, pyramid, plane(1)[:, 2]))
    some = chosen_features(whole, ("linearity", "height"))
    assert np.array_equal(some.features[:, 1], whole.features[:, 0])
    assert some.features.shape == (len(pyramid.levels[0].xyz), 2)
    cut = cut_cylinder(some, np.array([15.0, 15.0, 0.0]), 6.0)
    assert np.array_equal(cut.features, some.features[cut.picked])


def test_the_grid_of_cylinders_holds_every_point():
    xyz = plane(10, size=83.0)
    centres = grid_centres(xyz, 10.0, 0.3)
    assert cKDTree(centres[:, :2]).query(xyz[:, :2])[0].max() <= 10.0


def test_a_turn_keeps_distances_and_heights_and_noise_is_limited():
    levels = [plane(11), plane(12)[:40]]
    noise = clipped_noise(np.random.default_rng(0), 6000, 0.01, 0.02)
    assert np.abs(noise).max() == 0.02
    moved = vary(levels, 1.0, noise)
    assert np.allclose(moved[1][:, 2], levels[1][:, 2], atol=1e-6)
    assert np.allclose(np.linalg.norm(moved[1], axis=1), np.linalg.norm(levels[1], axis=1), atol=1e-4)
    still = vary(levels, 1.0, np.zeros(3))
    assert np.allclose(moved[0] - still[0], noise, atol=1e-5)


def raster(shape=(70, 50)):
    codes = np.full(shape, int(Change.UNCHANGED))
    codes[:4] = IGNORED
    codes[40, 25] = int(Change.ADDED)
    heights = np.zeros((2, *shape))
    heights[1, 40, 25] = 5.0
    return RasterPair(heights, codes)


def test_patches_carry_the_change_with_its_label_however_they_are_turned():
    sampler = PatchSampler([raster()], 32, 5.0, exchange=True)
    rng, seen = np.random.default_rng(0), set()
    for _ in range(60):
        heights, codes = sampler.draw(rng)
        assert heights.shape == (2, 32, 32)
        assert heights.dtype == np.float32
        for epoch, label in ((1, Change.ADDED), (0, Change.REMOVED)):
            raised = heights[epoch] > 0.5
            assert np.array_equal(raised, codes == label)
            seen |= {label} if raised.any() else set()
    assert seen == {Change.ADDED, Change.REMOVED}


def test_a_raster_smaller_than_a_patch_is_extended_without_labels():
    small = RasterPair(np.zeros((2, 20, 70)), np.full((20, 70), int(Change.UNCHANGED)))
    sampler = PatchSampler([small], 32, 5.0, exchange=False)
    patches = sampler.spread(np.random.default_rng(1), 9)
    assert len(patches) == 3  # 70 columns
    for heights, codes in patches:
        assert heights.shape == (2, 32, 32)
        assert (codes == 4).sum() == 20 * 32
        assert (codes == IGNORED).sum() == 12 * 32


def test_exchanged_epochs_reverse_every_label_and_twice_none():
    codes = np.array([IGNORED, 0, 1, 2, 3, 4])
    assert exchanged(codes).tolist() == [IGNORED, 1, 0, 3, 2, 4]
    assert np.array_equal(exchanged(exchanged(codes)), codes)


def test_the_eight_turns_differ_and_move_heights_and_labels_together():
    codes = np.arange(9).reshape(3, 3)
    heights = np.stack([codes, codes]).astype(float)
    found = [turned(heights, codes, number) for number in range(8)]
    assert len({c.tobytes() for _, c in found}) == 8
    assert all(np.array_equal(h[0], c) for h, c in found)


def test_network_input_does_not_depend_on_the_height_of_the_place():
    heights = np.random.default_rng(3).normal(size=(2, 8, 8))
    assert np.allclose(network_input(heights, 5.0), network_input(heights + 300.0, 5.0), atol=1e-4)


@given(st.integers(1, 300), st.floats(0.0, 0.9))
def test_patches_cover_every_cell(size, overlap):
    corners = patch_corners(size, 32, overlap)
    covered = np.zeros(max(size, 32), dtype=bool)
    for corner in corners:
        assert corner + 32 <= len(covered)
        covered[corner : corner + 32] = True
    assert covered.all()


def record(method="dsm-fc-ef"):
    return {"method": method, "config": {}, "hours": 0.1}


def test_weights_survive_their_file_with_matrices_in_half_precision(tmp_path):
    path = tmp_path / "w.npz"
    third = np.float32(1.0 / 3.0)
    weights = {"a.weight": np.array([[1.0, third]]), "a.bias": np.array([third]), "steps": np.array(7)}
    write_weights(path, weights, record())
    back, found = read_weights(path, "dsm-fc-ef")
    assert found["hours"] == 0.1
    assert back["a.weight"].dtype == np.float32
    assert np.allclose(back["a.weight"], weights["a.weight"], atol=1e-3)
    assert back["a.bias"][0] == third
    assert int(back["steps"]) == 7


def test_weights_of_another_method_or_none_at_all_are_refused(tmp_path):
    path = tmp_path / "w.npz"
    write_weights(path, {"a": np.zeros(2)}, record())
    with pytest.raises(InputError, match="not of dsm-siamese"):
        read_weights(path, "dsm-siamese")
    with pytest.raises(InputError, match="no such file; train them"):
        find_weights("efs-kpconv", str(tmp_path / "absent.npz"))


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06" + bytes(18), b"no archive"])
def test_a_damaged_file_of_weights_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "w.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="subiaco train") as caught:
        read_record(path)
    assert "\n" not in str(caught.value)


def test_a_record_of_an_unknown_method_is_refused(tmp_path):
    write_weights(tmp_path / "w.npz", {"a": np.zeros(2)}, record("magic"))
    with pytest.raises(InputError, match="magic"):
        read_record(tmp_path / "w.npz")


def test_the_learning_curve_is_a_table_and_a_picture(tmp_path):
    rows = [dict.fromkeys(COLUMNS, float(n)) for n in range(3)]
    write_curve(tmp_path / "net", rows)
    lines = (tmp_path / "net.curve.csv").read_text().splitlines()
    assert lines[0] == ",".join(COLUMNS)
    assert len(lines) == 4
    assert (tmp_path / "net.curve.png").read_bytes().startswith(b"\x89PNG")
