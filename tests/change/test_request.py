"""Requests: validated, frozen, the same through JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_change.config import ChangeConfig
from subiaco_change.request import ChangeRequest, ComparisonRequest
from subiaco_geo.errors import InputError
from subiaco_mapping.request import MappingRequest

PATHS = {"before": "a", "after": "b", "output": "c"}


@given(
    angle=st.floats(-3.0, 3.0),
    shift=st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    workers=st.integers(1, 64),
    classes=st.sampled_from([(), ("semantic",), ("semantic", "instance")]),
    observed=st.floats(0.0, 1.0),
    overwrite=st.booleans(),
    parcels=st.none() | st.just(Path("lots.gpkg")),
)
def test_a_request_is_the_same_through_json(
    angle: float, shift: tuple[float, float, float], observed: float, **options: Any
) -> None:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[:3, 3] = shift
    options["given"] = options.pop("classes")
    config = ChangeConfig.model_validate({"decisions": {"min_observed": observed}})
    request = ChangeRequest.of(**PATHS, transform=T, config=config, **options)
    again = ChangeRequest.from_json(request.to_json(), "goal")
    assert again == request
    np.testing.assert_array_equal(again.T_after_before, T)


def test_a_request_in_json_says_only_what_departs_from_the_defaults() -> None:
    request = ChangeRequest.of(**PATHS, transform="identity", config={"leaf": 0.25, "seed": 3})
    assert json.loads(request.to_json()) == {
        **PATHS,
        "transform": np.eye(4).tolist(),
        "config": {"seed": 3},
    }
    assert ChangeRequest.from_json('{"workers": 3}', "goal", **PATHS).workers == 3


def test_values_in_json_win_over_those_beside_it() -> None:
    request = ChangeRequest.from_json('{"output": "d"}', "goal", **PATHS)
    assert (request.before, request.output) == (Path("a"), Path("d"))


def test_one_limit_of_a_class_can_be_set_alone_and_is_all_that_is_written() -> None:
    config = ChangeConfig.model_validate({"decisions": {"vegetation": {"height": 0.7}}})
    usual = ChangeConfig().decisions.vegetation
    assert config.decisions.vegetation == usual.model_copy(update={"height": 0.7})
    request = ChangeRequest.of(**PATHS, config=config)
    assert json.loads(request.to_json())["config"] == {"decisions": {"vegetation": {"height": 0.7}}}
    assert ChangeRequest.from_json(request.to_json(), "goal").config == config


def test_a_value_at_the_default_of_its_model_but_not_of_its_group_is_written() -> None:
    config = ChangeConfig.model_validate({"confidence": {"single": {"density": 0.0}}})
    assert ChangeConfig().confidence.single.density != 0.0
    request = ChangeRequest.of(**PATHS, config=config)
    assert ChangeRequest.from_json(request.to_json(), "goal").config == config


WRONG = {
    "reflected": ({"transform": np.diag([1.0, 1.0, -1.0, 1.0])}, "transform: not rigid"),
    "scaled": ({"transform": np.diag([2.0, 2.0, 2.0, 1.0])}, "transform: not rigid"),
    "not finite": ({"transform": np.full((4, 4), np.nan)}, "transform: not rigid"),
    "of another shape": ({"transform": np.eye(3)}, "transform"),
    "objects without classes": ({"given": ("instance",)}, "given: instance needs semantic"),
    "no worker": ({"workers": 0}, "workers: Input should be"),
    "misspelt": ({"parcel": "lots.gpkg"}, "parcel: no such setting; did you mean parcels"),
    "a setting that is none": ({"config": {"leaves": 1}}, "config.leaves: no such setting"),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_a_wrong_request_is_refused_in_one_line_that_names_the_option(name: str) -> None:
    options, said = WRONG[name]
    with pytest.raises(InputError, match=said) as caught:
        ChangeRequest.of(**PATHS, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["{", "[1]", "3", "[" * 100_000])
def test_json_that_is_no_object_is_refused_with_its_source(text: str) -> None:
    with pytest.raises(InputError, match=r"^goal: "):
        ChangeRequest.from_json(text, "goal", **PATHS)


def test_resolved_paths_are_absolute_and_nothing_else_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    request = ChangeRequest.of(**PATHS, parcels="lots.gpkg", workers=2)
    assert request.resolved() == ChangeRequest.of(
        before=tmp_path / "a", after=tmp_path / "b", output=tmp_path / "c", parcels=tmp_path / "lots.gpkg",
        workers=2,
    )  # fmt: skip
    bags = MappingRequest.of(bags=("x", "y"), output="map").resolved().bags
    assert bags == (tmp_path / "x", tmp_path / "y")


def test_a_map_needs_a_recording_and_a_comparison_nothing_but_three_paths() -> None:
    with pytest.raises(InputError, match="bags"):
        MappingRequest.of(bags=(), output="map")
    assert ComparisonRequest.of(**PATHS).T_after_before is None
