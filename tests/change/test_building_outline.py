"""Outlines of buildings have right angles and the area of their cells, and cover the same place."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import MultiPolygon, box

from subiaco_change.outputs.building_outline import regular_outline
from subiaco_change.outputs.table import build_table, table_hash, with_regular_outlines


def cells_of(shape, cell=0.5):
    """The union of the cells whose centres lie in a shape, as the method makes footprints."""
    west, south, east, north = shape.bounds
    x, y = np.meshgrid(
        np.arange(np.floor(west), east, cell) + cell / 2, np.arange(np.floor(south), north, cell) + cell / 2
    )
    inside = shapely.contains_xy(shape, x.ravel(), y.ravel())
    x, y = x.ravel()[inside], y.ravel()[inside]
    union = shapely.union_all(shapely.box(x - cell / 2, y - cell / 2, x + cell / 2, y + cell / 2))
    return union if isinstance(union, MultiPolygon) else MultiPolygon([union])


def corner_angles(shape):
    """Angles between the edges that meet at a corner, modulo 90 degrees, in degrees from a right angle."""
    ring = np.asarray(shape.geoms[0].exterior.simplify(1e-6).coords)[:-1]
    edges = np.roll(ring, -1, axis=0) - ring
    turn = np.angle(np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0])))
    return np.degrees(np.abs(np.angle(np.exp(1j * (turn - turn[0]))))) / 4


L_SHAPE = box(0, 0, 14, 8).union(box(0, 0, 6, 15))


@pytest.mark.parametrize("degrees", [0.0, 11.0, 30.0, 45.0, 73.0])
def test_the_staircase_of_a_turned_house_becomes_its_walls(degrees):
    true = affinity.rotate(L_SHAPE, degrees)
    footprint = cells_of(true)
    outline = regular_outline(footprint)
    assert len(outline.geoms[0].exterior.simplify(1e-6).coords) - 1 == 6
    assert corner_angles(outline).max() < 0.01
    assert outline.area == pytest.approx(footprint.area, rel=1e-9)
    assert outline.intersection(true).area / outline.union(true).area > 0.95


@given(
    st.floats(0.0, 90.0), st.floats(4.0, 20.0), st.floats(4.0, 20.0),
    st.floats(391_000.0, 391_010.0), st.floats(6_464_000.0, 6_464_010.0),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_any_rectangle_stays_a_rectangle_of_the_area_and_place_of_its_cells(degrees, width, depth, x, y):
    footprint = cells_of(affinity.translate(affinity.rotate(box(0, 0, width, depth), degrees), x, y))
    outline = regular_outline(footprint)
    assert outline.is_valid
    assert outline.area == pytest.approx(footprint.area, rel=1e-6)
    assert outline.intersection(footprint).area / outline.union(footprint).area >= 0.8
    assert outline.centroid.distance(footprint.centroid) < 0.5


def test_parts_stay_apart_and_a_courtyard_stays_open():
    court = box(0, 0, 20, 20).difference(box(6, 6, 14, 14))
    outline = regular_outline(MultiPolygon([court, box(30, 0, 33, 3)]))
    assert len(outline.geoms) == 2
    assert len(outline.geoms[0].interiors) == 1
    assert outline.area == pytest.approx(court.area + 9.0)


def test_what_has_no_right_angles_keeps_its_cells():
    rng = np.random.default_rng(5)
    bits = [
        box(x, y, x + 0.5, y + 0.5) for x, y in np.arange(14)[:, None] * 0.5 + rng.integers(0, 2, (14, 2)) / 2
    ]
    ragged = shapely.union_all(bits).buffer(0.01, join_style="mitre")
    footprint = ragged if isinstance(ragged, MultiPolygon) else MultiPolygon([ragged])
    outline = regular_outline(footprint)
    assert outline.intersection(footprint).area / outline.union(footprint).area >= 0.8


def test_outlines_are_no_part_of_the_hash_and_only_buildings_have_them(result):
    table = build_table(result.records, "EPSG:7850")
    turned = table.set_geometry(
        [MultiPolygon([*cells_of(affinity.rotate(shape, 20.0)).geoms]) for shape in table.geometry],
        crs=table.crs,
    )
    regular = with_regular_outlines(turned)
    changed = ~regular.geometry.geom_equals(turned.geometry)
    assert set(regular.loc[changed, "class"]) == {"building"}
    assert changed.sum() >= 3
    np.testing.assert_allclose(regular.geometry.area, turned.geometry.area)
    assert table_hash(turned) != table_hash(table)


@pytest.mark.parametrize("seed", [6, 35, 38, 48, 63, 70])  # of 300, some of those whose outlines overlap
def test_parts_whose_outlines_would_overlap_keep_their_cells(seed):
    rng = np.random.default_rng(seed)
    degrees = rng.uniform(0, 90)
    house = box(0, 0, 10, 6)
    shed = affinity.translate(
        affinity.rotate(box(0, 0, 4, 4), rng.uniform(0, 90)), rng.uniform(4, 9), rng.uniform(3, 5)
    )
    beside = shed.difference(house.buffer(0.4))
    parts = [cells_of(affinity.rotate(part, degrees, origin=(0, 0))) for part in (house, beside)]
    footprint = shapely.union_all(parts)
    outline = regular_outline(footprint)
    assert outline.is_valid
    assert outline.equals(footprint)
