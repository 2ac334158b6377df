"""The key space of a farm. Pure functions.

<farm>/live/worker/<worker>        liveliness token of a worker, <worker> = <name>/<instance>
<farm>/live/learner/<run>          liveliness token of a learner
<farm>/want/<worker>               a worker's credits
<farm>/pairs/<worker>              a worker's inbox: chunks of jobs
<farm>/run/<run>/claim             queryable: when the run's learner started
<farm>/run/<run>/spec              queryable: what is simulated
<farm>/run/<run>/code/<digest>     queryable: the source of a class in a file; only with TLS
<farm>/run/<run>/asset/<digest>    queryable: a file that the task's model reads, such as a mesh
<farm>/run/<run>/generation        published and queryable: the current round
<farm>/run/<run>/result/<worker>   results
<farm>/run/<run>/status            queryable: state of the run
<farm>/run/<run>/report            published: a finished generation
<farm>/run/<run>/history           queryable, ?from=<generation>: past reports; empty at the end
<farm>/refused/<worker>            why a learner gives a worker no jobs
<farm>/cut/<name>                  published: a machine sends too much; routers cut it off
"""

import re
from typing import Final

from farm.errors import ConfigError, MessageError

# Only dots: a parent folder; a dash first: a flag
_NAME: Final = re.compile(r"(?!\.+$)(?!-)[A-Za-z0-9_.-]{1,100}")


FARM: Final = "farm"
"""Name of a farm that nobody named."""


def called(farm: str) -> str:
    """Words with which a message names a farm: its name, if somebody gave it one."""
    return "this farm" if farm == FARM else f"farm {farm}"


def checked(kind: str, name: str) -> str:
    """Return the name if it can be one part of a key.

    Raises:
      ConfigError: it has characters other than letters, digits, `_`, `.` and `-`, or begins with
          `-`.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{kind} {name!r} is not a name; expected 1 to 100 letters, digits, '_', '.' or '-', no"
            " '-' first"
        )
    return name


def worker_token(farm: str, worker: str) -> str:
    """Liveliness of a worker; `**` for all."""
    return f"{farm}/live/worker/{worker}"


def learner_token(farm: str, run: str) -> str:
    """Liveliness of a run's learner; `*` for all."""
    return f"{farm}/live/learner/{run}"


def want(farm: str, worker: str) -> str:
    """Where a worker requests jobs; `**` for all."""
    return f"{farm}/want/{worker}"


def inbox(farm: str, worker: str) -> str:
    """Where jobs for a worker are published."""
    return f"{farm}/pairs/{worker}"


def claim(farm: str, run: str) -> str:
    """Where learners that start under the same name find each other."""
    return f"{farm}/run/{run}/claim"


def spec(farm: str, run: str) -> str:
    """Where a run's specification can be queried."""
    return f"{farm}/run/{run}/spec"


def code(farm: str, run: str, digest: str) -> str:
    """Where the source with this SHA-256 can be queried; run and digest `*` for all."""
    return f"{farm}/run/{run}/code/{digest}"


def asset(farm: str, run: str, digest: str) -> str:
    """Where the task's file with this SHA-256 can be queried; run and digest `*` for all."""
    return f"{farm}/run/{run}/asset/{digest}"


def generation(farm: str, run: str) -> str:
    """Where the current round is published and can be queried; run `*` for all."""
    return f"{farm}/run/{run}/generation"


def result(farm: str, run: str, worker: str) -> str:
    """Where results of a run are published; worker `**` for all."""
    return f"{farm}/run/{run}/result/{worker}"


def status(farm: str, run: str) -> str:
    """Where the state of a run can be queried; run `*` for all."""
    return f"{farm}/run/{run}/status"


def report(farm: str, run: str) -> str:
    """Where a learner publishes each finished generation."""
    return f"{farm}/run/{run}/report"


def history(farm: str, run: str) -> str:
    """Where a learner's past reports can be queried; an empty message is published there when
    the run is over.
    """
    return f"{farm}/run/{run}/history"


def refused(farm: str, worker: str) -> str:
    """Where a learner tells a worker why it gets no jobs."""
    return f"{farm}/refused/{worker}"


def cut(farm: str, name: str) -> str:
    """Where a learner tells routers which machine to cut off; name `*` for all."""
    return f"{farm}/cut/{name}"


def worker_in(key: str, prefix: str) -> str:
    """The worker, <name>/<instance>, that follows the prefix in a key: `worker_in(key, want(farm,
    ""))`.

    Raises:
      MessageError: something else follows it; a message published on a pattern has no sender.
    """
    return run_in(key, prefix, 2)


def run_in(key: str, prefix: str, parts: int = 1) -> str:
    """The run, or another name of so many parts, that follows the prefix in a key; else a
    MessageError.
    """
    names = key.removeprefix(prefix).split("/", parts)  # a key may have 64 kB
    if not key.startswith(prefix) or len(names) != parts or not all(map(_NAME.fullmatch, names)):
        raise MessageError("a key without a name", "foreign")
    return "/".join(names)
