"""Packets read in one step hold what the SDK reads from them."""

from pathlib import Path

import numpy as np
import pytest
from mapping_scenes import pcap_bufs
from ouster.sdk import core

from subiaco_mapping.preprocessing.packet_contents import PacketContents

SENSORS = {
    "single": "OS-1-128_v2.3.0_1024x10",
    "dual": "OS-0-32-U1_v2.2.0_1024x10",
    "fusa": "OS-1-128_767798045_1024x10",
}
FIELDS = ("RANGE", "REFLECTIVITY", "RANGE2", "REFLECTIVITY2")


def contents(metadata: str) -> PacketContents:
    packets = core.PacketFormat(core.SensorInfo(metadata))
    return PacketContents(packets, [name for name in FIELDS if name in packets.fields])


def recorded(shared_data: Path, sensor: str) -> tuple[list[bytes], str]:
    folder = shared_data / "ouster"
    pcap, metadata = (next(folder.glob(f"{SENSORS[sensor]}*{kind}")) for kind in (".pcap", ".json"))
    return pcap_bufs(pcap, metadata.read_text()), metadata.read_text()


@pytest.mark.parametrize("sensor", SENSORS)
def test_every_value_equals_that_of_the_sdk(shared_data: Path, sensor: str) -> None:
    bufs, metadata = recorded(shared_data, sensor)
    at_once, by_sdk = contents(metadata), contents(metadata)
    assert at_once.places is not None
    by_sdk.places = None
    noise = np.random.default_rng(1).integers(0, 256, (8, len(bufs[0])), dtype=np.uint8)
    for data in [*(np.frombuffer(buf, dtype=np.uint8) for buf in bufs[::7]), *noise]:
        for ours, theirs in zip(at_once.read(data), by_sdk.read(data), strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_the_sdk_reads_packets_in_which_a_value_has_no_known_place(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, metadata = recorded(shared_data, "dual")
    monkeypatch.setattr("subiaco_mapping.preprocessing.packet_contents._SHIFTS", range(8, 9))
    assert contents(metadata).places is None
