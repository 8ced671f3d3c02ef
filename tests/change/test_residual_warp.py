"""The residual warp: smooth shear goes, what one surface says alone stays."""

import numpy as np
import pytest
from alignment_scene import rigid, street
from assembled_run import place

from subiaco_change.level_of_detection.alignment_corrections import PlacingConfig, WarpConfig
from subiaco_change.level_of_detection.displacement_lod import LodConfig
from subiaco_change.level_of_detection.registration_uncertainty import UncertaintyConfig

NORTH = np.array([0.0, 1.0, 0.0])


def placed(before, after, enabled=True):
    nothing = [np.zeros(len(c), dtype=bool) for c in (before, after)]
    return place(
        (before, after), rigid(), tuple(nothing), tuple(nothing),
        PlacingConfig(warp=WarpConfig(enabled=enabled), uncertainty=UncertaintyConfig(unstated_pose=0.0)),
        LodConfig(),
    )  # fmt: skip


def shear(p):
    return np.outer(0.06 * np.sin(2 * np.pi * p[:, 0] / 160.0), NORTH) + 0.0


def test_a_smooth_shear_is_removed_and_the_uncertainty_falls():
    before, after = street(1, shear), street(2)
    warped, plain = placed(before, after), placed(before, after, enabled=False)
    walls = np.abs(before.fields["normals"][:, 1]) > 0.5
    moved = (warped.before.xyz - before.xyz)[walls, 1]
    rest = shear(before.xyz[walls])[:, 1] + moved
    assert np.sqrt(np.mean(rest**2)) < 0.25 * 0.06 / np.sqrt(2)
    normals = np.tile(NORTH, (walls.sum(), 1))
    sigmas = [np.median(p.sigma.at(before.xyz[walls], normals)) for p in (warped, plain)]
    assert sigmas[0] < 0.5 * sigmas[1]


@pytest.mark.parametrize("step", [0.12, 0.2, 0.4])
def test_a_facade_that_really_moved_keeps_its_displacement(step):
    def one_facade(p):
        facade = (np.abs(p[:, 1] - 12) < 0.01) & (p[:, 0] > 64) & (p[:, 0] < 76.1) & (p[:, 2] > 0.5)
        return np.outer(step * facade, NORTH)

    before, after = street(1), street(2, one_facade)
    facade = (np.abs(before.xyz[:, 1] - 12) < 0.05) & (before.xyz[:, 0] > 64) & (before.xyz[:, 0] < 76)
    facade &= before.xyz[:, 2] > 0.5
    moved = placed(before, after).before.xyz - before.xyz
    assert np.abs(moved[facade, 1]).max() < 0.05 * step + 0.002


def test_a_resurfaced_patch_keeps_its_height():
    def patch(p):
        return np.outer(0.2 * ((p[:, 0] > 60) & (p[:, 0] < 80) & (p[:, 1] > 20) & (p[:, 1] < 40)), [0, 0, 1])

    before, after = street(1), street(2, patch)
    inside = patch(before.xyz)[:, 2] > 0
    moved = placed(before, after).before.xyz - before.xyz
    assert np.abs(moved[inside, 2]).max() < 0.01


def test_shear_and_change_together_are_told_apart():
    def both(p):
        facade = (np.abs(p[:, 1] - 12) < 0.01) & (p[:, 0] > 64) & (p[:, 0] < 76.1) & (p[:, 2] > 0.5)
        return np.outer(0.25 * facade, NORTH) - shear(p)

    before, after = street(1), street(2, both)
    facade = (np.abs(before.xyz[:, 1] - 12) < 0.05) & (before.xyz[:, 0] > 64) & (before.xyz[:, 0] < 76)
    facade &= before.xyz[:, 2] > 0.5
    moved = placed(before, after).before.xyz - before.xyz
    rest = 0.25 - shear(before.xyz[facade])[:, 1] - moved[facade, 1]
    assert np.median(rest) == pytest.approx(0.25, abs=0.03)


def test_it_is_off_by_default_and_the_stated_transform_stays_rigid():
    assert not PlacingConfig().warp.enabled
    before, after = street(1, shear), street(2)
    assert placed(before, after, enabled=False).frame.corrections == ()
    warped = placed(before, after)
    assert np.array_equal(warped.frame.registration.T_after_before, np.eye(4))
    back = warped.frame.before_world(warped.before.xyz)
    assert np.abs(back - before.xyz).max() < 1e-3
