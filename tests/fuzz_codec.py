"""Coverage-guided fuzzing of the decoder: `python tests/fuzz_codec.py -max_total_time=60` (needs
atheris).

The first byte says which message is expected. Whatever the bytes, the outcome is a message or a
MessageError.
"""

import contextlib
import sys

import atheris

with atheris.instrument_imports(include=["farm"]):
    from farm.errors import MessageError
    from farm.net import codec
    from farm.net.messages import Refusal, Spec, WorkRequest
    from farm.net.telemetry import Report, RunHistory, RunStatus
    from farm.net.work import Chunk, Failure, Results, RoundHeader

KINDS = (
    Chunk,
    Failure,
    RoundHeader,
    Refusal,
    Results,
    Report,
    RunHistory,
    RunStatus,
    Spec,
    WorkRequest,
)


def one(data: bytes) -> None:
    kind = KINDS[data[0] % len(KINDS)] if data else WorkRequest
    with contextlib.suppress(MessageError):
        codec.decode(data[1:], kind)


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
