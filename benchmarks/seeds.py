"""Tests how reliably a preset learns: runs with several seeds, one table (results: docs/results/seeds.md).

    python benchmarks/seeds.py [--preset default] [--seeds 10] [--out runs/seeds-default]

An existing run is not repeated; an interrupted one is resumed.
"""

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

SOLVED = 0.8  # robust success from which a run counts as learnt


def main() -> None:
    """Learn, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    out = arguments.out or Path(f"runs/seeds-{arguments.preset}")
    rows = [_run(out, arguments.preset, seed) for seed in range(arguments.seeds)]
    print("| seed | return, first mean policy | return, last | success | robust success | first success | seconds |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['seed']} | {row['first']:.2f} | {row['mean_policy_return']:.3f} "
            f"| {'yes' if row['mean_policy_success'] else 'no'} | {row['robust_success_rate']:.0%} "
            f"| {row['since'] or '-'} | {row['seconds']:.0f} |"
        )
    learnt = sum(row["mean_policy_success"] and row["robust_success_rate"] >= SOLVED for row in rows)
    print(f"\n{learnt} of {len(rows)} learnt the gait (mean policy succeeds, robust success at least {SOLVED:.0%}).")


def _run(out: Path, preset: str, seed: int) -> dict[str, Any]:
    folder = out / f"s{seed}"
    summary = folder / "summary.json"
    if not summary.exists() or json.loads(summary.read_text())["state"] != "finished":
        words = ["--resume", str(folder)] if folder.exists() else ["--preset", preset, "--seed", str(seed)]
        name = [] if folder.exists() else ["--out", str(out), "--name", f"s{seed}"]
        command = [sys.executable, "-m", "farm", "run", *words, *name, "--no-record"]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            try:
                process.wait()
            except KeyboardInterrupt:
                process.terminate()
                process.wait()  # it saves the run, which the same command then resumes
                raise
        if process.returncode:
            sys.exit(f"{shlex.join(command)} ended with status {process.returncode}")
    progress = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    since = next((line["generation"] for line in progress if line["mean_policy_success"]), None)
    return {**json.loads(summary.read_text()), "first": progress[0]["mean_policy_return"], "since": since}


if __name__ == "__main__":
    from running import script

    script(main)
