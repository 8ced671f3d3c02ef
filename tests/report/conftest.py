"""A change directory with its pages, made from the made-up result of the change tests."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "change"))

from result_scene import SceneConfig, scene_result

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_report.pages import write_pages


@pytest.fixture(scope="session")
def result():
    """A made-up change result with every label."""
    return scene_result()


@pytest.fixture(scope="session")
def change_directory(tmp_path_factory, result):
    """The directory written from it, with its pages."""
    target = tmp_path_factory.mktemp("change") / "out"
    write_change_directory(target, result, SceneConfig(), ChangeInputs(), write_pages=write_pages)
    return target
