"""README, docs and help name what is there: commands, options, settings, files, links. Nothing of it is run."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from velod.cli.entry import parser
from velod.config import Settings, from_tree, to_toml

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = re.findall(r"^    (\w+) +\w", parser().format_help(), re.M)
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.M | re.S)
# What the settings' sections hold; names of benchmarks, and of modules, look alike.
SETTING = re.compile(r"(?:rig|ingest|flow|depth|optimizer|zenoh)\.(?!event_by_event|kernel|shm)\w+")

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def blocks(page: Path) -> Iterator[str]:
    """Lines to be typed: of fences without a language, or indented by four spaces."""
    text = page.read_text("utf-8")
    for language, body in FENCE.findall(text):
        if not language:
            yield from body.splitlines()
    yield from re.findall(r"^ {4}.*", FENCE.sub("", text), re.M)


def mentions(page: Path) -> list[str]:
    """What stands between backticks in its sentences and tables."""
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", FENCE.sub("", page.read_text("utf-8")))]


def commands_in(line: str) -> Iterator[list[str]]:
    """The words after each ``velod`` that a line types; a remark stands behind ``#`` or two spaces."""
    line = line.strip()
    if re.match(r"(/\S+/)?velod ", line):
        for part in re.sub(r" {2,}[^-].*", "", line).split("&&"):
            program, *words = shlex.split(part, comments=True)
            if program.endswith("velod"):
                yield words


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What velod says against these arguments; empty where it takes them, or explains them (--help)."""
    try:
        parser().parse_args(words)
    except SystemExit as e:
        return capsys.readouterr().err if e.code else ""
    return ""


@each_page
def test_every_command_of_a_block_is_understood(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line in blocks(page):
        for words in commands_in(line):
            assert refusal(words, capsys) == "", line


@each_page
def test_a_command_in_a_sentence_is_understood_or_is_the_beginning_of_one(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for code in mentions(page):
        for words in commands_in(code):
            if not refusal(words, capsys):
                continue
            # `velod sim --rays 2`: the command explains the option, though it wants more.
            options = {word.partition("=")[0] for word in words if word.startswith("-")}
            named = words[: next((i for i, word in enumerate(words) if not re.match(r"[a-z]", word)), len(words))]
            assert refusal([*named, "--help"], capsys) == "", code
            assert options <= set(re.findall(r"--?[a-z][\w-]*", capsys.readouterr().out.split("examples:")[0])), code


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_a_help_are_understood(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal([command, "--help"], capsys) == ""
    examples = capsys.readouterr().out.split("examples:\n")[1].splitlines()
    found = [words for line in examples for words in commands_in(line)]
    assert [refusal(words, capsys) for words in found] == [""] * len(found) and found[0][0] == command


@each_page
def test_every_setting_that_a_page_names_is_one(page: Path) -> None:
    known = {f"{section}.{key}" for section, keys in tomllib.loads(to_toml(Settings())).items() for key in keys}
    for code in mentions(page):
        if SETTING.fullmatch(code.partition(" = ")[0]) and not code.endswith("_…"):
            assert code.partition(" = ")[0] in known, code
            from_tree(tomllib.loads(code) if " = " in code else {})


@each_page
def test_every_file_of_the_project_that_a_page_names_is_there(page: Path) -> None:
    named = re.findall(
        r"(?<![/\w])(?:velod|tests|docs|examples|schemas|deploy)/[\w/-]+\.\w+", page.read_text("utf-8")
    )
    assert [path for path in named if not (ROOT / path).exists()] == []


@each_page
def test_every_test_that_a_page_picks_out_by_name_is_in_the_file_that_it_names(page: Path) -> None:
    for code in mentions(page):
        if picked := re.search(r"^pytest .*-k (\w+)", code):
            files = [ROOT / word for word in code.split() if word.startswith("tests/")]
            assert any(picked[1] in file.read_text("utf-8") for file in files), code


@each_page
def test_every_link_within_the_project_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)]+)\)", page.read_text("utf-8")):
        path, _, anchor = target.partition("#")
        other = page.parent / path if path else page
        assert other.exists(), target
        titles = re.findall(r"^#+ (.+)", other.read_text("utf-8"), re.M) if anchor else []
        assert not anchor or anchor in {re.sub(r"[^\w -]", "", t.lower()).replace(" ", "-") for t in titles}, target


def test_every_target_of_make_that_the_readme_names_is_one() -> None:
    targets = re.search(r"^\.PHONY: (.+)", (ROOT / "Makefile").read_text("utf-8"), re.M)
    assert targets is not None
    assert set(re.findall(r"^make (\w+)", (ROOT / "README.md").read_text("utf-8"), re.M)) <= set(targets[1].split())
