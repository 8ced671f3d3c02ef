"""Scaffolding and awnings lie close before a wall that both surveys saw."""

from dataclasses import replace

import numpy as np
import pytest
from test_space_carving import CELL, LENGTH, sheet, voxels

from subiaco_change.objects.layers import before_walls

TALL = 6.0


def facade(normal=(0.0, -1.0, 0.0), y=0.0, shared=True):
    """Voxels of a wall along x, which faces the street at y < 0."""
    wall = voxels(sheet((0.0, y - CELL / 2, 0.0), (LENGTH, y + CELL / 2, TALL)), occupied_in_other=shared)
    return replace(wall, normal=np.tile(normal, (len(wall), 1)))


@pytest.mark.parametrize(("distance", "close"), [(0.4, True), (1.2, True), (1.8, True), (2.2, False)])
def test_a_place_is_close_before_a_wall_up_to_two_metres(distance, close):
    places = np.array([[5.0, -distance, 3.0], [5.0, distance, 3.0]])
    assert before_walls(places, facade()).tolist() == [close, close]
    outside = before_walls(places, facade(), lambda fronts: fronts[:, 1] < 0)
    assert outside.tolist() == [close, False]


def test_tubes_of_scaffolding_that_count_as_in_both_surveys_do_not_hide_the_wall_behind_them():
    tubes = facade(normal=(1.0, 0.0, 0.0), y=-0.4)
    tubes = tubes.select(np.isin(tubes.xyz[:, 0], (2.25, 5.25)))
    boards = np.array([[2.25, -1.0, 2.0], [5.25, -0.9, 3.0]])
    assert before_walls(boards, tubes).tolist() == [False, False]
    assert before_walls(boards, facade().add(tubes)).all()


def test_a_wall_of_one_survey_alone_has_no_layer_before_it():
    places = np.array([[5.0, -1.0, 3.0]])
    assert not before_walls(places, facade(shared=False)).any()
    assert not before_walls(places, replace(facade(), normal=np.tile([0.0, 0.0, 1.0], (240, 1)))).any()
