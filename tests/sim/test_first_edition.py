"""The presets of the first edition give the scenes on which their figures were measured, to 0.1 mm."""

from __future__ import annotations

import pytest

from subiaco_sim.presets import build_scene, preset_hash
from subiaco_sim.scene import EPOCHS, compile_scene
from subiaco_sim.truth import scene_hash

#: preset and seed -> hash of both epochs' geometry on a ground mesh of 2 m, from before the second edition
SCENES = {
    ("easy", 101): "17623ce01d4feca8",
    ("default", 101): "c888a5393db5a40f",
    ("hard", 101): "e8a269ffcd47b5ff",
}
PRESET_HASHES = {
    "easy": "a05ca43db36e27b6",
    "default": "085bbc634477a865",
    "hard": "589eeb6391b04241",
    "city": "c6d4a17002cec394",
}


@pytest.mark.parametrize(("preset", "seed"), SCENES)
def test_a_scene_of_the_first_edition_is_what_it_was(preset: str, seed: int) -> None:
    scene = build_scene(preset, seed, 2.0)
    assert scene_hash([compile_scene(scene, epoch) for epoch in EPOCHS]) == SCENES[preset, seed]


def test_the_presets_of_the_first_edition_say_what_they_said() -> None:
    assert {name: preset_hash(name) for name in PRESET_HASHES} == PRESET_HASHES
