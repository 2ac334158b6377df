"""`farm verify`: repeats a run, and compares its numbers."""

import json
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.progress import track

from farm import __version__, command_line, fingerprint
from farm.commands import logs
from farm.commands.certificates import signed
from farm.commands.logs import say
from farm.commands.screen import Console
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, writing
from farm.link import Link
from farm.net.session import free_endpoint
from farm.net.tls import Bundle
from farm.processes import cores
from farm.settings import setting
from farm.targets import check_target
from learner.commands.allowed import AllowedFiles
from learner.pool.placement import MOST_WORKERS, Placement
from learner.pool.pool import Stopped
from learner.run import checkpoint as checkpoints
from learner.run.files import replace_text
from learner.run.folder import RunFolder
from learner.tools.verify.receipt import check_replaced, continued, digest_of, sealed
from learner.tools.verify.stored import Differs, Stored, stored
from learner.tools.verify.verify import chosen, verify_all, verify_some, workers


@dataclass(frozen=True, kw_only=True)
class VerifyCommand(AllowedFiles, Link):
    """Repeats a run, and compares its numbers to the last bit; exit status 1 if one differs.

    By default some of its generations, from the stored parameters before them; --all: the whole
    run.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    share: float = setting(0.1, above=0.0, most=1.0)
    """Share of the generations, chosen at random; at least one."""
    all: bool = False
    """Learn the run again from its start: also checks the updates and the results."""
    workers: int | None = setting(None, least=0, most=MOST_WORKERS)
    """Local worker processes.

    By default a share is repeated in this process, and --all on one per core.
    """
    receipt: Path | None = None
    """Write what was verified to this file, as JSON; with --tls also a signature of it, FILE.sig.

    If the command is interrupted, it continues there when it is repeated.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.connect and self.workers:
            raise ConfigError("--workers with --connect: a farm has workers of its own")
        if self.all and self.workers == 0 and not self.connect:
            raise ConfigError(
                "--all with --workers 0, without --connect: there would be no workers"
            )
        if self.tls is not None and not self.connect and self.receipt is None:
            raise ConfigError("--tls is for a farm to --connect to, or to sign a --receipt")

    @property
    def place(self) -> Placement | None:
        """Where the workers are; None for this process."""
        count = self.workers if self.workers is not None else cores() if self.all else 0
        if not count and not self.connect:
            return None
        return Placement(
            workers=0 if self.connect else count,
            listen=free_endpoint(),
            connect=self.connect,
            farm=self.farm,
            tls=self.bundle if self.connect else None,
        )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(VerifyCommand, words, "farm verify")
    logs.set_up("WARNING")
    folder, bundle = RunFolder.open(command.run, command.allow_file), command.bundle
    if command.receipt is not None:
        check_target("--receipt", command.receipt)
        check_replaced(command.receipt)
    if bundle is not None and command.receipt is not None:
        signed(bundle.folder, b"")  # says now what would fail at the end
    receipt: dict[str, Any] = {
        "run": folder.name,
        "release": __version__,
        "numbers": fingerprint.digest(),
        "all": command.all,
        "generations": [],
        "rollouts": 0,
        "verdict": "interrupted",
        "difference": None,
        "not_compared": [],
        "workspace": "",
    }
    try:
        return _verify(command, folder, receipt)
    except Differs as error:
        receipt |= {"verdict": "different", "difference": str(error)}
        raise
    finally:
        if command.receipt is not None and (
            "chosen" in receipt or receipt["verdict"] == "different"
        ):
            _write(command.receipt, receipt, bundle)


def _write(path: Path, receipt: dict[str, Any], bundle: Bundle | None) -> None:
    """Write a receipt, and its signature if there is a certificate."""
    if bundle is not None:
        receipt["certificate"] = (bundle.folder / "cert.pem").read_text("utf-8")
    content = json.dumps(sealed(receipt), indent=2) + "\n"
    with writing(f"to {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, content)
        if bundle is not None:
            path.with_name(path.name + ".sig").write_bytes(signed(bundle.folder, content.encode()))


def _verify(command: VerifyCommand, folder: RunFolder, receipt: dict[str, Any]) -> int:
    receipt["code"] = checkpoints.load(folder.checkpoint).code
    run = stored(folder)
    if not run.last:
        raise ConfigError(
            f"the run in {folder.path} has done no generation: there is nothing to verify"
        )
    receipt |= {"chain": run.chain, "parameters_sha256": run.sha256}
    whole, rng = range(1, run.last + 1), np.random.default_rng(secrets.randbits(64))
    earlier, workspace = None, None
    if command.receipt is not None:
        earlier = continued(command.receipt, receipt)
        workspace = (
            command.receipt.with_name(command.receipt.name + ".run") if command.all else None
        )
    if workspace is not None and not _is_continued(workspace, folder, earlier):
        earlier = None
    receipt |= earlier or {"chosen": [*whole] if command.all else chosen(run, command.share, rng)}
    try:
        ended = _repeat(command, run, receipt, workspace)
    except Differs as error:
        if workspace is not None:  # there is nothing to continue
            shutil.rmtree(workspace, ignore_errors=True)
        if (origin := run.config.init_from) is None:
            raise
        raise Differs(
            f"{error}; it began with the mean of {origin}, and can be repeated only if that run has"
            " not gone on since"
        ) from None
    finally:
        if workspace is not None:
            receipt["workspace"] = digest_of(workspace / folder.name / "checkpoint")
    done, generations = receipt["generations"], receipt["chosen"]
    extent = (
        f"{len(done)} of {run.last} generations of {folder.path}, {receipt['rollouts']} rollouts"
    )
    if len(done) < len(generations) or (command.all and not ended):
        more = "" if command.receipt is None else "; the same command continues"
        say(f"stopped; no difference in {extent}{more}")
        return INTERRUPTED
    receipt["verdict"] = "the same"
    say(
        f"verified to the bit: {extent}"
        + (", and the results" if command.all else "; --all also repeats the updates")
    )
    receipt["not_compared"] = run.not_compared(evaluated=command.all)
    if receipt["not_compared"]:
        say(f"not compared, of summary.json: {', '.join(receipt['not_compared'])}")
    return 0


def _is_continued(workspace: Path, folder: RunFolder, earlier: dict[str, Any] | None) -> bool:
    """Whether there is a repetition to be continued.

    Raises:
      ConfigError: there is one that this user's receipt does not speak of: it may have come with
          the run.
    """
    if not workspace.exists():
        return False
    if earlier is None or digest_of(workspace / folder.name / "checkpoint") != earlier["workspace"]:
        raise ConfigError(
            f"{workspace} is not of an interrupted verification of this run by you: remove it, or"
            " take another --receipt"
        )
    return True


def _repeat(
    command: VerifyCommand, run: Stored, receipt: dict[str, Any], workspace: Path | None
) -> bool:
    """Repeat what the receipt does not have yet, and note it there; return whether it was not
    stopped.
    """
    done: list[int] = receipt["generations"]
    left = [each for each in receipt["chosen"] if each not in {*done}]
    place = command.place
    with (
        stop_flag("ending", at_once=place is None) as stop,
        suppress(Stopped),
        ExitStack() as stack,
    ):
        if place is None:
            stack.enter_context(suppress(KeyboardInterrupt))
        if command.all:
            assert place is not None
            repeated = verify_all(run, place, stop.is_set, workspace)
        else:
            repeated = verify_some(run, left, stack.enter_context(workers(run, place, stop.is_set)))
        for generation, rollouts in _bar(repeated, len(left)):
            done.append(generation)
            receipt["rollouts"] += rollouts
            if stop.is_set():
                break
    return not stop.is_set()


def _bar(repeated: Iterator[tuple[int, int]], count: int) -> Iterable[tuple[int, int]]:
    """Show a bar on a terminal."""
    console = Console()
    return (
        track(repeated, "generations", total=count, console=console)
        if console.is_terminal
        else repeated
    )
