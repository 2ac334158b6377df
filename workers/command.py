"""`farm worker`: worker processes on this machine."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from farm import command_line
from farm.commands import logs
from farm.commands.signals import stop_flag
from farm.errors import ConfigError, FarmError, check_addresses
from farm.processes import LocalWorkers, cores, forks
from farm.settings import Settings, setting
from workers.config import WorkerConfig


@dataclass(frozen=True, kw_only=True)
class WorkerCommand(Settings):
    """Start workers on this machine; they serve every learner of their farm until stopped."""

    worker: WorkerConfig = field(default_factory=WorkerConfig)
    """Settings of every worker process."""
    workers: int | None = setting(None, least=1, most=4096)
    """Worker processes; by default one per core."""
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(WorkerCommand, words, "farm worker")
    logs.set_up(command.log_level)
    check_addresses(2 << 30, "a worker")
    count = command.workers or cores()
    may_fork = command.worker.backend == "cpu"  # devices want processes of their own
    with (
        forks(count if may_fork else 0) as forked,
        stop_flag("leaving") as stop,
        LocalWorkers(count, _flags(command), forked) as pool,
    ):
        while not stop.wait(0.2):
            statuses = pool.tend()
            if statuses and not pool.pids:
                if max(statuses) == 2:
                    raise ConfigError("the workers could not start; see their messages above")
                raise FarmError("no worker is left; see their messages above")
    return 0


def _flags(command: WorkerCommand) -> list[str]:
    """Command-line arguments of each worker process."""
    config = command.worker
    flags = [word for endpoint in config.connect for word in ("--connect", endpoint)]
    flags += ["--farm", config.farm, "--name", config.name, "--backend", config.backend]
    if config.tls is not None:
        flags += ["--tls", str(config.tls)]
    flags += [word for path in config.allow_file for word in ("--allow-file", str(path.resolve()))]
    if config.accept_code:
        flags.append("--accept-code")
    if config.timeout is not None:
        flags += ["--timeout", str(config.timeout)]
    return [*flags, "--log-level", command.log_level.upper()]
