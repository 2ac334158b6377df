"""The tasks that a worker has built, one runner per specification; code that a learner sent runs
in processes.
"""

import hashlib
import logging
from collections import OrderedDict
from typing import Final, TypeAlias

from farm import plugins
from farm.building import built
from farm.errors import FarmError, described
from farm.net import codec, keys
from farm.net.messages import Spec
from farm.net.notices import Notices
from farm.net.work import RoundHeader
from farm.runner import Runner
from farm.runner_process import Begin
from farm.sim.interfaces import Backend
from farm.subprocess_runner import RunnerProcess, SubprocessRunner
from workers.config import WorkerConfig
from workers.queries import Queries
from workers.source_cache import SourceCache

log = logging.getLogger(__name__)

_FETCH: Final = 10.0  # [s] for a source, up to 1 MB
_FETCH_ASSET: Final = 60.0  # [s] for a file that a model reads, up to 32 MiB
_KEEP: Final = 32  # built tasks that are kept: this many learners can share a worker
_PROCESSES: Final = 8  # that execute received code; about 80 MB each

AnyRunner: TypeAlias = Runner | SubprocessRunner


class Runners:
    """Runners by the digest of their specification; the newest are kept."""

    def __init__(
        self, config: WorkerConfig, backend: Backend, queries: Queries, notices: Notices
    ) -> None:
        """Start without runners; `config` says which code they may run."""
        self._config = config
        self._backend = backend
        self._queries = queries
        self._notices = notices
        self._built: OrderedDict[str, AnyRunner | Exception] = OrderedDict()
        self._sources = SourceCache()
        # Started in advance: imports take half a second.
        self._spare = RunnerProcess(self._sources.empty) if config.accept_code else None

    def of(self, header: RoundHeader) -> AnyRunner | Exception | None:
        """A run's runner, built once; an exception if that failed; None if specification or code
        are unavailable.
        """
        if header.spec not in self._built:
            payload = self._queries.ask(header.run, keys.spec(self._config.farm, header.run))
            if payload is None or hashlib.sha256(payload).hexdigest() != header.spec:
                self._notices.once(
                    f"run {header.run} does not send its specification; its jobs wait"
                )
                return None
            try:
                runner = self._build(header.run, codec.decode(payload, Spec))
                if runner is None:
                    return None
                self._built[header.spec] = runner
                log.info("serving run %s", header.run)
            # The error says something about this machine, and nothing about the jobs
            except Exception as error:
                defect = error if is_defect(error) else None
                self._notices.once(
                    f"cannot serve run {header.run}:"
                    f" {error if isinstance(error, FarmError) else described(error)}",
                    level=logging.ERROR,
                    error=defect,
                )
                self._built[header.spec] = error
            self._let_go()
        self._built.move_to_end(header.spec)
        return self._built[header.spec]

    def unserved(self, header: RoundHeader, error: Exception) -> None:
        """A run turned out not to be served here: close its runner, and keep the reason."""
        self._close(self._built[header.spec])
        self._built[header.spec] = error

    def left(self, header: RoundHeader) -> None:
        """A learner left: end its process, which is started again if it comes back."""
        runner = self._built.get(header.spec)
        if isinstance(runner, SubprocessRunner):
            runner.close()
            del self._built[header.spec]

    def close(self) -> None:
        """Stop the processes that execute received code, and delete the code."""
        for runner in self._built.values():
            self._close(runner)
        if self._spare is not None:
            self._spare.close()
        self._sources.close()

    def _close(self, runner: AnyRunner | Exception) -> None:
        if not isinstance(runner, Exception):
            runner.close()

    def _let_go(self) -> None:
        """Keep only the newest runners, and fewer of those that are processes."""
        processes = [
            digest for digest, each in self._built.items() if isinstance(each, SubprocessRunner)
        ]
        for digest in {*processes[:-_PROCESSES], *list(self._built)[:-_KEEP]}:
            self._close(self._built.pop(digest))

    def _build(self, run: str, spec: Spec) -> AnyRunner | None:
        """The runner of a run's jobs; None if a source file is unavailable."""
        files = list(self._config.allow_file)
        here = {(path.name, plugins.file_digest(path)) for path in files}
        sources = {
            (plugins.named_file(spec.task), spec.code.get("task", "")),
            (plugins.named_file(spec.policy), spec.code.get("policy", "")),
        }
        travels = sorted((name, digest) for name, digest in sources - here if name)
        contents = self._assets(run, spec)
        if contents is None:
            return None
        if not (travels and self._config.accept_code):
            return built(spec, self._config.allow_file, contents, self._backend)
        for name, digest in travels:
            path = self._sources.place(name, digest)
            if not path.is_file():
                source = self._queries.ask(run, keys.code(self._config.farm, run, digest), _FETCH)
                if source is None:
                    self._notices.once(
                        f"run {run} does not send the source of {name}; its jobs wait"
                    )
                    return None
                self._sources.keep(name, digest, source)
            files.insert(0, path)
            log.info(
                "run %s: received %s (SHA-256 %s) from its learner; a separate process runs it",
                run,
                name,
                digest,
            )
        assets = str(self._sources.assets) if spec.assets else ""
        begin = Begin(
            spec=spec, files=tuple(map(str, files)), assets=assets, backend=self._config.backend
        )
        process, self._spare = self._spare, None
        try:
            return SubprocessRunner(begin, self._sources.empty, process)
        finally:
            self._spare = RunnerProcess(self._sources.empty)

    def _assets(self, run: str, spec: Spec) -> dict[str, bytes] | None:
        """Contents of a run's files by digest, each fetched once; None if one is unavailable."""
        for name, digest in spec.assets.items():
            if not (self._sources.assets / digest).is_file():
                content = self._queries.ask(
                    run, keys.asset(self._config.farm, run, digest), _FETCH_ASSET
                )
                if content is None:
                    self._notices.once(f"run {run} does not send {name}; its jobs wait")
                    return None
                self._sources.keep_asset(digest, content)
        return {
            digest: (self._sources.assets / digest).read_bytes() for digest in spec.assets.values()
        }


def is_defect(error: Exception) -> bool:
    """Whether an error is a defect of the farm: others are in the author's code, and its learner
    shows where.
    """
    return not isinstance(error, FarmError) and not plugins.author_traceback(error)
