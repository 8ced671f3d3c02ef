"""Stretches that a surveyor is warned of."""

import numpy as np
import pytest
from mapping_scenes import START_NS

from subiaco_mapping.config import ManifestConfig
from subiaco_mapping.manifest import describe_sequence
from subiaco_mapping.measurements import OdometryPose


def described(columns: list[tuple[int, int]], ratio: float = 0.05) -> dict[str, object]:
    poses = [
        OdometryPose(START_NS + k * 10**8, np.eye(4), np.eye(6), 100, 0.02, False, 0)
        for k in range(len(columns))
    ]
    positions = np.stack([np.arange(len(columns)), *[np.zeros(len(columns))] * 2], axis=1).astype(float)
    config = ManifestConfig(max_lost_ratio=ratio)
    return describe_sequence(poses, columns, ["gyro"] * len(columns), [], positions, config)


@pytest.mark.parametrize("sent", [512, 1024, 2048])
def test_lost_columns_are_judged_by_the_share_of_those_that_the_mode_sends(sent: int) -> None:
    little, much = int(0.04 * sent), int(0.06 * sent)
    facts = described([(0, sent), (little, sent), (much, sent), (much, sent), (0, sent)])
    (stretch,) = facts["flagged"]["packet_loss"]
    assert (stretch["scans"], stretch["length_m"]) == (2, 2.0)
    assert facts["lost_columns"] == little + 2 * much


def test_a_sensor_that_sends_no_columns_loses_none() -> None:
    assert described([(0, 0)] * 3)["flagged"] == {}
