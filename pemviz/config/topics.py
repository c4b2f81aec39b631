"""What belongs together among the settings of an experiment: for help, and for forms."""

from collections.abc import Mapping, Sequence

REST = "*"
"""Among a topic's settings: it has those that no topic names."""

TOPICS: Mapping[str, tuple[str, ...]] = {
    "question": ("preset", "config", "spec", "rule", "start", "tracker", "simulator",
                 "surrogate", "carla", "sumo_config", "encounters_per_hour"),
    "detector": ("pem", "memory_s", "assumed_memory_s", "frailty", "memory_law",
                 "varying_frailty", "varying_frailty_s", "measured_memory",
                 "memory_curve", "position_errors", "allow_python"),
    "certainty": ("precision", "max_rollouts", "max_minutes", "target", "plan", "reference",
                  "repetitions", "seed", "lost"),
    "output": ("out", "resume", "verbose", "json", "fail_above", "fail_on", "summary", "junit",
               "keep", "no_recording", "no_frames", "live"),
    "scenario": ("scenario.",),
    "encounter": ("encounter.",),
    "sumo": ("sumo.",),
    "method": (REST,),
}  # fmt: skip
"""Settings by topic, as in the configuration (``pem``), with the options of ``pemviz record`` that
are none; a name that ends with a dot stands for a table of them."""


def topic_of(name: str, topics: Mapping[str, Sequence[str]] = TOPICS) -> str | None:
    """The topic that a setting belongs to; ``None`` if no topic has it, nor the rest."""
    for topic, names in topics.items():
        if any(name == one or (one.endswith(".") and name.startswith(one)) for one in names):
            return topic
    return next((topic for topic, names in topics.items() if REST in names), None)
