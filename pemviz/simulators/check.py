"""Whether a simulator of somebody else's keeps to the protocol, tried before a run starts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.latents import StandardNormals
from pemviz.simulators.check_declared import (
    Complaint,
    check_counts,
    check_facts,
    check_kept,
    check_scene,
    check_sight,
    check_slots,
    check_starts,
)
from pemviz.simulators.episodic import episodic, kept_memory
from pemviz.simulators.latents import begun, latent_counts, stepped
from pemviz.simulators.own_randomness import drawn_alike, fixed_randomness
from pemviz.simulators.slots import SlotSimulator
from pemviz.simulators.tracking.tracker import tracker_of
from pemviz.types import Simulator, StateBatch, tells_violation

AnySimulator: TypeAlias = Simulator | SlotSimulator

MEMBERS = ("name", "states", "dt_s", "signals", "initial", "step", "salient")
ROUNDING = 1e-9
"""Of a signal's range: what a value may differ by when it is computed beside others."""
ALL_MISSED, ALL_DETECTED, MIXED, MIXED_AGAIN = range(4)
COUNT = 4
ONE = slice(MIXED, MIXED + 1)
DECLARE = "what is random about it is declared: latents = pemviz.LatentCounts(start=1)"
RANDOM = (
    "the answer would be for this one course of them; declare them as latents (of a gymnasium "
    "adapter: seed=None), or state fixed_randomness = True if that is meant"
)
COMPLETE = "; all that decides how a rollout goes on must be in signals and memory"
TRIED = 4
"""Rollouts by which it is found out whether latents make a difference."""


def check_simulator(simulator: AnySimulator) -> None:
    """Try the simulator on whole rollouts: missed, detected, and mixed outcomes twice.

    They are carried to the end three times: together; together in reverse order; and one of
    them alone, from the start and from a state that was kept in the middle. All must agree,
    since methods continue from kept states, and results must not depend on batches.
    Where slots are declared, "missed" is an error in every slot, and now and then in one alone.
    Where latents are, each rollout has its own, but for the two with the same outcomes.
    Episodes, which cannot be gone on with, are tried twice with the same mixed outcomes.
    Whether random numbers are the same in every rollout is tried with other seeds.

    Raises:
        ConfigError: One line: what is missing, of the wrong shape, not pure, or random.
    """
    if isinstance(simulator, type):
        name = simulator.__name__
        message = f"simulator: {name} is a class: give an instance of it, such as {name}()"
        raise ConfigError(message)
    members = (*MEMBERS, "present") if hasattr(simulator, "slots") else MEMBERS
    absent = [member for member in members if not hasattr(simulator, member)]
    if absent:
        kind = type(simulator).__name__
        message = f"simulator: {kind} is no pemviz.Simulator, it lacks {', '.join(absent)}"
        raise ConfigError(message)
    complaint = Complaint(f"simulator {simulator.name!r}")
    check_facts(simulator, complaint)
    check_counts(simulator, complaint)
    check_starts(simulator, complaint)
    if isinstance(simulator, SlotSimulator):
        check_slots(simulator, complaint)
    trial = _Trial(simulator, complaint)
    if episodic(simulator) is not None:
        trial.check_episodes()
        trial.check_own_randomness()
        return
    trial.check_start()
    start = trial.begun(trial.latents)
    trial.check_tracks(start)
    if isinstance(simulator, SlotSimulator):
        check_kept(start, complaint)
        check_sight(simulator, start, complaint)
    course = trial.course(start)
    if isinstance(simulator, SlotSimulator):
        trial.check_ever_present(simulator, course)
    else:
        trial.check_salient(simulator, course[1].signals)
    for states in (start, course[-1]):
        check_scene(simulator, states, complaint)
    trial.check_equal(course)
    trial.check_order(course)
    trial.check_continued(course)
    trial.check_own_randomness()


def _shown(states: StateBatch) -> StateBatch:
    """What a state shows, and where episodes are in one: that is another each time."""
    return replace(states, memory=dict(kept_memory(states.memory)))


class _Trial:
    """A simulator with the outcomes ``[COUNT, T-1]`` and latents that it is tried with."""

    def __init__(self, simulator: AnySimulator, complaint: Complaint) -> None:
        self.simulator, self.complaint = simulator, complaint
        self.steps = simulator.states - 1
        self.outcomes = np.zeros((COUNT, self.steps), dtype=np.bool_)
        self.outcomes[ALL_DETECTED] = True
        self.outcomes[MIXED] = np.random.default_rng(0).random(self.steps) < 0.5
        self.outcomes[MIXED_AGAIN] = self.outcomes[MIXED]
        counts, generator = latent_counts(simulator), np.random.default_rng(0)
        normals = StandardNormals(
            start=generator.standard_normal((COUNT, counts.at_start)),
            noise=generator.standard_normal((COUNT, self.steps, counts.noise)),
            choice=np.zeros((COUNT, self.steps)),
        )
        self.latents = normals.take(np.array([*range(COUNT - 1), MIXED]))  # the last two the same

    def begun(self, latents: StandardNormals) -> StateBatch:
        count, start = len(latents.start), latents.start.copy()
        return self.complaint.call(
            "initial", lambda: begun(self.simulator, count=count, start=start)
        )

    def stepped(self, states: StateBatch, detected: BoolArray, noise: FloatArray) -> StateBatch:
        simulator, given, by_slot = self.simulator, noise.copy(), detected.copy()
        if isinstance(simulator, SlotSimulator):
            by_slot = self.complaint.call("present", _by_slot, simulator, states, detected)
        return self.complaint.call("step", stepped, simulator, states, by_slot, given)

    def course(self, start: StateBatch) -> list[StateBatch]:
        """The states ``[COUNT]`` at every step; ``step`` leaves those that it is given alone."""
        course = [start]
        for step in range(self.steps):
            before = course[-1].map(np.array)
            noise = self.latents.noise[:, step]
            course.append(self.stepped(course[-1], self.outcomes[:, step], noise))
            self.check_states(course[-1], "step", step=step + 1)
            if self.difference(course[-2], before):
                self.complaint.refuse(
                    "step writes to the states it is given; it must return new ones"
                )
        return course

    def check_start(self) -> None:
        """With the same latents, or none, every rollout starts in the same state, every time."""
        latents = self.latents.take(np.zeros(COUNT, dtype=np.int64))
        start = self.begun(latents)
        self.check_states(start, f"initial(count={COUNT})", step=0)
        for row in range(1, COUNT):
            other = self.difference(_row(start, 0), _row(start, row))
            if other:
                self.complaint.refuse(
                    f"initial gives rollouts that start differently ({other}); every "
                    f"rollout must start in the same state; {DECLARE}"
                )
        other = self.difference(start, self.begun(latents))
        if other:
            self.complaint.refuse(f"initial gives another state when it is called again ({other})")

    def check_episodes(self) -> None:
        """Two episodes with the same outcomes must be the same; nothing can be gone on from."""
        simulator, courses = self.simulator, [self.episode() for _ in range(2)]
        for step, (one, other) in enumerate(zip(*courses, strict=True)):
            differs = self.difference(one, other)
            if differs:
                self.complaint.refuse(
                    "an episode must be the same again after a reset with the same outcomes; "
                    f"a second time it differs at step {step} ({differs})"
                )
        course = courses[0]
        self.check_tracks(course[0])
        if isinstance(simulator, SlotSimulator):
            check_sight(simulator, course[0], self.complaint)
            self.check_ever_present(simulator, course)
        else:
            first = {name: np.repeat(values, COUNT) for name, values in course[1].signals.items()}
            self.check_salient(simulator, first)
        check_scene(simulator, course[-1], self.complaint)

    def check_own_randomness(self) -> None:
        """An answer must not be for one course of random numbers, unless that is meant."""
        if fixed_randomness(self.simulator):
            return
        alike = drawn_alike(
            self.simulator,
            lambda other: map(_shown, self.alone((MIXED, ALL_MISSED)[other])),
            difference=self.difference,
        )
        if alike:
            self.complaint.refuse(f"{alike}: {RANDOM}")

    def alone(self, row: int) -> Iterator[StateBatch]:
        """The states ``[1]`` of a rollout with mixed outcomes and one row's latents."""
        latents = self.latents.take(slice(row, row + 1))
        states = self.begun(latents)
        yield states
        for step in range(self.steps):
            states = self.stepped(states, self.outcomes[ONE, step], latents.noise[:, step])
            yield states

    def episode(self) -> list[StateBatch]:
        """The states ``[1]`` of one episode with mixed outcomes."""
        course = list[StateBatch]()
        for step, states in enumerate(self.alone(MIXED)):
            self.check_states(states, "reset or step", step=step, count=1)
            course.append(_shown(states))
        return course

    def check_tracks(self, start: StateBatch) -> None:
        """A tracker that a simulator says it holds is its own, and lies in its states."""
        simulator = self.simulator
        tracker, slots = tracker_of(simulator), getattr(simulator, "slots", None)
        if tracker is None:
            return
        if abs(tracker.dt_s - simulator.dt_s) > ROUNDING * simulator.dt_s:
            self.complaint.refuse(
                f"dt_s = {simulator.dt_s:g}, and its tracker's is {tracker.dt_s:g}"
            )
        tracks = tracker.start(COUNT, slots=None if slots is None else len(slots))
        absent = sorted(set(tracker.memory(tracks)) - set(start.memory))
        if absent:
            self.complaint.refuse(
                f"the memory of its states lacks {', '.join(absent)}, which its tracker's "
                "memory gives"
            )

    def check_ever_present(self, simulator: SlotSimulator, course: Sequence[StateBatch]) -> None:
        """Perception must have something to answer, somewhere along whole rollouts."""
        if not any(simulator.present(states.signals).any() for states in course[:-1]):
            self.complaint.refuse(
                "no slot is ever present: perception would have nothing to answer"
            )

    def check_salient(self, simulator: Simulator, signals: Mapping[str, FloatArray]) -> None:
        twice = {name: np.stack([values, values], axis=1) for name, values in signals.items()}
        flat = np.shape(self.complaint.call("salient", simulator.salient, signals))
        nested = np.shape(self.complaint.call("salient", simulator.salient, twice))
        if len(flat) != 2 or flat[0] != COUNT or nested != (COUNT, 2, flat[1]):
            self.complaint.refuse(
                f"salient gives shapes {flat} and {nested} for signals of shapes ({COUNT},) "
                f"and ({COUNT}, 2): must be ({COUNT}, D) and ({COUNT}, 2, D)"
            )

    def check_equal(self, course: Sequence[StateBatch]) -> None:
        """Equal outcomes from equal states must lead to equal states."""
        for step, states in enumerate(course):
            other = self.difference(_row(states, MIXED), _row(states, MIXED_AGAIN))
            if other:
                self.complaint.refuse(
                    f"step must give the same again for the same outcomes; at step {step} "
                    f"two such rollouts differ ({other}){COMPLETE}"
                )

    def check_order(self, course: Sequence[StateBatch]) -> None:
        """A second time and in reverse order, every rollout must be what it was."""
        outcomes, latents = self.outcomes[::-1], self.latents.take(slice(None, None, -1))
        states = self.begun(latents)
        for step in range(self.steps):
            states = self.stepped(states, outcomes[:, step], latents.noise[:, step])
            for row in range(COUNT):
                other = self.difference(_row(course[step + 1], row), _row(states, COUNT - 1 - row))
                if other:
                    self.complaint.refuse(
                        "step must give a rollout the same again, whatever is beside it and "
                        "whatever ran before; a second time, in another order, it differs at "
                        f"step {step + 1} ({other})"
                    )

    def check_continued(self, course: Sequence[StateBatch]) -> None:
        """One rollout alone, from the start and from a state kept in the middle."""
        latents, middle = self.latents.take(ONE), self.steps // 2
        alone, kept = _row(self.begun(latents), 0), _row(course[middle], MIXED)
        legs = (
            ("alone", alone, range(middle)),
            (f"continued from its state at step {middle}", kept, range(middle, self.steps)),
        )
        for how, states, leg in legs:
            for step in leg:
                noise = latents.noise[:, step]
                states = self.stepped(states, self.outcomes[ONE, step], noise)  # noqa: PLW2901
                other = self.difference(_row(course[step + 1], MIXED), states)
                if other:
                    self.complaint.refuse(
                        f"a rollout must be the same again, whatever is beside it; {how}, "
                        f"it differs at step {step + 1} ({other}){COMPLETE}"
                    )

    def difference(self, one: StateBatch, other: StateBatch) -> str:
        """The first thing in which states differ, in words; empty if they agree.

        Signals and numbers in memory may differ by rounding. Objects, such as copies of an
        environment, need not know how to compare.
        """
        if not np.array_equal(one.step, other.step):
            return f"step {one.step} and {other.step}"
        if set(one.memory) != set(other.memory):
            return f"memory {sorted(one.memory)} and {sorted(other.memory)}"
        ranges = {signal.name: signal.high - signal.low for signal in self.simulator.signals}
        for name, values in {**one.signals, **one.memory}.items():
            others = other.signals[name] if name in ranges else other.memory[name]
            if values.dtype == np.object_:
                continue
            same = values == others
            if values.dtype.kind == "f":
                scale = np.maximum(np.abs(values), ranges.get(name, 0.0))
                same |= np.abs(values - others) <= ROUNDING * scale
            if not np.all(same):
                row = int(np.argmin(same))
                return f"{name} {values[row]!s} and {others[row]!s}"
        return ""

    def check_states(self, states: StateBatch, what: str, *, step: int, count: int = COUNT) -> None:
        complaint = Complaint(f"{self.complaint.where}: {what}")
        if np.ndim(states.step) != 0 or int(states.step) != step:
            complaint.refuse(
                f"step is {states.step!r}: must be one number for the batch, here {step}"
            )
        declared = {signal.name for signal in self.simulator.signals}
        if set(states.signals) != declared:
            complaint.refuse(f"signals are {sorted(states.signals)}, declared {sorted(declared)}")
        for name in states.memory:
            if tells_violation(name):
                complaint.refuse(f"the memory {name!r} is pemviz's own; choose another name")
        for name, values in {**states.signals, **states.memory}.items():
            if np.shape(values) != (count,):
                complaint.refuse(f"{name} has shape {np.shape(values)}: must be ({count},)")
        for name, values in states.signals.items():
            if values.dtype != np.float64 or not np.isfinite(values).all():
                complaint.refuse(f"{name} must be finite numbers of type float64 (state {step})")


def _by_slot(simulator: SlotSimulator, states: StateBatch, nominal: BoolArray) -> BoolArray:
    """Outcomes ``[N, K]`` from whether they are nominal ``[N]``; of the absent they always are.

    At every third step only one slot errs where they are not, each in its turn.
    """
    slots, step = simulator.slots, int(states.step)
    present, shape = np.asarray(simulator.present(states.signals)), (nominal.size, len(slots))
    if present.shape != shape:
        words = f"present gives shape {present.shape} at step {step}: must be {shape}"
        Complaint(f"simulator {simulator.name!r}").refuse(words)
    errs = np.full(len(slots), step % 3 > 0)
    errs[step // 3 % len(slots)] = True
    error = ~nominal[:, None] & errs & present
    return error ^ np.array([slot.nominal for slot in slots], dtype=np.bool_)


def _row(states: StateBatch, row: int) -> StateBatch:
    return states.take(slice(row, row + 1))


def latent_warnings(simulator: Simulator) -> tuple[str, ...]:
    """Latents that are declared and make no difference, which may be meant.

    A latent at the start that only shows later counts as ignored if nothing in signals and memory
    differs at the start.
    """
    latents, found = latent_counts(simulator), list[str]()
    generator = np.random.default_rng(1)
    for place in range(latents.start):
        start = np.zeros((TRIED, latents.at_start))
        start[:, place] = generator.standard_normal(TRIED)
        if _all_equal(begun(simulator, count=TRIED, start=start)):
            found.append(f"simulator {simulator.name}: initial ignores start latent {place}")
    if episodic(simulator) is not None:  # few at a time, and each step is dear
        return tuple(found)
    states = begun(simulator, count=TRIED)
    for place in range(latents.noise):
        noise = np.zeros((TRIED, latents.noise))
        noise[:, place] = generator.standard_normal(TRIED)
        if _ignored(simulator, states, noise):
            found.append(f"simulator {simulator.name}: step ignores noise {place}")
    return tuple(found)


def _ignored(simulator: Simulator, states: StateBatch, noise: FloatArray) -> bool:
    """Whether noise makes no difference at any step, be all missed or all detected."""
    for outcome in (False, True):
        reached, outcomes = states, np.full(TRIED, outcome)
        for _ in range(simulator.states - 1):
            reached = stepped(simulator, reached, outcomes, noise)
            if not _all_equal(reached):
                return False
    return True


def _all_equal(states: StateBatch) -> bool:
    """Whether all rows are one state, as far as numbers tell."""
    for values in (*states.signals.values(), *states.memory.values()):
        if values.dtype == np.object_ or np.any(values != values[:1]):
            return False
    return True
