"""The entry ``sensor`` of ``map.yaml``: what the scans of a survey looked at."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_mapping.fusion.field_of_view import FieldOfView


def scan(
    low_deg: float, high_deg: float, distance: float, sky_deg: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    def ring(elevation: np.ndarray, r: float) -> np.ndarray:
        azimuth = np.linspace(-np.pi, np.pi, len(elevation), endpoint=False)
        flat = np.cos(elevation)
        return r * np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])

    xyz = ring(np.radians(np.linspace(low_deg, high_deg, 4000)), distance)
    sky = np.zeros((0, 3)) if sky_deg is None else ring(np.radians(np.full(500, sky_deg)), 40.0)
    return xyz, sky


def test_elevations_and_range_are_those_of_the_scans() -> None:
    view = FieldOfView(proven=10.0, longest=100.0)
    view.add(*scan(-16.6, 11.2, 30.0))
    found = view.view(UPRIGHT)
    assert found is not None
    assert np.degrees(found.elevation_min) == pytest.approx(-16.6, abs=0.2)
    assert np.degrees(found.elevation_max) == pytest.approx(11.2, abs=0.2)
    assert found.useful_range == pytest.approx(30.5, abs=0.5)


def test_beams_into_the_sky_belong_to_the_field_of_view_and_prove_their_range() -> None:
    view = FieldOfView(proven=40.0, longest=100.0)
    view.add(*scan(-16.6, 11.2, 15.0, sky_deg=22.4))
    found = view.view(UPRIGHT)
    assert found is not None
    assert np.degrees(found.elevation_max) == pytest.approx(22.4, abs=0.2)
    assert found.useful_range == 40.0


def test_without_beams_nothing_is_said() -> None:
    assert FieldOfView(40.0, 100.0).view(UPRIGHT) is None


UPRIGHT = np.eye(3)[None]


def blind_degrees(arcs: tuple[tuple[float, float], ...] | None) -> list[list[float]]:
    assert arcs is not None
    return np.degrees(np.reshape(arcs, (-1, 2))).round(1).tolist()


@pytest.mark.parametrize(
    ("turn", "blind"),
    [((1, 1, 1), [[90.0, 180.0]]), ((1, -1, -1), [[90.0, 180.0]]), ((-1, -1, 1), [[90.0, 180.0]])],
)
def test_azimuths_without_beams_are_stated_from_the_heading(
    turn: tuple[int, int, int], blind: list[list[float]]
) -> None:
    """A view ahead stays one whether the sensor is upside down or the vehicle drives west."""
    xyz, sky = scan(-16.6, 11.2, 30.0, sky_deg=22.4)
    view = FieldOfView(proven=10.0, longest=100.0)
    view.add(xyz[xyz[:, 0] > 1e-9], sky[sky[:, 0] > 1e-9])
    found = view.view(np.diag(turn).astype(np.float64)[None])
    assert found is not None
    assert blind_degrees(found.blind) == blind
    assert found.description()["azimuth_blind_deg"] == blind


def test_a_mast_on_the_left_is_blind_on_the_other_side_of_an_inverted_sensor() -> None:
    xyz, sky = scan(-16.6, 11.2, 30.0)
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    view = FieldOfView(proven=10.0, longest=100.0)
    view.add(xyz[(azimuth < 60.0) | (azimuth > 80.0)], sky)
    upright, inverted, aside = (
        view.view(turn[None])
        for turn in (np.eye(3), np.diag([1.0, -1.0, -1.0]), np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))
    )
    assert upright is not None
    assert inverted is not None
    assert aside is not None
    assert blind_degrees(upright.blind) == [[60.0, 20.0]]
    assert blind_degrees(inverted.blind) == [[280.0, 20.0]]
    assert aside.blind is None
    assert "azimuth_blind_deg" not in aside.description()


def test_an_arc_through_the_heading_is_one_arc_and_a_full_circle_has_none() -> None:
    xyz, sky = scan(-16.6, 11.2, 30.0)
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    view = FieldOfView(proven=10.0, longest=100.0)
    view.add(xyz[np.abs(azimuth) > 45.0], sky)
    ahead = view.view(UPRIGHT)
    assert ahead is not None
    assert blind_degrees(ahead.blind) == [[315.0, 90.0]]
    view.add(xyz, sky)
    around = view.view(UPRIGHT)
    assert around is not None
    assert around.blind == ()
