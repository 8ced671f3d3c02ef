"""Project, client and logo stand in the header of the report and stay there."""

import shutil

import numpy as np
import pytest
from PIL import Image
from result_scene import SceneConfig

from subiaco_bringup.cli.main import run
from subiaco_change.outputs import directory as outputs
from subiaco_geo.errors import InputError
from subiaco_report.project_facts import project_facts, store_project_facts


@pytest.fixture
def directory(change_directory, tmp_path):
    target = tmp_path / "changes"
    shutil.copytree(change_directory, target)
    return target


def test_the_header_names_project_and_client_and_shows_the_logo(directory, tmp_path):
    Image.fromarray(np.full((8, 8, 3), 90, dtype=np.uint8)).save(tmp_path / "logo.png")
    words = ["--project", "Rowland & Hay <2025>", "--client", "City", "--logo", str(tmp_path / "logo.png")]
    assert run(["report", str(directory), *words, "-q"]) == 0
    text = (directory / "report.html").read_text(encoding="utf-8")
    assert "<h1>Rowland &amp; Hay &lt;2025&gt;" in text
    assert "For City." in text
    assert 'src="data:image/png;base64,' in text
    store_project_facts(directory, None, "Town", None)
    facts = project_facts(directory)
    assert (facts["project"], facts["client"]) == ("Rowland & Hay <2025>", "Town")
    assert facts["logo"].startswith("data:image/png")


def test_they_survive_a_rerun_of_the_pair(directory, result):
    store_project_facts(directory, "P", None, None)
    outputs.write_change_directory(directory, result, SceneConfig(), outputs.ChangeInputs(), overwrite=True)
    assert project_facts(directory)["project"] == "P"


def test_what_is_no_picture_is_refused(directory, tmp_path):
    (tmp_path / "logo.svg").write_text("<svg/>")
    with pytest.raises(InputError, match="no logo"):
        store_project_facts(directory, None, None, tmp_path / "logo.svg")
    (directory / "project.json").write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        project_facts(directory)
