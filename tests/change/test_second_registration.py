"""A sample of blocks tells whether the second registration moves; all points take part only where it does."""

import numpy as np
import pytest

from subiaco_change.config import ChangeConfig
from subiaco_change.records import Registration
from subiaco_change.tiling import registration_stage
from subiaco_change.tiling.alignment import ChangedPoints
from subiaco_change.tiling.epoch_tiles import Coordinates, EpochContext
from subiaco_change.tiling.registration_stage import RegistrationParams, RegistrationSlice, register_again
from subiaco_change.tiling.stage_inputs import PairRegistration, slice_of
from subiaco_geo.errors import RegistrationError
from subiaco_geo.work.results import pack
from subiaco_geo.work.store import MemoryStore
from subiaco_geo.work.tasks import Inputs

COUNT = 9000
SHARE = 0.25


def registration(shift):
    """Return a registration that moves *before* by a shift [m] along x."""
    T_local = np.eye(4)
    T_local[0, 3] = shift
    return Registration(T_local, np.zeros(3), 0.01, 0.02, 0.9, np.zeros(6), "test")


def refine(monkeypatch, sampled, whole, **settings):
    """Refine with a registration that moves a sample and all points so far; return it, and its arguments."""
    calls = []

    def register(before, after, config, exclude_before, exclude_after, start):
        calls.append((before, after, exclude_before, exclude_after))
        outcome = whole if len(before) == COUNT else sampled
        if outcome is None:
            raise RegistrationError("test")
        return registration(outcome)

    monkeypatch.setattr(registration_stage, "register", register)
    rng = np.random.default_rng(2)
    xyz = rng.uniform((0, 0, 0), (300, 300, 5), (COUNT, 3))
    pieces = {"registration": PairRegistration(registration(0.0), 0.0, None)}
    for epoch in ("before", "after"):
        pieces[f"cloud/{epoch}/0_0"] = Coordinates(xyz)
        pieces[f"changed/{epoch}/0_0"] = ChangedPoints(xyz[:, 0] < 30.0)
    zero = np.zeros(3)
    sides = tuple(EpochContext(e, zero, None, "shadow", None, zero, 0.5) for e in ("before", "after"))
    store = MemoryStore({name: pack(piece) for name, piece in pieces.items()})
    config = slice_of(RegistrationSlice, ChangeConfig(second_shift=0.01, **settings))
    found = register_again(Inputs(store, {n: n for n in pieces}), RegistrationParams(sides, config, None))
    return found, calls


def test_where_the_sample_does_not_move_the_first_registration_stays(monkeypatch):
    found, calls = refine(monkeypatch, 0.004, 1.0, second_points=int(SHARE * COUNT))
    assert found.shift == pytest.approx(0.004)
    assert found.registration.T_local[0, 3] == 0.0
    [(before, after, excluded, _)] = calls
    assert 0.15 * COUNT < len(before) < 0.35 * COUNT
    np.testing.assert_array_equal(before.xyz, after.xyz)  # the same blocks of both epochs
    np.testing.assert_array_equal(excluded, before.xyz[:, 0] < 30.0)
    blocks = {tuple(block) for block in (before.xyz[:, :2] // 20.0).astype(int).tolist()}
    assert 0.15 * 225 < len(blocks) < 0.35 * 225  # whole blocks, not single points


@pytest.mark.parametrize("sampled", [0.006, None], ids=["moves", "fails"])
def test_where_the_sample_moves_or_fails_all_points_are_registered(monkeypatch, sampled):
    found, calls = refine(monkeypatch, sampled, 0.02, second_points=int(SHARE * COUNT))
    assert [len(call[0]) == COUNT for call in calls] == [False, True]
    assert found.shift == pytest.approx(0.02)
    assert found.registration.T_local[0, 3] == 0.02


@pytest.mark.parametrize("points", [0, COUNT])
def test_few_points_are_registered_at_once(monkeypatch, points):
    found, calls = refine(monkeypatch, 0.0, 0.001, second_points=points)
    assert [len(call[0]) for call in calls] == [COUNT]
    assert found.shift == pytest.approx(0.001)
