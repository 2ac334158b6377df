"""Settings x seeds from Python; what `farm sweep` does.

import farm

config = farm.configure("finger-gait", generations=20)
for row in farm.sweep(config, "sweeps/pairs", vary={"pairs": [5, 15]}, seeds=range(3)):
    print(row["pairs"], row["seed"], row["robust_success_rate"])
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from farm.errors import ConfigError
from learner import parquet
from learner.recording.files import check_rerun
from learner.run import config as configs
from learner.run import setup
from learner.run.config import RunConfig
from learner.tools.sweep import grid, outcomes
from learner.tools.sweep import runs as sweeps
from learner.tools.sweep.grid import Setting, Sweep
from learner.tools.sweep.runs import Logged, RunWatcher, Sharing


def sweep(
    config: RunConfig,
    folder: str | Path,
    *,
    vary: Mapping[str, Sequence[Any]] | None = None,
    seeds: Iterable[int] = range(5),
    workers: int | None = None,
    parallel: int = 4,
    record: bool = False,
) -> list[dict[str, Any]]:
    """Learn every combination of some settings with each seed, with local workers, in a new folder
    or where such a sweep was interrupted.

    Args:
      config: settings of all runs; its seed is not used.
      folder: for the runs, a folder each, and table.csv.
      vary: values by the setting's name, such as {"pairs": [5, 15]}; None: one setting.
      seeds: of every combination; more may be added later.
      workers: processes on this machine, by default one per core; they do not change the results.
      parallel: runs that learn at the same time.
      record: record every run with Rerun.

    Returns:
      A table for each run: its settings as texts by name (`setting_state`, where a result is called
      `state`, and so on), `seed`, `state` (`finished`, or what
      became of it), and fields of its summary.json, such as `robust_success_rate`,
      `mean_policy_return` and `parameters_sha256`; None where there is none yet.

    Raises:
      ConfigError: a setting is unknown or invalid, or the folder is another sweep's.
      RunError: no worker keeps running; the same call continues.

    Example:
      ```python
      import farm

      config = farm.configure("finger-gait", policy="constant", generations=1)
      rows = farm.sweep(config, "sweeps/gait", vary={"pairs": [1, 2]}, seeds=[0], workers=2)
      print([(row["pairs"], row["state"]) for row in rows])
      ```
    """
    configs.checked(config)
    if not isinstance(vary, Mapping | None):
        raise ConfigError(
            f"vary is {vary!r:.60}; expected values by setting, as {{'pairs': [5, 15]}}"
        )
    values = {name: _listed(f"vary {name}", each) for name, each in (vary or {}).items()}
    if "seed" in values:
        raise ConfigError("vary seed: give seeds, for example seeds=range(5)")
    text = ",".join(map(str, _listed("seeds", seeds)))
    numbers = grid.parse_seeds(text)
    settings = tuple(_setting(config, each) for each in grid.combinations(values, len(numbers)))
    plan = Sweep(Path(folder), settings, numbers)
    sharing = Sharing(workers=workers, parallel=parallel, record=record)
    prepare(plan, sharing)
    _, table = learnt(plan, sharing, Logged(), lambda: False)
    return table


def _listed(what: str, values: object) -> list[Any]:
    """Several values as a list; a ConfigError if they are none, or one value alone."""
    listed = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    if not listed:
        raise ConfigError(f"{what}: {values!r}; expected a list of one value or more")
    return listed


def _setting(config: RunConfig, values: Mapping[str, Any]) -> Setting:
    """One combination of values."""
    texts = {  # as they are written for --vary
        name: str(value).lower() if isinstance(value, bool) else str(value)
        for name, value in values.items()
    }
    try:
        new = configs.pilot_unless(configs.changed_by(config, values), values)
    except ConfigError as error:
        text = " ".join(f"{name}={value}" for name, value in texts.items())
        raise ConfigError(f"vary {text}: {error}" if text else str(error)) from None
    return Setting(texts, configs.changed_by(new, {"seed": 0}))


def prepare(sweep: Sweep, sharing: Sharing) -> None:
    """Check that a sweep can be learnt, better now than hours later, and make or continue its
    folder.

    Raises:
      ConfigError: two settings are the same, one cannot begin, Rerun or certificates are missing,
          or the folder is another sweep's.
    """
    grid.check(sweep)
    check_sharing(sharing)
    _check_begins(sweep)
    sweep.prepare()


def learnt(
    sweep: Sweep, sharing: Sharing, watcher: RunWatcher, stopped: Callable[[], bool]
) -> tuple[bool, list[dict[str, Any]]]:
    """Learn what is left of a sweep, and write its tables; whether all runs are over then, and a
    row for each run.

    Raises:
      RunError: no local worker keeps running, or a table cannot be written.
    """
    complete = sweeps.run(sweep.runs, sharing, watcher, stopped)
    table = outcomes.rows(sweep)
    outcomes.write_csv(sweep.path / "table.csv", sweep, table)
    if parquet.available():
        outcomes.write_parquet(sweep.path / "table.parquet", sweep, table)
    return complete, table


def check_sharing(sharing: Sharing) -> None:
    """Check what the runs need: Rerun for recordings, and certificates."""
    if sharing.record:
        check_rerun()
    _ = sharing.bundle


def _check_begins(sweep: Sweep) -> None:
    """Check that every setting's task can start."""
    tasks: list[Any] = []
    for setting in sweep.settings:
        try:
            problem = setup.problem(setting.config)
            if (task := (setting.config.task, setting.config.task_config)) not in tasks:
                problem.runner().close()
                tasks.append(task)
        except ConfigError as error:
            raise ConfigError(f"{setting.label}: {error}") from None
