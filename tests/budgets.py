"""Risk budgets and small runs for them."""

from dataclasses import replace

import pemviz
from pemviz.runs.reading import read_result
from pemviz.runs.result import RunMemory
from pemviz.runs.result_file import write_result
from pemviz.runs.run_folder import record
from pemviz.sampling.bursts.curve import CurvePoint

COUNTED = pemviz.ExperimentConfig(
    method="monte-carlo",
    final_rollouts=400,
    pem="lr",
    memory_s=0.3,
    measured_memory=False,
    plan=False,
    seed=1,
)
WEIGHED = replace(COUNTED, method="mixture", stages=3, rollouts=100, memory_s=0.1)
DOUBTED = replace(WEIGHED, method="adaptive", rollouts=40, final_rollouts=40, epochs=20)
"""By a method whose intervals are none."""
CUT_IN = replace(
    COUNTED,
    final_rollouts=200,
    encounter=pemviz.config.EncounterConfig(logical_scenario="cut-in"),
).with_rules({
    "no-collision": "always[0,90] (clearance - collided >= 0.0)",
    "safe-distance": "always[0,90] (safe_distance >= 2.0)",
})  # fmt: skip
HIGHEST = 0.3
"""Of the memories that a run may have been looked at with."""


def make_run(folder, config):
    record(pemviz.build_experiment(config), folder)
    return folder


def look_at_memories(folder, *, high=HIGHEST):
    """The run as if it had been looked at with memories of misses, up to this upper end."""
    one = read_result(folder)
    own = one.config.memory_s, one.estimate.probability
    points = tuple(
        CurvePoint(tau_s=tau_s, probability=p, low=0.9 * p, high=1.1 * p, ess=99.0)
        for tau_s, p in ((0.0, 1e-6), own, (1.0, high / 1.1))
    )
    memory = replace(one.memory or RunMemory(tau_s=0.3), curve=points)
    write_result(folder, replace(one, memory=memory))
    return folder


ENCOUNTERS = 'events = 240\nhours = 20.0\nsource = "driven"'
HARM = 'median = 0.05\nlow = 0.02\nhigh = 0.1\nsource = "accidents"'
STATED = '[hazards.violation]\nmedian = 1e-6\nlow = 5e-7\nhigh = 2e-6\nsource = "elsewhere"'


def hazard(*, name="braking", runs=(), rule=None, extra="", encounters=ENCOUNTERS, harm=HARM):
    """A hazard's table; without runs its P(violation) is stated."""
    named = ", ".join(f"'{run}'" for run in runs)
    lines = ["[[hazards]]", f"name = '{name}'", extra]
    lines += [f"runs = [{named}]"] * bool(runs)
    lines += [f"rule = '{rule}'"] * (rule is not None)
    lines += [STATED] * (not runs)
    lines += ["[hazards.encounters]", encounters, "[hazards.harm]", harm]
    return "\n".join(lines)


def write_budget(path, *hazards, accepted=1e-5):
    head = f'accepted_harm_per_hour = {accepted!r}\nsource = "the safety board"\n'
    path.write_text(head + "\n".join(hazards), encoding="utf-8")
    return path
