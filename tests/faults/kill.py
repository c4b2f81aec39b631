"""Kill runs at random moments, resume them, and compare them with one that nobody disturbed.

    python -m tests.faults.kill --count 50

Every case is ``pemviz record`` in a process of its own, killed with SIGKILL once to three times
at moments drawn from the length of an undisturbed run. After every kill, what the folder shows
must be whole and a part of the undisturbed run; in the end it must be the same, bytes where
there are bytes. Prints what was checked; exit code 1 if a case failed.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

# What commands import when they are called is imported here, once, before the processes fork.
import torch  # noqa: F401
from safetensors.numpy import load_file

import pemviz.cli.record_run  # noqa: F401
from pemviz.cli import record
from pemviz.runs.rollout_files import load_rollouts
from tests.comparable_results import comparable_result

CONFIG = """\
method = "adaptive"
stages = 6
rollouts = 60
final_rollouts = 80
measured_memory = false
epochs = 60
repetitions = 2
seed = 5
"""


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(words)
    generator = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        (root / "config.toml").write_text(CONFIG)
        began = time.monotonic()
        whole = undisturbed(root)
        length_s = time.monotonic() - began
        expected = contents(whole)
        kills = 0
        for case in range(arguments.count):
            kills += carry_out(root, case, expected, length_s, generator)
            if sys.stdout.isatty():
                print(f"{case + 1} of {arguments.count}", end="\r", flush=True)
    print(f"{arguments.count} of {arguments.count} runs, killed {kills} times, ended the same")
    return 0


def undisturbed(root: Path) -> Path:
    out = root / "whole"
    process = start(["--config", str(root / "config.toml"), "--out", str(out)])
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 0
    return next(path for path in out.iterdir() if path.is_dir())


def carry_out(
    root: Path, case: int, expected: dict, length_s: float, generator: np.random.Generator
) -> int:
    """One case; returns how often its process was killed before it was done."""
    out = root / f"case-{case}"
    kills = 0
    for _ in range(int(generator.integers(1, 4))):
        process = start(words_for(out, root))
        time.sleep(generator.uniform(0.0, length_s))
        os.kill(process, signal.SIGKILL)
        kills += os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == -signal.SIGKILL
        for folder in run_folders(out):
            check_partial(folder, expected)
    process = start(words_for(out, root))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    assert code == 0, f"case {case}: resuming ended with exit code {code}"
    (folder,) = run_folders(out)
    assert contents(folder) == expected, f"case {case}: {folder} differs from the undisturbed run"
    assert not (folder / "stages").exists()
    assert list(folder.glob(".*partial")) == []
    return kills


def words_for(out: Path, root: Path) -> list[str]:
    """Resume the run if there is one to resume, as a person would; else begin."""
    for folder in run_folders(out):
        if (folder / "config.toml").exists():
            return ["--resume", str(folder)]
        folder.rmdir() if not any(folder.iterdir()) else remove_lock(folder)
    return ["--config", str(root / "config.toml"), "--out", str(out)]


def remove_lock(folder: Path) -> None:
    """A folder killed before its config was written holds at most partial files."""
    for path in folder.iterdir():
        assert path.name.startswith("."), path
        path.unlink()
    folder.rmdir()


def run_folders(out: Path) -> list[Path]:
    return sorted(path for path in out.iterdir() if path.is_dir()) if out.is_dir() else []


def start(words: Sequence[str]) -> int:
    """``pemviz record`` in a forked process: what it imports is there already."""
    process = os.fork()
    if process:
        return process
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    log = os.open(os.environ.get("PEMVIZ_KILL_LOG", os.devnull), os.O_WRONLY | os.O_APPEND)
    os.dup2(log, 2)
    code = 70
    try:
        code = record.run([*words, "--no-frames"])
    finally:
        os._exit(code)


def contents(folder: Path) -> dict:
    document = comparable_result(folder)
    del document["run_id"]
    files = ("config.toml", "rollouts.npz", "proposals.safetensors")
    return {"result": document, **{name: (folder / name).read_bytes() for name in files}}


def check_partial(folder: Path, expected: dict) -> None:
    """What a killed run shows is whole, and the beginning of the undisturbed run."""
    if (folder / "config.toml").exists():
        assert (folder / "config.toml").read_bytes() == expected["config.toml"]
    if (folder / "result.json").exists():
        document = json.loads((folder / "result.json").read_text())
        stages = document["stages"]
        assert stages == expected["result"]["stages"][: len(stages)]
        repetitions = document["repetitions"]
        assert repetitions == expected["result"]["repetitions"][: len(repetitions)]
        assert (document["status"] == "done") <= (len(stages) == 16)
    if (folder / "proposals.safetensors").exists():
        load_file(folder / "proposals.safetensors")
    parts = list((folder / "stages").glob("repetition-*.npz"))
    if not parts and not (folder / "rollouts.npz").exists():
        return
    count = len(load_rollouts(folder)["stage"])
    assert count in np.cumsum([60] * 7 + [80] + [60] * 7 + [80])


if __name__ == "__main__":
    sys.exit(main())
