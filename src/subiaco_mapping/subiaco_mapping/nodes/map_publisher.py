"""Publishers of the pose graph's results: path, map preview, frames."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix, PointCloud2

from subiaco_geo.frames import Floats, Ints
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.survey_graph.solution import GraphSolution, LiveEstimate
from subiaco_ros.local_frame import LocalFrame, earth_from_enu
from subiaco_ros.messages import cloud_message, origin_message, path_message, transform_message, xyz_cloud
from subiaco_ros.node_process import wait_until_received
from subiaco_ros.qos import latched, reliable
from tf2_msgs.msg import TFMessage

#: Most poses on the path; a viewer needs no more.
MAX_PATH = 5000


def thinned(count: int, most: int) -> Floats:
    """Return the indices of at most so many of ``count`` items, evenly spread, ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


class MapPublisher:
    """Publishers of the pose graph's results.

    Parameters
    ----------
    node : Node
    map_frame, odom_frame, earth_frame : str
    preview_points : int
        Most points of the map preview.
    """

    def __init__(
        self, node: Node, map_frame: str, odom_frame: str, earth_frame: str, preview_points: int
    ) -> None:
        self._frames = (earth_frame, map_frame, odom_frame)
        self._preview_points = preview_points
        self._T_map_chain = np.eye(4)
        self._T_chain_odom = np.eye(4)
        self._path = node.create_publisher(PathMessage, "path", latched(1))
        self._points = node.create_publisher(PointCloud2, "map/points", latched(1))
        self._origin = node.create_publisher(NavSatFix, "map/origin", latched(1))
        self._tf = node.create_publisher(TFMessage, "tf", reliable(100))
        self._tf_static = node.create_publisher(TFMessage, "tf_static", latched(1))

    def begin_sequence(self) -> None:
        """Let ``odom`` coincide with ``map`` until a sequence is solved."""
        self._T_map_chain = self._T_chain_odom = np.eye(4)

    def publish_odom_frame(self, stamp_ns: int, T_chain_odom: Floats) -> None:
        """Publish ``map -> odom`` of a scan, as the last solution says.

        Parameters
        ----------
        T_chain_odom : (4, 4) float64
            From the frame of the odometry's present run to that of its first.
        """
        _, map_frame, odom = self._frames
        self._T_chain_odom = T_chain_odom
        moving = transform_message(self._T_map_chain @ T_chain_odom, map_frame, odom, stamp_ns)
        self._tf.publish(TFMessage(transforms=[moving]))

    def publish_solution(self, solution: GraphSolution | LiveEstimate) -> None:
        """Publish path, origin, ``earth -> map`` and ``map -> odom``."""
        earth, map_frame, _ = self._frames
        times_ns = np.concatenate([s.stamps_ns for s in solution.sequences])
        poses = np.concatenate([s.T_local_lidar for s in solution.sequences])
        chosen = thinned(len(times_ns), MAX_PATH)
        self._path.publish(path_message(times_ns[chosen], poses[chosen], map_frame))
        newest = solution.sequences[-1]
        stamp_ns = int(newest.stamps_ns[-1])
        self._T_map_chain = newest.T_local_odom
        self.publish_odom_frame(stamp_ns, self._T_chain_odom)
        frame = solution.frame
        if frame is not None:
            origin = origin_message(frame.latitude_deg, frame.longitude_deg, frame.height, map_frame)
            self._origin.publish(origin)
            fixed = transform_message(earth_from_enu(frame), earth, map_frame, stamp_ns)
            self._tf_static.publish(TFMessage(transforms=[fixed]))

    def publish_map(self, survey: SurveyMap, solution: GraphSolution) -> None:
        """Publish the preview of a map in the local frame of its solution."""
        cloud = survey.cloud
        cloud = cloud.select(thinned(len(cloud), self._preview_points))
        local = LocalFrame(cloud.crs, solution.frame, np.zeros(3)).from_world(cloud.world())
        fields = {"intensity": np.asarray(cloud.fields["intensity"], np.float32)}
        stamp_ns = int(solution.sequences[-1].stamps_ns[-1])
        self._points.publish(cloud_message(xyz_cloud(local, **fields), self._frames[1], stamp_ns))

    def publish_growing(self, times_ns: Ints, poses: Floats, xyz: Floats) -> None:
        """Publish what there is of a live map: path (S, 4, 4) and points (N, 3) in ``map``."""
        map_frame = self._frames[1]
        stamp_ns = int(times_ns[-1])
        self._path.publish(path_message(times_ns, poses, map_frame))
        self._points.publish(cloud_message(xyz_cloud(xyz), map_frame, stamp_ns))

    def wait_until_received(self) -> None:
        """Wait until matched subscribers have everything."""
        wait_until_received([self._path, self._points, self._origin, self._tf_static])
