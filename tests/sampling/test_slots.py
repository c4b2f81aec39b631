"""Several obstacles and ghosts: every method against all joint outcomes, summed one by one."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

import pemviz
from pemviz.errors import ConfigError
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.rollout_files import load_rollouts
from pemviz.runs.run_folder import record
from pemviz.sampling.problem import sample
from pemviz.sampling.slots import slot_pem
from pemviz.sampling.zero_variance.method import with_absorbing_violation
from pemviz.sampling.zero_variance.reference import exact_log_probability
from pemviz.simulators.slots import Slot
from pemviz.types import StateBatch
from tests.faults.test_resume import stopped_and_whole
from tests.lattice_walk import ToyPem, ToySimulator
from tests.slot_toys import (
    CAMERA,
    GHOSTS,
    GhostBrake,
    LinearModel,
    TwoCars,
    exact_probability,
    joint_outcomes,
)
from tests.toy import ConstantPem

BRAKES = TwoCars(starts=(5, 6), largest=8, in_view=5, brakes_for_any=True)
GAPS = "always[0,{last}] (gap_a >= 0.5 and gap_b >= 0.5)"
SPEED = "always[0,15] (speed >= 0.5 and gap >= 0.5)"
BY_SLOT = {"car": CAMERA, "ghost": GHOSTS}


def hit(state):
    return min(state["gap_a"], state["gap_b"]) < 0.5


def stopped_or_hit(state):
    return min(state["speed"], state["gap"]) < 0.5


CASES = {
    "two cars": (TwoCars(), CAMERA, [CAMERA] * 2, hit, GAPS.format(last=20)),
    "brakes for any": (BRAKES, CAMERA, [CAMERA] * 2, hit, GAPS.format(last=20)),
    "false brake": (GhostBrake(), BY_SLOT, [CAMERA, GHOSTS], stopped_or_hit, SPEED),
}


def experiment_of(case, **settings):
    simulator, pem, _, _, spec = CASES[case]
    config = pemviz.ExperimentConfig(spec=spec, plan=False, measured_memory=False, **settings)
    return pemviz.build_experiment(config, simulator=simulator, pem=pem, twin=simulator)


def truth(case, **options):
    simulator, _, models, unsafe, _ = CASES[case]
    return exact_probability(simulator, models, unsafe, **options)


@pytest.mark.parametrize("case", CASES)
def test_the_recursion_over_turns_is_exact(case):
    experiment = experiment_of(case, method="zero-variance")
    found = exact_log_probability(experiment.problem, twin=experiment.twin)
    assert found is not None
    assert 1e-10 < truth(case) < 1e-8
    assert math.exp(found) == pytest.approx(truth(case), rel=1e-10)


@pytest.mark.parametrize("tau_s", [0.3, 2.0])
@pytest.mark.parametrize("brakes", [False, True])
def test_each_slot_remembers_its_own_outcomes(tau_s, brakes):
    """Also where a car goes out of view: what comes into view again begins anew."""
    cars = TwoCars(starts=(2, 4), largest=5, in_view=3, states=8, brakes_for_any=brakes)
    config = pemviz.ExperimentConfig(
        method="zero-variance", spec=GAPS.format(last=7), memory_s=tau_s, plan=False
    )
    experiment = pemviz.build_experiment(config, simulator=cars, pem=CAMERA, twin=cars)
    found = exact_log_probability(experiment.problem, twin=experiment.twin)
    exact = exact_probability(cars, [CAMERA] * 2, hit, tau_s=tau_s)
    assert exact > 1.5 * exact_probability(cars, [CAMERA] * 2, hit)
    assert math.exp(found) == pytest.approx(exact, rel=1e-11)


BUDGETS = {
    "mixture": {"rollouts": 200, "final_rollouts": 200, "stages": 6},
    "zero-variance": {"final_rollouts": 500},
}


@pytest.mark.parametrize("method", BUDGETS)
@pytest.mark.parametrize("case", CASES)
def test_methods_agree_with_the_recursion(case, method):
    """Within four standard errors: a false alarm with probability 6e-5 each."""
    found = pemviz.run(experiment_of(case, method=method, seed=4, **BUDGETS[method])).estimate
    assert abs(found.probability - truth(case)) < 4.0 * found.std_error, (found, truth(case))
    assert found.std_error < 0.1 * found.probability


@pytest.mark.parametrize(
    ("method", "spent"),
    [
        ("monte-carlo", {"final_rollouts": 20_000}),
        ("naive", {"final_rollouts": 20_000}),
        ("splitting", {"rollouts": 150, "stages": 6}),
        ("subset", {"rollouts": 300, "stages": 6}),
    ],
)
def test_what_learns_nothing_knows_slots_too(method, spent):
    """Absent slots cost no weight; four standard errors: a false alarm with probability 6e-5."""
    often = LinearModel(0.0, -0.1)
    cars = TwoCars(starts=(5, 6), largest=7, in_view=4, states=9)
    config = pemviz.ExperimentConfig(
        method=method, spec=GAPS.format(last=8), seed=2, plan=False, measured_memory=False, **spent
    )
    found = pemviz.run(pemviz.build_experiment(config, simulator=cars, pem=often)).estimate
    exact = exact_probability(cars, [often] * 2, hit)
    error = found.std_error or math.sqrt(exact * (1.0 - exact) / 20_000)
    assert abs(found.probability - exact) < 4.0 * error
    assert error < (0.2 if method in ("splitting", "subset") else 0.1) * exact


@dataclass(frozen=True)
class WalkWithASlot(ToySimulator):
    """The lattice walk, declared with its one slot."""

    slots = (Slot("car"),)

    def step(self, states, detected):
        return super().step(states, detected[:, 0])

    def salient(self, signals):
        return super().salient(signals)[..., None, :]

    def present(self, signals):
        return np.ones((*signals["gap"].shape, 1), dtype=np.bool_)


@pytest.mark.parametrize(
    ("method", "memory_s"),
    [("mixture", 2.0), ("adaptive", 0.0), ("naive", 0.0), ("splitting", 0.0), ("subset", 2.0)],
)
def test_one_slot_is_what_a_simulator_without_is(method, memory_s, tmp_path):
    config = pemviz.ExperimentConfig(
        method=method, spec="always[0,14] (gap >= 0.5)", rollouts=60, final_rollouts=60, stages=2,
        epochs=2, seed=3, memory_s=memory_s, plan=False,
    )  # fmt: skip
    found = []
    for name, simulator in (("with", WalkWithASlot()), ("without", ToySimulator())):
        experiment = pemviz.build_experiment(
            config, simulator=simulator, pem=ToyPem(), twin=simulator
        )
        (tmp_path / name).mkdir()
        result = record(experiment, tmp_path / name)
        explanation = replace(result.explanation, slots=()) if result.explanation else None
        found.append((result.estimate, explanation, load_rollouts(tmp_path / name)))
    (one, why, rollouts), (other, why_other, rollouts_other) = found
    assert (one, why) == (other, why_other)
    for name, values in rollouts.items():
        np.testing.assert_array_equal(values, rollouts_other[name])


@pytest.mark.parametrize("memory_s", [0.0, 0.4])
@pytest.mark.parametrize("case", CASES)
def test_folding_loses_nothing(case, memory_s):
    """To the last bit: a run that was interrupted goes on from what files hold of it."""
    experiment = experiment_of(case, method="mixture", memory_s=memory_s)
    folding, problem = experiment.folding, with_absorbing_violation(experiment.problem)
    proposal = ConstantProposal(0.6)
    drawn = sample(problem, proposal=proposal, count=50, seeds=np.random.SeedSequence(1)).rollouts
    folded = folding.folded(drawn)
    assert folded.detected.shape == (50, experiment.declared.states - 1, 2)
    assert folded.signals.keys() == {signal.name for signal in experiment.declared.signals}
    np.testing.assert_array_equal(folded.log_weight, drawn.log_weight)
    again = folding.unrolled(folded)
    for part in ("detected", "pem_logit", "proposal_logit"):
        np.testing.assert_array_equal(getattr(again, part), getattr(drawn, part))
    for part in ("signals", "memory"):
        kept, lost = getattr(again, part), getattr(drawn, part)
        assert kept.keys() == lost.keys()
        for name, values in lost.items():
            np.testing.assert_array_equal(kept[name], values, err_msg=name)
            assert kept[name].dtype == values.dtype


def test_a_run_goes_on_where_it_was_interrupted(tmp_path):
    """Every file is the same, to the last bit, as that of a run that was not interrupted."""
    settings = {"method": "mixture", "rollouts": 40, "final_rollouts": 40, "stages": 2, "seed": 1}
    experiment = experiment_of("false brake", memory_s=0.2, **settings)
    _, whole, _ = stopped_and_whole(experiment, tmp_path, 2)
    rollouts = load_rollouts(whole)
    assert rollouts["detected"].shape == rollouts["log_p"].shape == (160, 15, 2)
    assert rollouts["speed_m"].shape == (160, 16)
    assert "slot" not in rollouts
    assert "last_outcome" not in rollouts


def test_causes_are_told_by_slot_and_step():
    """Against the probability of each error given a violation, from all joint outcomes."""
    cars = TwoCars(starts=(3, 3), largest=4, in_view=3, states=6)
    config = pemviz.ExperimentConfig(
        method="zero-variance",
        spec=GAPS.format(last=5),
        final_rollouts=4_000,
        plan=False,
        measured_memory=False,
    )
    result = pemviz.run(pemviz.build_experiment(config, simulator=cars, pem=CAMERA, twin=cars))
    why = result.explanation
    assert [slot.name for slot in why.slots] == ["car a", "car b"]
    expected = errors_given_violation(cars)
    for slot, by_step in zip(why.slots, expected.T, strict=True):
        assert slot.probability_by_step == pytest.approx(by_step, abs=0.04)
        assert slot.errors == pytest.approx(by_step.sum(), rel=0.05)
    assert len(why.miss_probability_by_step) == 5
    for chain in why.chains:
        assert len(chain.slots) == len(chain.missed_steps)
        assert set(chain.slots) <= {"car a", "car b"}
        assert max(chain.missed_steps) < 5
    straight = {chain.slots: chain.missed_steps for chain in why.chains}
    assert straight["car a", "car a", "car a"] == (0, 1, 2)
    total = sum(slot.elasticity for slot in why.slots)
    assert total == pytest.approx(why.sensitivity[0].elasticity)


def errors_given_violation(cars):
    """P(error at step, slot | violation) ``[T-1, K]``, errors after it left out."""
    found, total = np.zeros((cars.states - 1, 2)), 0.0
    paths = [({"gap_a": 3.0, "gap_b": 3.0}, 1.0, ())]
    for step in range(cars.states - 1):
        after = []
        for state, chance, errors in paths:
            for chosen, probability, present in joint_outcomes(cars, state, [CAMERA] * 2):
                moved = cars.step(
                    StateBatch(np.array(step), {n: np.array([v]) for n, v in state.items()}),
                    np.array([chosen]),
                )
                reached = {name: float(values[0]) for name, values in moved.signals.items()}
                here = tuple((step, slot) for slot in (0, 1) if present[slot] and not chosen[slot])
                if hit(reached):
                    total += chance * probability
                    for place in (*errors, *here):
                        found[place] += chance * probability
                else:
                    after.append((reached, chance * probability, (*errors, *here)))
        paths = after
    return found / total


class Sideways(TwoCars):
    """One thing wrong with it, by name."""

    def __init__(self, wrong):
        super().__init__()
        object.__setattr__(self, "wrong", wrong)

    @property
    def slots(self):
        declared = {
            "none": (),
            "twice": (Slot("car"), Slot("car")),
            "unknown": (Slot("a", signals=("gap_c",)), Slot("b", signals=("gap_b",))),
            "uneven": (Slot("a", signals=("gap_a",)), Slot("b")),
            "text": ("a", "b"),
            "number": (Slot(1), Slot("b")),
            "two lines": (Slot("a\nb"), Slot("b")),
            "nominal": (Slot("a", nominal=None), Slot("b")),
            "letters": (Slot("a", signals="gap_a"), Slot("b", signals="gap_b")),
        }
        return declared.get(self.wrong, super().slots)

    def present(self, signals):
        found = super().present(signals)
        if self.wrong == "numbers":
            return found * 1.0
        if self.wrong == "nothing":
            return np.zeros_like(found)
        if self.wrong == "late" and (signals["gap_a"] < 8.0).any():
            return found[..., :1]
        return found[..., :1] if self.wrong == "present" else found

    def salient(self, signals):
        found = super().salient(signals)
        return found[..., 0] if self.wrong == "salient" else found

    def initial(self, *, count):
        start = super().initial(count=count)
        taken = {"slot_error_0": np.zeros(count)} if self.wrong == "memory" else {}
        return replace(start, memory=taken)


WRONG = {
    "none": "slots is empty: must be one at least",
    "twice": r"slots are named \['car', 'car'\]: each must have a name of its own",
    "unknown": r"slot 'a' has the signals \['gap_c'\]: must be among \['gap_a', 'gap_b'\]",
    "uneven": r"slots have \[1, 0\] signals of their own: must be as many for each",
    "text": "slots must be a tuple of pemviz.Slot",
    "number": "a slot has the name 1: must be one line of text",
    "two lines": "must be one line of text",
    "nominal": "slot 'a' has nominal = None: must be True or False",
    "letters": "slot 'a' has signals = 'gap_a': must be a tuple of names",
    "late": r"present gives shape \(\d, 1\) at step \d+: must be \(\d, 2\)",
    "numbers": r"present gives float64 of shape \(4, 2\) .* must be bool of shape \(4, 2\)",
    "nothing": "no slot is ever present",
    "present": r"present gives bool of shape \(4, 1\) .* must be bool of shape \(4, 2\)",
    "salient": r"salient gives shape \(4, 2\) .* must be \(4, 2\) and D variables",
    "memory": "the memory 'slot_error_0' is pemviz's own",
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_with_slots_is_told_in_one_line(wrong):
    config = pemviz.ExperimentConfig(method="mixture", spec=GAPS.format(last=20))
    with pytest.raises(ConfigError, match=f"simulator 'two-cars': .*{WRONG[wrong]}") as told:
        pemviz.build_experiment(config, simulator=Sideways(wrong), pem=CAMERA)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("settings", "parts", "words"),
    [
        ({"method": "adaptive"}, {}, "needs the gap"),
        ({"spec": "always[0,21] (gap_a >= 0)"}, {}, "21 states, steps 0 to 20"),
        ({"spec": "always[0,9] (slot >= 0)"}, {}, "slot"),
        ({}, {"pem": {"car a": CAMERA}}, "has models for .*'car a'.*: must be the slots"),
        ({}, {"pem": {1: CAMERA, "x": CAMERA}}, "must be the slots"),
        ({}, {"pem": {"car a": CAMERA, "car b": 3}}, "needs a method logit"),
        ({"memory_curve": True}, {}, "memory_curve = true: not with slots"),
        ({"frailty": 0.5}, {}, "frailty = 0.5: simulator .* has slots, works with frailty 0"),
        ({}, {"batch_rollouts": 0}, "batch_rollouts = 0: must be at least 1"),
        ({}, {"features": "gap"}, "features = str: has no method values and no reacts"),
    ],
)
def test_what_does_not_fit_is_told_before_the_run(settings, parts, words):
    config = pemviz.ExperimentConfig(
        **{"method": "mixture", "spec": GAPS.format(last=20), **settings}
    )
    with pytest.raises(pemviz.InputError, match=words) as told:
        pemviz.build_experiment(config, **{"simulator": TwoCars(), "pem": CAMERA, **parts})
    assert "\n" not in str(told.value)


def test_features_and_batches_of_ones_own():
    """A batch's size changes nothing; features are asked in the scenario's own steps."""

    @dataclass(frozen=True)
    class NearerCar:
        def values(self, states):
            assert states.step.max() < 20
            own = np.where(
                states.signals["slot"] == 0.0, *map(states.signals.get, ("gap_a", "gap_b"))
            )
            return own[..., None]

        def reacts(self, states):
            return states.signals["gap_a"] < 12.0

    config = pemviz.ExperimentConfig(
        method="mixture", spec=GAPS.format(last=20), rollouts=50, final_rollouts=50, stages=1
    )
    found = [
        pemviz.run(
            pemviz.build_experiment(
                config, simulator=TwoCars(), pem=CAMERA, features=NearerCar(), batch_rollouts=size
            )
        ).estimate
        for size in (40, 500)
    ]
    assert found[0] == found[1]
    assert found[0].failures > 20


def test_which_model_answers_for_which_slot_is_part_of_what_a_run_rests_on():
    """Also which slots are ghosts: a run is resumed only with the same."""
    first, second = ConstantPem(0.1, digest="11"), ConstantPem(0.2, digest="22")
    slots = [Slot("a"), Slot("b"), Slot("c")]
    models = [(first, first, first), (first, second, second), (first, first, second)]
    digests = [slot_pem(dict(zip("abc", one, strict=True)), slots).digest for one in models]
    ghost = slot_pem(first, [Slot("a"), Slot("b"), Slot("c", nominal=False)]).digest
    assert len({*digests, ghost}) == 4
    assert digests[0] == first.digest
