"""A scenario and what else outcomes and states tell: a system, as methods see any other.

States, error model and features of the scenario are each followed by those of the system's
components, in their order; what a component knows the component says.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.errors import ConfigError, InputError
from pemviz.faults import SimulationError
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.slots import turns_of
from pemviz.sampling.state.component import CARRIED, Component, Known
from pemviz.sampling.state.hidden import HiddenProperty, OwnLogit
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.state.varying_visibility import VaryingVisibility
from pemviz.sampling.state.visibility import Visibility
from pemviz.simulators.episodic import kept_memory
from pemviz.simulators.latents import WrappedSimulator, begun, salient_of, stepped
from pemviz.simulators.slots import UnrolledSimulator
from pemviz.types import RolloutBatch, Signal, Simulator, StateBatch, outcome_log_likelihood

Kind = TypeVar("Kind", bound=Component)
STEP_ALONE = "step alone"
"""Signal of states that tell nothing of a scenario."""


@dataclass(frozen=True)
class ComposedSimulator(WrappedSimulator):
    """A scenario whose states know what its components do.

    Attributes:
        components: At least one.
        pem: The model of single outcomes, where what is known depends on it; one of the user's own
            need not know how to compare, so that it takes no part in comparisons.
        left_out: Components whose part of the states is not gone on with.
    """

    components: tuple[Component, ...]
    pem: Pem | None = field(default=None, compare=False)
    left_out: tuple[Component, ...] = ()

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The scenario's signals, and each component's."""
        return (*self.scenario.signals, *_signals(self.components))

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The scenario's initial states, before any outcome."""
        states = begun(self.scenario, count=count, start=start)
        for one in self.components:
            states = _with(states, one.begin(states, self.own_logit))
        return states

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The scenario's next states after outcomes ``[N]``."""
        return self.followed(
            states, detected, stepped(self.scenario, self.scenario_states(states), detected, noise)
        )

    def followed(self, states: StateBatch, detected: BoolArray, reached: StateBatch) -> StateBatch:
        """The scenario's states that were ``reached`` after outcomes ``[N]``, with components'."""
        try:
            for one in self.components:
                reached = _with(reached, one.next(states, detected, reached, self.own_logit))
        except InputError:  # of a number that is none a formula knows neither rollout nor step
            _check_finite(reached, simulator=self.scenario)
            raise
        return reached

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The scenario's salient variables, and what components show, ``[..., D + K]``."""
        return self._followed(self.scenario.salient(self._scenario_signals(signals)), signals)

    def salient_at(self, states: StateBatch) -> FloatArray:
        """The same at states."""
        own = salient_of(self.scenario, self.scenario_states(states))
        return self._followed(own, states.signals)

    def own_logit(self, states: StateBatch) -> FloatArray:
        """Logit of P(detected) ``[...]`` of the model of single outcomes, at the system's states.

        Raises:
            TypeError: No component depends on it, so that the system does not know the model.
        """
        if self.pem is None:
            message = "a system whose components do not follow the error model does not know it"
            raise TypeError(message)
        return self.pem.logit(self.scenario.salient(self._scenario_signals(states.signals)))

    def scenario_states(self, states: StateBatch) -> StateBatch:
        """The system's states as those of the scenario."""
        every = (*self.components, *self.left_out)
        memory = {
            name: values
            for name, values in states.memory.items()
            if not any(one.owns(name) for one in every)
        }
        return replace(states, signals=self._scenario_signals(states.signals), memory=memory)

    def _scenario_signals(self, signals: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        added = {signal.name for signal in _signals((*self.components, *self.left_out))}
        return {name: values for name, values in signals.items() if name not in added}

    def _followed(self, own: FloatArray, signals: Mapping[str, FloatArray]) -> FloatArray:
        shown = [signals[name][..., None] for one in self.components for name in one.shown]
        return np.concatenate((own, *shown), -1) if shown else own


@dataclass(frozen=True, eq=False)
class ComposedPem:
    """An error model of single outcomes with what outcomes before add.

    Attributes:
        pem: The model of single outcomes.
        properties: In the order of the system's.
    """

    pem: Pem
    properties: tuple[HiddenProperty, ...]

    @property
    def name(self) -> str:
        """The model's name, and the labels of properties that no setting names."""
        labels = [one.label for one in self.properties if one.in_name and one.label]
        return " with ".join([self.pem.name, *labels])

    @property
    def digest(self) -> str:
        """The model's digest; with labelled properties, one of these too."""
        if not self._labels or not self.pem.digest:
            return self.pem.digest
        return hashlib.sha256(repr((self.pem.digest, self.properties)).encode()).hexdigest()

    @property
    def data(self) -> str:
        """What the model was trained on."""
        return self.pem.data

    @property
    def licence(self) -> str:
        """Terms of the model's use."""
        return self.pem.licence

    @property
    def _labels(self) -> list[str]:
        return [one.label for one in self.properties if one.label]

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected | outcomes so far) ``[...]`` at a system's salient variables."""
        return self._fold(lambda: self.pem.logit(self.own_salient(salient)), self._shown(salient))

    def own_salient(self, salient: FloatArray) -> FloatArray:
        """What the model of single outcomes sees ``[..., D]``, of what this one sees."""
        return salient[..., : salient.shape[-1] - self._width]

    def after(self, own: FloatArray, salient: FloatArray) -> FloatArray:
        """Logits ``[...]`` that follow from those of the model of single outcomes ``[...]``.

        Of the salient variables only the properties' columns are looked at.
        """
        return self._fold(lambda: own, self._shown(salient))

    @property
    def _width(self) -> int:
        return sum(len(one.shown) for one in self.properties)

    def _shown(self, salient: FloatArray) -> FloatArray:
        return salient[..., salient.shape[-1] - self._width :]

    def _fold(self, own: OwnLogit, shown: FloatArray) -> FloatArray:
        place = 0
        for one in self.properties:
            width = len(one.shown)
            own = partial(one.logit, shown[..., place : place + width], own)
            place += width
        return own()


@dataclass(frozen=True, eq=False)
class ChainModel(ComposedPem):
    """The same where what is known depends on the model: one of whole chains of outcomes."""

    def log_likelihood(self, salient: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of rollouts' outcomes together ``[N]`` [nats], under this very model.

        What the salient variables ``[N, T-1, D + K]`` say of properties is left out: it may be
        another model's.
        """
        own = self.pem.logit(self.own_salient(salient))
        found = self.properties[-1].log_likelihood(own, detected)
        return self._step_by_step(own, detected) if found is None else found

    def _step_by_step(self, own: FloatArray, detected: BoolArray) -> FloatArray:
        """The filter itself, on states that show nothing but the properties."""

        def model(states: StateBatch) -> FloatArray:
            return own[:, int(states.step)]

        log_p, before = np.zeros(len(detected)), None
        for step in range(detected.shape[1]):
            states = StateBatch(np.asarray(step), {STEP_ALONE: np.zeros(len(detected))})
            for one in self.properties:
                if before is None:
                    known = one.begin(states, model)
                else:
                    known = one.next(before, detected[:, step - 1], states, model)
                states = _with(states, known)
            columns = [states.signals[name] for one in self.properties for name in one.shown]
            shown = np.stack(columns, axis=-1) if columns else np.empty((len(detected), 0))
            logit = self._fold(partial(model, states), shown)
            log_p += outcome_log_likelihood(logit, detected[:, step])
            before = states
        return log_p


@dataclass(frozen=True, eq=False)
class OtherModel(ChainModel):
    """A model of whole chains whose outcomes another one's system was sampled with."""

    def logit(self, salient: FloatArray) -> FloatArray:  # noqa: ARG002
        """The system's states know what follows under another model.

        Raises:
            TypeError: Always; see :meth:`log_likelihood`.
        """
        message = "what this error model says depends on all outcomes so far: use log_likelihood"
        raise TypeError(message)


@dataclass(frozen=True)
class ComposedFeatures:
    """What a scenario offers to look at, and what hidden properties do.

    Attributes:
        features: The scenario's own.
        properties: In the order of the system's.
    """

    features: StateFeatures
    properties: tuple[HiddenProperty, ...]

    def values(self, states: StateBatch) -> FloatArray:
        """The scenario's features and each property's, ``[..., D + K]``."""
        own = self.features.values(states)
        added = [column for one in self.properties for column in one.features(states)]
        shape = own.shape[:-1]
        return np.concatenate((own, *(np.broadcast_to(c, shape)[..., None] for c in added)), -1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where an outcome may matter, ``[...]``; the last property that can tell says so."""
        for one in reversed(self.properties):
            found = one.matters(self.features, states)
            if found is not None:
                return found
        return self.features.reacts(states)

    def for_proposals(self) -> "ComposedFeatures":
        """What a proposal looks at, and where it may leave the model."""
        return replace(self, properties=tuple(one.for_proposals() for one in self.properties))


def properties_of_memory(
    memory: Memory | VaryingFrailty, *, simulator: Simulator
) -> tuple[HiddenProperty, ...]:
    """How misses hang together, as hidden properties; none where they do not."""
    if isinstance(memory, VaryingFrailty):
        return (VaryingVisibility(memory, simulator.dt_s),)
    found: list[HiddenProperty] = []
    if memory.tau_s > 0.0:
        found.append(_last_outcome(simulator, memory.tau_s))
    if memory.frailty > 0.0:
        found.append(Visibility(memory, simulator.dt_s))
    return tuple(found)


def composed(
    back_end: BackEnd, pem: Pem, *, properties: tuple[HiddenProperty, ...]
) -> tuple[BackEnd, Pem]:
    """Back end and error model with hidden properties; as they are without any.

    Raises:
        ConfigError: The scenario has a signal named like a property's.
    """
    if not properties:
        return back_end, pem
    names = [signal.name for signal in _signals(properties)]
    if twice := {name for name in names if names.count(name) > 1}:
        message = f"hidden: signal {min(twice)!r}: belongs to two properties; choose another name"
        raise ConfigError(message)
    following = [one for one in properties if one.follows_model]
    if following and len(properties) > 1 and not isinstance(properties[-1], Visibility):
        names = ", ".join(one.label or type(one).__name__ for one in properties)
        message = (
            f"hidden: {names}: a property that follows the error model stands alone, without "
            "another one, memory_s or frailty"
        )
        raise ConfigError(message)
    model = with_hidden(pem, properties)
    own = pem if isinstance(model, ChainModel) else None
    simulator = twin = system_of(back_end.simulator, properties, pem=own)
    if back_end.twin is None or not all(one.has_few_states for one in properties):
        twin = None
    elif back_end.twin is not back_end.simulator:
        twin = system_of(back_end.twin, properties, pem=own)
    system = replace(
        back_end,
        simulator=simulator,
        twin=twin,
        features=ComposedFeatures(back_end.features, properties),
        single_outcomes=back_end,
        surrogate=None
        if back_end.surrogate is None
        else system_of(back_end.surrogate, properties, pem=own),
    )
    return system, model


def system_of(
    simulator: Simulator, properties: tuple[HiddenProperty, ...], *, pem: Pem | None = None
) -> ComposedSimulator:
    """A scenario with hidden properties.

    Raises:
        ConfigError: It has a signal named like a property's.
    """
    taken = {name for signal in simulator.signals for name in (signal.name, signal.key)}
    for signal in _signals(properties):
        if signal.name in taken:
            message = (
                f"simulator {simulator.name!r}: the signal {signal.name!r} is pemviz's own where "
                "memory_s or frailty is above 0; choose another name"
            )
            raise ConfigError(message)
    return ComposedSimulator(simulator, properties, pem)


def with_component(simulator: Simulator, one: Component) -> ComposedSimulator:
    """The system with one more component, after those that it has."""
    if isinstance(simulator, ComposedSimulator):
        return replace(simulator, components=(*simulator.components, one))
    return ComposedSimulator(simulator, (one,))


def with_last_outcome(simulator: Simulator, *, tau_s: float) -> ComposedSimulator:
    """A scenario that shows the last outcome.

    Raises:
        ConfigError: As :func:`system_of`.
    """
    return system_of(simulator, (_last_outcome(simulator, tau_s),))


def _last_outcome(simulator: Simulator, tau_s: float) -> LastOutcome:
    turns = simulator.turns if isinstance(simulator, UnrolledSimulator) else None
    return LastOutcome(tau_s, simulator.dt_s, turns)


def with_hidden(pem: Pem, properties: tuple[HiddenProperty, ...]) -> Pem:
    """A model of single outcomes with hidden properties, on a system that knows it."""
    if not properties:
        return pem
    chains = any(one.follows_model for one in properties)
    return (ChainModel if chains else ComposedPem)(pem, properties)


def as_member(pem: Pem, *, like: Pem) -> Pem:
    """Another model of single outcomes with the properties that ``like`` has, on its system."""
    if isinstance(like, ChainModel):
        return OtherModel(pem, like.properties)
    return ComposedPem(pem, like.properties) if isinstance(like, ComposedPem) else pem


def stayed(simulator: Simulator, states: StateBatch, detected: BoolArray) -> StateBatch:
    """The next states after outcomes ``[N]`` if the scenario moves no more.

    What else outcomes tell goes on.
    """
    if isinstance(simulator, ComposedSimulator):
        own = simulator.scenario_states(states)
        return simulator.followed(states, detected, stayed(simulator.scenario, own, detected))
    if isinstance(simulator, UnrolledSimulator):
        return simulator.turned(states, detected, _unmoved)
    return _unmoved(states, detected)


def _unmoved(states: StateBatch, detected: BoolArray) -> StateBatch:  # noqa: ARG001  whatever it is
    return replace(states, step=states.step + 1)


def own_pem(pem: Pem) -> Pem:
    """The model of single outcomes."""
    return pem.pem if isinstance(pem, ComposedPem) else pem


def own_salient(pem: Pem, salient: FloatArray) -> FloatArray:
    """What the model of single outcomes sees ``[..., D]``, of what ``pem`` sees."""
    return pem.own_salient(salient) if isinstance(pem, ComposedPem) else salient


def own_features(features: StateFeatures) -> StateFeatures:
    """What the scenario itself offers to look at."""
    return features.features if isinstance(features, ComposedFeatures) else features


def proposal_features(features: StateFeatures) -> StateFeatures:
    """What a proposal looks at, and where it may leave the model."""
    return features.for_proposals() if isinstance(features, ComposedFeatures) else features


def first_logit(pem: Pem, salient: FloatArray) -> FloatArray:
    """Logit of P(detected) ``[...]`` where no outcome came before, of what ``pem`` sees."""
    return own_pem(pem).logit(own_salient(pem, salient))


def hidden_in(pem: Pem) -> tuple[HiddenProperty, ...]:
    """An error model's hidden properties; none where outcomes are independent given the state."""
    return pem.properties if isinstance(pem, ComposedPem) else ()


def property_in(properties: Sequence[Component], kind: type[Kind]) -> Kind | None:
    """The one of a kind; ``None`` if there is none."""
    return next((one for one in properties if isinstance(one, kind)), None)


def memory_of_pem(pem: Pem) -> Memory:
    """How an error model's misses hang together."""
    properties = hidden_in(pem)
    last, visibility = property_in(properties, LastOutcome), property_in(properties, Visibility)
    return Memory(
        tau_s=0.0 if last is None else last.tau_s,
        frailty=0.0 if visibility is None else visibility.memory.frailty,
    )


def without_following(simulator: Simulator) -> Simulator:
    """The system without properties that follow the error model; given these, it is as before."""
    if not isinstance(simulator, ComposedSimulator):
        return simulator
    kept = tuple(one for one in simulator.components if not one.follows_model)
    return ComposedSimulator(simulator.scenario, kept) if kept else simulator.scenario


def dynamics_of(simulator: Simulator) -> Simulator:
    """What steps a system's states where nobody evaluates the error model."""
    if not isinstance(simulator, ComposedSimulator) or simulator.pem is None:
        return simulator
    kept = tuple(one for one in simulator.components if not one.follows_model)
    rest = tuple(one for one in simulator.components if one.follows_model)
    return ComposedSimulator(simulator.scenario, kept, left_out=rest)


def carried_at(
    simulator: Simulator, rollouts: RolloutBatch, *, step: IntArray
) -> Mapping[str, AnyArray]:
    """Memory ``[N]`` that is not kept with rollouts, at their states ``step [N]``, ascending."""
    if not isinstance(simulator, ComposedSimulator):
        return {}
    carried: dict[str, AnyArray] = {}
    for one in simulator.components:
        carried |= one.memory_at(rollouts, step=step, model=simulator.own_logit)
    return carried


def kept_with_rollouts(memory: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """What of a state's memory rollouts hold: all but what is for going on alone."""
    kept = kept_memory(memory)
    return {name: values for name, values in kept.items() if not name.startswith(CARRIED)}


def _check_finite(states: StateBatch, *, simulator: Simulator) -> None:
    for name, values in states.signals.items():
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise SimulationError(
                f"simulator {simulator.name}: {name} is {values[row]}",
                why="must be a finite number",
                step=int(states.step) // turns_of(simulator),
                rollouts=range(row, row + 1),
            )


def _signals(components: Sequence[Component]) -> list[Signal]:
    return [signal for one in components for signal in one.signals]


def _with(states: StateBatch, known: Known) -> StateBatch:
    return replace(
        states,
        signals={**states.signals, **known.signals},
        memory={**states.memory, **known.memory},
        beside={**states.beside, **known.beside},
    )
