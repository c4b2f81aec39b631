import itertools
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.cli.sweep import ignored_notes
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import ConfigError, InputError
from pemviz.sweep.plan import Variation, make_plan, parse_variation, run_name, split_values

NAIVE = ExperimentConfig(method="naive", final_rollouts=20, seed=5)


def test_the_plan_is_the_product_of_all_values_and_seeds():
    texts = ("alpha=0.05,0.1", "metric=classical,agm", "scenario.initial_gap_m=12,15.5")
    plan = make_plan(NAIVE, [parse_variation(text) for text in texts], seeds=3)
    product = itertools.product((0.05, 0.1), ("classical", "agm"), (12.0, 15.5), (5, 6, 7))
    expected = [
        replace(
            NAIVE, alpha=alpha, metric=metric, seed=seed,
            scenario=ScenarioConfig(initial_gap_m=gap_m),
        )
        for alpha, metric, gap_m, seed in product
    ]  # fmt: skip
    assert [run.config for run in plan.runs] == expected
    assert plan.fields == ("alpha", "metric", "scenario.initial_gap_m")
    assert len({run.name for run in plan.runs}) == len(expected)
    assert plan.runs[0].setting == (
        ("alpha", 0.05), ("metric", "classical"), ("scenario.initial_gap_m", 12.0),
    )  # fmt: skip


def test_names_are_readable_and_follow_from_the_configuration_alone():
    (run,) = make_plan(NAIVE, [parse_variation("alpha=0.5")]).runs
    assert run.name == run_name(run.config, run.setting)
    assert run.name.startswith("alpha-0.5_seed-5_")
    other = run_name(replace(run.config, sigma=0.96), run.setting)
    assert other != run.name
    assert other.rpartition("_")[0] == run.name.rpartition("_")[0]


def test_a_long_formula_makes_a_name_that_file_systems_take():
    spec = "always[0,99] (gap >= 2.0 or ego_speed < 0.5 or lead_speed < 0.5)"
    plan = make_plan(NAIVE, [parse_variation(f"spec={spec},always[0,99] (gap >= 1)")])
    assert [run.config.spec for run in plan.runs] == [spec, "always[0,99] (gap >= 1)"]
    for run in plan.runs:
        assert len(run.name) < 160
        assert set(run.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_.")


def test_seeds_can_be_listed():
    plan = make_plan(NAIVE, [parse_variation("seed=1,9")])
    assert [run.config.seed for run in plan.runs] == [1, 9]
    assert plan.fields == ()
    assert {run.setting for run in plan.runs} == {()}


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("alpha=0.05, 0.1 ,1", (0.05, 0.1, 1.0)),
        ("rollouts=20,1e3", (20, 1000)),
        ("reference=true,False", (True, False)),
        ("target=none,1e-15", (None, 1e-15)),
        ("scenario.initial-gap-m=12", (12.0,)),
        ('pem="ml-nn"', ("ml-nn",)),
        ("method=naive,zero-variance", ("naive", "zero-variance")),
    ],
)
def test_values_have_their_fields_type(text, values):
    variation = parse_variation(text)
    assert variation.values == values
    assert [type(value) for value in variation.values] == [type(value) for value in values]


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("alpha", ["vary 'alpha'", "FIELD=VALUE"]),
        ("=1", ["FIELD=VALUE"]),
        ("alpha=", ["vary alpha", "empty"]),
        ("alpha=0.1,,0.2", ["vary alpha", "empty"]),
        ("alpha=0.1,0.10", ["vary alpha", "0.10 is given twice"]),
        ("alpha=two", ["vary alpha = 'two'", "at least 0 and at most 1"]),
        ("alpha=nan", ["vary alpha = nan", "at least 0"]),
        ("alpha=0.1,1.5", ["vary alpha = 1.5", "at most 1"]),
        ("rollouts=20.5", ["vary rollouts = 20.5", "a whole number"]),
        ("rollouts=1e400", ["vary rollouts = inf"]),
        ("reference=yes", ["vary reference = 'yes'", "true or false"]),
        ("metric=clasical", ["vary metric = 'clasical'", "one of classical"]),
        ("alhpa=0.1", ["vary alhpa", "did you mean alpha?"]),
        ("initial_gap=12", ["vary initial_gap", "did you mean scenario.initial_gap_m?"]),
        ("zzz=12", ["vary zzz", "allowed are method, metric"]),
        ("scenario=12", ["vary scenario", "is a table", "scenario.initial_speed_kmh"]),
        ("alpha.x=12", ["vary alpha.x"]),
        ("spec=always[0,99 (gap >= 2)", ["vary spec", "a ] is missing"]),
        ("target=0", ["vary target = 0.0", "above 0"]),
    ],
)
def test_bad_values_are_one_line(text, fragments):
    with pytest.raises(ConfigError) as caught:
        parse_variation(text)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    ("texts", "seeds", "fragments"),
    [
        (["alpha=0.1", "alpha=0.2"], 1, ["vary alpha", "given twice"]),
        (["seed=1,2"], 2, ["vary seed", "only one"]),
        (["spec=always[0,99] (speed >= 2)"], 1, ["setting spec", "speed"]),
        (["scenario.states=50"], 1, ["setting scenario.states 50", "looks 99 steps ahead"]),
        (["pem=nowhere"], 1, ["setting pem nowhere", "nowhere"]),
        (["alpha=" + ",".join(f"{i / 1000}" for i in range(1000))], 101, ["101000 runs"]),
        ([f"seed={2**63 - 1},0", "alpha=0.1,0.2"], 1, []),
    ],
)
def test_what_does_not_fit_together_is_found_before_anything_runs(texts, seeds, fragments):
    variations = [parse_variation(text) for text in texts]
    if not fragments:
        assert len(make_plan(NAIVE, variations, seeds=seeds).runs) == 4
        return
    with pytest.raises(InputError) as caught:
        make_plan(NAIVE, variations, seeds=seeds)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


def test_a_seed_beyond_the_range_is_refused():
    with pytest.raises(ConfigError, match="seed = 9223372036854775808"):
        make_plan(replace(NAIVE, seed=2**63 - 1), [], seeds=2)


@given(st.lists(st.text(st.characters(exclude_characters=',"()[]', exclude_categories=["C", "Z"]),
                        min_size=1), min_size=1))  # fmt: skip
def test_plain_values_are_split_at_commas(values):
    assert split_values(",".join(values), where="x") == values


@given(st.text(max_size=30) | st.text('alphe=.,()[]"01', max_size=12))
def test_any_text_is_a_variation_or_one_line(text):
    complaint = ""
    try:
        assert isinstance(parse_variation(text), Variation)
    except ConfigError as error:
        complaint = str(error)
    assert "\n" not in complaint


LOOKED_AT = "final_rollouts, naive_detection_probability"


@pytest.mark.parametrize(
    ("texts", "notes"),
    [
        (["alpha=0.1,0.5"], [f"alpha is varied: naive does not look at it, but at {LOOKED_AT}"]),
        (["metric=classical,agm", "naive_detection_probability=0.4,0.5", "seed=1,2"], []),
        (
            ["method=monte-carlo,adaptive", "rollouts=50,100"],
            ["rollouts is varied: monte-carlo does not look at it, but at final_rollouts"],
        ),
    ],
)
def test_varied_settings_that_a_method_does_not_look_at_are_told(texts, notes):
    plan = make_plan(NAIVE, [parse_variation(text) for text in texts])
    assert [*ignored_notes(plan)] == notes
