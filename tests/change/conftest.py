"""Scenes shared by the tests of the change room."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # the made-up scenes beside the tests

from result_scene import SceneConfig, scene_result

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory


@pytest.fixture(scope="session")
def result():
    """A made-up change result with every label."""
    return scene_result()


@pytest.fixture(scope="session")
def change_directory(tmp_path_factory, result):
    """The directory written from it, without pages."""
    target = tmp_path_factory.mktemp("change") / "out"
    write_change_directory(target, result, SceneConfig(), ChangeInputs())
    return target


@pytest.fixture
def no_pages(monkeypatch):
    """Leave the pages of the commands out where a test is about something else."""
    monkeypatch.setattr("subiaco_report.pages.write_pages", lambda directory, *_: directory / "report.html")
