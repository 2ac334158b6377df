"""`farm learner`: the learner without workers; and the code shared with `farm run`."""

import gc
import itertools
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

from farm.commands import logs
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, NameTakenError
from farm.net.session import LISTEN
from farm.net.tls import find
from learner.commands import display, options, recordings
from learner.commands.options import LearnerOptions, parse
from learner.config import RunConfig
from learner.run import Placement, Run, how_to_join, open_run
from learner.run_folder import RunFolder
from learner.scheduler.scheduler import SchedulerConfig
from learner.setup import fitted


@dataclass(frozen=True, kw_only=True)
class LearnerCommand:
    """The learner without workers; they join it with `farm worker` from any machine."""

    learner: LearnerOptions = field(default_factory=LearnerOptions)
    """Where the run starts from, where it is saved, and its network addresses."""
    run: RunConfig = field(default_factory=RunConfig)
    """The run."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command, resumed, begin = parse(LearnerCommand, words, "farm learner")
    place = Placement() if command.learner.tls is None else Placement(listen=LISTEN.replace("tcp/", "tls/"))
    return learn(command.learner, command.run, place, resumed, begin)


def learn(
    chosen: LearnerOptions, config: RunConfig, place: Placement, resumed: RunFolder | None, begin: RunConfig
) -> int:
    """Learn until the end, an interruption or a failure; exit status."""
    logs.set_up("WARNING" if chosen.quiet and chosen.log_level == "INFO" else chosen.log_level)
    place = replace(
        place, connect=chosen.connect, farm=chosen.farm, record=chosen.record, log=chosen.log,
        listen=chosen.listen or place.listen, trusted=chosen.trust_network, mixed=chosen.mixed,
        scheduler=SchedulerConfig(audit=chosen.audit, straggler_seconds=chosen.patience),
        tls=None if chosen.tls is None else find(chosen.tls, "learner"),
        serve=None if chosen.serve is None else options.address(chosen.serve),
    )  # fmt: skip
    if resumed is not None and chosen.name:
        raise ConfigError("--name is for a new run; a resumed one keeps its name")
    path = chosen.out / options.run_name(chosen, config) if resumed is None else resumed.path
    if chosen.resume_existing and path.exists():
        resumed, config = RunFolder.open(path), fitted(config)
        begin = resumed.read_config()
    if resumed is not None:
        options.check_resume(begin, config, resumed)
    with stop_flag("saving and ending") as stop:
        with ExitStack() as stack:
            run, first = None, path.name
            for number in itertools.count(2):
                opened = open_run(config, path, place, resume=resumed is not None, stopped=stop.is_set)
                try:
                    run = stack.enter_context(opened)
                    break
                except NameTakenError:  # of a run of the same second
                    if chosen.name or resumed is not None:
                        raise
                    path = path.with_name(f"{first}-{number}")
            assert run is not None
            shown = display.display(run, _announcement(run, place), chosen.style)
            gc.freeze()  # existing objects stay: collecting garbage among them took 20 ms each time
            with shown:
                for report in run.learn():
                    shown.show(report)
        shown.conclude(_conclusion(run, place))
    return INTERRUPTED if run.summary["state"] == "interrupted" else 0


def _announcement(run: Run, place: Placement) -> list[str]:
    folder, at = run.learner.folder, run.learner.state.generation
    lines = [f"run {folder.path}" + (f", continuing after generation {at}" if at else "")]
    if place.record:
        lines[0] += "; farm view shows it at any time"
    if not place.workers:
        lines.append(f"workers join with: {how_to_join(place, run.learner.problem)}")
    if run.live is not None:
        lines += recordings.look_on(run.live)
    if (config := run.learner.config).start == "fitted":
        width, sigma = config.policy_config.bandwidth, config.algorithm_config.initial_sigma  # type: ignore[attr-defined]
        lines.append(f"fitted to the observation: bandwidth {width:.4g}, initial sigma {sigma:.4g}")
    seen = run.learner.problem.spec.observation if run.learner.config.policy_config.normalise else 0
    kept = folder.every(run.learner.state.mu.size, run.learner.config.generations, seen)
    if kept > 1:
        lines.append(f"parameters: one generation in {kept} is kept, to stay below 100 MB")
    return lines


def _conclusion(run: Run, place: Placement) -> list[str]:
    summary, folder = run.summary, run.learner.folder.path
    lines = []
    if summary["mean_policy_return"] is not None:
        if summary["mean_policy_success"] is None:
            said = f"; from other starts {summary['robust_return']:.3f} on average"
        else:
            success = "succeeds" if summary["mean_policy_success"] else "does not succeed"
            said = f" and {success}; robust success {summary['robust_success_rate']:.0%}"
        lines.append(f"the mean policy returns {summary['mean_policy_return']:.3f}{said}")
    lines.append(f"parameters {summary['parameters_sha256'][:16]}  in {folder}")
    if summary["state"] == "interrupted":
        lines.append(f"continue with: farm {'run' if place.workers else 'learner'} --resume {folder}")
    elif place.record:
        lines.append(f"look at it with: farm view {folder}")
    return lines
