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
    found = view.view()
    assert found is not None
    assert np.degrees(found.elevation_min) == pytest.approx(-16.6, abs=0.2)
    assert np.degrees(found.elevation_max) == pytest.approx(11.2, abs=0.2)
    assert found.useful_range == pytest.approx(30.5, abs=0.5)


def test_beams_into_the_sky_belong_to_the_field_of_view_and_prove_their_range() -> None:
    view = FieldOfView(proven=40.0, longest=100.0)
    view.add(*scan(-16.6, 11.2, 15.0, sky_deg=22.4))
    found = view.view()
    assert found is not None
    assert np.degrees(found.elevation_max) == pytest.approx(22.4, abs=0.2)
    assert found.useful_range == 40.0


def test_without_beams_nothing_is_said() -> None:
    assert FieldOfView(40.0, 100.0).view() is None
