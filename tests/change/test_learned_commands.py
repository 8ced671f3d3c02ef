"""The verbs baseline and train with learned methods and PDAL: refusals in one line, and whole runs."""

import importlib.util
import json
import os
import stat
import sys

import numpy as np
import pytest
from test_baselines import AFTER, BEFORE

from subiaco_bringup.cli.commands_evaluation import Learned, Method
from subiaco_bringup.cli.main import run
from subiaco_change.outputs.directory import read_change_directory
from subiaco_evaluation.baseline_run import ALL_METHODS
from subiaco_evaluation.baselines.config import M3c2Config
from subiaco_evaluation.baselines.pdal import pipeline, require_pdal
from subiaco_evaluation.learned.config import TrainingConfig
from subiaco_evaluation.learned.jobs import training_job
from subiaco_evaluation.learned.methods import LEARNED_METHODS
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.codes import Change
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clouds")
    for name, scene, seed in (("before", BEFORE, 1), ("after", AFTER, 2)):
        write_cloud(folder / f"{name}.ply", scene.survey(seed).cloud)
    return folder / "before.ply", folder / "after.ply"


def test_the_command_offers_the_methods_that_there_are():
    assert {m.value for m in Method} == set(ALL_METHODS)
    assert {m.value for m in Learned} == set(LEARNED_METHODS)


@pytest.fixture
def without_torch(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "torch" else found(name, *rest)
    )


@pytest.mark.usefixtures("without_torch")
@pytest.mark.parametrize("method", LEARNED_METHODS)
def test_without_pytorch_the_command_says_in_one_line_how_to_get_it(clouds, tmp_path, capsys, method):
    out = tmp_path / "out"
    assert run(["baseline", method, *map(str, clouds), "-o", str(out), "-q"]) == 2
    said = capsys.readouterr().err.strip()
    assert "make learned" in said
    assert "\n" not in said
    assert not out.exists()


def survey(folder, name):
    (folder / name / "truth").mkdir(parents=True)
    (folder / name / "truth" / "scene.yaml").write_text("seed: 1\n")
    return folder / name


@pytest.mark.usefixtures("without_torch")
def test_a_training_without_pytorch_says_in_one_line_how_to_get_it(tmp_path, capsys):
    surveys = [str(survey(tmp_path, name)) for name in "ab"]
    assert run(["train", "dsm-fc-ef", *surveys, "-o", str(tmp_path / "w.npz")]) == 2
    assert "make learned" in capsys.readouterr().err


def test_the_last_survey_is_the_validation_survey_unless_one_is_named(tmp_path):
    a, b, c = (survey(tmp_path, name) for name in "abc")
    job = training_job("dsm-fc-ef", [a, b, c], (), tmp_path / "w.npz")
    assert (job.surveys, job.held_out) == ((a, b), (c,))
    job = training_job("dsm-fc-ef", [a], [c], tmp_path / "w.npz")
    assert (job.surveys, job.held_out) == ((a,), (c,))


@pytest.mark.parametrize(
    ("surveys", "output", "said"),
    [
        (["a"], "w.npz", "--validate"),
        (["a", "none"], "w.npz", "subiaco simulate"),
        (["a", "a"], "w.npz", "given twice"),
        (["a", "b"], "w.pt", ".npz"),
        (["a", "b"], "old.npz", "exists already"),
    ],
)
def test_a_training_that_cannot_be_is_refused_before_pytorch_is_needed(tmp_path, surveys, output, said):
    for name in "ab":
        survey(tmp_path, name)
    (tmp_path / "old.npz").touch()
    with pytest.raises(InputError, match=said):
        training_job("dsm-fc-ef", [tmp_path / name for name in surveys], (), tmp_path / output)


def test_the_published_sizes_are_a_valid_configuration(repository):
    config = load_config(TrainingConfig, (repository / "config" / "learned_published.yaml",), [])
    assert (config.point_network.width, config.point_network.levels) == (64, 5)
    assert (config.point_training.epochs, config.point_training.samples) == (550, 6000)
    assert config.raster_network.width == 16


FAKE = """#!{python}
import json, sys
import numpy as np
if sys.argv[1:] == ["--drivers"]:
    print("{drivers}")
    sys.exit(0)
from subiaco_geo.cloud_io import read_cloud
stages = json.load(open(sys.argv[2]))
own, other = (read_cloud(__import__("pathlib").Path(s["filename"])).xyz for s in stages[:2])
from scipy.spatial import cKDTree
xy = cKDTree(other[:, :2]).query(own[:, :2])[1]
rise = other[xy, 2] - own[:, 2]
near = np.abs(rise) < stages[3]["cyl_halflen"]
rows = np.column_stack([np.where(near, rise, 0), np.where(near, 0.1, 0), np.where(near, 9, 0)])
np.savetxt(stages[4]["filename"], rows[:{kept}], delimiter=",", header="a,b,c", comments="")
"""


@pytest.fixture
def fake_pdal(tmp_path, monkeypatch):
    """A program that answers as PDAL does, by differences of height."""

    def install(drivers="filters.m3c2", kept=""):
        program = tmp_path / "bin" / "pdal"
        program.parent.mkdir()
        program.write_text(FAKE.format(python=sys.executable, drivers=drivers, kept=kept))
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")

    return install


def test_the_pipeline_names_every_cloud_once_and_the_settings_of_m3c2(tmp_path):
    settings = M3c2Config()
    stages = pipeline(tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "c.csv", 0.02, settings)
    assert [stage["type"] for stage in stages] == ["readers.ply"] * 3 + ["filters.m3c2", "writers.text"]
    assert stages[3]["inputs"] == [stage["tag"] for stage in stages[:3]]
    assert stages[3]["cyl_radius"] == settings.radius
    assert stages[3]["reg_error"] == 0.02


@pytest.mark.usefixtures("no_pages")
@pytest.mark.parametrize("program", ["fake", "installed"])
def test_what_pdal_computes_becomes_a_change_directory(clouds, tmp_path, fake_pdal, program):
    if program == "fake":
        fake_pdal()
    else:
        try:
            require_pdal()
        except InputError as error:
            pytest.skip(str(error))
    out = tmp_path / "out"
    words = ["baseline", "pdal-m3c2", *map(str, clouds), "-o", str(out), "--registration", "identity", "-q"]
    assert run(words) == 0
    read = read_change_directory(out)
    assert {"Added", "Removed", "Increased"} <= set(read.table["label"])
    assert json.loads((out / "run.json").read_text())["notes"]["baseline"] == "pdal-m3c2"
    xyz, change = read.after.xyz, np.asarray(read.after.fields["change"])
    centre = read.after.origin[:2] + xyz[:, :2]
    new_house = (np.abs(centre - (20, -13)) < 3).all(axis=1) & (xyz[:, 2] > 4)
    assert (change[new_house] == Change.ADDED).mean() > 0.9


@pytest.mark.parametrize(
    ("drivers", "kept", "said"), [("filters.icp", "", "2.10"), ("filters.m3c2", "5", "5 points")]
)
def test_a_pdal_that_cannot_do_it_is_refused_in_one_line(
    clouds, tmp_path, fake_pdal, capsys, drivers, kept, said
):
    fake_pdal(drivers, kept)
    words = ["baseline", "pdal-m3c2", *map(str, clouds), "-o", str(tmp_path / "out"), "-q"]
    assert run([*words, "--registration", "identity"]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_pdal_the_command_says_what_to_install(clouds, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert run(["baseline", "pdal-m3c2", *map(str, clouds), "-o", str(tmp_path / "out"), "-q"]) == 2
    assert "install PDAL 2.10" in capsys.readouterr().err
