"""A reproduction small enough for tests."""

from dataclasses import replace

from pemviz.config.toml_files import load_preset
from pemviz.reproduce.experiments import Settings

QUICK = Settings(
    repetitions=2,
    seed=5,
    workers=1,
    monte_carlo_rollouts=(10, 40),
    naive_rollouts=(10, 30),
    least_safe_rollouts=1500,
    reference_rollouts=200,
    base=replace(
        load_preset("paper"), stages=4, rollouts=20, final_rollouts=20, epochs=3, plan=False
    ),
)
