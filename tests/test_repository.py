"""Files for GitHub and for tools that read the repository fit the project."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import farm

ROOT = Path(__file__).parent.parent
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def read(path: str) -> Any:
    return yaml.safe_load((ROOT / path).read_text("utf-8"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_jobs_of_a_workflow_run_what_exists(path: Path) -> None:
    jobs = read(f".github/workflows/{path.name}")["jobs"]
    for job in jobs.values():
        assert set([job["needs"]] if "needs" in job else []) <= set(jobs)
        assert "steps" not in job or job["runs-on"]
        called = [job["uses"]] if "uses" in job else []
        called += [each["run"].split()[1] for each in job.get("steps", []) if "run" in each]
        assert called == [each for each in called if (ROOT / each).is_file()]


def test_only_the_jobs_that_publish_can_publish() -> None:
    workflow = read(".github/workflows/release.yml")
    assert workflow["permissions"] == {"contents": "read"}
    able = {
        name for name, job in workflow["jobs"].items() if "id-token" in job.get("permissions", {})
    }
    assert able == {"publish", "site"}, "actions/deploy-pages needs a token as well"
    assert workflow["jobs"]["publish"]["environment"] == "release"
    assert workflow["jobs"]["site"]["permissions"]["pages"] == "write"


def test_checks_before_a_commit_are_steps_of_ci() -> None:
    steps = re.sub(r'"\$work/venv/bin/(\w+)"', r"\1", (ROOT / ".ci/run").read_text("utf-8"))
    [repository] = read(".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local"
    for hook in repository["hooks"]:
        assert f'step "{hook["name"]}" {hook["entry"]}' in steps
        assert hook["language"] == "system"


def test_a_report_of_a_bug_has_version_status_and_fingerprint() -> None:
    fields = {
        each["id"]: each["attributes"]
        for each in read(".github/ISSUE_TEMPLATE/bug.yml")["body"]
        if "id" in each
    }
    assert {"version", "status", "fingerprint"} <= set(fields)
    [program] = re.findall(r'python -c "([^"]+)"', fields["fingerprint"]["description"])
    process = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd="/"
    )
    assert re.fullmatch(r"[0-9a-f]{8}\n", process.stdout)
    columns = re.findall(r"column `(\w+)`|and `(\w+)`", fields["status"]["description"])
    status = (ROOT / "farm/commands/status.py").read_text("utf-8")
    assert all(f'"{name}"' in status for pair in columns for name in pair if name)


def test_the_newest_entry_of_the_changelog_is_of_this_release() -> None:
    lines = (ROOT / "CHANGELOG.md").read_text("utf-8").splitlines()
    [version, date] = next(
        match.groups() for line in lines if (match := re.match(r"## \[(\S+)\] - (\S+)$", line))
    )
    cited = read("CITATION.cff")
    assert (version, date) == (farm.__version__, str(cited["date-released"]))
    assert len(lines) <= 150


def test_the_citation_is_of_this_project() -> None:
    cited = read("CITATION.cff")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert cited["license"] == project["license"]
    assert cited["keywords"] == project["keywords"]
    assert cited["title"].startswith(project["name"])
    assert cited["version"] == farm.__version__
    [thesis] = cited["references"]
    assert thesis["title"] in (ROOT / "docs/method.md").read_text("utf-8")
