"""The truth of a simulated survey is read, or refused with the remedy."""

import numpy as np
import pytest
import yaml

from subiaco_evaluation.layouts import in_after_frame
from subiaco_evaluation.truth import read_truth, read_truth_points
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3, make_pose, transform_points
from subiaco_geo.trajectories import Trajectory, write_tum

XYZ = np.array([[391_200.25, 6_464_500.125, 30.5], [391_201.0, 6_464_502.0, 31.0]])


def survey(root, transform=None, **changes):
    (root / "truth").mkdir()
    scene = {"seed": 3, "preset": "easy"}
    if transform is not None:
        scene["T_after_before"] = transform.tolist()
    (root / "truth" / "scene.yaml").write_text(yaml.safe_dump(scene))
    (root / "truth" / "objects.csv").write_text("object_id,label\n1,Added\n")
    for epoch in ("before", "after"):
        (root / epoch / "truth").mkdir(parents=True)
        arrays = {
            "xyz": XYZ,
            "object": np.array([1, -1]),
            "class": np.array([1, 0]),
            "change": np.array([0, 255]),
        }
        np.savez(root / epoch / "truth" / "points.npz", **(arrays | changes))
        poses = make_pose(np.tile(np.eye(3), (2, 1, 1)), XYZ)
        write_tum(root / epoch / "truth" / "trajectory.tum", Trajectory(np.array([1, 2]) * 10**9, poses))
    return root


def test_points_keep_their_millimetres_codes_and_objects(tmp_path):
    truth = read_truth(survey(tmp_path))
    np.testing.assert_allclose(truth.after.world(), XYZ, atol=1e-9)
    assert truth.after.fields["change"].tolist() == [0, 255]
    assert truth.after.fields["semantic"].tolist() == [1, 0]
    assert truth.before.fields["object"].tolist() == [1, -1]
    np.testing.assert_array_equal(truth.T_after_before, np.eye(4))
    assert truth.objects["label"].tolist() == ["Added"]
    assert len(truth.trajectories["before"]) == 2


def test_points_of_before_are_brought_into_the_frame_of_after(tmp_path):
    about = make_pose(np.eye(3), XYZ[0])
    transform = about @ exp_se3([0.0, 0.0, 0.3, 2.0, -1.0, 0.5]) @ make_pose(np.eye(3), -XYZ[0])
    truth = read_truth(survey(tmp_path, transform))
    moved = in_after_frame(truth)
    np.testing.assert_allclose(moved["before"].world(), transform_points(transform, XYZ), atol=1e-7)
    np.testing.assert_allclose(moved["after"].world(), XYZ, atol=1e-9)


@pytest.mark.parametrize(("name", "code"), [("change", 9), ("class", 17)])
def test_codes_without_a_meaning_are_refused(tmp_path, name, code):
    root = survey(tmp_path, **{name: np.array([0, code])})
    with pytest.raises(InputError, match=f"{name} holds {code}"):
        read_truth(root)


def test_missing_or_damaged_files_are_refused_with_the_remedy(tmp_path):
    with pytest.raises(InputError, match=r"scene\.yaml: missing.*subiaco simulate"):
        read_truth(tmp_path)
    broken = tmp_path / "points.npz"
    broken.write_bytes(b"nothing")
    with pytest.raises(InputError, match="simulate again"):
        read_truth_points(broken)
    np.savez(broken, xyz=XYZ)
    with pytest.raises(InputError, match="object"):
        read_truth_points(broken)
