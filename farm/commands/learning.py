"""What `farm run` and `farm learner` have in common."""

import sys
from dataclasses import replace

from farm.commands import display, logs, options
from farm.commands.options import LearnerOptions
from farm.commands.signals import stop_flag
from farm.errors import ConfigError
from farm.local import Place, Run, how_to_join, open_run
from farm.tls import find
from learner.config import RunConfig
from learner.folder import RunFolder

INTERRUPTED = 130
"""Exit status after Ctrl-C or SIGTERM, as of a shell."""


def learn(chosen: LearnerOptions, config: RunConfig, place: Place, resumed: RunFolder | None, begin: RunConfig) -> int:
    """Learn until the end, an interruption or a failure; exit status."""
    logs.set_up(chosen.log_level)
    place = replace(place, connect=chosen.connect, farm=chosen.farm, record=chosen.record)
    place = replace(place, listen=chosen.listen or place.listen, trusted=chosen.trust_network, mixed=chosen.mixed)
    if chosen.tls is not None:
        place = replace(place, tls=find(chosen.tls, "learner"))
    if chosen.serve is not None:
        place = replace(place, serve=options.address(chosen.serve))
    path = chosen.out / options.run_name(chosen, config) if resumed is None else resumed.path
    if resumed is not None:
        if chosen.name:
            raise ConfigError("--name is for a new run; a resumed one keeps its name")
        options.check_resume(begin, config, resumed)
    with stop_flag("saving and ending") as stop:
        opened = open_run(config, path, place, resume=resumed is not None, stopped=stop.is_set)
        with opened as run:
            _announce(run, place)
            with display.display(config.generations, run.learner.state.generation) as screen:
                for report in run.learn():
                    screen.show(report)
        _conclude(run, place)
    return INTERRUPTED if run.summary["state"] == "interrupted" else 0


def _announce(run: Run, place: Place) -> None:
    name, at = run.learner.folder.path, run.learner.state.generation
    sys.stdout.write(f"run {name}" + (f", going on after generation {at}\n" if at else "\n"))
    if not place.workers:
        sys.stdout.write(f"workers join with: {how_to_join(place)}\n")
    if run.live is not None:
        sys.stdout.write(f"live: rerun {run.live}   (in a browser: rerun --web-viewer {run.live})\n")
    kept = run.learner.folder.every(run.learner.state.mu.size, run.learner.config.generations)
    if kept > 1:
        sys.stdout.write(f"parameters: one generation in {kept} is kept, to stay below 100 MB\n")
    sys.stdout.flush()


def _conclude(run: Run, place: Place) -> None:
    """What came out, and what to do next."""
    summary, folder = run.summary, run.learner.folder.path
    lines = []
    if summary["mean_policy_return"] is not None:
        success = "succeeds" if summary["mean_policy_success"] else "does not succeed"
        lines.append(
            f"the mean policy returns {summary['mean_policy_return']:.3f} and {success}; "
            f"robust success {summary['robust_success_rate']:.0%}"
        )
    lines.append(f"parameters {summary['parameters_sha256'][:16]}  in {folder}")
    if summary["state"] == "interrupted":
        lines.append(f"go on with: farm {'run' if place.workers else 'learner'} --resume {folder}")
    elif place.record:
        lines.append(f"look at it with: farm view {folder}")
    sys.stdout.write("\n".join(lines) + "\n")
