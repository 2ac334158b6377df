"""The files of a recording: parts that a run left behind, merged, repaired and compacted.

Rerun overwrites a file it is given, and a file whose last bytes a crash tore off cannot be read until `rerun rrd
optimize` has repaired it. So a run that goes on repairs what is there and begins a part of its own.
"""

import json
import logging
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

log = logging.getLogger(__name__)

COMPACTING: Final = 600.0
"""How long merging may take [s]; 30 MiB take about one."""


def parts(path: Path) -> list[Path]:
    """The files of a recording that are there: run.rrd, run.part2.rrd, ...; open them together."""
    further = [f for f in path.parent.glob(f"{path.stem}.part*{path.suffix}") if _number(path, f)]
    further.sort(key=lambda f: _number(path, f))
    return [path, *further] if path.exists() else further


def compact(path: Path) -> bool:
    """Merge a recording's parts into one compact file, repairing an end that a crash tore off.

    Returns:
      whether it worked; where not, every part is as it was.
    """
    found = parts(path)
    merged = path.with_name(f"{path.stem}.merging{path.suffix}")
    try:
        _optimise(found, merged)
        merged.replace(path)
        for old in found:
            if old != path:
                old.unlink()
    except (OSError, subprocess.SubprocessError) as error:
        log.warning("the recording %s stays as it is, not merged or compacted: %s", path, error)
        merged.unlink(missing_ok=True)
        return False
    return True


def _optimise(found: list[Path], merged: Path) -> None:
    command = [sys.executable, "-m", "rerun_cli", "rrd", "optimize", *map(str, found), "-o", str(merged)]
    with tempfile.TemporaryDirectory() as home:
        subprocess.run(command, env=_quiet(home), check=True, capture_output=True, timeout=COMPACTING)


def next_part(path: Path) -> Path:
    """Where a run goes on recording; what is there becomes one file first, if it can."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not parts(path):
        return path
    compact(path)
    last = max(_number(path, parts(path)[-1]), 1)
    return path.with_name(f"{path.stem}.part{last + 1}{path.suffix}")


def _number(path: Path, part: Path) -> int:
    """Which part a file is, 0 where it is none."""
    digits = part.name.removeprefix(f"{path.stem}.part").removesuffix(path.suffix)
    return int(digits) if digits.isdecimal() else 0


def _quiet(home: str) -> dict[str, str]:
    """An environment in which Rerun's command sends no usage data and writes no settings."""
    settings = Path(home, "rerun")
    settings.mkdir()
    values = {"analytics_enabled": False, "analytics_id": "none"}
    (settings / "analytics.json").write_text(json.dumps(values), encoding="utf-8")
    return {**os.environ, "HOME": home, "XDG_CONFIG_HOME": home, "RUST_LOG": "warn"}
