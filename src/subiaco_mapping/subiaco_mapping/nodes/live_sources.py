"""Inputs of a live graph: waiting for extrinsics, and odometry segments joined to one."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from subiaco_geo.errors import InputError, SubiacoError
from subiaco_geo.frames import Floats
from subiaco_mapping.fusion.preview import LivePreview
from subiaco_mapping.measurements import DeskewedScan, Extrinsics
from subiaco_mapping.nodes.extrinsics import StaticTransforms
from subiaco_mapping.nodes.map_publisher import MapPublisher, thinned
from subiaco_mapping.survey_graph.solution import GraphSolution

LOGGER = logging.getLogger(__name__)

#: Most poses of the path while it grows: a message of more takes the processor from the mapping.
_MAX_PATH = 1000
_FIRST_SOLVE = 5.0
#: A solution may take this share of the time; the recording never waits for it.
_SOLVE_SHARE = 0.05
_SAY = 5.0


class ExtrinsicsWaiter:
    """Hold a live sequence back until ``/tf_static`` says where the sensors sit.

    Topics come up in any order; what arrives earlier is left out. After ``patience`` seconds it goes
    on with what is known, as a recording without that sensor would.

    Parameters
    ----------
    needs : sequence of {"imu", "gnss"}
    patience : float
        [s]
    clock : callable
        Steady seconds.
    """

    def __init__(
        self, needs: Sequence[str], patience: float = 5.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._needs = needs
        self._patience = patience
        self._clock = clock
        self._since: float | None = None
        self._said = 0.0

    def extrinsics(self, transforms: StaticTransforms) -> Extrinsics | None:
        """Return the extrinsics, None while it is worth waiting for more."""
        now = self._clock()
        self._since = now if self._since is None else self._since
        try:
            return transforms.extrinsics(self._needs)
        except InputError as error:
            if now - self._since < self._patience:
                return None
            LOGGER.warning("%s; going on without", error)
            return transforms.extrinsics(())

    def waiting_for(self, what: str) -> None:
        """Say now and then what is waited for."""
        now = self._clock()
        if now - self._said >= _SAY:
            self._said = now
            LOGGER.warning("waiting for %s", what)


class ListenerWaiter:
    """Hold the first scan of a live graph back until the nodes that take it listen.

    Nodes come up in any order; what is published before a node is matched is lost to it. Sensor messages wait
    in the middleware meanwhile. After ``patience`` seconds it goes on without those that are missing.

    Parameters
    ----------
    missing : callable
        Returns the names of the nodes that do not listen yet.
    patience : float
        [s]
    clock : callable
        Steady seconds.
    """

    def __init__(
        self,
        missing: Callable[[], Sequence[str]],
        patience: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._missing = missing
        self._patience = patience
        self._clock = clock
        self._since: float | None = None
        self._over = False

    @property
    def over(self) -> bool:
        """Whether nothing is waited for any more."""
        if self._over:
            return True
        now = self._clock()
        self._since = now if self._since is None else self._since
        missing = self._missing()
        late = now - self._since >= self._patience
        if missing and late:
            LOGGER.warning("%s: not listening after %.0f s; going on", ", ".join(missing), self._patience)
        self._over = not missing or late
        return self._over


class LiveTimes:
    """What has been taken of live topics, so that nothing enters the map twice.

    Time goes back where a clock is set, and where a bag is played in a loop.
    """

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}
        self._taken: dict[str, set[int]] = {}
        self._behind: set[str] = set()

    def is_newer(self, topic: str, stamp_ns: int) -> bool:
        """Whether a message is newer than all before; say it where that ceases to be so."""
        newest = self._newest.get(topic)
        if newest is None or stamp_ns > newest:
            self._newest[topic] = stamp_ns
            self._behind.discard(topic)
            return True
        if topic not in self._behind:
            self._behind.add(topic)
            went = (newest - stamp_ns) * 1e-9
            LOGGER.warning("%s: time went back by %.1f s; the map leaves out what it has", topic, went)
        return False

    def is_repeated(self, topic: str, stamp_ns: int) -> bool:
        """Whether a message of this very stamp was taken before."""
        taken = self._taken.setdefault(topic, set())
        known = stamp_ns in taken
        taken.add(stamp_ns)
        return known


class LiveMap:
    """Publish path and map as they grow; solve now and then in between.

    Parameters
    ----------
    publisher : MapPublisher
    optimize : callable
        Solves the graph of everything so far.
    on_solution : callable
    period : float
        Between two publications [s]; 0 publishes nothing.
    voxel : float
        Of the preview [m].
    points : int
        Most points of the preview.
    clock : callable
        Steady seconds.
    """

    def __init__(
        self,
        publisher: MapPublisher,
        optimize: Callable[[], GraphSolution],
        on_solution: Callable[[GraphSolution], None],
        *,
        period: float,
        voxel: float,
        points: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._publisher = publisher
        self._optimize = optimize
        self._on_solution = on_solution
        self._period = period
        self._clock = clock
        self._preview = LivePreview(voxel, points)
        self._published = 0
        self._publish_at = 0.0
        self._solve_at = clock() + _FIRST_SOLVE

    def set_period(self, period: float) -> None:
        """Publish at another interval [s]; 0 publishes nothing more until it is set again."""
        self._period = period
        self._publish_at = 0.0

    def add(self, stamp_ns: int, T_chain_lidar: Floats, scan: DeskewedScan) -> None:
        """Take a registered scan and its pose in the chain of all runs."""
        self._preview.add(stamp_ns, T_chain_lidar, scan.xyz)

    def step(self) -> None:
        """Publish and solve what is due."""
        now = self._clock()
        if len(self._preview) == 0 or self._period <= 0 or now < self._publish_at:
            return
        if now >= self._solve_at:
            self._solve(now)
        if len(self._preview) > self._published:
            self._publish()
        self._publish_at = now + self._period

    def _solve(self, now: float) -> None:
        try:
            solution = self._optimize()
        except (SubiacoError, RuntimeError) as error:  # the solver's own errors: the drive goes on
            LOGGER.warning("no solution yet: %s", error)
        else:
            newest = solution.sequences[-1]
            self._preview.solved(newest.stamps_ns, newest.T_local_lidar, newest.T_local_odom)
            self._on_solution(solution)
        took = self._clock() - now
        self._solve_at = now + max(_FIRST_SOLVE, took / _SOLVE_SHARE)

    def _publish(self) -> None:
        times_ns, poses = self._preview.path()
        chosen = thinned(len(times_ns), _MAX_PATH)
        self._publisher.publish_growing(times_ns[chosen], poses[chosen], self._preview.points())
        self._published = len(self._preview)
