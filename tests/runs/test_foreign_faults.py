"""Whatever a user's code raises in a run of a program, the run has failed, and can go on."""

import json
import signal
import threading
from dataclasses import dataclass, replace

import pytest

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import InputError, RunError
from pemviz.panel.controller import Controller
from pemviz.runs.engine import run
from pemviz.runs.events import RunDone, RunFailed, StageDone
from pemviz.runs.experiment import build_experiment
from pemviz.runs.run_folder import record
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from tests.faults.test_resume import contents, folder_of
from tests.panel.test_controller import wait_until
from tests.runs.test_engine import Listener
from tests.toy import FunctionPem

SMALL = ExperimentConfig(
    method="mixture", stages=2, rollouts=40, final_rollouts=40, seed=4, plan=False, repetitions=2,
    scenario=ScenarioConfig(states=40), spec="always[0,39] (gap >= 9.0)", measured_memory=False,
)  # fmt: skip


class Odd(BaseException):
    """What nobody expects."""


FAULTS = {
    "exit 0": SystemExit(0),
    "exit 1": SystemExit(1),
    "interrupt": KeyboardInterrupt(),
    "odd": Odd("neither"),
    "end": GeneratorExit(),
    "error": ValueError("wheel fell off"),
}


@dataclass(frozen=True)
class Car(VectorizedSimulator):
    """The scenario, which does ``fault`` at step 30 of the so many-th large batch."""

    @property
    def name(self):
        return "car"

    def step(self, states, detected):
        if states.shape[0] > 30 and int(states.step) == 30:
            self.fault()
        return super().step(states, detected)

    def fault(self):
        """None yet."""


def faulty(fault, *, after=0):
    calls = []

    class Faulty(Car):
        def fault(self):
            calls.append(0)
            if len(calls) > after:
                raise fault

    return Faulty(SMALL.scenario)


def unpresentable(name):
    def leave(*_):
        raise SystemExit(0)

    looked_at = leave if name == "__getattribute__" else property(leave)
    return type("Unpresentable", (Exception,), {name: looked_at})()


@pytest.mark.parametrize("name", ["__notes__", "__cause__", "__getattribute__", "__traceback__"])
def test_an_error_that_leaves_when_it_is_looked_at_fails_the_run(name):
    fault = unpresentable(name)
    with pytest.raises(RunError, match="Unpresentable that cannot be looked at"):
        run(build_experiment(SMALL, simulator=faulty(fault, after=5)))


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("limit_s", [None, 600.0])
def test_whatever_a_simulator_raises_fails_the_run(fault, limit_s):
    listener = Listener()
    experiment = build_experiment(SMALL, simulator=faulty(fault, after=5))
    problem = replace(experiment.problem, step_time_limit_s=limit_s)
    with pytest.raises(RunError) as caught:
        run(replace(experiment, problem=problem), observers=[listener])
    told = listener.events[-1]
    assert isinstance(told, RunFailed)
    assert told.message == told.result.message == str(caught.value)
    assert told.result.status == "failed"
    kind = type(fault).__name__
    where = f"simulator car: step raises {kind} in rollouts 0 to 39, step 30"
    assert told.message.startswith(f"{where} (stage 1, repetition 2 of 2)")
    assert caught.value.__cause__ is fault
    assert "in fault" in caught.value.traceback_text
    assert "pemviz" not in caught.value.traceback_text.split("in step")[0].split("File")[0]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What a run leaves in which nothing fails."""
    folder = folder_of(tmp_path_factory.mktemp("undisturbed"), "whole")
    record(build_experiment(SMALL, simulator=Car(SMALL.scenario)), folder)
    return contents(folder)


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_once_the_fault_is_gone_the_run_goes_on_to_the_same_bytes(fault, whole, tmp_path):
    parts = folder_of(tmp_path, "parts")
    with pytest.raises(RunError, match=type(fault).__name__):
        record(build_experiment(SMALL, simulator=faulty(fault, after=4)), parts)
    assert json.loads((parts / "result.json").read_text())["status"] == "failed"
    record(build_experiment(SMALL, simulator=Car(SMALL.scenario)), parts)
    assert contents(parts) == whole


def test_the_same_in_another_thread():
    """Where no signal ever arrives."""
    found = []

    def work():
        try:
            run(build_experiment(SMALL, simulator=faulty(KeyboardInterrupt())))
        except BaseException as error:
            found.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert isinstance(found[0], RunError)


@pytest.mark.parametrize("when", ["init", "step", "is_done", "estimate"])
def test_a_method_of_another_package_may_raise_anything(when):
    experiment = build_experiment(SMALL)

    class Broken:
        name, stages = "broken", 1

        def __getattr__(self, name):
            if name == when:
                raise SystemExit(0)
            return getattr(experiment.method, name)

    listener = Listener()
    with pytest.raises(RunError, match=r"^SystemExit: 0") as caught:
        run(replace(experiment, method=Broken()), observers=[listener])
    assert isinstance(listener.events[-1], RunFailed)
    assert isinstance(caught.value.__cause__, SystemExit)
    assert ("(stage 0" in str(caught.value)) == (when == "step")


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("limit_s", [None, 600.0])
def test_a_signal_stops_the_run_as_ever(limit_s):
    class Interrupting(Car):
        def fault(self):
            signal.raise_signal(signal.SIGINT)

    listener, before = Listener(), signal.getsignal(signal.SIGINT)
    experiment = build_experiment(SMALL, simulator=Interrupting(SMALL.scenario))
    problem = replace(experiment.problem, step_time_limit_s=limit_s)
    with pytest.raises(KeyboardInterrupt):
        run(replace(experiment, problem=problem), observers=[listener])
    assert isinstance(listener.events[-1], RunDone)
    assert listener.events[-1].result.status == "stopped"
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("ctrl_c")
def test_what_a_signal_was_turned_into_is_the_signals():
    class Leaves(Car):
        def fault(self):
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise SystemExit(0) from None

    experiment = build_experiment(SMALL, simulator=Leaves(SMALL.scenario))
    problem = replace(experiment.problem, step_time_limit_s=None)
    with pytest.raises(KeyboardInterrupt):
        run(replace(experiment, problem=problem))


@pytest.mark.parametrize("event", [StageDone, RunDone])
def test_an_observer_that_exits_fails_the_run(event):
    class Exits:
        def notify(self, told):
            if isinstance(told, event):
                raise SystemExit(0)

    with pytest.raises(RunError, match="an observer raises SystemExit: 0"):
        run(build_experiment(SMALL), observers=[Exits()])


@pytest.mark.parametrize("what", ["name", "step", "latents"])
def test_an_exit_while_an_experiment_is_built_is_bad_input(what):
    class Exits(Car):
        def __getattribute__(self, name):
            if name == what and not object.__getattribute__(self, "__class__").quiet:
                raise SystemExit(0)
            return super().__getattribute__(name)

    Exits.quiet = True
    simulator = Exits(SMALL.scenario)
    Exits.quiet = False
    with pytest.raises(InputError, match="SystemExit: 0"):
        build_experiment(SMALL, simulator=simulator)
    with pytest.raises(InputError, match="SystemExit: 0"):
        build_experiment(SMALL, pem=FunctionPem(lambda salient: exec("raise SystemExit(0)")))  # noqa: S102  in a lambda


def test_the_panel_outlives_an_exit(tmp_path, monkeypatch):
    """Its worker tells what happened and takes the next run."""
    monkeypatch.setattr(
        "pemviz.simulators.braking.vectorized.VectorizedSimulator.salient", _exits, raising=True
    )
    controller = Controller(tmp_path)
    try:
        controller.start(SMALL)
        assert "SystemExit: 0" in wait_until(controller).error
        monkeypatch.undo()
        controller.start(SMALL)
        assert wait_until(controller).error is None
    finally:
        controller.close()


def _exits(*_):
    raise SystemExit(0)
