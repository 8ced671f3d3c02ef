"""Volumes, and surfaces that the other epoch looked across."""

from dataclasses import replace

import numpy as np
import pytest

from subiaco_change.objects.column_volumes import NO_COLUMNS, OpenGround, compare_volumes, ground_columns
from subiaco_change.objects.measures import MeasureConfig, measure
from subiaco_change.objects.voxel_objects import Voxels, observed_on_both_sides


def voxels(xyz, instance=0, occupied_in_other=True, free_space_confirmed=False):
    xyz = np.asarray(xyz, dtype=float).reshape(-1, 3)
    count = len(xyz)
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    flags = [np.full(count, value) for value in (True, occupied_in_other, free_space_confirmed)]
    return Voxels(np.full(count, instance), xyz, up, xyz[:, 2], *flags)


def block(low, high, step=0.5):
    axes = [np.arange(a, b, step) + step / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def walls(length, width, height):
    solid = block((0, 0, 0), (length, width, height))
    inner = (
        (solid[:, 0] > 0.5) & (solid[:, 0] < length - 0.5) & (solid[:, 1] > 0.5) & (solid[:, 1] < width - 0.5)
    )
    return solid[~inner]


def volume(standing, closing=0.0, bare=NO_COLUMNS):
    """Volume of an object of *after* alone, in columns of half a metre."""
    alone = replace(standing, occupied_in_other=np.zeros(len(standing), dtype=bool))
    return compare_volumes(voxels([]), alone, 0.5, closing, OpenGround(NO_COLUMNS, bare)).change


def test_a_solid_block_has_its_own_volume():
    assert volume(voxels(block((0, 0, 0), (4, 3, 2)))) == pytest.approx(4 * 3 * 1.75)


def test_a_wing_of_three_metres_is_filled_between_its_walls_and_a_court_of_eight_is_not():
    wing, court = voxels(walls(8, 3, 2)), voxels(walls(8, 8, 2))
    assert volume(wing, 1.5) == pytest.approx(8 * 3 * 1.75)
    assert volume(court, 1.5) == pytest.approx(volume(court))


def test_a_corner_where_the_ground_was_met_is_not_filled():
    """The corner of an L is as narrow as a wing; points of the ground tell it from one."""
    ell = voxels(np.concatenate([block((0, 0, 0), (6, 3, 2)), block((0, 3, 0), (3, 6, 2))]))
    bare = ground_columns(block((3, 3, 0), (6, 6, 0.5)), 0.5)
    solid = volume(ell)
    assert volume(ell, 1.5, bare) == pytest.approx(solid)
    assert measure(ell, ell, MeasureConfig(), OpenGround(bare, bare)).delta_v == 0.0


def test_the_volume_of_a_house_counts_what_lies_behind_what_was_seen():
    """Two walls of a house of 12 m by 12 m tell how large it is; their columns are a twelfth of it."""
    corner = np.concatenate([block((0, 0, 0), (12, 0.5, 4)), block((0, 0.5, 0), (0.5, 12, 4))])
    for building in (False, True):
        seen = measure(voxels(corner), voxels(corner), MeasureConfig(), building=building)
        assert seen.volume == pytest.approx(12 * 12 * 3.75, rel=0.15)


def test_a_beam_that_grazes_a_wall_has_not_looked_across_it():
    wall = np.array([[0.0, y, 1.0] for y in np.arange(0, 5, 0.5)])
    normal = np.tile([1.0, 0.0, 0.0], (len(wall), 1))

    def in_front(xyz):
        return xyz[:, 0] > -0.4

    def everywhere(xyz):
        return np.ones(len(xyz), dtype=bool)

    assert not observed_on_both_sides(wall, normal, in_front, 1.0).any()
    assert observed_on_both_sides(wall, normal, everywhere, 1.0).all()


def test_what_is_new_and_gone_balances_over_the_mean_surface():
    config = MeasureConfig()
    before = voxels(block((0, 0, 0), (5, 5, 2)))
    wing = voxels(block((5, 0, 0), (6, 5, 2)), occupied_in_other=False, free_space_confirmed=True)
    after = Voxels(
        *(np.concatenate([getattr(before, n), getattr(wing, n)]) for n in Voxels.__dataclass_fields__)
    )
    share = len(wing) / (0.5 * (len(before) + len(after)))
    assert measure(before, after, config).net_changed_fraction == pytest.approx(share)
    assert measure(after, before, config).net_changed_fraction == pytest.approx(-share)


def test_voxels_that_were_not_looked_across_carry_nothing():
    before = voxels(block((0, 0, 0), (5, 5, 2)), occupied_in_other=False, free_space_confirmed=False)
    after = voxels(block((0, 0, 0), (5, 2, 2)))
    assert measure(before, after, MeasureConfig()).net_changed_fraction == 0.0
