"""Makes the sample run that ships with the project: ``python -m studies.sample_run``.

A small but complete run of the default method on the paper's scenario, so that a newcomer can
open a recording before having made one.
"""

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset
from pemviz.runs.engine import run_experiment
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import RESULT_FILE, write_result
from pemviz.runs.run_folder import RunStore

TARGET = Path(__file__).resolve().parents[1] / "recordings" / "sample"
RUN_ID = "sample"
MOST_BYTES = 2_000_000
"""Of the folder; a quarter of it are the twenty rollouts from above."""


def sample_config() -> ExperimentConfig:
    """The preset ``paper`` with fewer stages, fewer and shorter rollouts, to stay small."""
    paper = load_preset("paper")
    return replace(
        paper,
        stages=4,
        rollouts=26,
        final_rollouts=18,
        precision=1.0,
        seed=10,
        spec="always[0,69] (gap >= 2.0)",
        scenario=replace(paper.scenario, states=70),
    )


def make_sample(folder: Path) -> RunResult:
    """Run the sample's experiment into ``folder``, which exists and is empty.

    Raises:
        RunError: It failed.
    """
    from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

    observers = (Recorder(folder / "run.rrd", compacted=True), RunStore(folder))
    result = run_experiment(sample_config(), run_id=RUN_ID, observers=observers)
    _compress(folder / "rollouts.npz")
    write_result(folder, result, files=[p.name for p in folder.iterdir() if p.name != RESULT_FILE])
    return result


def replace_sample(target: Path) -> RunResult:
    """Make the sample beside ``target`` and put it in its place once it is whole.

    Raises:
        RunError: The run failed; the old sample is still there.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".sample-", dir=target.parent) as scratch:
        made = Path(scratch) / RUN_ID
        made.mkdir()
        result = make_sample(made)
        if target.exists():
            shutil.rmtree(target)
        made.rename(target)
    return result


def folder_bytes(folder: Path) -> int:
    """Size of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _compress(path: Path) -> None:
    """Rewrite an archive of arrays with compression; whoever reads it need not know."""
    with np.load(path, allow_pickle=False) as arrays:
        contents = {name: arrays[name] for name in arrays.files}
    np.savez_compressed(path, allow_pickle=False, **contents)


def main() -> int:
    """Make the sample anew and tell its size; 1 if it is too large to be committed."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET
    result = replace_sample(target)
    size = folder_bytes(target)
    failures = 0 if result.estimate is None else result.estimate.failures
    print(f"{target}: {size} bytes of at most {MOST_BYTES}, {failures} violations at the end")
    return 0 if size <= MOST_BYTES and failures else 1


if __name__ == "__main__":
    sys.exit(main())
