"""Shifts between geodetic frames have their sign, and a measured shift is named after the nearest."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_geo.crs import transformer
from subiaco_geo.datum_shifts import known_shifts, likely_shift

PERTH = np.array([391_200.0, 6_464_500.0, 10.0])


def test_gda94_called_gda2020_is_one_metre_eighty_to_the_north_east():
    truth = transformer("EPSG:28350", "EPSG:7850").apply(PERTH[None])[0] - PERTH
    found = likely_shift(truth + np.array([0.03, -0.04, 0.02]), PERTH, "EPSG:7850")
    assert found is not None
    assert (found.before, found.after) == ("GDA94", "GDA2020")
    np.testing.assert_allclose(found.vector, truth, atol=0.002)
    assert found.size == pytest.approx(1.80, abs=0.01)


def test_the_other_way_round_the_survey_after_is_in_gda94():
    found = likely_shift(np.array([-1.0, -1.5, 0.08]), PERTH, "EPSG:7850")
    assert found is not None
    assert (found.before, found.after) == ("GDA2020", "GDA94")


def test_the_shift_of_the_world_frame_grows_with_the_years_since_2020():
    def shift(year: float) -> float:
        (found,) = (
            s
            for s in known_shifts(PERTH, "EPSG:7850", (year, None))
            if (s.before, s.after) == ("ITRF2014", "GDA2020")
        )
        return found.size

    assert shift(2020.0) < 0.01
    assert shift(2026.0) == pytest.approx(6 * 0.07, abs=0.05)  # Australia moves by 7 cm a year


def test_without_years_the_world_frame_is_not_compared():
    assert all("ITRF" not in s.before + s.after for s in known_shifts(PERTH, "EPSG:7850"))


def test_in_europe_the_plate_frame_is_etrs89():
    place = np.array([500_000.0, 5_500_000.0, 100.0])
    named = {(s.before, s.after): s.size for s in known_shifts(place, "EPSG:25832", (2026.0, 2026.0))}
    assert named["ITRF2014", "ETRS89"] == pytest.approx(0.92, abs=0.05)
    assert not any("GDA" in before + after for before, after in named)


@pytest.mark.parametrize("shift", [(0.3, 0.2, 0.0), (-0.9, 0.95, -0.36), (1.0, 1.5, 33.0), (0.0, 0.0, 0.0)])
def test_a_shift_that_is_none_of_the_known_ones_gets_no_name(shift: tuple[float, float, float]):
    assert likely_shift(np.array(shift), PERTH, "EPSG:7850") is None
