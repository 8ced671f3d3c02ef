"""The baseline verb: the same change directory as ours, and refusals in one line."""

import json
import shutil

import numpy as np
import pytest
import yaml
from test_baselines import AFTER, BEFORE

from subiaco_bringup.cli.main import run
from subiaco_change.outputs.directory import read_change_directory
from subiaco_geo.cloud_io import write_cloud


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clouds")
    for name, scene, seed in (("before", BEFORE, 1), ("after", AFTER, 2)):
        write_cloud(folder / f"{name}.ply", scene.survey(seed).cloud)
    return folder / "before.ply", folder / "after.ply"


@pytest.mark.parametrize("method", ["dsm", "nn", "m3c2", "c2c"])
@pytest.mark.usefixtures("no_pages")
def test_the_command_writes_a_change_directory_that_reads_back(clouds, tmp_path, method):
    out = tmp_path / "out"
    assert (
        run(["baseline", method, *map(str, clouds), "-o", str(out), "--registration", "identity", "-q"]) == 0
    )
    read = read_change_directory(out)
    assert {"Added", "Removed", "Increased", "Decreased"} <= set(read.table["label"])
    assert set(read.table["object_id"]) >= set(np.unique(read.after.fields["instance"])) - {-1}
    document = json.loads((out / "run.json").read_text())
    assert document["notes"]["baseline"] == method
    assert not document["confidence_calibrated"]
    assert any("neither visibility" in warning for warning in document["warnings"])


def test_the_report_of_a_baseline_is_built_too(clouds, tmp_path):
    out = tmp_path / "out"
    assert (
        run(["baseline", "dsm", *map(str, clouds), "-o", str(out), "--registration", "identity", "-q"]) == 0
    )
    assert "baseline dsm" in (out / "report.html").read_text()


@pytest.mark.usefixtures("no_pages")
def test_a_registration_found_before_is_taken_from_its_file(clouds, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    words = ["baseline", "dsm", *map(str, clouds), "-q", "-o"]
    assert run([*words, str(first), "--registration", "identity"]) == 0
    assert run([*words, str(second), "--transform", str(first / "registration.json")]) == 0
    labels = [read_change_directory(out).after.fields["change"] for out in (first, second)]
    assert np.array_equal(*labels)


@pytest.mark.usefixtures("no_pages")
def test_without_a_transform_the_epochs_are_registered(clouds, tmp_path):
    out = tmp_path / "out"
    assert run(["baseline", "c2c", *map(str, clouds), "-o", str(out), "-q"]) == 0
    document = json.loads((out / "registration.json").read_text())
    assert document["method"] not in ("identity", "given")
    assert np.allclose(document["T_after_before"], np.eye(4), atol=0.05)


@pytest.mark.usefixtures("no_pages")
def test_a_run_on_simulated_maps_names_their_simulator_and_one_on_others_none(clouds, tmp_path):
    named = dict.fromkeys(("preset", "simulator_hash", "preset_hash", "scene_hash"), "ab12") | {"seed": 7}
    survey = tmp_path / "survey"
    for cloud in clouds:
        (survey / cloud.stem).mkdir(parents=True)
        shutil.copy(cloud, survey / cloud.stem / "map.ply")
    (survey / "truth").mkdir()
    (survey / "truth" / "scene.yaml").write_text(yaml.safe_dump(named))
    simulated = [survey / cloud.stem for cloud in clouds]
    for pair, expected in ((simulated, [named]), (clouds, None)):
        words = ["baseline", "dsm", *map(str, pair), "-o", str(tmp_path / "out"), "--overwrite"]
        assert run([*words, "--registration", "identity", "-q"]) == 0
        notes = json.loads((tmp_path / "out" / "run.json").read_text())["notes"]
        assert notes.get("simulations") == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["magic"], "magic"),
        (["dsm", "--registration", "guess"], "only 'identity' is known"),
        (["dsm", "--set", "dsm.treshold=1"], "did you mean threshold"),
        (["dsm", "--set", "dsm.threshold=-1"], "dsm.threshold"),
    ],
)
def test_wrong_words_are_refused_in_one_line(clouds, tmp_path, capsys, words, said):
    method, *rest = words
    assert run(["baseline", method, *map(str, clouds), "-o", str(tmp_path / "out"), *rest]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
