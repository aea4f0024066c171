"""What deploy/ ships: profiles that velod takes, a unit that systemd takes, and files that name what exists."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from velod import config
from velod.cli import main
from velod.config import Settings
from velod.eval.baselines import paper_settings

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
PROFILES = sorted((DEPLOY / "profiles").glob("*.toml"))


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
def test_velod_takes_every_profile(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "check", str(path)]) == 0
    assert capsys.readouterr().out.startswith(f"{path}: good")


def test_the_default_profile_is_what_config_init_writes() -> None:
    written = (DEPLOY / "profiles" / "default.toml").read_text("utf-8")
    assert written == config.to_toml(Settings()), "velod config init --force deploy/profiles/default.toml"


def test_the_papers_profile_is_the_paper_like_baseline() -> None:
    assert config.load(DEPLOY / "profiles" / "paper.toml") == paper_settings(Settings())


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not here")
def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / "velod.service"
    text = (DEPLOY / "systemd" / "velod.service").read_text("utf-8")
    # The binary must exist for the check.
    unit.write_text(text.replace("/opt/velod/bin/velod", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60
    )
    # What it says of units of the host is not ours.
    assert [line for line in done.stderr.splitlines() if "velod.service" in line] == []
    assert done.returncode == 0, done.stderr


def test_the_unit_and_the_container_type_commands_that_velod_has() -> None:
    unit = (DEPLOY / "systemd" / "velod.service").read_text("utf-8")
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text("utf-8"))
    container = (DEPLOY / "Containerfile").read_text("utf-8")
    commands = re.findall(r"^Exec\w+=.*?/bin/velod (\w+)", unit, re.M)
    commands += re.findall(r"^RUN velod (\w+)", container, re.M)
    commands += [
        re.search(r'^CMD \["(\w+)"', container, re.M)[1],
        compose["services"]["velod"]["healthcheck"]["test"][2],
    ]
    assert commands == ["warmup", "run", "warmup", "run", "top"]
    for command in commands:
        with pytest.raises(SystemExit) as caught:
            main([command, "--help"])
        assert caught.value.code == 0


def test_the_container_is_built_from_files_that_exist_and_are_sent() -> None:
    container = (DEPLOY / "Containerfile").read_text("utf-8")
    copied = [name for line in re.findall(r"^COPY (.+) \S+$", container, re.M) for name in line.split()]
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines() if line.startswith("!")}
    assert set(copied) == sent
    assert all((ROOT / name).exists() for name in copied)


def test_the_wheel_gets_every_package_and_the_source_distribution_what_make_test_needs() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    folders = [path.parent for path in (ROOT / "velod").rglob("__init__.py")]
    found = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert set(setuptools["packages"]) == found | {"velod.workers", "velod.schemas"}
    assert (ROOT / "velod" / "py.typed").exists() and "py.typed" in setuptools["package-data"]["velod"]
    taken = re.findall(r"^(?:include|graft) (.+)", (ROOT / "MANIFEST.in").read_text("utf-8"), re.M)
    assert {"Makefile", "constraints.txt", "deploy", "docs", "examples", "tests"} <= set(" ".join(taken).split())
