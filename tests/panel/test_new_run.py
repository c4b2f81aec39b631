"""What the form for a new run answers, without a browser."""

import importlib
import shlex
import sys
from contextlib import closing
from dataclasses import fields, is_dataclass, replace

import pytest

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import load_preset, preset_names, with_own_rules
from pemviz.errors import InputError
from pemviz.panel import form_checks
from pemviz.panel.arguments import Arguments
from pemviz.panel.controller import Controller
from pemviz.panel.form_fields import LONGEST, RULE, START, config_of, form_fields, typed_values
from pemviz.panel.hub import Hub
from pemviz.panel.new_run_place import Base, NewRunPlace, command
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.runs_place import RunsPlace
from pemviz.panel.site import dumps
from tests.panel.conftest import SMALL, wait_until

MINUS = "\N{MINUS SIGN}"
TINY = {"stages": "1", "rollouts": "20", "final_rollouts": "20", "max_rollouts": "60",
    "measured_memory": "false", "plan": "false"}  # fmt: skip


@pytest.fixture
def hub(tmp_path):
    with closing(Controller(tmp_path / "recordings")) as controller:
        yield Hub(controller, RecordingsFolder(tmp_path / "recordings"))


@pytest.fixture
def place(hub):
    return NewRunPlace(hub, RunsPlace(hub).run)


REGISTERED = ("faster", "lattice", "failing")


@pytest.fixture
def registered(tmp_path, monkeypatch):
    """Simulators of a package, as pip would have installed it into another folder."""
    module = """
from dataclasses import dataclass
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from tests.lattice_walk import ToySimulator
@dataclass(frozen=True)
class Faster(VectorizedSimulator):
    name: str = "faster"
def faster(scenario): return Faster(scenario)
def lattice(): return ToySimulator(states=11)
def failing(): raise ValueError("no licence")
"""
    (tmp_path / "own_simulators.py").write_text(module)
    info = tmp_path / "own_simulators-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-simulators\n")
    points = "\n".join(f"{one} = own_simulators:{one}" for one in REGISTERED)
    (info / "entry_points.txt").write_text(f"[pemviz.simulators]\n{points}\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield
    sys.modules.pop("own_simulators", None)


def ask(place, name, **asked):
    found = place.requests[name](None, Arguments(asked))
    dumps(found)  # all of it can be said
    return found


def check(place, values, *, preset="paper", whole=True):
    return ask(place, "check", preset=preset, values=values, whole=whole)


def test_every_setting_has_a_field_with_words():
    def leaves(kind, table=""):
        for one in fields(kind):
            if is_dataclass(one.default_factory):
                yield from leaves(one.default_factory, f"{table}{one.name}.")
            else:
                yield f"{table}{one.name}"

    shown = {field.key: field for field in form_fields()}
    both = {"spec", "rules"}  # are one field
    assert set(shown) == (set(leaves(ExperimentConfig)) - both) | {RULE, START}
    for field in shown.values():
        assert len(field.help) > 20, field.key
        assert field.label, field.key
    assert shown["scenario.initial_gap_m"].unit == "m"
    assert shown["pem"].open
    assert "auto" in shown["method"].choices


@pytest.mark.parametrize("name", preset_names())
def test_what_stands_in_the_fields_is_read_back_to_the_same(name):
    config = load_preset(name)
    found, wrong = config_of(ExperimentConfig(), typed_values(config))
    assert wrong == {}
    assert found == config


NONSENSE = [
    ("paper", "seed", "-1", "must be a whole number, at least 0"),
    ("paper", "seed", "", "must be a whole number"),
    ("paper", "seed", "1.5", "must be a whole number"),
    ("paper", "seed", "9" * 6000, "must be a whole number"),
    ("paper", "seed", "x" * (LONGEST + 1), "must have at most 20,000 characters"),
    ("paper", "sigma", "0", "must be a number, at least 0.95 and below 1"),
    ("paper", "sigma", "1", "below 1"),
    ("paper", "sigma", "nan", "must be a number"),
    ("paper", "sigma", "zero point nine", "must be a number"),
    ("paper", "alpha", "1.5", "must be a number, at least 0 and at most 1"),
    ("paper", "alpha", "0,1", "must be a number, at least 0 and at most 1; a comma is not"),
    ("paper", "alpha", f"{MINUS}0.1", "; in plain digits and signs"),
    ("paper", "precision", "inf", "must be a number"),
    ("paper", "precision", "0", "at least 0.001"),
    ("paper", "precision", "1000%", "at most 1"),
    ("paper", "precision", "10 % %", "must be a number"),
    ("paper", "target", "0", "above 0 and at most 1"),
    ("paper", "target", "1e-400", "above 0"),
    ("paper", "target", "1e400", "at most 1"),
    ("paper", "max_rollouts", "3,7", "a comma is not understood"),
    ("paper", "max_rollouts", "1e9", "at most 100,000,000"),
    ("paper", "max_rollouts", "100", "must be at least the 1200 that stages"),
    ("paper", "final_rollouts", "1e9", "must be at most 10000000; more take method monte-carlo"),
    ("paper", "final_rollouts", "1e300", "at most 1,000,000,000"),
    ("paper", "stages", "0", "must be a whole number, at least 1 and at most 1000"),
    ("paper", "rollouts", "ten", "must be a whole number"),
    ("paper", "rollouts", "\N{ARABIC-INDIC DIGIT FIVE}0", "in plain digits"),
    ("paper", "memory_s", "-0.2", "at least 0 and at most 60"),
    ("paper", "memory_s", "0x1", "must be a number"),
    ("paper", "frailty", "10%", "at least 0 and at most 5"),
    ("paper", "metric", "robustest", "must be one of classical, agm, smooth-cumulative"),
    ("paper", "method", "mixtur", "no such method; did you mean mixture?"),
    ("paper", "method", "", "no such method"),
    ("paper", "simulator", "matlab", "no such simulator"),
    ("paper", "pem", "", "must be the name of a shipped model or a file"),
    ("paper", "pem", "ml-n", "did you mean ml-nn?"),
    ("paper", "pem", "/dev/null", "no perception error model"),
    ("paper", "pem", __file__, "not a .safetensors or .csv file"),
    ("paper", "pem", "os:system", "would run Python code"),
    ("paper", "position_errors", "/nowhere.safetensors", "no such file"),
    ("paper", RULE, "", "formula"),
    ("paper", RULE, "always[0,99] (gap >= ", "formula, line 1"),
    ("paper", RULE, "always[0,99] (gp >= 2)", "did you mean 'gap'?"),
    ("paper", RULE, "always[0,100] (gap >= 2)", "looks 100 steps ahead"),
    ("paper", RULE, "a = gap >= 2\nb", "must be NAME=FORMULA"),
    ("paper", RULE, "a = gap >= 2\na = gap >= 1", "another rule has this name"),
    ("paper", "scenario.tracker", "4/3", "4 hits of 3 outcomes"),
    ("paper", "scenario.initial_gap_m", "10%", "above 0 and at most 200"),
    ("paper", "scenario.states", "1", "at least 2"),
    ("paper", "plan", "perhaps", "must be true or false"),
    ("paper", "carla", "here", "must be left out without simulator carla"),
    ("cut-in", START, "gap = normal(1", "must be a number, normal(MEAN, SD)"),
    ("cut-in", START, "gqp = 3", "must be one of ego_speed, gap"),
    ("cut-in", "method", "zero-variance", "has latents"),
    ("cut-in", "simulator", "merge", "must be vectorized, highway-env, sumo"),
    ("cut-in", "encounter.side", "above", "must be one of left, right"),
]  # fmt: skip


@pytest.mark.parametrize(("preset", "key", "typed", "words"), NONSENSE)
def test_nonsense_is_answered_at_its_field_and_starts_nothing(
    place, hub, preset, key, typed, words
):
    found = check(place, {key: typed}, preset=preset)
    assert set(found["wrong"]) == {key}
    assert words in found["wrong"][key]
    assert "\n" not in found["wrong"][key]
    assert found["understood"] == found["command"] == ""
    assert [one["key"] for one in found["differs"]] == [key]
    started = ask(place, "start", preset=preset, values={key: typed})
    assert set(started["wrong"]) == {key}
    assert not hub.controller.state.running
    assert not hub.recordings.names()


def test_all_that_is_wrong_is_told_at_once(place):
    found = check(place, {"seed": "x", "sigma": "2", RULE: "gap >", "pem": "none"})
    assert set(found["wrong"]) == {"seed", "sigma", RULE, "pem"}


def test_what_a_page_of_others_sends_is_refused(place):
    for values in ({"no-such": "1"}, {"seed": 1}, {"seed": None}):
        with pytest.raises(InputError):
            check(place, values)
    with pytest.raises(InputError, match="did you mean paper"):
        ask(place, "form", preset="papr")
    for begin in ({"run": "../x"}, {"run": "none"}):
        with pytest.raises(InputError):
            ask(place, "form", **begin)


def test_percentages_and_exponents_are_read_as_they_are_typed(place):
    found = check(place, {"precision": "10 %", "final_rollouts": "1e3", "target": " 1e-9 "})
    assert found["wrong"] == {}
    words = shlex.split(found["command"])[2:]
    config = parse(words).experiment
    assert (config.precision, config.final_rollouts, config.target) == (0.1, 1000, 1e-9)
    assert {one["key"]: one["after"] for one in found["differs"]}["precision"] == "10 %"


@pytest.mark.parametrize(
    ("preset", "values"),
    [
        ("paper", {}),
        ("paper", {"plan": "false", "reference": "true", "memory_s": "0.25", "seed": "7"}),
        ("paper", {RULE: "near = always[0,99] (gap >= 2)\nfast = always[0,9] (ego_speed < 20)"}),
        ("paper", {"simulator": "merge"}),
        ("merge", {"max_rollouts": "", "scenario.tracker": "none"}),
        ("cut-in", {RULE: "always[0,90] (clearance >= 0)", START: "gap = uniform(9, 10)"}),
        ("cut-in", {"encounter.neighbour": "true", "measured_memory": "false", "pem": "-x"}),
        ("town01", {"scenario.initial_gap_m": "12.5", "keep": "violations"}),
    ],
)
def test_the_command_line_said_is_that_of_the_same_run(preset, values):
    config = with_own_rules(config_of(load_preset(preset), values)[0])
    text = command(Base(preset, "", load_preset(preset), ("--preset", preset)), config)
    assert parse(shlex.split(text)[2:]).experiment == config


def test_an_absurd_size_tells_what_it_would_take(place):
    refused = check(place, {"final_rollouts": "1e9", "method": "monte-carlo"})
    assert "4,000 GB" in refused["notes"]["final_rollouts"]
    asked = {"final_rollouts": "1e9", "method": "monte-carlo", "keep": "violations"}
    allowed = check(place, asked)
    assert allowed["wrong"] == {}
    assert "1,000,000,000 rollouts take about" in allowed["notes"]["final_rollouts"]
    assert check(place, {})["notes"] == {}


def test_a_setting_that_the_method_does_not_look_at_is_told(place):
    found = check(place, {"method": "monte-carlo", "sigma": "0.96"}, whole=False)
    assert found["notes"]["sigma"].startswith("monte-carlo does not look at it")
    assert "sigma" in found["hidden"]["unused"]


def test_what_is_not_installed_is_named(place, monkeypatch):
    monkeypatch.setattr("pemviz.simulators.sumo.engine.find_spec", lambda name: None)
    form = ask(place, "form")
    missing = {one["name"]: one["missing"] for one in form["presets"] if one["missing"]}
    assert set(missing) == {"free-traffic"}
    assert "pip install 'pemviz[sumo]'" in missing["free-traffic"]
    assert set(form["missing"]) == {"sumo"}
    found = check(place, {}, preset="free-traffic")
    assert "pip install 'pemviz[sumo]'" in found["wrong"]["simulator"]


def test_a_message_about_no_field_is_told_all_the_same():
    assert form_checks.placed(InputError("something\n else")) == ("", "something else")
    assert form_checks.placed(InputError("out = 'x': no run folder"))[0] == ""
    message = "rules.near = 'gap > \\': x': formula, line 1: what: is this"
    assert form_checks.placed(InputError(message)) == (RULE, "near: formula, line 1: what: is this")


def test_a_form_that_begins_with_a_run_tells_what_differs_from_it(place, hub):
    assert hub.controller.start(SMALL)
    name = wait_until(hub.controller).run.name
    form = ask(place, "form", run=name)
    assert form["values"]["seed"] == "5"
    assert form["name"] == name
    found = ask(place, "check", run=name, values={"seed": "6"}, whole=True)
    assert [(one["label"], one["before"], one["after"]) for one in found["differs"]] == [
        ("Seed", "5", "6")
    ]
    again = parse(shlex.split(found["command"])[2:]).experiment
    assert (again.seed, again.stages, again.epochs) == (6, SMALL.stages, SMALL.epochs)


def test_start_values_that_are_taken_back_are_in_no_command_line():
    config = config_of(load_preset("cut-in"), {START: "gap = 20"})[0]
    assert command(Base("run", "", config, ("--config", "x")), load_preset("cut-in")) == ""


@pytest.mark.usefixtures("registered")
def test_a_system_that_registered_itself_can_be_chosen_with_its_own_signals(place, hub):
    (field,) = [one for one in ask(place, "form")["fields"] if one["key"] == "simulator"]
    assert set(field["choices"]) >= set(REGISTERED)
    assert "no licence" in check(place, {"simulator": "failing"})["wrong"]["simulator"]
    unfit = check(place, {"simulator": "lattice"})["wrong"]["pem"]
    assert unfit.startswith("pem = 'ml-nn' on simulator ")
    wrong = {"simulator": "faster", RULE: "always[0,99] (gp >= 2)"}
    assert "did you mean 'gap'?" in check(place, wrong)["wrong"][RULE]
    values = {"simulator": "faster", **TINY}
    found = check(place, values)
    assert found["wrong"] == {}
    assert found["facts"][RULE] == "Signals: gap [m], ego_speed [m/s], lead_speed [m/s]"
    assert "run" in ask(place, "start", preset="paper", values=values)
    state = wait_until(hub.controller)
    assert state.error is None
    assert state.run.config.simulator == "faster"


def test_a_run_of_what_is_gone_can_still_be_begun_with(hub, live_run):
    config = replace(live_run.config, method="gone", simulator="gone-too", pem="gone.safetensors")
    run = replace(live_run, result=replace(live_run.result, config=config))
    place = NewRunPlace(hub, lambda name: run)
    assert ask(place, "form", run="x")["values"]["method"] == "gone"
    found = ask(place, "check", run="x", values={}, whole=True)
    assert found["wrong"]["method"].startswith("no such method")
    assert found["wrong"]["pem"] == "gone.safetensors: no such file"
    mended = {"method": "auto", "pem": "ml-nn"}
    found = ask(place, "check", run="x", values=mended, whole=True)
    assert found["wrong"]["simulator"].startswith("no such simulator")
    assert found["understood"] == ""


def test_one_run_at_a_time(place, hub, monkeypatch):
    monkeypatch.setattr(hub.controller, "start", lambda config: False)
    assert "another run" in ask(place, "start", preset="paper", values=TINY)["wrong"][""]


SLOW = ("merge", "free-traffic")
SHIPPED = [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in preset_names()
]


@pytest.mark.parametrize("preset", SHIPPED)
def test_all_that_is_shipped_starts_and_comes_to_its_end(place, hub, preset):
    slow = {"rollouts": "4", "final_rollouts": "4", "max_rollouts": "12"}
    values = {**TINY, **(slow if preset == "merge" else {})}
    assert check(place, values, preset=preset)["wrong"] == {}
    started = ask(place, "start", preset=preset, values=values)
    state = wait_until(hub.controller, timeout_s=600.0)
    assert state.error is None
    assert started["run"] == state.run.name
    assert state.run.result.status == "done"
    assert with_own_rules(config_of(load_preset(preset), values)[0]) == state.run.config
