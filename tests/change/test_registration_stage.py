"""What a registration takes of a city: all of a small one, of a large one a part, alike of both epochs."""

import numpy as np
import pytest

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.tiling.alignment import ChangedPoints
from subiaco_change.tiling.epoch_tiles import Coordinates, EpochContext
from subiaco_change.tiling.registration_stage import RegistrationParams, RegistrationSlice, gather
from subiaco_geo.work.results import pack
from subiaco_geo.work.store import MemoryStore
from subiaco_geo.work.tasks import Inputs

TILES = [f"{column}_{row}" for column in range(5) for row in range(4)]


def city(crs, limit, leaf=0.25):
    """Inputs and parameters of twenty tiles of 400 points, each in a voxel of its own."""
    store, keys = MemoryStore(), {}
    x, y = (axis.ravel() * leaf + leaf / 2 for axis in np.mgrid[0:20, 0:20])
    for name in TILES:
        column, row = map(int, name.split("_"))
        xyz = np.stack([x + 80 * column, y + 80 * row, np.zeros(400)], axis=1)
        for epoch in ("before", "after"):
            keys[f"cloud/{epoch}/{name}"] = f"{epoch}/{name}"
            store.save(f"{epoch}/{name}", pack(Coordinates(xyz)))
    keys["changed/after/2_1"] = "mask"
    store.save("mask", pack(ChangedPoints(np.arange(400) == 7)))
    sides = tuple(
        EpochContext(e, np.zeros(3), crs, "assumed", None, np.zeros(3), 0.5) for e in ("before", "after")
    )
    config = RegistrationSlice(
        RegistrationConfig(), registration_points=limit, leaf=leaf, second_shift=0.01, second_points=0
    )
    return Inputs(store, keys), RegistrationParams(sides, config, None)


def tiles_of(cloud):
    return {f"{int(x // 80)}_{int(y // 80)}" for x, y, _ in cloud.xyz}


def test_what_fits_is_taken_whole_tile_by_tile_with_what_changed():
    before, after = gather(*city("EPSG:7850", 8000))
    assert len(before) == len(after) == 8000
    assert not before.fields["changed"].any()
    (changed,) = after.xyz[after.fields["changed"]].tolist()
    assert changed == pytest.approx([160.125, 81.875, 0.0])
    assert np.array_equal(after.xyz[:, 0] // 80, np.repeat(np.arange(5), 1600))


def test_more_than_fits_is_thinned_once_and_a_changed_point_keeps_its_mark():
    before, after = gather(*city("EPSG:7850", 2000))
    assert len(before) == len(after) == 2000  # four voxels make one
    assert tiles_of(before) == set(TILES)
    assert after.fields["changed"].sum() == 1


def test_of_a_city_the_same_tiles_of_both_epochs_stand_for_it_from_all_over_it():
    before, after = gather(*city("EPSG:7850", 950))
    assert 950 < len(before) == len(after) <= 1050
    chosen = tiles_of(before)
    assert chosen == tiles_of(after)
    assert len({name.split("_")[0] for name in chosen}) >= 4
    assert len({name.split("_")[1] for name in chosen}) >= 3


def test_epochs_without_a_crs_are_thinned_and_no_tile_is_left_out():
    before, _ = gather(*city(None, 500))
    assert len(before) == 2000
    assert tiles_of(before) == set(TILES)
