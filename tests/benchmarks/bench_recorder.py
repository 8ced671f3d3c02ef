# ruff: noqa: T201
"""The recorder under load, and under the axe: simulated sensors in one process, the recorder in another.

    source ros2_ws/env.sh
    python tests/benchmarks/bench_recorder.py load --seconds 600
    python tests/benchmarks/bench_recorder.py kill --times 20 --seed 8
    python tests/benchmarks/bench_recorder.py load --seconds 600 --folder DIR --keep    # 20 GB
    python tests/benchmarks/bench_recorder.py report --folder DIR

``load`` publishes dual-return 2048x10 packets of 128 beams (33 kB, 1,280 a second, 42 MB/s) with real
frame and measurement ids and noisy payload, IMU at 100 Hz and GNSS at 10 Hz, and reports what was lost by
each counter, whether the bag holds every packet that was published, the recorder's memory over time and its
processor time; with ``--keep`` the bag is read and compared later, by ``report``, which needs no quiet
machine. ``kill`` records a small fast load and kills the recorder with SIGKILL at random moments;
each time the recording is made whole and compared with what had been published.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml

from subiaco_bringup.graph import process_command
from subiaco_bringup.recording import record_graph
from subiaco_geo.bag_recovery import recover_bag
from subiaco_geo.bags import BagReader, packet_to_cdr
from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, METADATA

RATES = {IMU: 100.0, FIX: 10.0}
STAMP_NS = 1_700_000_000_000_000_000
COLUMNS_PER_PACKET = 16
SMALL = 512
COURSE = "course.json"
#: Packets in one go, 50 ms of them, where the machine let us sleep: a sensor does not catch up a second.
CATCH_UP = 64


class Load:
    """Packets of one frame over and over, each with its own ids."""

    def __init__(self, columns: int, seed: int = 3) -> None:
        from ouster.sdk import core

        from subiaco_sim.config import LidarMode
        from subiaco_sim.packets import sensor_info

        info = sensor_info(LidarMode(f"{columns}x10"), dual=True)
        self.metadata = info.to_json_string()
        self.per_frame = columns // info.format.columns_per_packet
        self.rate = 10.0 * self.per_frame
        self._layout = core.PacketFormat(info)
        rng = np.random.default_rng(seed)
        self._packets = [core.LidarPacket(self._layout) for _ in range(self.per_frame)]
        for place, packet in enumerate(self._packets):
            noise = (
                rng.integers(0, 256, len(packet.buf)) // 3
            )  # compresses like returns of a street, about 0.8
            packet.buf[32:-32] = noise[32:-32].astype(np.uint8)
            for column in range(info.format.columns_per_packet):
                number = place * info.format.columns_per_packet + column
                self._layout.set_col_measurement_id(packet, column, number)

    def raw(self, number: int) -> bytes:
        """Serialise the packet of a number."""
        packet = self._packets[number % self.per_frame]
        frame = number // self.per_frame % (self._layout.max_frame_id + 1)
        self._layout.set_frame_id(packet, frame)
        return packet_to_cdr(bytes(packet.buf))


def publish(seconds: float, columns: int) -> None:
    """Publish everything at its rate, and say how many of each."""
    import rclpy
    from sensor_msgs.msg import Imu, NavSatFix
    from std_msgs.msg import String

    from ouster_sensor_msgs.msg import PacketMsg
    from subiaco_mapping.nodes.recorder_node import go_first
    from subiaco_ros.qos import latched, reliable

    load = Load(columns)
    go_first()  # a sensor does not wait for the machine
    rclpy.init()
    node = rclpy.create_node("sensors")
    metadata = node.create_publisher(String, METADATA, latched())
    metadata.publish(String(data=load.metadata))
    publishers: dict[str, Any] = {
        LIDAR_PACKETS: node.create_publisher(PacketMsg, LIDAR_PACKETS, reliable(2000)),
        IMU: node.create_publisher(Imu, IMU, reliable(200)),
        FIX: node.create_publisher(NavSatFix, FIX, reliable(50)),
    }
    kinds = {IMU: Imu, FIX: NavSatFix}
    sent = dict.fromkeys(publishers, 0)
    while min(publisher.get_subscription_count() for publisher in publishers.values()) < 1:
        time.sleep(0.02)
    time.sleep(0.5)
    begun, stood = time.monotonic(), 0.0
    while (elapsed := time.monotonic() - begun) < seconds:
        due = int(elapsed * load.rate) - sent[LIDAR_PACKETS]
        if due > CATCH_UP:  # the machine let us sleep: the sensor's time stood still
            begun += (due - CATCH_UP) / load.rate
            stood += (due - CATCH_UP) / load.rate
        for _ in range(min(due, CATCH_UP)):
            publishers[LIDAR_PACKETS].publish(load.raw(sent[LIDAR_PACKETS]))
            sent[LIDAR_PACKETS] += 1
        for topic, kind in kinds.items():
            while sent[topic] < elapsed * RATES[topic]:
                publishers[topic].publish(stamped(kind(), STAMP_NS + int(sent[topic] * 1e9 / RATES[topic])))
                sent[topic] += 1
        print(json.dumps({"time_ns": time.time_ns(), "sent": sent, "stood": stood}), flush=True)
        time.sleep(0.002)
    time.sleep(1.0)
    node.destroy_node()
    rclpy.try_shutdown()


def stamped(message: Any, stamp_ns: int) -> Any:
    """Give a message its time."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


class Publisher:
    """The publishing process, and what it says it has sent."""

    def __init__(self, seconds: float, columns: int) -> None:
        command = [sys.executable, __file__, "publish", "--seconds", str(seconds), "--columns", str(columns)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.lines: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("{"):
                self.lines = [*self.lines[-2000:], json.loads(line)]

    def finish(self) -> dict[str, int]:
        """Wait for the end; return what was sent."""
        self.process.wait()
        self._reader.join()
        return dict(self.lines[-1]["sent"])


def start_recorder(folder: Path, settings: list[str]) -> subprocess.Popen[bytes]:
    """Start the recorder as ``subiaco record`` does."""
    (node,) = record_graph(folder, (), settings).nodes
    return subprocess.Popen(process_command(node))


def load_run(seconds: float, columns: int, settings: list[str], folder: Path) -> None:
    """Record the whole load and compare."""
    recorder = start_recorder(folder, settings)
    watched = psutil.Process(recorder.pid)
    publisher = Publisher(seconds, columns)
    samples: list[tuple[float, float, float]] = []
    begun = time.monotonic()
    while publisher.process.poll() is None:
        cpu = watched.cpu_times()
        memory = watched.memory_info()  # less the transport's shared memory, which is nobody's alone
        own = (memory.rss - memory.shared) / 1e6
        samples.append((time.monotonic() - begun, own, cpu.user + cpu.system))
        time.sleep(1.0)
    sent = publisher.finish()
    recorder.send_signal(signal.SIGINT)
    recorder.wait(60)
    course = {"sent": sent, "stood": publisher.lines[-1]["stood"], "samples": samples, "columns": columns}
    course["load"] = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    (folder / COURSE).write_text(json.dumps(course))


def report_load(folder: Path) -> None:
    """Print what was sent, recorded and lost; memory and processor time."""
    course = json.loads((folder / COURSE).read_text())
    sent, samples, per_frame = course["sent"], course["samples"], course["columns"] // COLUMNS_PER_PACKET
    print(f"the machine stopped the sensors for {course['stood']:.2f} s")
    facts = yaml.safe_load((folder / "recording.yaml").read_text())
    recorded = dict.fromkeys(sent, 0)
    wrong = 0
    with BagReader(folder) as reader:
        for message in reader.messages(list(sent)):
            if message.topic == LIDAR_PACKETS:  # the frame id stands in the third and fourth byte of a packet
                frame_id = int.from_bytes(message.raw[10:12], "little")
                wrong += frame_id != recorded[LIDAR_PACKETS] // per_frame % 65536
            recorded[message.topic] += 1
    print(f"sent     {sent}\nrecorded {recorded}")
    print(f"missing  { {t: sent[t] - recorded[t] for t in sent} }, frame ids out of order {wrong}")
    for topic in sent:
        print(f"  {topic}: {facts['topics'][topic]}")
    print(f"files {facts['files']}, {facts['bytes'] / 1e9:.2f} GB, slowest sync {facts['slowest_sync_s']} s")
    steady = np.array([sample for sample in samples if sample[0] > samples[-1][0] / 3])
    slope = np.polyfit(steady[:, 0], steady[:, 1], 1)[0] * 60
    share = (steady[-1, 2] - steady[0, 2]) / (steady[-1, 0] - steady[0, 0])
    tenths = " ".join(f"{part[:, 1].mean():.0f}" for part in np.array_split(np.array(samples), 10))
    print(f"memory {tenths} MB by tenths of the time, slope of the last two thirds {slope:+.2f} MB/min")
    print(f"processor {share:.0%} of one core; {course['load']}")


def kill_run(times: int, seed: int, folder: Path) -> None:
    """Kill the recorder at random moments of one long load; print what each kill cost."""
    rng = random.Random(seed)
    publisher = Publisher(7200.0, SMALL)
    costs = []
    try:
        for turn in range(times):
            bag = folder / f"kill_{turn}"
            cost, kept, files = one_kill(bag, rng, publisher)
            costs.append(cost)
            print(
                f"{turn:3d}: kept {kept} packets without a gap in {files} files, lost {cost:.3f} s",
                flush=True,
            )
            shutil.rmtree(bag)
    finally:
        publisher.process.kill()
    print(f"{len(costs)} kills, at most {max(costs):.3f} s lost, median {np.median(costs):.3f} s; ", end="")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def one_kill(bag: Path, rng: random.Random, publisher: Publisher) -> tuple[float, int, int]:
    """Record, kill, recover; return seconds lost, packets kept and files read."""
    recorder = start_recorder(bag, [f"record.split_duration={rng.choice([1.0, 2.0, 60.0])}"])
    while not bag.is_dir() or sum(p.stat().st_size for p in bag.glob("*.mcap*")) < 1_000_000:
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, 4.0))
    recorder.kill()
    killed_ns = time.time_ns()
    recorder.wait()
    recover_bag(bag, in_place=True)
    for file in bag.glob("*.mcap"):
        with BagReader(file) as reader:
            assert sum(1 for _ in reader.messages()) > 0
    with BagReader(bag) as reader:
        numbers = [packet_number(m.raw) for m in reader.messages([LIDAR_PACKETS])]
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    sent = max(line["sent"][LIDAR_PACKETS] for line in publisher.lines if line["time_ns"] <= killed_ns)
    cost = max(0, sent - 1 - numbers[-1]) / (10.0 * SMALL / COLUMNS_PER_PACKET)
    return cost, len(numbers), len(list(bag.glob("*.mcap")))


def packet_number(raw: bytes) -> int:
    """Return which packet of the small load this is, from its frame and first measurement id."""
    frame_id, column = int.from_bytes(raw[10:12], "little"), int.from_bytes(raw[48:50], "little")
    return (frame_id * SMALL + column) // COLUMNS_PER_PACKET


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["load", "kill", "publish", "report"])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--columns", type=int, default=2048)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--folder", type=Path, help="where to record; a temporary folder if absent")
    parser.add_argument("--keep", action="store_true", help="leave the load in --folder, for 'report'")
    given = parser.parse_args()
    if given.what == "publish":
        publish(given.seconds, given.columns)
        return
    if given.what == "report":
        report_load(given.folder / "load")
        return
    if given.keep:
        load_run(given.seconds, given.columns, given.settings, given.folder / "load")
        return
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        if given.what == "load":
            load_run(given.seconds, given.columns, given.settings, Path(folder) / "load")
            report_load(Path(folder) / "load")
        else:
            kill_run(given.times, given.seed, Path(folder))


if __name__ == "__main__":
    main()
