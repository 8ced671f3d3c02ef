"""Hedges stay whole or part where their clipped tops step; crowns that touch part by their trunks."""

import numpy as np
import pytest
from scenes import tree

from subiaco_change.segmentation.instances import InstanceConfig, split_crowns, split_hedge


def hedge(*tops, length=4.0):
    """Clipped hedges of 4 m by 0.9 m end to end, their sides and tops."""
    rng = np.random.default_rng(1)
    parts = []
    for k, top in enumerate(tops):
        x, z = k * length + rng.uniform(0, length, 500), rng.uniform(0, top, 500)
        parts.append(np.column_stack([x, rng.choice([0.0, 0.9], 500), z]))
        parts.append(
            np.column_stack(
                [k * length + rng.uniform(0, length, 200), rng.uniform(0, 0.9, 200), np.full(200, top)]
            )
        )
    xyz = np.concatenate(parts) + rng.normal(scale=0.02, size=(700 * len(tops), 3))
    return xyz, np.repeat(np.arange(len(tops)), 700)


@pytest.mark.parametrize("tops", [(1.2, 1.8), (1.5, 1.0, 1.6)])
def test_hedges_end_to_end_part_where_their_tops_step(tops):
    xyz, owner = hedge(*tops)
    parts = split_hedge(xyz, xyz[:, 2], InstanceConfig())
    assert len(np.unique(parts)) == len(tops)
    assert (parts == owner).mean() > 0.95


@pytest.mark.parametrize("tops", [(1.4,), (1.4, 1.4, 1.5), (3.4, 2.9)])
def test_a_level_hedge_stays_whole_and_so_does_a_row_of_trees(tops):
    xyz, _ = hedge(*tops)
    assert split_hedge(xyz, xyz[:, 2], InstanceConfig()).max() == 0


def test_an_irregular_hedge_stays_whole():
    rng = np.random.default_rng(2)
    x = rng.uniform(0, 12, 3000)
    z = rng.uniform(0, 1, 3000) * (1.4 + 0.25 * np.sin(1.3 * x))
    xyz = np.column_stack([x, rng.uniform(0, 0.9, 3000), z])
    assert split_hedge(xyz, z, InstanceConfig()).max() == 0


@pytest.mark.parametrize(("trunks", "trees"), [(True, 2), (False, 1)])
def test_crowns_with_hardly_a_dip_between_them_part_by_their_trunks(trunks, trees):
    rng = np.random.default_rng(3)
    xyz = np.concatenate([tree(rng, 0, 0, 7.0, 2.4), tree(rng, 3.4, 0, 6.9, 2.4)])
    fill = rng.uniform((0.5, -1.0, 5.5), (2.9, 1.0, 6.7), (600, 3))
    xyz = np.concatenate([xyz, fill])
    xyz = xyz if trunks else xyz[xyz[:, 2] > 2.2]
    assert split_crowns(xyz, xyz[:, 2], InstanceConfig()).max() + 1 == trees
