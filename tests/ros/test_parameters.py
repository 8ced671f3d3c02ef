"""Parameters tell their meaning, unit and bounds, and are refused where nobody would read them any more."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import Field

from subiaco_geo.config import StrictModel
from subiaco_mapping.config import MappingConfig

pytestmark = pytest.mark.ros


class Own(StrictModel):
    """Parameters of a node of ours."""

    rate: float = Field(0.0, ge=0, description="speed of the replay; 0 is as fast as it goes [1]")
    depth: int = Field(5, gt=0, le=100, description="messages that are kept")
    folder: str = Field("", description="folder to write")
    bags: tuple[str, ...] = Field((), description="bags that are played")


def read(node: Any) -> tuple[Own, MappingConfig]:
    from subiaco_ros.parameters import read_models

    own, config = read_models(node, Own, MappingConfig)
    return own, config


def test_a_parameter_says_its_meaning_type_and_bounds(ros: Any) -> None:
    from rcl_interfaces.msg import ParameterType

    node = ros.node("probe", rate=2.0, odometry__voxel=0.7)
    read(node)
    rate, depth = node.describe_parameter("rate"), node.describe_parameter("depth")
    assert rate.description == "speed of the replay; 0 is as fast as it goes [1]"
    assert (rate.type, rate.read_only) == (ParameterType.PARAMETER_DOUBLE, True)
    assert rate.floating_point_range[0].from_value == 0.0
    assert (depth.integer_range[0].from_value, depth.integer_range[0].to_value) == (0, 100)
    assert depth.additional_constraints == "greater than 0, at most 100"
    voxel = node.describe_parameter("odometry.voxel")
    assert "[m]" in voxel.description
    assert node.get_parameter("odometry.voxel").value == 0.7


def test_every_setting_is_declared_with_the_value_that_the_node_uses(ros: Any) -> None:
    from subiaco_ros.parameters import leaves

    node = ros.node("probe", odometry__voxel=0.7, sensors__lidar__translation=[1.0, 0.0, 2.0])
    own, config = read(node)
    names = [name for model in (own, config) for name, _, _ in leaves(model)]
    assert len(names) == len(set(names)) > 100
    assert all(node.has_parameter(name) for name in names)
    assert node.get_parameter("odometry.voxel").value == config.odometry.voxel == 0.7
    assert node.get_parameter("odometry.max_range").value == config.odometry.max_range
    assert list(node.get_parameter("sensors.lidar.translation").value) == [1.0, 0.0, 2.0]


def test_a_parameter_that_is_set_later_is_refused_and_keeps_its_value(ros: Any) -> None:
    from rclpy.parameter import Parameter

    node = ros.node("probe", rate=2.0)
    read(node)
    for name, value in (("rate", 3.0), ("odometry.voxel", 2.0), ("folder", "/elsewhere")):
        before = node.get_parameter(name).value
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert "read-only" in result.reason
        assert node.get_parameter(name).value == before


def test_parameters_read_back_make_the_same_models(ros: Any) -> None:
    first = ros.node("probe", rate=2.0, odometry__voxel=0.7)
    own, config = read(first)
    found = {name: p.value for name, p in first.get_parameters_by_prefix("").items() if p.value is not None}
    own_ros = {name: value for name, value in found.items() if not name.startswith("qos_overrides")}
    again = ros.node("other", **{name.replace(".", "__"): value for name, value in own_ros.items()})
    assert read(again) == (own, config)


def test_every_parameter_of_every_node_has_a_description() -> None:
    from subiaco_change.config import ChangeConfig
    from subiaco_change.nodes.change_node import ChangeParameters
    from subiaco_mapping.nodes.monitor_node import MonitorParameters
    from subiaco_mapping.nodes.odometry_node import OdometryParameters
    from subiaco_mapping.nodes.pose_graph_node import PoseGraphParameters
    from subiaco_mapping.nodes.recorder_node import RecorderParameters
    from subiaco_mapping.nodes.replay_node import ReplayParameters
    from subiaco_mapping.recording.config import RecordingConfig
    from subiaco_ros.parameters import leaves

    models = (
        MonitorParameters, OdometryParameters, PoseGraphParameters, RecorderParameters, ReplayParameters,
        ChangeParameters, MappingConfig, ChangeConfig, RecordingConfig,
    )  # fmt: skip
    for model in models:
        required = {name: field for name, field in model.model_fields.items() if field.is_required()}
        given = {name: ("x",) if "tuple" in str(f.annotation) else "x" for name, f in required.items()}
        bare = [name for name, field, _ in leaves(model(**given)) if not field.description]
        assert bare == [], model.__name__
