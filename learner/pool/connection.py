"""The session of a pool: one that listens for workers, or one that is connected to a router."""

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final

from farm.errors import NameTakenError
from farm.net import keys, session
from farm.net.session import Session
from farm.processes import Forked, forks
from learner.pool.placement import Placement
from learner.pool.served import Served

_REMEMBERED: Final = 5.0  # [s] for which a router may believe that a killed learner is still there
_LOOK: Final = 0.3  # [s] between two checks for other claims on a run's name


@dataclass(frozen=True)
class Connection:
    """An open session, and processes of this machine that wait to become workers."""

    session: Session
    place: Placement
    stopped: Callable[[], bool]
    """Whether the user has asked to stop; to be called regularly."""
    forked: Sequence[Forked] = ()


def check_place(place: Placement) -> None:
    """Check, before anything is simulated, that a learner can listen there.

    Raises:
      ConfigError: the endpoint is malformed, its port in use, or it is open to other machines
        without certificates.
    """
    if not place.connect:
        session.check_listening(place.listen, place.farm, place.tls, trusted=place.trusted)


@contextmanager
def connected(
    served: Served,
    place: Placement,
    stopped: Callable[[], bool],
    *,
    claim: str | None = None,
    fork: bool = False,
) -> Iterator[Connection]:
    """Open the session of a pool.

    Args:
      served: what its workers simulate.
      place: where they are.
      stopped: whether the user has asked to stop.
      claim: name of a run that only one learner may have.
      fork: whether local workers may be forked from this process, which then has what they share.

    Raises:
      NameTakenError: another learner has the name.
      FarmError: the address cannot be used, or there is no router.
    """
    largest = served.shapes(steps=True).largest_message
    with ExitStack() as stack:
        # Devices want processes of their own.
        count = place.workers if fork and place.backend == "cpu" else 0
        forked = stack.enter_context(forks(count))
        if place.connect:
            opened = session.connect(place.connect, None, stopped, place.tls, largest=largest)
        else:
            opened = session.listen(
                place.listen, place.farm, place.tls, trusted=place.trusted, largest=largest
            )
        link = stack.enter_context(opened)
        if claim is not None and place.connect:
            _claim(link, place.farm, claim, stopped)
        yield Connection(link, place, stopped, forked)


def _claim(link: Session, farm: str, run: str, stopped: Callable[[], bool]) -> None:
    """Check that no other learner has this run's name at the same router: they would discard each
    other's work.

    If several start together, the first one stays: each claims the name, then looks for other
    claims.
    """
    error = NameTakenError(
        f"a learner of run {run} is on {keys.called(farm)} already: choose a different --name"
    )
    until = time.monotonic() + _REMEMBERED
    while link.present(keys.learner_token(farm, run), 1.0):
        if time.monotonic() > until or stopped():
            raise error
    claim = f"{time.time_ns():020}-{secrets.token_hex(8)}".encode()
    link.answer(keys.claim(farm, run), lambda: claim)
    for pause in (0.0, _LOOK):  # again, because routers take time to forward a claim
        time.sleep(pause)
        if any(other < claim for other in link.ask_all(keys.claim(farm, run), 1.0)):
            raise error
