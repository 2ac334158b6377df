"""Ctrl-C, SIGTERM and SIGHUP end long work cleanly; nohup keeps its meaning."""

import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from farm import plugins
from farm.__main__ import main
from farm.commands.signals import stop_flag

NAMES = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}


@pytest.mark.parametrize("number", NAMES, ids=NAMES.values())
def test_each_sets_the_flag_once(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_flag() as stop:
        assert not stop.is_set()
        signal.raise_signal(number)
        assert stop.is_set()
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", NAMES, ids=NAMES.values())
def test_at_once_it_also_interrupts(number: signal.Signals) -> None:
    with pytest.raises(KeyboardInterrupt), stop_flag(at_once=True):
        signal.raise_signal(number)


def test_a_hang_up_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_flag() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_command_that_is_stopped_while_it_imports_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def imports(_: object) -> int:
        # As an extension module does that is interrupted while it is imported
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr(plugins, "find", lambda *_: SimpleNamespace(target=imports))
    assert main(["runs"]) == 130
    assert capsys.readouterr().err == "farm: stopped before the end\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_looks_at_no_flag_ends_in_one_line(number: signal.Signals) -> None:
    code = f"""
import os, sys
from farm import plugins
from farm.__main__ import main
class Command:
    target = staticmethod(lambda _: os.kill(os.getpid(), {number:d}))
plugins.find = lambda *_: Command
sys.argv = ["farm", "runs"]
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (130, "farm: stopped before the end\n")
