"""Of every voxel of a scan the first point is kept."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from kiss_icp.voxelization import voxel_down_sample

from subiaco_mapping.odometry.voxel_thinning import first_in_voxels

clouds = arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-90.0, 90.0))


@given(clouds, st.sampled_from([0.25, 0.5, 1.5, 20.0]))
def test_the_first_point_of_every_voxel_is_kept_in_the_order_of_the_points(xyz, edge):
    seen, first = set(), []
    for k, voxel in enumerate(map(tuple, np.floor(xyz / edge).astype(int).tolist())):
        if voxel not in seen:
            seen.add(voxel)
            first.append(k)
    np.testing.assert_array_equal(first_in_voxels(xyz, edge), xyz[first])


def test_the_points_are_those_that_kiss_icp_keeps():
    xyz = np.random.default_rng(3).normal(0.0, 20.0, (20_000, 3))
    ours, theirs = first_in_voxels(xyz, 0.5), np.asarray(voxel_down_sample(xyz, 0.5))
    np.testing.assert_array_equal(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)])
