"""Objects that several tiles see: which of their fragments are one object."""

from types import SimpleNamespace

import numpy as np

from subiaco_change.tiling.retiling import MergingParams, unite
from subiaco_change.tiling.tile_segmentation import TileSegmentation
from subiaco_geo.codes import Semantic


def tile(own, around, neighbour):
    """A tile with objects of its points, and of those of a neighbour in its surroundings.

    ``own`` (N,), ``around`` (M,): object of every point; point i of the surroundings is point i of the other
    tile.
    """
    count, objects = len(own), np.concatenate([own, around])
    size = int(objects.max()) + 1
    inside = np.bincount(own, minlength=size)
    none = np.zeros(0, np.float32)
    rows = np.column_stack([np.full(size, Semantic.VEGETATION), inside, np.zeros((size, 2))]).astype(float)
    return TileSegmentation(
        normals=np.zeros((count, 3), np.float32),
        semantic=np.full(count, Semantic.VEGETATION, np.uint8),
        score=np.ones(count, np.float32),
        height=np.ones(count, np.float32),
        passed=none,
        moved=none,
        instance=objects.astype(np.int32),
        neighbours=(neighbour,),
        near_tile=np.zeros(len(around), np.uint8),
        near_index=np.arange(len(around), dtype=np.int32),
        inner=np.ones(len(objects), dtype=bool),
        objects=rows,
    )


def objects_of(west, east):
    """Number of points of every object of two tiles."""
    tiles = {"prepared/w": west, "prepared/e": east}
    inputs = SimpleNamespace(under=lambda _: ["e", "w"], of=lambda _, alias: tiles[alias])
    return sorted(unite(inputs, MergingParams(given=False)).points.tolist())


CROWNS = np.repeat([0, 1], 100)


def test_two_crowns_are_two_objects_though_a_neighbouring_tile_sees_them_as_one_in_its_surroundings():
    """Of the crowns near its edge the other tile sees a part, in which no dip parts them."""
    other = tile(np.full(50, 0), np.full(200, 1), "w")
    assert objects_of(tile(CROWNS, np.zeros(0, np.int64), "e"), other) == [50, 100, 100]


def test_a_house_of_which_the_other_tile_sees_two_wings_apart_is_one_object():
    wings = tile(np.repeat([0, 1], 30), np.repeat([0, 1], 100), "w")
    assert objects_of(tile(np.zeros(200, np.int64), np.zeros(0, np.int64), "e"), wings) == [260]


def test_a_crown_on_the_border_of_two_tiles_is_one_object():
    other = tile(np.full(50, 0), np.full(100, 0), "w")
    assert objects_of(tile(CROWNS, np.zeros(0, np.int64), "e"), other) == [100, 150]
