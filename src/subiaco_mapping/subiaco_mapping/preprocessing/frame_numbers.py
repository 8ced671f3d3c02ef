"""Frame ids of LiDAR packets, which start again at zero, as numbers that rise during a run of the sensor."""

from __future__ import annotations

#: A frame farther ahead than an outage may last, or farther behind than a packet may be late, is of another
#: run of the sensor: a driver that was started again, or a bag that is played in a loop.
_RESTART_FRAMES, _LATE_FRAMES = 600, 10


class FrameUnwrapper:
    """Numbers of frames from their ids.

    Parameters
    ----------
    modulus : int
        Number of different frame ids; the id after the largest is 0.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._newest: int | None = None

    def number_of(self, frame_id: int) -> int | None:
        """Return the number of a frame, None where the frame is of another run of the sensor."""
        if self._newest is None:
            return self.restart(frame_id)
        half = self._modulus // 2
        step = (frame_id - self._newest + half) % self._modulus - half
        if not -_LATE_FRAMES <= step <= _RESTART_FRAMES:
            return None
        number = self._newest + step
        self._newest = max(self._newest, number)
        return number

    def restart(self, frame_id: int) -> int:
        """Begin another run of the sensor with a frame; return the number of this frame, which is its id."""
        self._newest = frame_id
        return frame_id
