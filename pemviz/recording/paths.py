"""Every entity path and timeline of a recording; the only place where they are spelled out.

Timelines: ``stage`` (the learning stage), ``step`` (the step in a rollout) and ``sim_time``
(the same in seconds). What belongs to a stage as a whole is on all three, at step 0, so that
it shows whichever is chosen; text is static.
"""

STAGE = "stage"
STEP = "step"
SIM_TIME = "sim_time"

ANSWER = "/answer/summary"
STRIP = "/answer/in_short"
WARNINGS = "/answer/warnings"
UNCERTAINTY = "/answer/uncertainty"
REPETITIONS = "/answer/repetitions"

CONFIG = "/config/config_toml"
RESULT = "/config/result_json"
PROVENANCE = "/config/provenance"
CONTENTS = "/config/about_this_recording"

STAGE_TABLE = "/learning/table"
PROPOSALS = "/learning/proposals"
PEM_CURVE = "/learning/proposals/error_model"
NEWEST_CURVE = "/learning/proposals/newest"
ESTIMATES = "/learning/by_stage/estimate"
ROBUSTNESS = "/learning/robustness"
FIGURES = (
    "threshold",
    "failures",
    "ess",
    "loss",
    "log10_probability",
    "log10_ci_low",
    "log10_ci_high",
)

PEM_SERIES = "p_detected_pem"
PROPOSAL_SERIES = "p_detected_proposal"
DETECTED = "detected"
MISSED_SHARE = "missed_share"
TABLE = "table"

WORST_SUMMARY = "/worst_case/summary"
SCENE = "/worst_case/scene"
OUTCOMES = "/worst_case/outcomes"
WORST_DETECTION = "/worst_case/p_detected"
WORST_NOISE = "/worst_case/random_by_step"
FRAMES = "/worst_case/film"

SUBTREE = "/**"  # in a view: the entity and all below it


SWEEP_SUMMARY = "/sweep/summary"
SWEEP_RUNS = "/sweep/runs"
SWEEP_SETTINGS = "/sweep/settings"
SWEEP_ESTIMATES = "/sweep/estimates"


def part(plot: str, name: str) -> str:
    """A part of what is drawn at a path: ``axes``, ``values``, ``answer``, ``legend``."""
    return f"{plot}/{name}"


def figure(name: str) -> str:
    """A stage figure as a scalar on ``stage``."""
    return f"/learning/figures/{name}"


def by_stage(name: str) -> str:
    """A stage figure drawn against the stages done so far."""
    return f"/learning/by_stage/{name}"


def stage_curve(stage: int) -> str:
    """The proposal that a stage sampled from, against gap."""
    return f"/learning/proposals/stage_{stage:03d}"


def rollouts(stage: int, part: str) -> str:
    """A part (a signal's key, or one of the names above) of a stage's rollouts."""
    return f"/rollouts/stage_{stage:03d}/{part}"


def lane(rank: int, part: str) -> str:
    """A part of the scene's lane for the ``rank``-th least robust rollout, from 1."""
    return f"/worst_case/scene/rank_{rank}/{part}"


def road_car(rank: int, car: int) -> str:
    """A car of the scene's ``rank``-th rollout, from 1; the ego is car 0."""
    return lane(rank, f"car_{car}")


def plan(rank: int) -> str:
    """The ``rank``-th least robust rollout from above, from 1."""
    return f"/worst_case/from_above/rank_{rank:02d}"


def plan_road(rank: int) -> str:
    """The road below it."""
    return f"{plan(rank)}/road"


def outcomes(rank: int) -> str:
    """Detected or missed at each step of the ``rank``-th least robust rollout, from 1."""
    return f"/worst_case/outcomes/rank_{rank:02d}"


def worst_series(part: str) -> str:
    """A signal of the least robust rollouts, by its key."""
    return f"/worst_case/series/{part}"


def page(name: str, part: str) -> str:
    """A part (``text``, ``picture``, ``series``) of a page; see :mod:`pemviz.recording.pages`."""
    return f"/pages/{name}/{part}"


def sweep_estimates(part: str) -> str:
    """A part of the plot of all estimates: ``grid``, ``settings``, ``intervals``, ``points``."""
    return f"{SWEEP_ESTIMATES}/{part}"
