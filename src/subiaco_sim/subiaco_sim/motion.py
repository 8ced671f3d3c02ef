"""How the vehicle moves: a smooth pose at any nanosecond, with its exact rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, make_pose
from subiaco_sim.ground import Terrain
from subiaco_sim.recorded import RecordedDrive

STANDING = 1.0  # s at rest before moving off
ACCELERATION = 1.8  # m/s2
KNOT = 0.05  # s between spline knots
LANE = 1.7  # crown to the middle of the lane [m]; Australia drives on the left


@dataclass(frozen=True)
class Motion:
    """Splines of position and of yaw, pitch, roll over seconds since ``start_ns``."""

    start_ns: int
    duration: float
    position: CubicSpline  # (3,) of base_link in ENU [m]
    angles: CubicSpline  # (3,) yaw, pitch, roll [rad], rotation Rz Ry Rx

    def seconds(self, times_ns: Ints) -> Floats:
        """Return seconds since the start."""
        return np.asarray((np.asarray(times_ns) - self.start_ns) * 1e-9)

    def rotation(self, seconds: Floats) -> Rotation:
        """Return base_link in ENU."""
        return Rotation.from_euler("ZYX", self.angles(seconds))

    def poses(self, times_ns: Ints) -> Floats:
        """Return T_enu_base (N, 4, 4)."""
        t = self.seconds(times_ns)
        return make_pose(self.rotation(t).as_matrix(), self.position(t))

    def body_rate(self, seconds: Floats) -> Floats:
        """Return the angular velocity (N, 3) of base_link in base_link [rad/s]."""
        _, pitch, roll = np.moveaxis(self.angles(seconds), -1, 0)
        d_yaw, d_pitch, d_roll = np.moveaxis(self.angles(seconds, 1), -1, 0)
        return np.stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
                -d_pitch * np.sin(roll) + d_yaw * np.cos(roll) * np.cos(pitch),
            ],
            axis=-1,
        )

    def acceleration(self, seconds: Floats, lever: Floats) -> Floats:
        """Return the acceleration (N, 3) in ENU of a point fixed in base_link [m/s2]."""
        rate = self.body_rate(seconds)
        step = 1e-4
        change = (self.body_rate(seconds + step) - self.body_rate(seconds - step)) / (2 * step)
        swing = np.cross(change, lever) + np.cross(rate, np.cross(rate, lever))
        return np.asarray(self.position(seconds, 2) + self.rotation(seconds).apply(swing))


def travelled(seconds: Floats, speed: float, phase: float) -> Floats:
    """Return the distance driven: at rest, moving off, then a speed that breathes by 12 %."""
    moving = np.maximum(seconds - STANDING, 0.0)
    rise = speed / ACCELERATION
    # smooth ramp: v = speed * (1 - exp(-(t/rise)^2)), plus a slow swing that starts at zero
    swing = 1.0 + 0.12 * np.sin(0.35 * moving + phase) * (1 - np.exp(-moving))
    velocity = speed * (1 - np.exp(-((moving / rise) ** 2))) * swing
    steps = np.diff(seconds, prepend=seconds[0])
    average = 0.5 * (velocity + np.concatenate([velocity[:1], velocity[:-1]]))
    return np.asarray(np.cumsum(average * steps))


def drive(
    route: Floats,
    terrain: Terrain,
    start_ns: int,
    duration: float,
    speed: float,
    reverse: bool,
    seed: int,
    place: float = 0.5,
    recorded: RecordedDrive | None = None,
    lane: float = LANE,
) -> Motion:
    """Drive along a dense centreline on the left of the road, ``lane`` off its crown [m].

    ``place`` says where along the spare length of the route: 0 from its very
    start, 0.5 centred on its middle. With ``recorded``, speed and swing are those
    of a stretch of a real drive, slower where the route is too short for it.

    Raises
    ------
    InputError
        The drive is longer than the route.
    """
    line = _lane(route[::-1] if reverse else route, lane)
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    rng = np.random.default_rng([seed, 11])
    seconds = np.arange(-2.0, duration + 2.0, KNOT)
    distance = travelled(seconds, speed, float(rng.uniform(0, 6.28)))
    stretch = recorded.stretch(duration, rng) if recorded is not None else None
    if stretch is not None:
        distance = stretch.travelled(seconds)
        distance = _smoothed(distance * min(1.0, 0.98 * arc[-1] / distance[-1]))
    distance -= np.interp(0.0, seconds, distance)
    needed = float(distance[-1])
    if needed > arc[-1]:
        longest = duration * arc[-1] / needed
        raise InputError(f"duration {duration:g} s: the street is too short; at most {longest:.0f} s")
    station = distance + place * (arc[-1] - needed)
    smooth = CubicSpline(arc[::20], line[::20])
    xy, tangent = smooth(station), smooth(station, 1)
    z, pitch, roll = _ride(terrain, xy, tangent, seconds, distance, rng)
    if stretch is not None:
        swing = stretch.swing(seconds)
        pitch, roll = pitch + swing[0], roll + swing[1]
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return Motion(
        start_ns,
        duration,
        CubicSpline(seconds, np.column_stack([xy, z])),
        CubicSpline(seconds, np.column_stack([yaw, pitch, roll])),
    )


def _lane(route: Floats, lane: float) -> Floats:
    """Shift a dense centreline to the left."""
    tangent = np.gradient(route, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.asarray(route + lane * np.column_stack([-tangent[:, 1], tangent[:, 0]]))


def _ride(
    terrain: Terrain, xy: Floats, tangent: Floats, seconds: Floats, distance: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Return height, pitch and roll: the lie of the road, smoothed, and the springs' swing."""
    heading = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    left = np.column_stack([-heading[:, 1], heading[:, 0]])

    def slope(direction: Floats) -> Floats:
        ahead, behind = xy + 1.3 * direction, xy - 1.3 * direction
        rise = terrain.height(ahead[:, 0], ahead[:, 1]) - terrain.height(behind[:, 0], behind[:, 1])
        return _smoothed(rise / 2.6)

    moving = 1 - np.exp(-distance)
    phases = rng.uniform(0, 6.28, 6)
    swing = [
        moving * np.sin(2 * np.pi * f * seconds + p) for f, p in zip((1.1, 1.7, 0.6) * 2, phases, strict=True)
    ]
    height = _smoothed(terrain.height(xy[:, 0], xy[:, 1])) + 0.012 * swing[0]
    pitch = -np.arctan(slope(heading)) + 0.004 * swing[1] + 0.003 * swing[2]
    roll = np.arctan(slope(left)) + 0.005 * swing[4] + 0.003 * swing[5]
    return height, pitch, roll


def _smoothed(values: Floats, width: int = 15) -> Floats:
    """Smooth twice with a box, ends held."""
    for _ in range(2):
        padded = np.pad(values, width // 2, mode="edge")
        values = np.convolve(padded, np.ones(width) / width, mode="valid")
    return np.asarray(values)
