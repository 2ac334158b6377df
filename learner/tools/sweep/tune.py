"""A race from Python; what `farm tune` does.

import farm

done = farm.tune(farm.RunConfig(task="reacher.py:Reacher"), "tunes/reacher", rollouts=60_000)
print(done.winner.name, done.folder(done.winner))
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from farm.errors import ConfigError
from learner.pool.placement import check_workers
from learner.recording.files import check_rerun
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.tools.sweep import race
from learner.tools.sweep.portfolio import portfolio
from learner.tools.sweep.race import Race
from learner.tools.sweep.runs import Logged, Sharing, site

log = logging.getLogger(__name__)


def tune(
    config: RunConfig,
    folder: str | Path,
    *,
    rollouts: int,
    entries: Mapping[str, Mapping[str, Any]] | None = None,
    workers: int = 2,
    record: bool = False,
) -> Race:
    """Race settings on a task with local workers, in a new folder or where such a race was
    interrupted.

    Args:
      config: the task, and settings of all entries.
      folder: for race.json, and a run folder per entry.
      rollouts: exploring rollouts of all entries together.
      entries: settings that replace some of the configuration's, by the entry's name; None: those
          of `farm tune`.
      workers: processes on this machine; they do not change the result.
      record: record the winner's last rung with Rerun.

    Raises:
      ConfigError: an entry does not fit the task, or the folder is another race's.
      RunError: an entry failed; the same call continues.

    Example:
      ```python
      import farm

      config = farm.RunConfig(task="finger-gait", seed=1)
      entries = {
          "few": {"policy": "constant", "pairs": 2},
          "many": {"policy": "constant", "pairs": 4},
      }
      done = farm.tune(config, "tunes/gait", rollouts=64, entries=entries, workers=2)
      print(done.winner.name, done.folder(done.winner))
      ```
    """
    check_workers(workers)
    if type(rollouts) is not int or rollouts < 1:
        raise ConfigError(f"rollouts is {rollouts!r}; expected a positive whole number")
    configs.checked(config)
    if not isinstance(entries, Mapping | None):
        raise ConfigError(f"entries is {entries!r:.60}; expected settings by the entry's name")
    if record:
        check_rerun()
    entrants = race.entries_of(config, portfolio("general") if entries is None else entries)
    done = Race(Path(folder), tuple(entrants), rollouts)
    race.check(done)
    done.prepare()
    with site(Sharing(workers=workers), [entry.config for entry in entrants]) as place:
        done.run(place, _Logged(), lambda: False, record=record)
    return done


class _Logged(Logged):
    """Writes to the log how the race goes."""

    def rung(self, number: int) -> None:
        log.info("rung %d begins", number + 1)
