"""One case of ``python -m benchmarks scale``, in a process so that its memory is its own."""

import json
import sys
import time
from pathlib import Path

from numpy.random import SeedSequence

from pemviz.config import ExperimentConfig, KeepName, ScenarioConfig
from pemviz.proposals.fixed import PemProposal
from pemviz.runs.experiment import build_experiment
from pemviz.runs.run_folder import record
from pemviz.sampling.problem import sample


def run_case(
    *, rollouts: int, states: int, folder: Path, keep: KeepName = "all"
) -> dict[str, float]:
    """Keep one Monte Carlo run of ``rollouts`` rollouts of ``states`` states in ``folder``.

    Returns:
        Seconds for the whole run and for its simulation, peak memory of this process and size
        of the run folder in bytes.
    """
    config = ExperimentConfig(
        method="monte-carlo",
        final_rollouts=rollouts,
        spec=f"always[0,{states - 1}] (gap >= 2.0)",
        keep=keep,
        scenario=ScenarioConfig(states=states),
    )
    experiment = build_experiment(config)
    sample(experiment.problem, proposal=PemProposal(), count=2, seeds=SeedSequence(0))  # imports
    began = time.perf_counter()
    result = record(experiment, folder)
    return {
        "run_s": time.perf_counter() - began,
        "simulation_s": result.timings_s["simulation"],
        "peak_bytes": float(peak_memory_bytes()),
        "disk_bytes": float(sum(path.stat().st_size for path in folder.iterdir())),
    }


def peak_memory_bytes() -> int:
    """Largest resident set of this process so far.

    Linux's own count of this program is read, where there is one: that of `getrusage` starts
    with what the process that started this one had.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    import resource  # noqa: PLC0415  not on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


if __name__ == "__main__":
    asked = json.loads(sys.argv[1])
    figures = run_case(
        rollouts=asked["rollouts"],
        states=asked["states"],
        keep=asked["keep"],
        folder=Path(asked["folder"]),
    )
    print(json.dumps(figures))
