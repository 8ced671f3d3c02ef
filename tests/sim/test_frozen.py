"""Figures hold for one simulator and its presets: these are frozen, and renewed only on purpose."""

from __future__ import annotations

from pathlib import Path

import yaml

from subiaco_sim.presets import PRESETS, preset_hash, simulator_hash

FROZEN = Path(__file__).parents[2] / "config" / "frozen.yaml"


def test_simulator_and_presets_are_those_that_the_reported_figures_hold_for() -> None:
    now = {
        "simulator_hash": simulator_hash(),
        "preset_hash": {name: preset_hash(name) for name in PRESETS},
    }
    assert yaml.safe_load(FROZEN.read_text()) == now, (
        "subiaco_sim or a preset differs from the frozen one, so no reported figure holds for it. Undo the "
        "change; or, if it is meant, run scripts/prove_presets.py and every reported figure anew, and write "
        f"this into config/frozen.yaml:\n{yaml.safe_dump(now, sort_keys=False)}"
    )
