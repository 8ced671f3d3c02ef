"""Messages to numpy, for rosbags and rclpy alike: both spell the attributes the same way."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose, make_pose, pose_from_quaternion
from subiaco_geo.topics import POINTS, TF_STATIC
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import (
    Extrinsics,
    GnssFix,
    HeadingSample,
    ImuSample,
    Returns,
    Scan,
)
from subiaco_mapping.preprocessing.cloud_sky import SkyOfClouds
from subiaco_mapping.preprocessing.config import FramePose, SensorsConfig
from subiaco_mapping.preprocessing.gnss_drivers import StatusReading, rtk_state
from subiaco_mapping.preprocessing.point_times import TIME_FIELDS, point_times

_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def stamp_ns(stamp: Any) -> int:
    """Turn a stamp with ``sec`` and ``nanosec`` into nanoseconds."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _vector(message: Any) -> Floats:
    return np.array([message.x, message.y, message.z], dtype=np.float64)


def imu_from_msg(message: Any) -> ImuSample:
    """Convert a sensor_msgs/Imu."""
    return ImuSample(
        stamp_ns(message.header.stamp),
        _vector(message.angular_velocity),
        _vector(message.linear_acceleration),
    )


def fix_from_msg(message: Any, config: StatusReading) -> GnssFix:
    """Convert a sensor_msgs/NavSatFix; the driver profile says what its status means."""
    covariance = np.array(message.position_covariance, dtype=np.float64).reshape(3, 3)
    return GnssFix(
        time_ns=stamp_ns(message.header.stamp),
        latitude=float(message.latitude),
        longitude=float(message.longitude),
        altitude=float(message.altitude),
        covariance=covariance,
        status=rtk_state(
            int(message.status.status),
            covariance,
            int(message.position_covariance_type),
            config.driver,
            config.fixed_below,
            config.float_below,
        ),
    )


def heading_from_msg(message: Any) -> HeadingSample:
    """Convert the sensor_msgs/Imu of a dual antenna; without a heading its sigma is NaN."""
    covariance = np.array(message.orientation_covariance, dtype=np.float64)
    q = message.orientation
    yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    sigma = np.sqrt(covariance[8]) if covariance[0] >= 0 and covariance[8] > 0 else np.nan
    return HeadingSample(stamp_ns(message.header.stamp), float(yaw), float(sigma))


def cloud_array(message: Any) -> NDArray[np.void]:
    """Return the points of a PointCloud2 as a structured array (N,), without copying."""
    order = ">" if message.is_bigendian else "<"
    try:
        dtype = np.dtype(
            {
                "names": [field.name for field in message.fields],
                "formats": [order + _FORMATS[field.datatype] for field in message.fields],
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
        )
        return np.frombuffer(memoryview(message.data), dtype=dtype)
    except (KeyError, ValueError) as error:
        raise InputError(f"{POINTS}: point layout cannot be read ({error}); check its fields") from error


def _column(points: NDArray[np.void], names: tuple[str, ...], dtype: Any) -> NDArray[Any]:
    name = next((n for n in names if n in (points.dtype.names or ())), None)
    return np.zeros(len(points), dtype=dtype) if name is None else points[name].astype(dtype)


def scan_from_points(message: Any, config: MappingConfig, sky: SkyOfClouds | None = None) -> Scan:
    """Convert a sensor_msgs/PointCloud2 of any LiDAR.

    Points that are not finite or outside the range limits are dropped; the former are counted. ``sky`` finds
    the beams that met nothing.

    Raises
    ------
    InputError
        No x y z, or no point times while ``deskewed`` is not set.
    """
    return scan_from_array(cloud_array(message), stamp_ns(message.header.stamp), config, sky)


def scan_from_array(
    points: NDArray[np.void], header_ns: int, config: MappingConfig, sky: SkyOfClouds | None = None
) -> Scan:
    """Convert the points of a cloud.

    Parameters
    ----------
    points : (N,) structured
        ``x``, ``y``, ``z`` [m] in ``lidar_link``, a time field (:mod:`.point_times`), and if known
        ``intensity`` or ``reflectivity``, ``ring`` or ``line``.
    header_ns : int
        Stamp of the message, from where times that are not absolute count.
    config : MappingConfig
    sky : SkyOfClouds, optional
        Of the scanner; without it no beam is taken to have met nothing.

    Raises
    ------
    InputError
        No x y z, or no point times while ``deskewed`` is not set.
    """
    missing = [name for name in "xyz" if name not in (points.dtype.names or ())]
    if missing:
        raise InputError(f"{POINTS}: no field {missing[0]}; a cloud needs x, y and z")
    xyz = np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    times_ns = (
        None if config.deskewed else point_times(points, header_ns, np.asarray(finite & xyz.any(axis=1)))
    )
    if times_ns is None and not config.deskewed:
        raise InputError(
            f"{POINTS}: no per-point time ({', '.join(TIME_FIELDS[:5])}); record it, or set deskewed: true "
            "if the clouds are already motion-compensated"
        )
    times_ns = np.full(len(points), header_ns) if times_ns is None else times_ns
    reach = np.sqrt((xyz * xyz).sum(axis=1))
    keep = finite & (reach >= max(config.decode.min_range, 1e-6)) & (reach <= config.decode.max_range)
    offset_ns = config.decode.time_offset_ns
    intensity = _column(points, ("intensity", "reflectivity", "i"), np.float32)
    ring = _column(points, ("ring", "line", "channel"), np.uint16)
    inside = times_ns[keep] + offset_ns
    empty = None
    if sky is not None and not config.deskewed and "ring" in (points.dtype.names or ()):
        met = finite & (reach > 0)
        empty = sky.find(xyz[met], times_ns[met] + offset_ns, ring[met], config.decode.sky_range)
    return Scan(
        start_ns=int(inside.min(initial=header_ns + offset_ns)) if len(inside) else header_ns + offset_ns,
        end_ns=int(inside.max()) if len(inside) else header_ns + offset_ns,
        first=Returns(xyz[keep], inside, intensity[keep], ring[keep]),
        sky=empty,
        dropped_points=int((~finite).sum()),
        deskewed=config.deskewed,
    )


def _tree(transforms: Iterable[Any]) -> dict[str, tuple[str, Floats]]:
    """Return child -> (parent, T_parent_child) of geometry_msgs/TransformStamped."""
    tree = {}
    for item in transforms:
        turn = item.transform.rotation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        if not np.isfinite(quaternion).all() or abs(np.linalg.norm(quaternion) - 1.0) > 0.01:
            raise InputError(
                f"{TF_STATIC}: {item.child_frame_id}: its rotation is no unit quaternion; correct it"
            )
        place = _vector(item.transform.translation)
        if not np.isfinite(place).all():
            raise InputError(f"{TF_STATIC}: {item.child_frame_id}: its translation is not finite; correct it")
        pose = pose_from_quaternion(place, quaternion)
        tree[item.child_frame_id.lstrip("/")] = (item.header.frame_id.lstrip("/"), pose)
    return tree


def _to_root(tree: dict[str, tuple[str, Floats]], frame: str) -> tuple[str, Floats]:
    """Return the root above a frame and ``T_root_frame``."""
    pose, seen = np.eye(4), {frame}
    while frame in tree:
        frame, step = tree[frame]
        if frame in seen:
            raise InputError(f"{TF_STATIC}: {frame}: the frames form a loop; correct the transforms")
        seen.add(frame)
        pose = step @ pose
    return frame, pose


def check_frames(transforms: Iterable[Any]) -> None:
    """Refuse transforms that are not numbers, no rotations, or a loop.

    Raises
    ------
    InputError
        Names the frame.
    """
    tree = _tree(transforms)
    for frame in tree:
        _to_root(tree, frame)


def _from_tf(tree: dict[str, tuple[str, Floats]], base: str, frame: str) -> Floats | None:
    """Return ``T_base_frame``, None where the tree does not join them."""
    if frame not in tree and frame not in {parent for parent, _ in tree.values()}:
        return None
    base_root, T_root_base = _to_root(tree, base)
    frame_root, T_root_frame = _to_root(tree, frame)
    return invert_pose(T_root_base) @ T_root_frame if base_root == frame_root else None


def _from_config(pose: FramePose | None) -> Floats | None:
    if pose is None:
        return None
    rotation = Rotation.from_euler("xyz", pose.rotation_deg, degrees=True).as_matrix()
    return make_pose(rotation, pose.translation)


def extrinsics_from_tf(
    transforms: Iterable[Any], config: SensorsConfig, needs: Collection[str] = ()
) -> Extrinsics:
    """Put the extrinsics together from ``/tf_static`` and configuration.

    Parameters
    ----------
    transforms : iterable of geometry_msgs/TransformStamped
    config : SensorsConfig
        Fills gaps; wins with ``override``.
    needs : collection of {"imu", "gnss"}
        Sensors whose data will be used.

    Raises
    ------
    InputError
        A sensor that is needed has no extrinsic. Without IMU and GNSS the LiDAR may be the base.
    """
    tree = _tree(transforms)

    def find(name: str, frame: str, given: FramePose | None) -> Floats | None:
        recorded, configured = _from_tf(tree, config.base_frame, frame), _from_config(given)
        first, second = (configured, recorded) if config.override else (recorded, configured)
        pose = first if first is not None else second
        if pose is None and (name in needs or (name == "lidar" and needs)):
            raise InputError(
                f"{TF_STATIC}: nothing joins {config.base_frame} and {frame}; record the transform or set "
                f"sensors.{name} in config/sensors.yaml"
            )
        return pose

    lidar = find("lidar", config.lidar_frame, config.lidar)
    imu = find("imu", config.imu_frame, config.imu)
    gnss = find("gnss", config.gnss_frame, config.gnss)
    return Extrinsics(
        np.eye(4) if lidar is None else lidar, imu, None if gnss is None else gnss[:3, 3].copy()
    )
