"""Messages that a pool sends to workers and receives from them: decoded, attributed to a worker,
and handed on.
"""

import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import MessageError
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.session import Session
from farm.net.work import NOT_NORMALISED, Chunk, Failure, Jobs, Results, RoundHeader
from learner.pool.status import StatusAnswer

# Requests or results of one worker, which has a few chunks at a time, and asks once per second
_UNREAD: Final = 100
_ASK: Final = 0.5  # [s] timeout of a query for one token

NO_FILES: Final[Mapping[str, bytes]] = {}
"""Binary files of a model that is text only: none."""


class Mail:
    """The messages of one pool; only the thread of its owner calls it."""

    def __init__(
        self, session: Session, farm: str, spec: Spec, files: Mapping[str, bytes] = NO_FILES
    ) -> None:
        """Subscribe, and answer questions for the specification and these model files, by digest.

        Workers see the pool after `show`.
        """
        self.run = spec.run
        self.status = StatusAnswer()
        """The answer to `farm status`."""
        self._session = session
        self._farm = farm
        self._wants = keys.want(farm, "")
        self._results = keys.result(farm, self.run, "")
        self._tokens = keys.worker_token(farm, "")
        simulated = codec.encode(spec)
        self.header = RoundHeader(
            run=self.run,
            incarnation=secrets.token_hex(8),
            round=0,
            generation=0,
            spec=hashlib.sha256(simulated).hexdigest(),
            traces="none",
            mu=np.empty(0),
        )
        """The round that was announced last."""
        session.subscribe("want", keys.want(farm, "**"), most=_UNREAD)
        session.subscribe("result", keys.result(farm, self.run, "**"), most=_UNREAD)
        session.watch("worker", keys.worker_token(farm, "**"))
        session.answer(keys.spec(farm, self.run), lambda: simulated)
        session.answer(keys.generation(farm, self.run), lambda: codec.encode(self.header))
        session.answer(keys.status(farm, self.run), lambda: self.status.payload)
        for digest, content in files.items():
            session.answer(keys.asset(farm, self.run, digest), partial(bytes, content))

    def offer_code(self, sources: Mapping[str, bytes]) -> None:
        """Answer questions for source code, by digest."""
        for digest, source in sources.items():
            self._session.answer(keys.code(self._farm, self.run, digest), partial(bytes, source))

    def show(self) -> None:
        """Show the pool to workers."""
        self._session.token(keys.learner_token(self._farm, self.run))

    def announce(
        self,
        generation: int,
        mu: FloatArray,
        traces: str,
        normaliser: FloatArray = NOT_NORMALISED,
        *,
        terms: bool = False,
    ) -> None:
        """Begin the next round; arguments as in `RoundHeader`."""
        self.header = replace(
            self.header,
            round=self.header.round + 1,
            generation=generation,
            traces=traces,
            mu=mu,
            normaliser=normaliser,
            terms=terms,
        )
        self._session.publish(keys.generation(self._farm, self.run), codec.encode(self.header))

    def send(self, worker: str, jobs: Jobs) -> None:
        """Send jobs of this round to a worker."""
        head = self.header
        chunk = Chunk.carrying(jobs, run=head.run, incarnation=head.incarnation, round=head.round)
        # Without block: a frozen host must not delay the others; deadlines cover lost messages.
        self._session.publish(keys.inbox(self._farm, worker), codec.encode(chunk), block=False)

    def refuse(self, worker: str, reason: str) -> None:
        """Tell a worker why it gets no jobs."""
        message = codec.encode(Refusal(run=self.run, reason=reason))
        self._session.publish(keys.refused(self._farm, worker), message, block=False)

    def cut_off(self, machine: str) -> None:
        """Ask routers to cut a machine off, which sends too much."""
        self._session.publish(keys.cut(self._farm, machine), b"", block=False)

    def events(self, timeout: float) -> list[Event]:
        """What arrived; waits for at most the timeout [s]."""
        return self._session.events.waiting(timeout)

    @property
    def dropped(self) -> int:
        """Number of events for which there was no room."""
        return self._session.events.dropped

    def burden(self, event: Event) -> None:
        """Count an event among those of which a machine may send a limited number."""
        self._session.burden(event)

    def sender(self, event: Event) -> str:
        """Name of the worker that an event is of; a MessageError if the key is malformed."""
        prefix = {"want": self._wants, "result": self._results, "worker": self._tokens}
        return keys.worker_in(event.key, prefix[event.topic])

    def present(self, worker: str) -> bool:
        """Whether a worker's token is there: Zenoh sometimes misses a new one."""
        return self._session.present(self._tokens + worker, _ASK)

    def request(self, event: Event) -> WorkRequest:
        """The request for work in an event; a MessageError if it cannot be read."""
        return codec.decode(event.payload, WorkRequest)

    def answer(self, event: Event) -> Results | Failure:
        """The answer to jobs in an event; a MessageError if it cannot be read."""
        try:
            return codec.decode(event.payload, Results)
        except MessageError as first:
            if first.kind != "bad":
                raise
            try:
                return codec.decode(event.payload, Failure)
            except MessageError:
                raise first from None
