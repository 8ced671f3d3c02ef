"""Of every voxel of a scan the first point is kept."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from kiss_icp.voxelization import voxel_down_sample

from subiaco_mapping.odometry.voxel_thinning import first_in_voxels

clouds = arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-90.0, 90.0))


@given(clouds, st.sampled_from([0.25, 0.5, 1.5, 20.0]))
def test_the_first_point_of_every_voxel_is_kept(xyz, edge):
    seen, first = set(), []
    for k, voxel in enumerate(map(tuple, np.floor(xyz / edge).astype(int).tolist())):
        if voxel not in seen:
            seen.add(voxel)
            first.append(k)
    found = first_in_voxels(xyz, edge)
    np.testing.assert_array_equal(found[np.lexsort(found.T)], xyz[first][np.lexsort(xyz[first].T)])


def test_points_come_in_an_order_that_does_not_follow_the_scan_and_is_the_same_every_time():
    xyz = np.column_stack([np.arange(2000.0), np.zeros(2000), np.zeros(2000)])
    found = first_in_voxels(xyz, 1.0)
    assert abs(np.corrcoef(found[:, 0], np.arange(2000))[0, 1]) < 0.2
    np.testing.assert_array_equal(found, first_in_voxels(xyz, 1.0))


def test_the_points_are_those_that_kiss_icp_keeps():
    xyz = np.random.default_rng(3).normal(0.0, 20.0, (20_000, 3))
    ours, theirs = first_in_voxels(xyz, 0.5), np.asarray(voxel_down_sample(xyz, 0.5))
    np.testing.assert_array_equal(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)])
