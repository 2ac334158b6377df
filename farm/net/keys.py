"""The key space of a farm, in one place. Pure.

<farm>/live/worker/<worker>        liveliness token of a worker, <worker> = <name>/<instance>
<farm>/live/learner/<run>          liveliness token of a learner
<farm>/want/<worker>               a worker's credits
<farm>/pairs/<worker>              a worker's inbox: chunks of jobs
<farm>/run/<run>/claim             queryable: when the run's learner began
<farm>/run/<run>/spec              queryable: what is simulated
<farm>/run/<run>/code/<digest>     queryable: the source of a class that lies in a file; by TLS only
<farm>/run/<run>/generation        published and queryable: the round that is on
<farm>/run/<run>/result/<worker>   results
<farm>/run/<run>/status            queryable: how it is doing
<farm>/run/<run>/report            published: a generation that is over
<farm>/run/<run>/history           queryable, ?from=<generation>: reports so far; published, empty, when the run is over
<farm>/refused/<worker>            why a learner gives a worker no jobs
"""

import re
from typing import Final

from farm.errors import ConfigError, MessageError

_NAME: Final = re.compile(r"(?!\.+$)[A-Za-z0-9_.-]{1,100}")  # dots alone would be a folder above


def checked(kind: str, name: str) -> str:
    """The name, if it can be one part of a key.

    Raises:
      ConfigError: it has other characters than letters, digits, `_`, `.` and `-`.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{kind} {name!r} is not a name; expected 1 to 100 letters, digits, '_', '.' or '-'")
    return name


def worker_token(farm: str, worker: str) -> str:
    """Liveliness of a worker; `**` for all."""
    return f"{farm}/live/worker/{worker}"


def learner_token(farm: str, run: str) -> str:
    """Liveliness of a run's learner; `*` for all."""
    return f"{farm}/live/learner/{run}"


def want(farm: str, worker: str) -> str:
    """Where a worker says how much it wants; `**` for all."""
    return f"{farm}/want/{worker}"


def inbox(farm: str, worker: str) -> str:
    """Where jobs for a worker are published."""
    return f"{farm}/pairs/{worker}"


def claim(farm: str, run: str) -> str:
    """Where learners that start under one name find each other."""
    return f"{farm}/run/{run}/claim"


def spec(farm: str, run: str) -> str:
    """Where a run's specification is answered."""
    return f"{farm}/run/{run}/spec"


def code(farm: str, run: str, digest: str) -> str:
    """Where a run's learner answers the source with this SHA-256; run and digest `*` for all."""
    return f"{farm}/run/{run}/code/{digest}"


def generation(farm: str, run: str) -> str:
    """Where the round that is on is published and answered; run `*` for all."""
    return f"{farm}/run/{run}/generation"


def result(farm: str, run: str, worker: str) -> str:
    """Where results of a run are published; worker `**` for all."""
    return f"{farm}/run/{run}/result/{worker}"


def status(farm: str, run: str) -> str:
    """Where a learner answers how its run is doing; run `*` for all."""
    return f"{farm}/run/{run}/status"


def report(farm: str, run: str) -> str:
    """Where a learner publishes each generation that is over."""
    return f"{farm}/run/{run}/report"


def history(farm: str, run: str) -> str:
    """Where a learner answers what it reported so far; something is published there when the run is over."""
    return f"{farm}/run/{run}/history"


def refused(farm: str, worker: str) -> str:
    """Where a learner tells a worker why it gets no jobs."""
    return f"{farm}/refused/{worker}"


def worker_in(key: str, prefix: str) -> str:
    """The worker, <name>/<instance>, that follows the prefix in a key: `worker_in(key, want(farm, ""))`.

    Raises:
      MessageError: something else follows it; a sender that publishes on a pattern speaks for nobody.
    """
    return _tail(key, prefix, 2)


def run_in(key: str, prefix: str) -> str:
    """The run that follows the prefix in a key.

    Raises:
      MessageError: something else follows it.
    """
    return _tail(key, prefix, 1)


def _tail(key: str, prefix: str, parts: int) -> str:
    names = key.removeprefix(prefix).split("/", parts)  # no more: a key may be 64 kB of names
    if not key.startswith(prefix) or len(names) != parts or not all(map(_NAME.fullmatch, names)):
        raise MessageError("a key without a name", "foreign")
    return "/".join(names)
