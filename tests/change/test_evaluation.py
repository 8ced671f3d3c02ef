"""Scores on grids and points whose answer is known by hand."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from result_scene import SceneConfig, scene_result

from subiaco_change.outputs.directory import ChangeInputs, write_change_directory
from subiaco_evaluation import object_matching as objects
from subiaco_evaluation.grid import GridConfig, cell_keys, cell_rule, look_up, rasterise
from subiaco_evaluation.layouts import read_published_pair
from subiaco_evaluation.scores import (
    bootstrap,
    class_f1,
    class_iou,
    confusion,
    reliability,
    risk_coverage,
    scores,
)
from subiaco_evaluation.scoring import (
    EvaluationConfig,
    evaluate,
    evaluate_published,
    registration_error,
    write_evaluation,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, invert_pose, make_pose

PLAIN = GridConfig(leaf=0.0)


def counts(**named):
    order = ("added", "removed", "increased", "decreased", "unchanged", "unseen", "unreported")
    return np.array([[named.get(name, 0) for name in order]])


def labelled(xyz, change, epoch=None, **kwargs):
    xyz = np.asarray(xyz, dtype=float)
    epoch = np.ones(len(xyz), int) if epoch is None else np.asarray(epoch)
    return rasterise(xyz, np.asarray(change), epoch, kwargs.pop("config", PLAIN), **kwargs)


# -- confusion and scores


def test_scores_of_a_known_matrix_by_hand():
    truth = np.array([0] * 4 + [1] * 2 + [4] * 4)
    said = np.array([0, 0, 0, 4, 1, 1, 4, 4, 4, 0])
    matrix = confusion(truth, said)
    assert matrix.shape == (5, 6)
    assert matrix[0].tolist() == [3, 0, 0, 0, 1, 0]
    iou = class_iou(matrix)
    assert iou[[0, 1, 4]].tolist() == [3 / 5, 1.0, 3 / 5]
    assert np.isnan(iou[[2, 3]]).all()
    result = scores(matrix)
    assert result["accuracy_percent"] == pytest.approx(80.0)
    assert result["miou_percent"] == pytest.approx(100 * (0.6 + 1.0 + 0.6) / 3)
    assert result["miou_change_percent"] == pytest.approx(80.0)
    assert class_f1(matrix)[0] == pytest.approx(0.75)


def test_an_undecided_prediction_is_a_miss_of_its_class_and_an_unlabelled_truth_is_left_out():
    truth = np.array([0, 0, 255, -1, 4])
    said = np.array([255, 0, 0, 1, 4])
    matrix = confusion(truth, said)
    assert matrix.sum() == 3
    assert matrix[0].tolist() == [1, 0, 0, 0, 0, 1]
    assert class_iou(matrix)[0] == 0.5
    assert scores(matrix)["abstention_percent"] == pytest.approx(100 / 3)
    assert scores(matrix)["accuracy_percent"] == pytest.approx(200 / 3)


def test_perfect_predictions_score_100():
    truth = np.tile(np.arange(5), 7)
    result = scores(confusion(truth, truth))
    assert {v for k, v in result.items() if k != "abstention_percent"} == {100.0}
    assert result["abstention_percent"] == 0.0


codes = st.lists(
    st.tuples(st.sampled_from([0, 1, 2, 3, 4, 255]), st.sampled_from([0, 1, 2, 3, 4, 255])), min_size=1
)


@given(codes, st.randoms(use_true_random=False))
def test_the_matrix_does_not_depend_on_order_and_counts_every_label_once(pairs, random):
    shuffled = random.sample(pairs, len(pairs))
    first, second = (confusion(*np.array(p).T) for p in (pairs, shuffled))
    np.testing.assert_array_equal(first, second)
    assert first.sum() == sum(truth < 5 for truth, _ in pairs)


@given(codes)
def test_every_score_is_a_percentage(pairs):
    values = np.array([v for v in scores(confusion(*np.array(pairs).T)).values() if np.isfinite(v)])
    assert ((values >= 0) & (values <= 100)).all()


# -- cells


def test_a_changed_label_takes_the_cell_at_exactly_30_percent_and_not_below():
    assert cell_rule(counts(added=3, unchanged=7), PLAIN).tolist() == [0]
    assert cell_rule(counts(added=29, unchanged=71), PLAIN).tolist() == [4]


def test_the_changed_label_with_most_points_wins_even_against_more_unchanged_points():
    assert cell_rule(counts(added=3, removed=4, unchanged=5), PLAIN).tolist() == [1]


def test_a_cell_is_unobserved_only_when_most_of_it_is():
    assert cell_rule(counts(unseen=6, unchanged=4), PLAIN).tolist() == [255]
    assert cell_rule(counts(unseen=5, unchanged=5), PLAIN).tolist() == [4]
    assert cell_rule(counts(unseen=7, removed=3), PLAIN).tolist() == [1]


def test_unreported_points_neither_vote_nor_dilute():
    assert cell_rule(counts(unreported=90, added=3, unchanged=7), PLAIN).tolist() == [0]
    assert cell_rule(counts(unreported=5), PLAIN).tolist() == [254]


def test_points_of_both_epochs_label_a_cell_together():
    xyz = [[0.1, 0.1, 0.0]] * 3 + [[0.2, 0.2, 1.0]] * 7
    cells = labelled(xyz, [1] * 3 + [4] * 7, [0] * 3 + [1] * 7)
    assert cells.codes.tolist() == [1]


def test_points_fall_into_half_metre_cells_from_the_stated_origin():
    xyz = np.array([[0.49, 0.0, 0], [0.51, 0.0, 0], [0.99, 0.49, 0], [-0.01, 0, 0]])
    assert len(np.unique(cell_keys(xyz[:, :2], PLAIN))) == 3
    assert len(np.unique(cell_keys(xyz[:3, :2], GridConfig(origin_x=0.25)))) == 2


def test_points_of_one_label_in_one_voxel_count_once():
    dense = [[0.1, 0.1, 0.1]] * 20 + [[0.4, 0.4, 0.1]]
    change = [4] * 20 + [0]
    assert labelled(dense, change).codes.tolist() == [4]
    assert labelled(dense, change, config=GridConfig(leaf=0.25)).codes.tolist() == [0]


def test_a_cell_without_prediction_is_undecided():
    cells = labelled([[0.1, 0.1, 0.0]], [2], confidence=np.array([0.7]))
    keys = cell_keys(np.array([[0.2, 0.2], [5.0, 5.0]]), PLAIN)
    said, trust = look_up(cells, keys)
    assert said.tolist() == [2, 255]
    assert trust.tolist() == [0.7, 0.0]


labels = st.sampled_from([0, 1, 2, 3, 4, 254, 255])
points = st.lists(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-1, 1), labels, st.integers(0, 1)),
    min_size=1,
    max_size=60,
)


@given(points, st.sampled_from([0.0, 0.25]), st.integers(0, 2**31))
def test_cells_do_not_depend_on_the_order_of_points(rows, leaf, seed):
    order = np.random.default_rng(seed).permutation(len(rows))
    table = np.array(rows)

    def cells(values):
        return rasterise(
            values[:, :3], values[:, 3].astype(int), values[:, 4].astype(int), GridConfig(leaf=leaf)
        )

    first, second = cells(table), cells(table[order])
    np.testing.assert_array_equal(first.keys, second.keys)
    np.testing.assert_array_equal(first.codes, second.codes)
    np.testing.assert_allclose(first.confidence, second.confidence)


# -- confidence


def test_risk_falls_when_doubtful_decisions_are_left_out():
    correct = np.array([True] * 8 + [False] * 2)
    curve = risk_coverage(correct, np.linspace(0.99, 0.5, 10), total=20, steps=10)
    assert curve[-1]["coverage_fraction"] == 0.5
    assert curve[-1]["risk_fraction"] == pytest.approx(0.2)
    assert curve[7]["risk_fraction"] == 0.0


def test_calibration_error_of_a_known_table():
    confidence = np.array([0.95] * 10 + [0.55] * 10)
    right = np.array([True] * 9 + [False] + [True] * 3 + [False] * 7)
    result = reliability(confidence, right)
    assert result["ece_fraction"] == pytest.approx(0.5 * 0.05 + 0.5 * 0.25)
    assert [b["rows"] for b in result["bins"]] == [0, 0, 0, 0, 0, 10, 0, 0, 0, 10]


def test_bootstrap_encloses_the_pooled_score_and_needs_two_scenes():
    rng = np.random.default_rng(3)
    matrices = [confusion(rng.integers(0, 5, 200), rng.integers(0, 5, 200)) for _ in range(6)]
    intervals = bootstrap(matrices, scores, 200, 0)
    low, high = intervals["accuracy_percent"]
    assert low < scores(np.sum(matrices, axis=0))["accuracy_percent"] < high
    assert intervals == bootstrap(matrices, scores, 200, 0)
    assert bootstrap(matrices[:1], scores, 200, 0) == {}


# -- registration and trajectories


def test_registration_error_is_measured_at_the_origin_of_the_registration():
    origin = np.array([391_200.0, 6_464_500.0, 30.0])
    about = make_pose(np.eye(3), origin)
    true = about @ exp_se3([0, 0, 0.01, 1.0, 0, 0]) @ invert_pose(about)
    wrong = exp_se3([0, 0, 0.01 + np.radians(0.1), 1.0, 0.03, 0.04])
    document = {"origin": origin.tolist(), "T_local_about_origin": wrong.tolist()}
    error = registration_error(document, true)
    assert error["rotation_error_deg"] == pytest.approx(0.1, abs=1e-6)
    assert error["translation_error_m"] == pytest.approx(0.05, abs=1e-6)
    assert registration_error(None, true) is None


# -- points and objects


def test_truth_is_carried_to_the_nearest_point_within_reach_only():
    truth = PointCloud(
        np.array([[0.0, 0, 0], [1.0, 0, 0]]),
        fields={"change": np.array([0, 4]), "semantic": np.array([1, 0]), "object": np.array([7, -1])},
    )
    said = PointCloud(
        np.array([[0.1, 0, 0], [0.6, 0, 0], [0.9, 0, 0]]), fields={"change": np.array([0, 0, 0])}
    )
    found = objects.transfer(said, truth, radius=0.3)
    assert found.true_change.tolist() == [0, 255, 4]
    assert found.true_object.tolist() == [7, -1, -1]
    assert found.matched.tolist() == [True, False, True]


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_points_of_one_object_in_one_voxel_count_once(seed, times):
    rng = np.random.default_rng(seed)
    xyz, change = rng.uniform(0, 2, (40, 3)), rng.integers(0, 2, 40).astype(np.uint8)
    sparse = PointCloud(xyz, fields={"change": change, "instance": change.astype(np.int32)})
    dense = sparse.select(np.repeat(np.arange(40), times))
    counts = [len(objects.one_a_voxel(cloud, 0.25)) for cloud in (sparse, dense)]
    expected = len(np.unique(np.column_stack([np.floor(xyz / 0.25), change]), axis=0))
    assert counts == [expected, expected]
    assert len(objects.one_a_voxel(dense, 0.0)) == len(dense)


def test_claims_and_finds_are_counted_by_object():
    table = pd.DataFrame(
        {
            "object_id": [1, 2, 3],
            "label": ["Added", "Removed", "Added"],
            "class": "building",
            "confidence": 0.9,
        }
    )
    n = 40
    pairs = objects.PointPairs(
        change=np.repeat([0, 1, 0], n),
        true_change=np.repeat([0, 4, 255], n),
        semantic=np.ones(3 * n, int),
        true_semantic=np.ones(3 * n, int),
        instance=np.repeat([1, 2, 3], n),
        true_object=np.repeat([11, 12, 13], n),
        matched=np.ones(3 * n, bool),
    )
    x = np.linspace(0, 2, n)
    place = np.column_stack([x, x, x])
    truth = PointCloud(
        np.concatenate([place, place]),
        fields={"change": np.repeat([0, 1], n), "object": np.repeat([11, 14], n)},
    )
    verdicts = objects.row_verdicts(table, pairs, 0.5)
    assert verdicts["right"].tolist() == [True, False, False]
    real = objects.true_changes(truth, pairs, 30, 1.0)
    assert len(real) == 1  # the other real change has no predicted points in its place
    result = objects.rates(objects.object_counts(verdicts, real, 0.5, 30))
    assert (result["predicted"], result["right"], result["true"], result["found"]) == (2, 1, 1, 1)
    assert result["claims_in_unobserved_places_above_half_confidence"] == 1
    assert result["precision_percent"] == 50.0
    assert result["recall_percent"] == 100.0


# -- whole runs


def write_truth(root, scene, transform=None):
    (root / "truth").mkdir(parents=True)
    (root / "truth" / "scene.yaml").write_text(
        yaml.safe_dump(
            {
                "seed": 7,
                "preset": "made up",
                "T_after_before": (np.eye(4) if transform is None else transform).tolist(),
            }
        )
    )
    pd.DataFrame({"object": [1]}).to_csv(root / "truth" / "objects.csv", index=False)
    for epoch in ("before", "after"):
        cloud = getattr(scene, epoch)
        (root / epoch / "truth").mkdir(parents=True)
        xyz = cloud.world()
        if epoch == "before" and transform is not None:
            inverse = invert_pose(transform)
            xyz = xyz @ inverse[:3, :3].T + inverse[:3, 3]
        np.savez(
            root / epoch / "truth" / "points.npz",
            xyz=xyz,
            object=cloud.fields["instance"],
            change=cloud.fields["change"],
            **{"class": cloud.fields["semantic"]},
        )
    return root


@pytest.fixture(scope="module")
def perfect(tmp_path_factory):
    root = tmp_path_factory.mktemp("perfect")
    scene = scene_result()
    truth = write_truth(root / "sim", scene, scene.registration.T_after_before)
    write_change_directory(root / "change", scene, SceneConfig(), ChangeInputs())
    return root / "change", truth


def test_a_perfect_change_directory_scores_100_everywhere(perfect):
    result = evaluate([perfect])
    for part in ("grid", "points"):
        assert result[part]["miou_percent"] == 100.0
        assert result[part]["accuracy_percent"] == 100.0
    assert result["semantics"]["miou_percent"] == 100.0
    assert result["objects"]["precision_percent"] == result["objects"]["recall_percent"] == 100.0
    assert result["objects"]["true"] == 6
    registration = result["scenes"][0]["registration"]
    assert registration["translation_error_m"] < 1e-6
    assert registration["rotation_error_deg"] < 1e-6
    assert result["grid"]["cells_left_out_not_reported"] == 0
    assert result["options"]["grid"]["share"] == 0.3


def test_labels_by_another_method_as_clouds_and_as_arrays_score_the_same(tmp_path, perfect):
    change, truth = perfect
    for epoch in ("before", "after"):
        with np.load(truth / epoch / "truth" / "points.npz") as data:
            np.save(tmp_path / f"{epoch}.npy", np.where(data["change"] == 0, 4, data["change"]))
    result = evaluate([(tmp_path, truth)])
    assert result["grid"]["iou_percent"]["Added"] == 0.0
    assert result["grid"]["iou_percent"]["Removed"] == 100.0
    assert result["objects"] is None
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    for epoch in ("before", "after"):
        (clouds / f"{epoch}.ply").write_bytes((change / f"{epoch}_labelled.ply").read_bytes())
    assert evaluate([(clouds, truth)])["grid"]["miou_percent"] == 100.0


def test_several_pairs_pool_and_get_intervals(perfect, tmp_path):
    result = evaluate([perfect, perfect], EvaluationConfig(draws=100))
    single = evaluate([perfect])
    doubled = 2 * np.array(single["grid"]["confusion_rows_truth"])
    np.testing.assert_array_equal(result["grid"]["confusion_rows_truth"], doubled)
    assert result["grid"]["interval_95_percent"]["miou_percent"] == [100.0, 100.0]
    write_evaluation(result, tmp_path)
    document = json.loads((tmp_path / "evaluation.json").read_text())
    assert document["truth_is_simulated"] is True
    assert (tmp_path / "reliability.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "evaluation.md").read_text()
    assert page.startswith("# Evaluation against simulated truth")
    assert "| cells | 100.0 | 100.0 | 100.0 | 100.0 | 0.0 |" in page


def test_a_score_names_the_simulated_survey_it_holds_for(perfect, tmp_path):
    scene = tmp_path / "truth" / "truth" / "scene.yaml"
    shutil.copytree(perfect[1], tmp_path / "truth")
    named = {
        "preset": "easy",
        "seed": 7,
        "simulator_hash": "ab12",
        "preset_hash": "cd34",
        "scene_hash": "ef56",
    }
    scene.write_text(yaml.safe_dump({**yaml.safe_load(scene.read_text()), **named}))
    result = evaluate([(perfect[0], tmp_path / "truth")])
    assert result["simulations"] == [named]
    write_evaluation(result, tmp_path / "out")
    assert "simulator ab12, preset cd34, scene ef56" in (tmp_path / "out" / "evaluation.md").read_text()


def test_labels_that_do_not_fit_the_truth_are_refused(tmp_path, perfect):
    _, truth = perfect
    with pytest.raises(InputError, match="no labels of epoch before"):
        evaluate([(tmp_path, truth)])
    np.save(tmp_path / "before.npy", np.zeros(3))
    np.save(tmp_path / "after.npy", np.zeros(3))
    with pytest.raises(InputError, match="expected one code for each"):
        evaluate([(tmp_path, truth)])


def test_published_files_are_read_and_scored(tmp_path):
    for name, said in (("loop01", [[0, 1], [4, 4]]), ("loop02", [[0, 0], [4, 255]])):
        (tmp_path / name / "change").mkdir(parents=True)
        np.save(tmp_path / name / "gt_change.npy", np.array([[0, 1], [4, -1]]))
        np.save(tmp_path / name / "gt_sem.npy", np.array([[0, 1], [2, 3]]))
        np.save(tmp_path / name / "pred_sem.npy", np.array([[0, 1], [2, 2]]))
        np.save(tmp_path / name / "change" / "ours.npy", np.array(said))
    result = evaluate_published(tmp_path, "ours")
    assert result["truth_is_simulated"] is False
    assert result["grid"]["cells"] == 6
    assert result["grid"]["accuracy_percent"] == pytest.approx(100 * 5 / 6)
    assert result["grid"]["iou_percent"]["Removed"] == 50.0
    assert result["semantics"]["iou_percent"]["mobile"] == 0.0
    with pytest.raises(InputError, match="theirs"):
        evaluate_published(tmp_path, "theirs")


def test_a_published_pair_of_ascii_clouds_is_read(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\n"
    head += "".join(f"property float {n}\n" for n in "xyz") + "".join(
        f"property uchar {n}\n" for n in ("red", "green", "blue")
    )
    for name in ("2023.ply", "2025.ply"):
        (tmp_path / name).write_text(head + "end_header\n1 2 3 0 0 0\n4 5 6 0 0 0\n")
    before, after = read_published_pair(tmp_path)
    assert len(before) == len(after) == 2
    assert before.crs is None
    np.testing.assert_allclose(after.world()[1], [4, 5, 6])
    (tmp_path / "2025.ply").unlink()
    with pytest.raises(InputError, match=r"2025\.ply is missing"):
        read_published_pair(tmp_path)


def marked(truth, folder, near, **scene):
    """Copy a truth whose named objects are near a gate, with more entries of its scene."""
    shutil.copytree(truth, folder)
    path = folder / "truth" / "objects.csv"
    table = pd.DataFrame({"object_id": near, "near_gate": 1})
    table.to_csv(path, index=False)
    said = folder / "truth" / "scene.yaml"
    said.write_text(yaml.safe_dump({**yaml.safe_load(said.read_text()), **scene}))
    return folder


def test_changes_near_a_gate_are_scored_apart(tmp_path, perfect):
    """What is said of an object near a gate is neither right nor wrong without these objects."""
    change, truth = perfect
    for epoch in ("before", "after"):
        with np.load(truth / epoch / "truth" / "points.npz") as data:
            np.save(tmp_path / f"{epoch}.npy", np.where(data["change"] == 0, 4, data["change"]))
            if epoch == "after":
                added = np.unique(data["object"][data["change"] == 0])
    with_near = marked(truth, tmp_path / "marked", added.tolist())
    result = evaluate([(tmp_path, with_near)])
    assert result["grid"]["iou_percent"]["Added"] == 0.0
    clear = result["without_near_gate"]
    assert clear["objects_near_gate"] == len(added)
    assert clear["grid"]["iou_percent"]["Added"] is None
    assert clear["grid"]["accuracy_percent"] == 100.0
    perfect_said = evaluate([(change, with_near)])["without_near_gate"]["objects"]
    assert perfect_said["true"] == 6 - len(added)
    assert perfect_said["precision_percent"] == perfect_said["recall_percent"] == 100.0
    assert evaluate([perfect])["without_near_gate"] is None


def test_families_are_scored_apart_and_the_gap_between_them_is_stated(tmp_path, perfect):
    change, truth = perfect
    for epoch in ("before", "after"):
        with np.load(truth / epoch / "truth" / "points.npz") as data:
            np.save(tmp_path / f"{epoch}.npy", np.where(data["change"] == 0, 4, data["change"]))
    suburb = marked(truth, tmp_path / "suburb", [], family="suburb")
    dense = marked(truth, tmp_path / "dense", [], family="dense")
    result = evaluate([(change, suburb), (tmp_path, dense)])
    families = result["families"]
    assert families["never_tuned"] == "dense"
    assert families["scores"]["suburb"]["miou_percent"] == 100.0
    lost = evaluate([(tmp_path, truth)])["grid"]["miou_percent"]
    assert families["scores"]["dense"]["miou_percent"] == lost < 100.0
    assert families["generalisation_gap_miou_percent"] == pytest.approx(100.0 - lost)
    write_evaluation(result, tmp_path / "out")
    page = (tmp_path / "out" / "evaluation.md").read_text()
    assert "| dense (never tuned on) | 1 |" in page
    assert f"Generalisation gap, mIoU of the tuned family less that of the other: {100.0 - lost:.1f}" in page
    assert evaluate([perfect])["families"] is None
