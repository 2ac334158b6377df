"""Every command on a page is accepted by the program that it starts: its flags, values, packages,
scripts, services.

The commands of docs/tutorial.md and docs/extending.md are run by tests of their own.
"""

import argparse
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

import farm
import farm.__main__
from farm import command_line

pytestmark = pytest.mark.slow
pytest.importorskip("cryptography")
pytest.importorskip("gymnasium")

ROOT = Path(__file__).parent.parent
PAGES = [
    *ROOT.glob("*.md"),
    *ROOT.glob("docs/**/*.md"),
    *(ROOT / f"{f}/README.md" for f in ("benchmarks", "examples")),
]
ELSEWHERE = {"CHANGELOG.md", "tutorial.md", "extending.md"}
PROGRAMS = ("farm", "python", "pip", "docker")
STANDS_FOR = {
    "FILE.py:CLASS": "pendulum.py:Pendulum",
    "--allow-file FILE": "--allow-file pendulum.py",
    "RUN FILE": "RUN p.npz",
    "gym:NAME": "gym:Swimmer-v5",
    "worker-NAME": "worker-lab-1",
    "--object NAME": "--object bar",
    "TABLE ENVIRONMENT": "ars Hopper-v5",
    "thesis NAME": "thesis fig-4.1",
    "tasks NAME": "tasks finger-gait",
    "walker.py:Flat": "pendulum.py:Pendulum",
    "walker.py:Hills": "pendulum.py:Pendulum",
    "walker.py:Stairs": "pendulum.py:Pendulum",
    "--task TASK": "--task finger-gait",
    "check TASK": "check finger-gait",
    "tune TASK": "tune finger-gait",
    "COMMAND": "run",
    "RUN --plan": "runs/steered --plan",
    "RUN": "runs/first",
    "seed S ...": "seed 1",
    "...": "",
    "[": "",
    "]": "",
}
"""What a page leaves to its reader, in this order; one letter is a number."""
RUN = "runs/first"
ARGUMENTS = {
    "evaluate": [RUN],
    "stress": [RUN],
    "replay": [RUN],
    "play": [RUN],
    "chain": [RUN],
    "export": [RUN, "p.npz"],
    "compare": [RUN, RUN],
    "check": ["finger-gait"],
    "new-task": ["mine"],
    "certificates": ["new", "certs"],
}
VALUES = {
    "--connect": ["tcp/learner.lab:7447"],
    "--listen": ["tcp/127.0.0.1:7447"],
    "--config": [f"{RUN}/config.json"],
    "--video": ["gait.gif"],
    "--accept-code": ["--tls", "certs/worker-lab-1"],
}
"""What a sentence leaves out of a command: arguments, and the value of the flag that it is about.
"""


class Accepted(Exception):  # noqa: N818  not an error
    """The arguments have been read, and nothing has been done yet."""


def commands(page: Path) -> Iterator[tuple[str, bool]]:
    """The commands of a page, and whether each is a line of code, not a part of the text."""
    inside, text = "", ""
    for line in page.read_text("utf-8").replace(" \\\n", " ").splitlines():
        if line.startswith("```"):
            inside = "" if inside else line
        elif inside in ("```sh", "```bash") or (not inside and line.startswith("    ")):
            for part in re.split(r" && ", line.strip()):
                yield re.sub(r"^(/opt/rolloutfarm/|\.venv/)bin/", "", part), True
        elif not inside:
            text += f"{line.strip()} "
    yield from ((part.replace("\\|", "|"), False) for part in re.findall(r"`([^`]+)`", text))


FOUND = [
    pytest.param(words, whole, id=f"{page.name}: {words}")
    for page in PAGES
    if page.name not in ELSEWHERE
    for words, whole in dict.fromkeys(commands(page))
    if words.split(" ")[0] in PROGRAMS and (whole or " " in words) and words not in PROGRAMS
]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's folder: two runs, a task, certificates."""
    path = tmp_path_factory.mktemp("reader")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(path)
        assert farm.__main__.main(["new-task", "pendulum"]) == 0
        names = ["--learner", "learner.lab", *(f"--worker=lab-{i}" for i in (1, 2, 7))]
        assert farm.__main__.main(["certificates", "new", "certs", *names]) == 0
        page = (ROOT / "docs/own-hand.md").read_text("utf-8")
        files = r"Save this as `(hand[^`]+)`[^\n]*:\n\n```\w+\n(.*?)```"
        for name, text in re.findall(files, page, re.S):
            Path(name).write_text(text)
        steered = f"{ROOT}/examples/tasks/steer.py:Cube"
        for run, task in (("runs/first", "finger-gait"), ("runs/steered", steered)):
            config = farm.configure(task, algorithm="snes", generations=1, pairs=1)
            for _ in farm.learn(config, run, workers=1, record=False):
                pass
    return path


@pytest.fixture
def reader(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work there, and stop each program as soon as it has read its arguments."""
    parse = command_line.parse

    def read(*arguments: Any, **more: Any) -> NoReturn:
        parse(*arguments, **more)
        raise Accepted

    read_by_script = argparse.ArgumentParser.parse_args

    def read_all(parser: argparse.ArgumentParser) -> NoReturn:
        read_by_script(parser)
        raise Accepted

    for kind in ("tasks", "robots"):
        shutil.copytree(ROOT / "examples" / kind, folder / "examples" / kind, dirs_exist_ok=True)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(command_line, "parse", read)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", read_all)


@pytest.mark.parametrize(("words", "whole"), FOUND)
@pytest.mark.usefixtures("reader")
def test_a_command_is_accepted(words: str, whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if "--backend warp" in words:
        pytest.importorskip("mujoco_warp")
    if words.startswith("python -c "):
        compile(shlex.split(words)[2], "page", "exec")
        return
    extras = set(re.findall(r"[\w-]+", "".join(re.findall(r"'\.\[(.*)\]'", words))))
    for name, value in STANDS_FOR.items():
        words = words.replace(name, value)
    words = re.sub(r"(?<= )[A-Z]\b(?![-.])", "1", words)
    program, *rest = shlex.split(re.split(r" [|>] ", words)[0], comments=True)
    if program == "farm":
        for run in set(re.findall(r"runs/[\w-]+", words)) - {"runs/first", "runs/steered"}:
            shutil.copytree("runs/first", run, dirs_exist_ok=True)
        with pytest.raises((Accepted, SystemExit)):  # help ends the program
            farm.__main__._run(rest if whole else completed(*rest), standalone=False)
    elif program == "python":
        script(rest, monkeypatch)
    elif program == "pip":
        groups = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
            "optional-dependencies"
        ]
        assert extras <= groups.keys()
    else:
        services = re.findall(
            r"^  (\w+):$", "".join(p.read_text("utf-8") for p in ROOT.glob("compose*.yaml")), re.M
        )
        assert {a or b for a, b in re.findall(r"(\w+):/|--scale (\w+)=", words)} <= set(services)


def completed(command: str, *words: str) -> list[str]:
    flags = next((i for i, word in enumerate(words) if word.startswith("--")), len(words))
    arguments = [*words[:flags], *ARGUMENTS.get(command, [])[flags:]]
    return [command, *arguments, *words[flags:], *(VALUES.get(words[-1], []) if words else [])]


def script(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Start a script of the checkout until it has read its arguments."""
    name = (
        words[words.index("-m") + 1].replace(".", "/") + "/__main__.py"
        if "-m" in words
        else words[0]
    )
    [path] = [each for each in (ROOT / name, ROOT / "examples" / name) if each.is_file()]
    monkeypatch.setattr(sys, "argv", [str(path), *words[2 if "-m" in words else 1 :]])
    monkeypatch.syspath_prepend(path.parent)
    monkeypatch.syspath_prepend(ROOT)
    if "-m" in words or "parse_args" in path.read_text("utf-8"):
        with pytest.raises(Accepted):
            runpy.run_path(str(path), run_name="__main__")
