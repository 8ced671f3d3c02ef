"""Images and compose file, as far as reading them tells."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parents[2]
DOCKER = REPOSITORY / "docker"
FILES = ["Dockerfile", "Dockerfile.jazzy"]


def instructions(name: str) -> list[tuple[str, str]]:
    """Return the instructions of a Dockerfile, continued lines joined."""
    lines = [x for x in (DOCKER / name).read_text().splitlines() if not x.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [(word, " ".join(rest.split())) for word, _, rest in (x.partition(" ") for x in joined) if word]


@pytest.mark.parametrize("name", FILES)
def test_an_image_is_made_by_the_one_set_up_script(name: str) -> None:
    said = instructions(name)
    assert [word for word, _ in said] == ["FROM", "ENV", "RUN", "WORKDIR", "COPY", "RUN", "ENTRYPOINT", "CMD"]
    assert said[5] == ("RUN", "scripts/setup.sh")
    assert "source ros2_ws/env.sh" in said[6][1]
    assert "shm-size=1g" in (DOCKER / name).read_text()


@pytest.mark.parametrize("name", FILES)
def test_an_image_holds_every_system_package_that_the_set_up_looks_for(name: str) -> None:
    script = (REPOSITORY / "scripts/setup.sh").read_text()
    body = script[script.index("missing_system_packages() {") : script.index("require_system_packages() {")]
    wanted = set(re.findall(r"=(lib[\w.+-]+?)(?=[ ;])", body)) | {"build-essential", "make", "cmake", "git"}
    assert len(wanted) == 11
    installed = set(instructions(name)[2][1].split())
    assert wanted | {"python3-dev", "python3-venv"} <= installed


def test_the_compose_file_replays_without_a_network_and_with_shared_memory() -> None:
    document = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    assert {s["build"]["dockerfile"] for s in document["services"].values()} == {f"docker/{n}" for n in FILES}
    for service in document["services"].values():
        assert service["shm_size"] == "1gb"
        assert service["network_mode"] == "none"
        bags, out = service["volumes"]
        assert bags.endswith("/opt/subiaco/bags:ro")
        assert out.endswith("/opt/subiaco/out")
        assert (DOCKER / service["build"]["context"]).resolve() == REPOSITORY


def test_what_is_built_or_recorded_here_stays_out_of_the_image() -> None:
    left_out = set((REPOSITORY / ".dockerignore").read_text().split())
    ignored = {line.strip("/") for line in (REPOSITORY / ".gitignore").read_text().split() if line[0] != "!"}
    assert {name for name in ignored if not name.startswith("*") and name != "__pycache__"} <= left_out
