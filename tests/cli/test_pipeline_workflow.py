"""The workflow in the page on pipelines: valid YAML, and its pemviz steps parse and run."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import xml.etree.ElementTree as Xml
from pathlib import Path

import pytest

from pemviz.cli.record_arguments import parse
from pemviz.files.shipped import asset_path
from pemviz.runs.experiment import build_experiment

yaml = pytest.importorskip("yaml", reason="pyyaml is among the test extras")

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "how-to" / "pipeline.md").read_text(encoding="utf-8")
QUICK = (
    "--method monte-carlo --final-rollouts 200 --fail-above 0.5 --no-recording --no-plan "
    "--no-measured-memory"
)


@pytest.fixture(autouse=True)
def own_model(tmp_path, monkeypatch):
    """The working folder with a detector's model where the workflow has it."""
    work = tmp_path / "work"
    (work / "models").mkdir(parents=True)
    shutil.copy(asset_path("pem", "rrc.safetensors"), work / "models" / "own.safetensors")
    monkeypatch.chdir(work)
    return work


@pytest.fixture(scope="module")
def workflow():
    blocks = re.findall(r"<!-- tested: workflow -->\n```yaml\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(blocks) == 1
    return yaml.safe_load(blocks[0])


def steps_of(workflow):
    return [step for job in workflow["jobs"].values() for step in job["steps"]]


def pemviz_scripts(workflow):
    return [step["run"] for step in steps_of(workflow) if "pemviz record" in step.get("run", "")]


def commands(script):
    """The words of each pemviz command, up to where its output goes."""
    for line in script.replace("\\\n", " ").splitlines():
        words = shlex.split(line)
        if words[:1] == ["pemviz"]:
            yield words[1 : words.index(">") if ">" in words else None]


def test_it_is_a_workflow(workflow):
    assert workflow["name"]
    # YAML 1.1 reads the key 'on' as true
    assert set(workflow[True]) == {"push", "pull_request"}
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert {"runs-on", "steps", "timeout-minutes"} <= set(job)
    for step in steps_of(workflow):
        assert ("run" in step) != ("uses" in step), step
        assert set(step) <= {"name", "run", "uses", "with", "if"}
    assert steps_of(workflow)[-1]["if"] == "always()"


def test_its_pemviz_commands_are_valid(workflow):
    found = [words for script in pemviz_scripts(workflow) for words in commands(script)]
    assert found
    for words in found:
        assert words[0] == "record"
        arguments = parse(words[1:])
        build_experiment(arguments.experiment)
        assert arguments.json
        assert arguments.limits.overall is not None
        assert str(arguments.summary) == "$GITHUB_STEP_SUMMARY"


def test_its_steps_run_and_leave_what_is_uploaded(workflow, tmp_path, own_model):
    """As a runner does it, with bash -e, but with a quick experiment."""
    program = tmp_path / "bin" / "pemviz"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pemviz "$@" {QUICK}\n')
    program.chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{program.parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "GITHUB_STEP_SUMMARY": str(tmp_path / "summary.md"),
    }
    for script in pemviz_scripts(workflow):
        done = subprocess.run(
            ["bash", "-e", "-c", script],
            cwd=own_model, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "gate passed" in done.stderr
    kept = steps_of(workflow)[-1]["with"]["path"].split()
    assert {path.name for path in own_model.iterdir()} == {"models", *kept}
    assert json.loads((own_model / "result.json").read_text())["status"] == "done"
    assert Xml.parse(own_model / "gate.xml").getroot().attrib["failures"] == "0"  # noqa: S314  ours
    assert "Gate passed" in (tmp_path / "summary.md").read_text(encoding="utf-8")
