"""From a configuration to the parts of an experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from pemviz import stl
from pemviz.analysis.model_uncertainty import model_classes_beside
from pemviz.config import SHIPPED_SIMULATORS, ExperimentConfig
from pemviz.config.toml_files import with_own_rules
from pemviz.errors import ConfigError
from pemviz.faults import exception_text, refused, refusing, signals_distinguished
from pemviz.pem import DetectorModel, Pem, PemEnsemble, as_pem, ensemble_of, load_pem
from pemviz.pem.models.cards import memory_of, varying_frailty_of
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.protocol import Refits
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.runs import back_ends
from pemviz.runs.salient_names import check_salient_names, outside_training
from pemviz.runs.specification import build_formula, build_problem
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.folding import Folding, folding_of
from pemviz.sampling.method import AnswersRules, Method
from pemviz.sampling.problem import Problem
from pemviz.sampling.registry import build_named_method, by_name
from pemviz.sampling.rollouts.repeat import LOGIT_ROUNDING
from pemviz.sampling.rollouts.runners import check_values
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.slots import turns_of, with_slots
from pemviz.sampling.state.composed import as_member, composed, properties_of_memory
from pemviz.sampling.state.hidden import HiddenProperty
from pemviz.sampling.zero_variance.method import require_unsafe
from pemviz.simulators.check import latent_warnings
from pemviz.simulators.detector_loop import detecting
from pemviz.simulators.episodic import EpisodicSimulator
from pemviz.simulators.latents import LatentSimulator
from pemviz.simulators.slots import SlotSimulator, UnrolledSimulator
from pemviz.types import Simulator


@dataclass(frozen=True)
class Experiment:
    """The parts that a run puts together.

    Attributes:
        config: The configuration, validated.
        ensemble: Models that its training data could as well have produced, if there are any.
        model_classes: Models of other classes that were trained on the same data.
        formula: The specification.
        problem: What is to be estimated.
        back_end: The simulator with its twin, if it has one, and what proposals may look at.
        method: How.
        planned_rollouts: How many rollouts all repetitions take together; with splitting, how
            many particles.
        warnings: What looks wrong with the parts, but may be meant.
        twin_doubt: What is wrong with the twin, once rollouts were compared; empty if nothing.
    """

    config: ExperimentConfig
    ensemble: PemEnsemble | None
    formula: stl.Formula
    problem: Problem
    back_end: BackEnd
    method: Method[Any]
    planned_rollouts: int
    model_classes: tuple[Pem, ...] = ()
    warnings: tuple[str, ...] = ()
    twin_doubt: str = ""

    @property
    def pem(self) -> Pem:
        """The perception error model."""
        return self.problem.pem

    @property
    def twin(self) -> Simulator | None:
        """A fast simulator of the same scenario, for the reference and the data's bound."""
        return self.back_end.twin

    @property
    def folding(self) -> Folding | None:
        """How rollouts become those of the scenario's own steps; ``None`` without slots."""
        return folding_of(self.problem.simulator)

    @property
    def declared(self) -> Simulator | SlotSimulator:
        """The simulator as observers and files know it: with its own steps and slots."""
        folding = self.folding
        return self.problem.simulator if folding is None else folding.simulator.scenario

    @property
    def features(self) -> StateFeatures:
        """What the scenario's states offer to look at."""
        return self.back_end.features

    @property
    def description(self) -> MethodDescription:
        """What the method needs and spends, and what its figures mean."""
        return by_name(self.config.method)

    @property
    def is_own_system(self) -> bool:
        """Whether the scenario is another than the shipped one."""
        return self.back_end.is_own

    @property
    def has_likelihood_ratios(self) -> bool:
        """Whether rollouts carry weights; splitting's particles are cut and copied instead."""
        return self.description.has_likelihood_ratios


@signals_distinguished()
@refusing()
def build_experiment(
    config: ExperimentConfig,
    *,
    simulator: Simulator | SlotSimulator | LatentSimulator | EpisodicSimulator | None = None,
    pem: DetectorModel | Mapping[str, DetectorModel] | None = None,
    twin: Simulator | SlotSimulator | None = None,
    surrogate: Simulator | SlotSimulator | EpisodicSimulator | None = None,
    features: StateFeatures | None = None,
    hidden: Sequence[HiddenProperty] = (),
    batch_rollouts: int | None = None,
    allow_python: bool = False,
) -> Experiment:
    """Validate ``config`` and build everything it names; nothing is estimated yet.

    Args:
        config: The configuration.
        simulator: A system of your own instead of the one that ``config`` names. It is tried
            out on whole rollouts, so that what is wrong with it shows here.
        pem: A detector model of your own, anything with ``logit(salient)``, instead of the
            one that ``config`` names; for a simulator with slots also one for each by name. None
            where the detector itself is in the loop (:class:`pemviz.DetectorInTheLoop`).
        twin: With ``simulator``: a fast simulator of the same scenario (itself, if a step of
            thousands of states costs it little) for method zero-variance and the reference.
        surrogate: A fast simulator of about the same scenario, with the same states and signals,
            instead of the one that ``config`` names: methods auto and mixture learn proposals on it
            first. It may be wrong, as the answer rests on rollouts of the simulator alone.
        features: What proposals look at instead of what the simulator offers: for one of your own
            that is all signals and the step, in a slot's turn what is about that slot.
        hidden: Properties of perception of your own that outcomes reveal, each with a label; one
            whose state follows the error model stands alone, without ``frailty``.
        batch_rollouts: How many rollouts are simulated at a time; the result does not depend on
            it, but speed and memory do.
        allow_python: Whether the error model may be ``module:attribute``, whose code then runs.
            Never taken from a configuration: a file must not decide that code runs.

    Raises:
        InputError: A value is out of range, the specification does not parse or fit the scenario,
            the error model cannot be loaded, or your own simulator or detector does not keep to
            its protocol.
    """
    own = None if simulator is None else back_ends.own_back_end(simulator, twin=twin)
    if surrogate is not None:
        config = replace(config, surrogate=surrogate.name)
    config, named, back_end = _named_parts(
        config, own, pem, allow_python=allow_python, hidden=hidden
    )
    back_end = back_ends.with_surrogate(back_end, config, given=surrogate)
    back_end = back_ends.with_choices(back_end, features=features, batch_rollouts=batch_rollouts)
    _check_hidden(config, back_end, hidden)
    check_salient_names(named, back_end.simulator)
    memory, left_out = _memory(config, named, back_end)
    lasting = memory.frailty if isinstance(memory, Memory) else 0.0
    back_ends.check_method_fits(config, back_end, frailty=lasting)
    observed = detecting(back_end.simulator) is not None
    ensemble = ensemble_of(config.pem) if pem is None and not observed else None
    model, ensemble = with_slots(back_end.simulator, named, ensemble)
    simulator = back_end.simulator
    warnings = (*latent_warnings(simulator), *_error_model_warnings(model, simulator), *left_out)
    others = () if back_end.is_own else model_classes_beside(model)
    properties = properties_of_memory(memory, simulator=simulator)
    back_end, model = composed(back_end, model, properties=(*properties, *hidden))
    if hidden:
        config = replace(config, pem=model.name)
    if ensemble is not None and back_end.single_outcomes is not None:
        members = [as_member(member, like=model) for member in ensemble.members]
        ensemble = Refits(ensemble.name, members)
    formula = build_formula(config, back_end.simulator)
    problem = build_problem(config, formula, model, back_end)
    return Experiment(
        config=config,
        ensemble=ensemble,
        formula=formula,
        problem=problem,
        back_end=back_end,
        method=_method(config, problem, back_end),
        planned_rollouts=config.repetitions * by_name(config.method).budget(config).rollouts,
        model_classes=tuple(as_member(other, like=model) for other in others),
        warnings=warnings,
    )


def _method(config: ExperimentConfig, problem: Problem, back_end: BackEnd) -> Method[Any]:
    """The method, if it and the reference can be had for the specification."""
    if "single states" in by_name(config.method).needs:
        require_unsafe(problem, method=config.method)
    if config.reference:
        require_unsafe(problem)
    method = build_method(config, back_end=back_end)
    if config.rules and not isinstance(method, AnswersRules):
        raise ConfigError(f"rules: method {config.method} answers one specification only")
    return method


def _memory(
    config: ExperimentConfig, named: Pem | Mapping[str, Pem], back_end: BackEnd
) -> tuple[Memory | VaryingFrailty, tuple[str, ...]]:
    """How misses hang together: as the configuration says, else as the error model itself does.

    Returns:
        That, and a line for each part of what a model has that is left out.
    """
    every = named.values() if isinstance(named, Mapping) else (named,)
    models = list({id(model): model for model in every}.values())
    owned = {model.name: own for model in models if (own := memory_of(model)) is not None}
    memory = Memory(tau_s=config.assumed_memory_s)
    if detecting(back_end.simulator) is not None:
        return Memory(), ()
    if config.memory_law == "visibility":
        return _varying_frailty(config, named, back_end), ()
    if len(models) == 1:
        memory = owned.get(models[0].name, memory)
    if config.memory_s is not None:
        memory = replace(memory, tau_s=config.memory_s)
    if config.frailty is not None:
        memory = replace(memory, frailty=config.frailty)
    if len(models) > 1:
        words = "its memory is left out, as slots have models of their own; memory_s is for all"
        return memory, tuple(f"error model {name}: {words}" for name in owned)
    if memory.frailty > 0.0 and isinstance(back_end.simulator, UnrolledSimulator):
        which = f"simulator {back_end.simulator.name!r}, which has slots,"
        words = f"its frailty {memory.frailty:.2g} is left out: {which} works with frailty 0 alone"
        return replace(memory, frailty=0.0), (f"error model {models[0].name}: {words}",)
    return memory, ()


def _varying_frailty(
    config: ExperimentConfig, named: Pem | Mapping[str, Pem], back_end: BackEnd
) -> VaryingFrailty:
    """How visibility comes and goes: as the configuration says, else as the error model itself."""
    if isinstance(back_end.simulator, UnrolledSimulator) or isinstance(named, Mapping):
        which = f"simulator {back_end.simulator.name!r}, which has slots,"
        raise ConfigError(f"memory_law = 'visibility': {which} works with outcomes alone")
    own = varying_frailty_of(named)
    given = {
        "varying": config.varying_frailty,
        "varying_s": config.varying_frailty_s,
        "frailty": config.frailty,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if own is not None:
        return replace(own, **given)
    lacks = {"varying", "varying_s"} - set(given)
    if lacks:
        option = "varying_frailty_s" if "varying" in given else "varying_frailty"
        raise ConfigError(
            f"memory_law = 'visibility': error model {named.name} says nothing of it; give "
            f"{option}, or fit a model by 'pemviz pem fit --memory --varying-frailty'"
        )
    return VaryingFrailty(**{"frailty": 0.0, **given})


def _check_hidden(config: ExperimentConfig, back_end: BackEnd, hidden: Sequence[object]) -> None:
    """Refuse properties that the answer could not name, and slots with what is of one obstacle."""
    for one in hidden:
        if not isinstance(one, HiddenProperty):
            raise ConfigError(f"hidden: {type(one).__name__}: must be a pemviz.HiddenProperty")
        if not one.label:
            raise ConfigError(
                f"hidden: {type(one).__name__}: must have a label, by which the answer names it"
            )
    if not isinstance(back_end.simulator, UnrolledSimulator):
        return
    which = f"simulator {back_end.simulator.name!r}, which has slots,"
    if config.frailty:
        raise ConfigError(f"frailty = {config.frailty:g}: {which} works with frailty 0 alone")
    if hidden:
        raise ConfigError(f"hidden: {which} takes no property of your own")


def _named_parts(
    config: ExperimentConfig,
    own: BackEnd | None,
    pem: DetectorModel | Mapping[str, DetectorModel] | None,
    *,
    allow_python: bool,
    hidden: Sequence[object],
) -> tuple[ExperimentConfig, Pem | Mapping[str, Pem], BackEnd]:
    """The user's own parts, or those that ``config`` names; it then names what is used."""
    own_pem: Pem | Mapping[str, Pem] | None = None
    if isinstance(pem, Mapping):
        wrapped = {id(model): as_pem(model) for model in pem.values()}
        own_pem = {slot: wrapped[id(model)] for slot, model in pem.items()}  # one stays one
        config = replace(config, pem="+".join(dict.fromkeys(m.name for m in own_pem.values())))
    elif pem is not None:
        own_pem = as_pem(pem)
        config = replace(config, pem=own_pem.name)
    if own is not None:
        name = own.simulator.name
        if name in SHIPPED_SIMULATORS:
            raise ConfigError(f"simulator {name!r}: a shipped one has this name already")
        config = replace(config, simulator=name)
    else:
        config = with_own_rules(config)
    config.validate()
    if own is not None:
        back_ends.check_measures(config)
    back_end = own or back_ends.build_back_end(replace(config, surrogate=None))
    observed = back_ends.observed_outcomes(config, back_end, given=pem, hidden=hidden)
    if observed is not None:
        return replace(config, pem=observed.name), observed, back_end
    model = load_pem(config.pem, allow_python=allow_python) if own_pem is None else own_pem
    return config, model, back_end


def _error_model_warnings(pem: Pem, simulator: Simulator) -> tuple[str, ...]:
    """Evaluate the error model at all states of two rollouts, all missed and all detected.

    What cannot be its logits is refused; what looks wrong, but may be meant, is returned.
    """
    outcomes = np.zeros((2, simulator.states - 1), dtype=np.bool_)
    outcomes[1] = True
    signals = replay(simulator=simulator, detected=outcomes)
    named = [(f"simulator {simulator.name}: {name}", values) for name, values in signals.items()]
    with refusing():
        check_values(named, turns=turns_of(simulator))
    salient = simulator.salient({name: values[:, :-1] for name, values in signals.items()})
    where = f"pem = {pem.name!r} on simulator {simulator.name!r}"
    try:
        logit = np.asarray(pem.logit(salient))
    except BaseException as error:  # the user's code may raise anything
        raise refused(ConfigError(f"{where}: {exception_text(error)}"), error) from error
    if logit.shape != salient.shape[:-1] or logit.dtype.kind != "f":
        raise ConfigError(
            f"{where}: logit of salient variables {list(salient.shape)} has shape "
            f"{list(logit.shape)} and type {logit.dtype}: must be {list(salient.shape[:-1])} "
            "numbers of type float64"
        )
    if not np.isfinite(logit).all():
        odd = float(logit[~np.isfinite(logit)][0])
        raise ConfigError(
            f"{where}: logit is {odd}: must be a finite number; 40 or -40 is as good as certain"
        )
    for again, of_whom in ((pem.logit(salient), logit), (pem.logit(salient[:1]), logit[:1])):
        differs = np.abs(np.asarray(again) - of_whom)
        if not (differs <= LOGIT_ROUNDING).all():
            place = np.unravel_index(int(differs.argmax()), differs.shape)
            raise ConfigError(
                f"{where}: logit is {of_whom[place]:.6g}, and {again[place]:.6g} when it is asked "
                "again: must depend on the salient variables of its row alone"
            )
    outside = tuple(outside_training(pem, salient))
    low, high = float(logit.min()), float(logit.max())
    if low < 0.0 or high > 1.0:
        return outside
    return (
        *outside,  # more often probabilities than P(detected) of 50 to 73 %
        f"error model {pem.name}: every logit lies between {low:.3g} and {high:.3g}, as "
        f"probabilities do; taken as logits they mean that {expit(low):.0%} to {expit(high):.0%} "
        "are detected",
    )


def build_method(config: ExperimentConfig, *, back_end: BackEnd | None = None) -> Method[Any]:
    """The method that ``config`` names, on the back end that it names unless one is given.

    Raises:
        ConfigError: The back end does not offer what the method needs.
    """
    back_end = back_ends.build_back_end(config) if back_end is None else back_end
    back_ends.check_method_fits(config, back_end)
    return build_named_method(config, back_end)
