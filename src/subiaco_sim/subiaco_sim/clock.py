"""What the LiDAR's clock makes of true time: free running, leaps, stamps that are zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Ints
from subiaco_sim.config import FaultConfig


@dataclass(frozen=True)
class LidarClock:
    """Stamps of columns that began to turn at ``start_ns`` on a drive of some length [s]."""

    faults: FaultConfig
    start_ns: int
    duration: float

    def stamps(self, times_ns: Ints, columns: int, rng: np.random.Generator) -> Ints:
        """Return the stamps of the columns of a scan (N,) [ns]; ``columns`` of a packet share a fate."""
        faults = self.faults
        since = (times_ns - self.start_ns).astype(np.int64)
        stamped = times_ns.copy()
        if faults.pps_lost is not None:
            free = np.maximum(since - round(1e9 * faults.pps_lost), 0)
            stamped += np.round(free * faults.clock_drift).astype(np.int64)
        if faults.clock_leap:
            stamped[since > 0.5e9 * self.duration] += round(1e9 * faults.clock_leap)
        if faults.stamps_zeroed:
            packets = -(-len(times_ns) // columns)
            stamped[np.repeat(rng.random(packets) < faults.stamps_zeroed, columns)[: len(times_ns)]] = 0
        return stamped
