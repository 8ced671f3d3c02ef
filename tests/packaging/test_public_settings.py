"""Few settings are public; all others are numbers of the method, whose version and hash stand in results."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from subiaco_bringup.cli.main import run
from subiaco_change.config import ChangeConfig
from subiaco_geo.config import StrictModel, load_config
from subiaco_geo.settings import (
    METHOD_VERSION,
    method_numbers,
    method_statement,
    setting_fields,
    setting_values,
)
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.recording.config import RecordingConfig

MODELS: dict[str, type[StrictModel]] = {
    "map": MappingConfig, "change": ChangeConfig, "record": RecordingConfig,
}  # fmt: skip
MOST = 70


def test_no_more_settings_are_public_than_a_user_can_read() -> None:
    counts = {job: len(model.PUBLIC or ()) for job, model in MODELS.items()}
    assert sum(counts.values()) <= MOST, counts
    assert min(counts.values()) > 0


@pytest.mark.parametrize("job", MODELS)
def test_every_public_setting_exists_and_is_described(job: str) -> None:
    fields = dict(setting_fields(MODELS[job]))
    public = MODELS[job].PUBLIC or ()
    assert len(set(public)) == len(public)
    assert [name for name in public if name not in fields] == []
    assert [name for name in public if not fields[name].description] == []


def test_the_method_has_a_version_a_hash_of_its_numbers_and_a_list_of_departures() -> None:
    usual = method_statement(ChangeConfig())
    assert usual["version"] == METHOD_VERSION
    assert usual["departures"] == {}
    public = ChangeConfig.model_validate({"leaf": 0.4, "decisions": {"min_observed": 0.5}})
    assert method_statement(public) == usual
    other = method_statement(ChangeConfig.model_validate({"lod": {"radius": 1.5}}))
    assert other["departures"] == {"lod.radius": 1.5}
    assert other["hash"] != usual["hash"]
    assert method_statement(ChangeConfig(), {"constants.x": 1.0})["hash"] != usual["hash"]


@pytest.mark.parametrize("job", MODELS)
def test_public_settings_and_numbers_of_the_method_are_all_there_is(job: str) -> None:
    config = MODELS[job]()
    values = setting_values(config)
    numbers = set(method_numbers(config))
    assert numbers.isdisjoint(MODELS[job].PUBLIC or ())
    assert set(values) - numbers <= set(MODELS[job].PUBLIC or ())


@pytest.mark.parametrize("job", MODELS)
@pytest.mark.parametrize("every", [[], ["--all"]])
def test_the_shown_settings_are_a_configuration_file(
    job: str, every: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["config", job, *every]) == 0
    text = capsys.readouterr().out
    file = tmp_path / "shown.yaml"
    file.write_text(text)
    shipped = run_json(job, capsys, "--config", str(file))
    assert shipped == run_json(job, capsys)
    assert load_config(MODELS[job], [file]) is not None
    assert len(yaml.safe_load(text)["/**"]["ros__parameters"]) > 0


def run_json(job: str, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, object]:
    assert run(["config", job, "--all", "--json", *options]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_settings_are_shown_as_they_are_given(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "change", "--json", "--set", "ground.area=40"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["ground.area"] == 40.0
    assert set(shown) == set(ChangeConfig.PUBLIC)
