"""Synthetic rooms, motions and bags with known answers for the mapping tests."""

from pathlib import Path

import numpy as np
from ouster.sdk import core, pcap
from scipy.spatial.transform import Rotation

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.frames import invert_pose, make_pose
from subiaco_geo.topics import MESSAGE_TYPES, POINTS

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
ROOM = np.array([12.0, 9.0, 3.0])


def pcap_bufs(recording: Path, metadata: str) -> list[bytes]:
    """LiDAR packets of a pcap."""
    info = core.SensorInfo(metadata)
    source = pcap.PcapPacketSource(str(recording), sensor_info=[info])
    return [bytes(packet.buf) for _, packet in source if isinstance(packet, core.LidarPacket)]


def sdk_frames(bufs: list[bytes], metadata: str) -> list[core.LidarFrame]:
    """The same packets batched by the SDK itself."""
    info = core.SensorInfo(metadata)
    batcher, frames, frame = core.FrameBatcher(info), [], core.LidarFrame(info)
    for buf in bufs:
        packet = core.LidarPacket(core.PacketFormat(info))
        packet.buf[:] = np.frombuffer(buf, dtype=np.uint8)
        if batcher.batch(packet, frame):
            frames.append(frame)
            frame = core.LidarFrame(info)
    return frames


def room_scan(pose: np.ndarray, count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """Points (count, 3) in the sensor frame of a closed room of half size ROOM with two boxes."""
    rng = np.random.default_rng(seed)
    beams = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.5]
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    return cast(pose, beams) + noise * rng.normal(size=(count, 3))


def cast(poses: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """Where beams (N, 3) of poses (4, 4) or (N, 4, 4) meet the room, in the frames of the poses."""
    poses = np.broadcast_to(poses, (len(beams), 4, 4))
    start = poses[:, :3, 3]
    direction = np.einsum("nij,nj->ni", poses[:, :3, :3], beams)
    with np.errstate(divide="ignore"):
        reach = np.max(np.stack([(ROOM - start) / direction, (-ROOM - start) / direction]), axis=0).min(
            axis=1
        )
        for low, high in (
            (np.array([4, 3, -3.0]), np.array([6, 5, 1.0])),
            (np.array([-8, -6, -3.0]), np.array([-6, -3, 0])),
        ):
            a, b = (low - start) / direction, (high - start) / direction
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (near > 0) & (near < far)
            reach = np.where(hit, np.minimum(reach, near), reach)
    return beams * reach[:, None]


def turning_pose(times_ns: np.ndarray, speed: float = 3.0, rate: float = 0.4) -> np.ndarray:
    """Poses (N, 4, 4) on a circle: exact constant body twist."""
    seconds = (np.asarray(times_ns) - START_NS) / SECOND
    angle = rate * seconds
    rotation = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    radius = speed / rate
    position = np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), 0 * angle], axis=1)
    return make_pose(rotation, position - [4.0, 3.0, 0.0])


def relative(poses: np.ndarray) -> np.ndarray:
    """Poses relative to the first."""
    return invert_pose(poses[0]) @ poses


def point_cloud_message(xyz: np.ndarray, stamp_ns: int, **columns: np.ndarray) -> object:
    """A sensor_msgs/PointCloud2 of float32 x y z and further columns."""
    types = TYPESTORE.types
    codes = {"f4": 7, "f8": 8, "u4": 6, "u2": 4, "u1": 2}
    dtype = np.dtype([(n, "<f4") for n in "xyz"] + [(n, v.dtype.str) for n, v in columns.items()])
    points = np.zeros(len(xyz), dtype)
    for axis, name in enumerate("xyz"):
        points[name] = xyz[:, axis]
    for name, values in columns.items():
        points[name] = values
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name=n, offset=dtype.fields[n][1], datatype=codes[dtype[n].str[1:]], count=1)
        for n in dtype.names
    ]
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="lidar_link"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(points),
        data=points.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def write_clouds(bag: Path, clouds: list[np.ndarray], intensities: list[np.ndarray] | None = None) -> None:
    """A bag of clouds at 10 Hz without point times."""
    with BagWriter(bag) as writer:
        for k, xyz in enumerate(clouds):
            stamp = START_NS + k * SECOND // 10
            extra = {} if intensities is None else {"intensity": intensities[k].astype("<f4")}
            writer.write(POINTS, MESSAGE_TYPES[POINTS], point_cloud_message(xyz, stamp, **extra), stamp)


def transform_message(parent: str, child: str, pose: np.ndarray) -> object:
    """A geometry_msgs/TransformStamped."""
    types = TYPESTORE.types
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return types["geometry_msgs/msg/TransformStamped"](
        header=types["std_msgs/msg/Header"](
            stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=parent
        ),
        child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](x=pose[0, 3], y=pose[1, 3], z=pose[2, 3]),
            rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        ),
    )
