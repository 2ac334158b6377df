"""A robot as a worker, in plain Python with zenoh and msgpack: docs/protocol.md, "The worker's
side, exactly".

# local workers do jobs that the rig cannot
farm run --task rig.py:Rig --any-rounding --patience 10 --listen tcp/127.0.0.1:7447
python robot_worker.py --connect tcp/127.0.0.1:7447
"""

import argparse
import hashlib
import json
import math
import os
import queue
import random
import signal
import struct
import time
from pathlib import Path

import msgpack
import zenoh

SCHEMA = 11
# Array dtype -> format character of struct
LETTERS = {"<f8": "d", "<f4": "f", "<i8": "q", "|b1": "?"}


def rollout(theta: list[float], clock: float) -> float:
    """The return of 50 steps of 50 ms by the rig's clock; raises RuntimeError if it fails.

    Put your robot here.
    """
    angle, speed, value, start = 0.3 + random.uniform(-0.1, 0.1), 0.0, 0.0, time.monotonic()
    for step in range(1, 51):
        action = (
            theta[0] * math.sin(angle)
            + theta[1] * math.cos(angle)
            + theta[2] * 0.1 * speed
            + theta[3]
        )
        for _ in range(10):
            speed += (
                0.005
                * (2.4525 * math.sin(angle) + 1.5 * max(-1.0, min(1.0, action)) - 0.06 * speed)
                / 0.126
            )
            angle += 0.005 * speed
        if abs(speed) > 7.0:
            raise RuntimeError(f"the rig's guard stopped it in step {step}: faster than 7 rad/s")
        value += math.cos(angle)
        time.sleep(max(0.0, clock and start + 0.05 * step / clock - time.monotonic()))
    return value


def array(dtype: str, shape: list[int], values: list[float]) -> msgpack.ExtType:
    """Encode numbers as an array: one byte with the header's length, the header (dtype, shape), the
    numbers' bytes.
    """
    head = msgpack.packb([dtype, shape])
    return msgpack.ExtType(
        1, bytes([len(head)]) + head + struct.pack(f"<{len(values)}{LETTERS[dtype]}", *values)
    )


def numbers(_: int, data: bytes) -> list[float]:
    """Decode an array into a flat list of its numbers."""
    (dtype, _), raw = msgpack.unpackb(data[1 : 1 + data[0]]), data[1 + data[0] :]
    return struct.unpack(f"<{len(raw) // struct.calcsize(LETTERS[dtype])}{LETTERS[dtype]}", raw)


class Worker:
    """Joins a farm, does one job at a time, and reports jobs that it cannot do."""

    def __init__(self, session: zenoh.Session, name: str, clock: float) -> None:
        self.session = session
        self.clock = clock
        self.id = f"{name}/{os.getpid()}-{os.urandom(3).hex()}"
        self.runs, self.rounds, self.events = set(), {}, queue.Queue()
        self.inbox = session.declare_subscriber(f"farm/pairs/{self.id}", self.events.put)
        self.learners = session.liveliness().declare_subscriber(
            "farm/live/learner/*", self.events.put, history=True
        )
        # The token comes last: it brings jobs, which would be lost without the subscription
        self.token = session.liveliness().declare_token(f"farm/live/worker/{self.id}")

    def serve(self) -> None:
        """Handle events as they arrive; after a second without any, report that this worker is
        idle.
        """
        while True:
            try:
                sample = self.events.get(timeout=1.0)
                if "/live/learner/" in (key := str(sample.key_expr)):
                    (self.runs.add if sample.kind == zenoh.SampleKind.PUT else self.runs.discard)(
                        key.split("/")[-1]
                    )
                    self.want()
                else:
                    self.chunk(msgpack.unpackb(sample.payload.to_bytes(), ext_hook=numbers))
            except queue.Empty:
                self.want(idle=tuple(self.runs))
            except (
                ValueError,
                KeyError,
                TypeError,
                StopIteration,
                struct.error,
                msgpack.UnpackException,
            ) as error:
                print("ignored a message:", ascii(error))

    def want(self, idle: tuple[str, ...] = ()) -> None:
        """Ask for one job at a time.

        The fingerprint is empty, because these numbers cannot be repeated.
        """
        machine = {
            "version": "robot_worker",
            "fingerprint": "",
            "host": os.uname().nodename,
            "cores": 1,
            "ignored": {},
        }
        self.say(
            f"want/{self.id}", "WorkRequest", worker=self.id, credits=1, idle=list(idle), **machine
        )

    def say(self, key: str, kind: str, **fields: object) -> None:
        """Publish a message; wait while the send queue is full."""
        payload = msgpack.packb({"schema": SCHEMA, "type": kind, **fields})
        self.session.put(f"farm/{key}", payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def ask(self, run: str, what: str) -> bytes:
        """The answer of the run's learner to a query; empty if there is none."""
        replies = self.session.get(f"farm/run/{run}/{what}", timeout=1.0)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok), b"")

    def round(self, run: str) -> dict:
        """The current round's header, and whether the rig can serve its run."""
        header = msgpack.unpackb(self.ask(run, "generation"), ext_hook=numbers)
        content = self.ask(run, "spec")
        if hashlib.sha256(content).hexdigest() != header["spec"]:
            raise ValueError("a specification that is not the round's")
        spec = msgpack.unpackb(content, ext_hook=numbers)
        run_settings = (
            spec["task"],
            spec["policy"],
            spec["task_config"]["steps"] or 50,
            spec["task_config"]["gamma"],
        )
        return header | {
            "fits": run_settings == ("rig.py:Rig", "linear", 50, 1.0) and not header["normaliser"]
        }

    def chunk(self, chunk: dict) -> None:
        """Do the jobs of a message, if they belong to the current round."""
        run, head = (
            chunk["run"],
            {"worker": self.id} | {name: chunk[name] for name in ("run", "incarnation", "round")},
        )
        if any(
            self.rounds.get(run, {}).get(name) != head[name] for name in ("incarnation", "round")
        ):
            self.rounds[run] = self.round(run)
        header, key = self.rounds[run], f"run/{run}/result/{self.id}"
        if chunk["schema"] != SCHEMA or any(
            header[name] != head[name] for name in ("incarnation", "round")
        ):
            return  # the round is over
        if not header["fits"]:
            self.say(
                key,
                "Failure",
                **head,
                index=None,
                error="this rig does rig.py:Rig with --policy linear alone",
            )
            return
        eps = iter(chunk["eps"])
        for at in range(0, len(chunk["table"]), 10):
            index, around, explores, rate, *signs = chunk["table"][at : at + 6]
            job = [(mu * around, next(eps) if explores else 0.0) for mu in header["mu"]]
            try:
                if rate:
                    raise RuntimeError("the rig records no trajectory")
                values = [
                    rollout([o + sign * e for o, e in job], self.clock) for sign in signs if sign
                ]
            except RuntimeError as error:
                self.say(key, "Failure", **head, index=index, error=str(error))
                self.want()  # a worker that failed gets no jobs until it asks again
                continue
            n, body = len(values), {"trajectories": [], "traces": array("<f4", [0, 0, 0], [])}
            body |= {
                "returns": array("<f8", [n], values),
                "flags": array("|b1", [n, 4], [False] * 4 * n),
            }
            self.say(
                key,
                "Results",
                **head,
                **body,
                jobs=array("<i8", [1], [index]),
                steps=array("<i8", [n], [50] * n),
            )
            print(
                f"job {index} of round {head['round']}:",
                *(f"{value:.2f}" for value in values),
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A simulated rig as a worker.")
    parser.add_argument(
        "--connect", default="tcp/127.0.0.1:7447", help="where a learner or a router listens"
    )
    parser.add_argument("--tls", type=Path, help="a folder worker-NAME of farm certificates")
    parser.add_argument(
        "--clock",
        type=float,
        default=10.0,
        help="the rig's speed, times real time; 0 does not wait",
    )
    flags, config, name = parser.parse_args(), zenoh.Config(), "rig"
    settings = {"mode": "client", "connect/endpoints": [flags.connect], "connect/timeout_ms": -1}
    settings |= {
        "connect/retry": {"period_max_ms": 1000},
        "transport/link/tls/enable_mtls": bool(flags.tls),
    }
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C also stops a pending query
    try:
        if flags.tls:
            name = json.loads((flags.tls / "identity.json").read_text())["name"]
            for key in (
                "root_ca_certificate ca",
                "connect_certificate cert",
                "connect_private_key key",
            ):
                settings[f"transport/link/tls/{key.split()[0]}"] = str(
                    flags.tls / f"{key.split()[1]}.pem"
                )
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        with zenoh.open(config) as session:
            Worker(session, name, flags.clock).serve()
    except (OSError, ValueError, KeyError, zenoh.ZError) as error:
        parser.error(f"it cannot start with these settings: {error}")
