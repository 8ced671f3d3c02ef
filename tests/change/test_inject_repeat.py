"""The noise of a second pass, measured where another map of the same days overlaps."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_evaluation.injection.config import InjectionConfig, RepeatConfig
from subiaco_evaluation.injection.repeat import measured_repeat
from subiaco_evaluation.injection.second_pass import resampled
from subiaco_evaluation.injection.source_objects import SourceScene, by_turns
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.errors import InputError

ORIGIN = np.array([391_000.0, 6_464_000.0, 20.0])


def scene(seed: int = 1) -> SourceScene:
    """A floor of 40 m by 25 m that one to eight beams a voxel hit, and a block of leaves."""
    rng = np.random.default_rng(seed)
    floor = np.stack(np.meshgrid(np.arange(0, 40, 0.25), np.arange(0, 25, 0.25), [0.0]), -1).reshape(-1, 3)
    leaves = np.stack(np.meshgrid(*[np.arange(0, s, 0.25) for s in (6, 6, 3)]), -1).reshape(-1, 3)
    xyz = np.concatenate([floor, leaves + np.array([10.0, 10.0, 2.0])])
    fields = {"n": rng.integers(1, 9, len(xyz)).astype(np.uint32)}
    semantic = np.repeat([Semantic.GROUND, Semantic.VEGETATION], [len(floor), len(leaves)]).astype(np.uint8)
    return SourceScene(
        PointCloud(xyz, ORIGIN, "EPSG:7850", fields), semantic, np.zeros(len(xyz), dtype=np.int32)
    )


@pytest.mark.parametrize(("sigma", "again", "foliage"), [(0.02, 0.3, 0.5), (0.006, 0.7, 0.2)])
def test_what_a_second_pass_was_made_with_is_measured_again(sigma, again, foliage):
    made, config = scene(), InjectionConfig(repeat=RepeatConfig(uneven=np.inf))
    truth = RepeatConfig(sigma=sigma, again=again, foliage=foliage, uneven=np.inf)
    fields = {**made.cloud.fields, "semantic": made.semantic}
    settings = config.model_copy(update={"repeat": truth})
    _, moved = resampled(made.cloud.xyz, fields, settings, np.random.default_rng(5))
    measured = measured_repeat(made, PointCloud(moved, ORIGIN, "EPSG:7850"), config)
    assert measured.sigma == pytest.approx(sigma, rel=0.35)  # thinning to the leaf averages a few
    assert measured.again == pytest.approx(again, abs=0.12)
    assert measured.foliage == pytest.approx(foliage, abs=0.12)


def test_a_map_of_another_street_is_refused():
    made = scene()
    with pytest.raises(InputError, match="shares 0 points"):
        measured_repeat(made, PointCloud(made.cloud.xyz + 500.0, ORIGIN, "EPSG:7850"), InjectionConfig())


def test_classes_take_turns_and_everything_comes_once():
    classes = [1] * 20 + [2] * 3 + [4]
    order = by_turns(classes, np.random.default_rng(2))
    assert sorted(order) == list(range(24))
    assert {classes[i] for i in order[:3]} == {1, 2, 4}
    assert [classes[i] for i in order[:7]].count(2) == 3
