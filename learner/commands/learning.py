"""Learns and shows it: what `farm run` and `farm learner` do with their settings."""

import gc
import itertools
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from farm.commands import logs
from farm.commands.screen import figure
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, NameTakenError, printable
from farm.targets import typed
from learner.commands import display, options, recordings
from learner.commands.options import LearnerOptions, Style
from learner.pool.placement import Placement, how_to_join, how_to_resume
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import RunConfig
from learner.run.evaluation import EVALUATION_ROLLOUTS
from learner.run.folder import RunFolder
from learner.run.launch import Outputs, Run, open_run
from learner.run.pilot import begun
from learner.run.setup import fitted
from learner.run.states import RolledBack
from learner.run.worth import CONSTANTS


def learn(
    flags: LearnerOptions,
    config: RunConfig,
    place: Placement,
    resumed: RunFolder | None,
    base: RunConfig,
) -> int:
    """Learn until the end, an interruption or a failure; exit status."""
    logs.set_up("WARNING" if flags.quiet and flags.log_level == "INFO" else flags.log_level)
    place = replace(
        place,
        connect=flags.connect,
        farm=flags.farm,
        listen=flags.listen or place.listen,
        trusted=flags.trust_network,
        any_rounding=flags.any_rounding,
        fingerprint=flags.fingerprint,
        scheduler=SchedulerConfig(
            audit=flags.audit, straggler_seconds=flags.patience, instances=flags.instances
        ),
        tls=flags.bundle,
        checker=flags.checker,
    )
    outputs = Outputs(
        record=flags.record,
        serve=None if flags.serve is None else options.address(flags.serve),
        log=flags.log,
        compare=flags.compare,
    )
    if resumed is not None and flags.name:
        raise ConfigError("--name is for a new run; a resumed one keeps its name")
    path = flags.out / options.run_name(flags, config) if resumed is None else resumed.path
    if flags.resume_existing and path.exists():
        resumed, config = RunFolder.open(path, flags.allow_file), fitted(config)
        base = resumed.read_config()
        config = begun(config, resumed)
    if resumed is not None:
        options.check_resume(base, config, resumed)
    with stop_flag("saving and ending") as stop:
        first = path.name
        numbers = itertools.count(2)
        resume = resumed is not None
        while True:
            try:
                run = _learn(
                    open_run(config, path, place, outputs, resume=resume, stopped=stop.is_set),
                    flags.style,
                )
                break
            except RolledBack:
                resume = True
            except NameTakenError:  # of a run of the same second
                if flags.name or resume:
                    raise
                path = path.with_name(f"{first}-{next(numbers)}")
    return INTERRUPTED if run.summary["state"] == "interrupted" else 0


def _learn(context: AbstractContextManager[Run], style: Style) -> Run:
    """Learn until the end or an interruption, and say how it ended."""
    with context as run:
        screen = display.display(run, _announcement(run), style)
        gc.freeze()  # existing objects stay: collecting garbage among them took 20 ms each time
        with screen:
            for report in run.learn():
                screen.show(report)
    screen.conclude(_conclusion(run))
    return run


def _announcement(run: Run) -> list[str]:
    folder, at = run.learner.folder, run.learner.state.generation
    lines = [f"run {folder.path}" + (f", continuing after generation {at}" if at else "")]
    if run.outputs.record:
        lines[0] += "; farm view shows it at any time"
    if not run.place.workers:
        lines.append(f"workers join with: {how_to_join(run.place, run.learner.problem.files)}")
    if run.live is not None:
        lines += recordings.look_on(run.live)
    if (config := run.learner.config).start == "fitted":
        width, sigma = config.policy_config.bandwidth, config.algorithm_config.initial_sigma  # type: ignore[attr-defined]
        lines.append(f"fitted to the observation: bandwidth {width:.4g}, initial sigma {sigma:.4g}")
    observation = (
        run.learner.problem.spec.observation if run.learner.config.policy_config.normalise else 0
    )
    every = folder.parameters.every(
        run.learner.state.mu.size, run.learner.config.generations, observation
    )
    if every > 1:
        lines.append(f"parameters: one generation in {every} is kept, to stay below 100 MB")
    return lines


def worth(summary: Mapping[str, Any]) -> str:
    """What the mean policy returns, from the nominal start and, if no line of `compared` says
    that, from others.
    """
    value, failed = summary["mean_policy_return"], summary["robust_failed"]
    nominal = "fails" if value is None else f"returns {value:.3f}"
    if (succeeds := summary["mean_policy_success"]) is None:
        success, others = "", f"from others {figure(summary['robust_return'])} on average"
    else:
        success = " and succeeds" if succeeds else " and does not succeed"
        others = f"robust success {summary['robust_success_rate']:.0%}"
    parts = [f"the mean policy {nominal}{success} from the undisturbed start"]
    if summary.get("without_learning") is None:
        parts.append(others)
    if failed:
        parts.append(f"{failed} of {EVALUATION_ROLLOUTS} failed, unstable or by an error")
    return "; ".join(parts)


def chosen(summary: Mapping[str, Any]) -> list[str]:
    """Which policy is the run's, if that is not the last one."""
    generation = summary["policy_generation"]
    best = summary["best_validation"]
    last = summary["last_validation"]
    if generation == summary["generations"]:
        return []
    return [
        f"the run's policy is the mean after generation {generation}: in validation it returned"
        f" {figure(best)}, the last one {figure(last)}; --last takes that one"
    ]


def compared(summary: Mapping[str, Any]) -> list[str]:
    """What the run's policy is worth beside none, and a warning if it is worth nothing."""
    if (others := summary.get("without_learning")) is None:
        return []
    value, still = summary["robust_score"], others["nothing"]["score"]
    ours = {
        "score": value,
        "success_rate": summary["robust_success_rate"],
        "measures": summary.get("robust_measures", {}),
    }
    policy, nothing, constant = (
        _in_numbers(each) for each in (ours, others["nothing"], others["constant"])
    )
    lines = [
        f"the policy returns {policy} from {EVALUATION_ROLLOUTS} starts; doing nothing {nothing}, "
        f"the best of {CONSTANTS} constant actions {constant}"
    ]
    if still is not None and (value is None or value <= still):
        lines.append("warning: the policy is not better than doing nothing; farm check may say why")
    return lines


def _in_numbers(of: Mapping[str, Any]) -> str:
    """A return, and in brackets success and measures, where the task has some."""
    success, measures = of.get("success_rate"), of.get("measures", {})
    more = [] if success is None else [f"success {success:.0%}"]
    more += [printable(f"{name} {figure(value, '.3g')}") for name, value in measures.items()]
    return figure(of["score"], ".4g") + (f" ({', '.join(more)})" if more else "")


def _conclusion(run: Run) -> list[str]:
    summary, folder = run.summary, run.learner.folder.path
    lines = []
    if summary["state"] == "finished":
        lines.append(worth(summary))
        if run.learner.config.validate:
            lines += [*chosen(summary), *compared(summary)]
    lines.append(f"hash {summary['parameters_sha256'][:16]}  in {folder}")
    if not run.learner.folder.there:
        lines.append(run.learner.folder.gone)
    elif summary["state"] == "interrupted":
        lines.append(f"continue with: {how_to_resume(run.place, folder)}")
    elif run.outputs.record:
        lines.append(f"look at it with: farm view {typed(folder)}")
    return lines
