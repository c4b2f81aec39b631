"""Scenarios with slots, for methods: the error model of a slot in its turn.

:mod:`pemviz.simulators.slots` makes of a scenario with K slots one with a single outcome a step.
Here an error model of the user's becomes one of that scenario;
:class:`pemviz.sampling.back_end.SlotFeatures` is what proposals look at in a slot's turn, and
:mod:`pemviz.sampling.folding` leads back to the scenario's own steps.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import ConfigError
from pemviz.pem import DetectorModel, Pem, PemEnsemble, PemError, as_pem
from pemviz.pem.models.protocol import Refits
from pemviz.simulators.latents import within
from pemviz.simulators.slots import BringsSlotModels, Slot, UnrolledSimulator
from pemviz.types import Simulator

CERTAIN_LOGIT = 1000.0
"""Of the nominal outcome of an absent slot: its probability is 1 and its log 0 to the last bit."""


@dataclass(frozen=True, eq=False)
class SlotPem:
    """Logit of a slot's nominal outcome in its turn.

    Attributes:
        models: One for each of K slots, of P(detected); the same one may stand for several.
        nominal: Each slot's nominal outcome, ``[K]``.
    """

    models: tuple[Pem, ...]
    nominal: BoolArray

    @property
    def name(self) -> str:
        """The models' names."""
        return "+".join(dict.fromkeys(model.name for model in self._distinct))

    @property
    def digest(self) -> str:
        """The one model's digest, or one of which answers for which slot, and which are ghosts.

        Empty if a model has none.
        """
        digests = [model.digest for model in self.models]
        if (len(set(digests)) == 1 and self.nominal.all()) or not all(digests):
            return digests[0] if all(digests) else ""
        answers = zip(digests, self.nominal.tolist(), strict=True)
        return hashlib.sha256(repr(list(answers)).encode()).hexdigest()

    @property
    def data(self) -> str:
        """What the models were trained on."""
        return "; ".join(dict.fromkeys(model.data for model in self._distinct))

    @property
    def licence(self) -> str:
        """Terms of the models' use."""
        return "; ".join(dict.fromkeys(model.licence for model in self._distinct))

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of the nominal outcome ``[...]``; see :meth:`UnrolledSimulator.salient`."""
        present, slot = salient[..., -2] > 0.5, salient[..., -1].astype(np.int64)
        own, result = salient[..., :-2], np.full(salient.shape[:-1], CERTAIN_LOGIT)
        for model in self._distinct:
            answers = np.array([each is model for each in self.models])
            chosen = present if answers.all() else present & answers[slot]
            if chosen.any():
                logit = np.asarray(model.logit(own[chosen]))
                if logit.shape != (count := int(np.count_nonzero(chosen)),):
                    message = (
                        f"pem = {model.name!r}: logit of salient variables "
                        f"{[count, own.shape[-1]]} has shape {list(logit.shape)}: must be {[count]}"
                    )
                    raise PemError(message)
                if not self.nominal.all():
                    logit = np.where(self.nominal[slot[chosen]], logit, -logit)
                result[chosen] = logit
        return result

    @property
    def _distinct(self) -> Sequence[Pem]:
        return list({id(model): model for model in self.models}.values())


def unrolled(simulator: object) -> UnrolledSimulator | None:
    """The scenario with slots within a simulator, whatever wraps it; ``None``: there is none."""
    return within(simulator, UnrolledSimulator)


def turns_of(simulator: Simulator) -> int:
    """Outcomes of a step: K with slots, else 1."""
    scenario = unrolled(simulator)
    return 1 if scenario is None else scenario.turns


def slot_pem(pem: DetectorModel | Mapping[str, DetectorModel], slots: Sequence[Slot]) -> SlotPem:
    """An error model for all slots, or one for each by the slot's name.

    Raises:
        ConfigError: The names are not those of the slots.
        PemError: A model has no method ``logit``.
    """
    nominal = np.array([slot.nominal for slot in slots], dtype=np.bool_)
    if not isinstance(pem, Mapping):
        return SlotPem((as_pem(pem),) * len(slots), nominal)
    names = [slot.name for slot in slots]
    if set(pem) != set(names):
        message = (
            f"pem: has models for {sorted(map(repr, pem))}: must be the slots, {sorted(names)}"
        )
        raise ConfigError(message)
    by_model = {id(model): as_pem(model) for model in pem.values()}
    return SlotPem(tuple(by_model[id(pem[name])] for name in names), nominal)


def single_model(pem: Pem) -> Pem:
    """The one model that answers for all slots; what has no slots, or several models, as it is."""
    if isinstance(pem, SlotPem) and all(model is pem.models[0] for model in pem.models):
        return pem.models[0]
    return pem


def with_slots(
    simulator: Simulator, pem: Pem | Mapping[str, Pem], ensemble: PemEnsemble | None
) -> tuple[Pem, PemEnsemble | None]:
    """Error model and ensemble for a simulator; as they are if it has no slots.

    Raises:
        ConfigError: There is a model for each slot by name, and the names do not fit.
    """
    scenario = unrolled(simulator)
    if scenario is None:
        if isinstance(pem, Mapping):
            message = f"pem: models by slot, and simulator {simulator.name!r} has no slots"
            raise ConfigError(message)
        return pem, ensemble
    members = None
    if ensemble is not None:
        members = Refits(
            ensemble.name, [_with_own(member, scenario) for member in ensemble.members]
        )
    return _with_own(pem, scenario), members


def _with_own(pem: Pem | Mapping[str, Pem], scenario: UnrolledSimulator) -> SlotPem:
    """The error model, but for slots whose model the scenario brings; one by name goes first."""
    own = scenario.scenario
    if isinstance(pem, Mapping) or not isinstance(own, BringsSlotModels) or not own.slot_models:
        return slot_pem(pem, scenario.slots)
    by_name = {slot.name: own.slot_models.get(slot.name, pem) for slot in scenario.slots}
    return slot_pem(by_name, scenario.slots)
