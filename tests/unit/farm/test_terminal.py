"""Text from other machines moves no cursor, rings no bell and reverses no text on our terminal."""

import io
import logging
from typing import Any

import pytest
from rich.console import Console, Group

from farm.__main__ import main
from farm.commands import logs, status
from farm.commands.screen import plain
from farm.errors import FarmError, printable
from farm.net import codec, keys
from farm.net.session import free_endpoint, listen
from farm.net.telemetry import RunStatus, WorkerStatus

ATTACKS = {
    "escape": "\x1b",
    "bell": "\a",
    "clear the screen": "\x1b[2J",
    "window title": "\x1b]0;owned\a",
    "link": "\x1b]8;;http://evil\x1b\\safe\x1b]8;;\x1b\\",
    "CSI of one character": "\x9b2J",
    "OSC of one character": "\x9d0;x\x9c",
    "bidi override": "\u202egnp.exe",
    "bidi isolate": "\u2066a\u2069",
    "new lines": "a\r\nfarm: all is well",
    "backspace": "a\b",
    "delete": "\x7f",
    "null": "\0",
    "line separator": "\u2028",
    "tag": "\U000e0041",
    "surrogate": "\udc80",
}
LETTERS = "Grüße, Ωμέγα, привет, 你好, こんにちは, שלום, café, 3 µs → 4 °C, C:\\x1b"


def assert_harmless(text: str) -> None:
    assert all(letter.isprintable() or letter == "\n" for letter in text), repr(text)


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_escaped(attack: str) -> None:
    assert printable(attack).isprintable()
    assert printable(f"a{attack}b").startswith("a")
    assert "\\" in printable(attack)


def test_letters_stay() -> None:
    assert printable(LETTERS) == LETTERS


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_in_the_log(attack: str) -> None:
    record = logging.LogRecord("n", logging.INFO, "p", 1, "run %s", (f"{attack}{LETTERS}",), None)
    text = logs.Formatter("%(message)s").format(record)
    assert text.isprintable()
    assert text.startswith("run ")
    assert text.endswith(LETTERS)


def test_in_a_traceback_of_the_log() -> None:
    try:
        raise ValueError("".join(ATTACKS.values()))
    except ValueError as error:
        record = logging.LogRecord(
            "n", logging.ERROR, "p", 1, "failed", (), (ValueError, error, error.__traceback__)
        )
    text = logs.Formatter("%(message)s").format(record)
    assert_harmless(text)
    assert len(text.splitlines()) > 3


def test_every_handler_of_ours_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.INFO)
    logs.set_up("INFO")
    assert [type(handler.formatter) for handler in logging.root.handlers] == [logs.Formatter]
    assert logging.getLogger("farm").isEnabledFor(logging.INFO)
    assert not logging.getLogger("OpenGL.acceleratesupport").isEnabledFor(logging.INFO)


def test_in_the_table_of_a_farm(capsys: pytest.CaptureFixture[str]) -> None:
    """Names in brackets are Rich's own way to change colours."""
    attacks = [*(ATTACKS[name] for name in ATTACKS if name != "surrogate"), "[bold]", "[/red]"]
    endpoint = free_endpoint()
    with listen(endpoint, "farm") as session:
        for i, attack in enumerate(attacks):
            machine: Any = {
                "host": attack,
                "cores": 1,
                "version": attack,
                "fingerprint": attack,
                "ignored": {attack: 1},
            }
            worker = WorkerStatus(worker=f"w{attack}/1", rollouts=1, rate=1.0, seen=1.0, **machine)
            run = RunStatus(
                run=f"r{attack}",
                generation=i,
                generations=1234,
                return_mean=None,
                mean_policy_return=None,
                open=0,
                reissued=0,
                refused=0,
                ignored={attack: 3},
                workers=(worker,),
            )
            session.answer(keys.status("farm", f"r{i}"), lambda run=run: codec.encode(run))
        assert main(["status", "--connect", endpoint]) == 0
    output = capsys.readouterr().out
    assert_harmless(output)
    assert all(f"{i}/1234" in output for i in range(len(attacks)))
    assert output.endswith("\n".join([*status.LEGEND, ""]))
    assert all(
        f"r{name}" in output and f"w{name}/1" in output and f"{name} 3" in output
        for name in ("[bold]", "[/red]")
    )


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_in_lines_that_commands_say(attack: str, capsys: pytest.CaptureFixture[str]) -> None:
    logs.say(f"reward of {attack}{LETTERS}", "two\nlines")
    output = capsys.readouterr().out
    assert_harmless(output)
    assert output.endswith(f"{LETTERS}\ntwo\nlines\n")


def test_in_rows_of_tables() -> None:
    assert_harmless(shown(Group(*map(plain, ATTACKS.values()))))


def test_at_the_front_door(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: object) -> int:
        raise FarmError("a learner answers: " + "".join(ATTACKS.values()))

    monkeypatch.setattr(status, "main", fails)
    assert main(["status"]) == 1
    output = capsys.readouterr().err
    assert_harmless(output)
    assert len(output.splitlines()) == 1


def shown(what: Group) -> str:
    console = Console(file=io.StringIO(), width=500, color_system=None)
    console.print(what)
    return console.file.getvalue()  # type: ignore[attr-defined]
