"""`farm status`: shows the runs and workers of a farm, and their state."""

import dataclasses
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Group
from rich.live import Live
from rich.text import Text

from farm import command_line
from farm.commands import logs
from farm.commands.screen import compact, figure, plain, wide
from farm.commands.signals import stop_flag
from farm.errors import FarmError, MessageError
from farm.link import Joining
from farm.near import meant
from farm.net import codec, keys
from farm.net.session import Session, connect
from farm.net.telemetry import RunStatus
from farm.net.tls import Bundle
from farm.settings import setting

LEGEND: Final = (
    "return: mean of the last generation's rollouts; mean policy: its return",
    "open: jobs of this generation without an answer; reissued: jobs that were sent again",
    "refused: workers that may not take part; fingerprint: how a machine rounds",
    "1/s: rollouts per second; seen: time since a worker's last message",
    "ignored: messages that were not used, and why; a few stale or doubled ones are normal",
)
"""What the columns are."""

_ANSWER = 1.0  # [s] that learners have to answer


@dataclass(frozen=True, kw_only=True)
class StatusCommand(Joining):
    """Shows the runs and workers of a farm, and their state; on a terminal refreshed until
    Ctrl-C.
    """

    run: str = ""
    """Show only this run; exit status 1 if its learner does not answer."""
    worker: str = ""
    """Exit status 1 if there is no worker with this name."""
    json: bool = False
    """Print JSON once instead of a table."""
    timeout: float | None = setting(5.0, least=0.0, most=1e6)
    """Give up if nothing has answered after this time [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for kind in ("run", "worker"):
            if name := getattr(self, kind):
                keys.checked(kind, name)


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(StatusCommand, words, "farm status")
    logs.set_up("ERROR")
    bundle, run = command.bundle, command.run or "*"
    with (
        stop_flag() as stop,
        connect(command.endpoints, command.timeout, stop.is_set, bundle) as session,
    ):
        runs = ask(session, command.farm, run)
        _check(command, session, runs)
        if command.json:
            sys.stdout.write(json.dumps([dataclasses.asdict(run) for run in runs], indent=2) + "\n")
            return 0
        console = wide()
        if not console.is_terminal:
            console.print(_tables(runs, bundle))
            return 0
        with Live(_tables(runs, bundle), console=console, auto_refresh=False) as live:
            while not stop.wait(1.0):
                live.update(_tables(ask(session, command.farm, run), bundle), refresh=True)
    return 0


def _check(command: StatusCommand, session: Session, runs: list[RunStatus]) -> None:
    """Check that the named run and worker are there, for health checks; a FarmError names the
    missing one.
    """
    farm = keys.called(command.farm)
    if command.run and not runs:
        others = [run.run for run in ask(session, command.farm)]
        near = meant(command.run, others)
        raise FarmError(f"no learner of run {command.run} answers on {farm}{near}")
    token = keys.worker_token(command.farm, f"{command.worker}/*")
    if command.worker and not session.present(token, _ANSWER):
        raise FarmError(f"no worker {command.worker} is on {farm}")


def ask(session: Session, farm: str, run: str = "*") -> list[RunStatus]:
    """The state of all runs, or of one, by name; a FarmError if all learners that answer are of
    another release.
    """
    runs, foreign = [], None
    for payload in session.ask_all(keys.status(farm, run), _ANSWER):
        try:
            runs.append(codec.decode(payload, RunStatus))
        except MessageError as error:
            foreign = foreign or error
    if foreign and not runs:
        raise FarmError(f"a learner answers, but its message cannot be read: {foreign}")
    return sorted(runs, key=lambda run: run.run)


def _tables(runs: list[RunStatus], bundle: Bundle | None = None) -> Group:
    heading = (
        []
        if bundle is None
        else [plain(f"as {bundle.role} {bundle.name}, by the certificate in {bundle.folder}")]
    )
    if not runs:
        return Group(*heading, "no runs: no learner answers")
    table = compact(time.strftime("runs at %H:%M:%S"))
    for name in (
        "run",
        "generation",
        "return",
        "mean policy",
        "open",
        "reissued",
        "refused",
        "fingerprint",
        "ignored",
    ):
        table.add_column(
            name,
            justify="left" if name in ("run", "fingerprint", "ignored") else "right",
            overflow="fold",
        )
    workers = compact("workers")
    for name in (
        "worker",
        "host",
        "cores",
        "release",
        "fingerprint",
        "run",
        "rollouts",
        "1/s",
        "seen",
        "ignored",
    ):
        right = name in ("cores", "rollouts", "1/s", "seen")
        workers.add_column(name, justify="right" if right else "left", overflow="fold")
    for run in runs:
        ignored = _counts(run.ignored)
        figures = [figure(value) for value in (run.return_mean, run.mean_policy_return)]
        generation = f"{run.generation}/{run.generations}"
        what = (
            run.run,
            generation,
            *figures,
            str(run.open),
            str(run.reissued),
            str(run.refused),
            run.fingerprint[:8],
            ignored,
        )
        table.add_row(*map(plain, what))
        for worker in run.workers:
            machine = worker.host, str(worker.cores), worker.version, worker.fingerprint[:8]
            did = str(worker.rollouts), f"{worker.rate:.0f}", f"{worker.seen:.0f} s"
            workers.add_row(
                *map(plain, (worker.worker, *machine, run.run, *did, _counts(worker.ignored)))
            )
    return Group(*heading, table, workers, *(Text(line, "dim") for line in LEGEND))


def _counts(ignored: Mapping[str, int]) -> str:
    return ", ".join(f"{kind} {count}" for kind, count in sorted(ignored.items())) or "-"
