"""A replay never joins a domain in which others send or record sensor data."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from subiaco_bringup.domain import require_free_domain
from subiaco_geo.errors import InputError

pytestmark = pytest.mark.ros

RECORDER = """
import rclpy, sys
from sensor_msgs.msg import NavSatFix
rclpy.init()
node = rclpy.create_node("recorder", namespace="car")
node.create_subscription(NavSatFix, "/gnss/fix", print, 10)
print("listening", flush=True)
sys.stdin.read()
"""


def test_a_domain_in_which_a_recorder_listens_is_refused_and_an_empty_one_is_not() -> None:
    busy = {**os.environ, "ROS_DOMAIN_ID": "87"}
    recorder = subprocess.Popen(
        [sys.executable, "-c", RECORDER],
        env=busy,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert recorder.stdout is not None
        assert recorder.stdout.readline() == "listening\n"
        with pytest.raises(
            InputError, match=r"ROS_DOMAIN_ID=87: /car/recorder already .* unset ROS_DOMAIN_ID"
        ):
            require_free_domain(busy)
        require_free_domain({**os.environ, "ROS_DOMAIN_ID": "88"})
    finally:
        recorder.kill()
        recorder.wait()
