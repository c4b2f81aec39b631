"""A detector that reads images, in the closed loop in place of an error model.

The scenario is one that is told, at each step, whether its perception detected; here it is told
what a detector makes of the image of that state. An outcome thereby is observed, not sampled: it
follows from the state for certain. It stands among the signals of the state that the image is of,
and what is random about a rollout is latents alone.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config.ranges import described
from pemviz.errors import ConfigError
from pemviz.faults import SimulationError, blame
from pemviz.files.atomic import write_text
from pemviz.matching import iou, matched
from pemviz.simulators.latents import WrappedSimulator, begun, parts_of, stepped
from pemviz.simulators.slots import Slot
from pemviz.types import CERTAIN, RolloutBatch, Signal, StateBatch

FOUND, SCORE = "found", "score"
DETECTOR_ITSELF = "detector itself"
AS_GOOD_AS_CERTAIN = 40.0
"""Logit."""
SAME_SCORE = 1e-9
TRIED = 4
"""Rollouts whose first images a detector is tried with."""
AGAIN = "when asked again; what is random about it must come of latents"
ELSEWHERE = "in another place among images; images_at_a_time = 1 shows it one at a time"
IMAGES = "must be a numpy array of uint8, [N, height, width] or [N, height, width, channels]"


@dataclass(frozen=True)
class DetectorItself:
    """What stands in an error model's place: the outcome is what the detector said."""

    name: str = DETECTOR_ITSELF
    digest: str = ""
    data: str = "none: the detector looks at images as the simulator renders them"
    licence: str = "not stated"

    def logit(self, salient: FloatArray) -> FloatArray:
        """As good as certain, ``[...]``, of whether nothing is wrong ``[..., 1]``."""
        return AS_GOOD_AS_CERTAIN * (2.0 * salient[..., 0] - 1.0)


@dataclass(frozen=True, eq=False)
class Detecting(WrappedSimulator, ABC):
    """A scenario with the detector itself; what both ways of stepping have in common.

    Attributes:
        detect: What the detector makes of images ``[n, height, width(, channels)]``, uint8. Without
            ``boxes``: of each image whether the obstacle was found, or a score, ``[n]``; with K
            slots ``[n, K]``. With ``boxes``: two arrays, its boxes ``[n, D, 4]`` (left, top, right,
            bottom [px]) and their scores ``[n, D]``; where an image has fewer, the others' score
            is 0. The same image must give the same again.
        boxes: Where the obstacle is in the images of states ``[N]``: ``[N, 4]`` or, with K slots,
            ``[N, K, 4]`` [px]; NaN where it is not. Of an environment's present state: ``[4]`` or
            ``[K, 4]``.
        threshold: Scores from here on count as found.
        iou_above: With ``boxes``: overlaps (intersection over union) above this count.
        images_at_a_time: The detector is always given so many, the last ones filled up with
            copies: a network's last digit may depend on how many there are.
    """

    scenario: Any
    _: KW_ONLY
    detect: Callable[[AnyArray], Any]
    boxes: Callable[[Any], FloatArray] | None = None
    threshold: float = 0.5
    iou_above: float = 0.5
    images_at_a_time: int = 32

    def __post_init__(self) -> None:
        """Refuse numbers that cannot be, and signals that are there already.

        Raises:
            ConfigError: One line.
        """
        taken = {word for s in self.scenario.signals for word in (s.name, s.key)}
        own = next((name for name in self._names(FOUND, SCORE) if name in taken), None)
        wrong = (
            (not np.isfinite(self.threshold), f"threshold = {self.threshold}: must be finite"),
            (
                not 0.0 <= self.iou_above < 1.0,
                f"iou_above = {self.iou_above}: must be from 0 to below 1",
            ),
            (
                self.images_at_a_time < 1,
                f"images_at_a_time = {self.images_at_a_time}: must be at least 1",
            ),
            (own is not None, f"the signal {own!r} is pemviz's own here; choose another name"),
        )
        for is_wrong, words in wrong:
            if is_wrong:
                raise ConfigError(f"detector in the loop of {self.scenario.name!r}: {words}")

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The scenario's, then whether the detector found, 0 or 1, and its score, by slot."""
        own = (Signal(name, name, "", 0.0, 1.0) for name in self._names(FOUND, SCORE))
        return (*self.scenario.signals, *own)

    @property
    def slots_reported(self) -> tuple[Slot, ...]:
        """What the detector answers for: the scenario's slots, or its one obstacle."""
        return getattr(self.scenario, "slots", (Slot("obstacle"),))

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Whether the detector is right about everything that is there, 0 or 1, ``[..., 1]``."""
        right = self._reported(signals) == self._nominal
        return right.all(axis=-1)[..., None].astype(np.float64)

    def write_frames(
        self, path: Path | str, rollouts: RolloutBatch, *, where: BoolArray | None = None
    ) -> int:
        """Write what the detector made of each frame of rollouts, for ``pemviz pem fit``.

        A CSV table with the scenario's salient variables, by its attribute ``salient_names``,
        ``detected``, and ``sequence``, ``track``, ``frame`` and ``rate_hz`` for ``--memory``; no
        row where nothing is present, nor of slots where a report is an error.

        Args:
            path: Of the table.
            rollouts: With signals of this simulator, as they come: none that are weighted.
            where: Which frames ``[N, T-1]``; ``None``: all.

        Returns:
            How many rows it has.

        Raises:
            ConfigError: Rollouts are weighted, or the scenario has no ``salient_names``.
            OSError: The file cannot be written.
        """
        names = getattr(self.scenario, "salient_names", None)
        if not names:
            message = f"simulator {self.name!r}: a table needs salient_names = ('distance', ...)"
            raise ConfigError(message)
        if np.any(rollouts.log_weight != 0.0):
            message = "rollouts are weighted: a table needs them as they come (method monte-carlo)"
            raise ConfigError(message)
        signals = rollouts.decision_states().signals
        reported = self._reported(signals)
        salient = self.scenario.salient(signals).reshape((*reported.shape, len(names)))
        kept = np.broadcast_to(self._nominal, reported.shape)
        if self._has_slots:
            kept = kept & self.scenario.present(signals)
        if where is not None:
            kept = kept & where[..., None]
        lines = [",".join(("sequence", "track", "frame", "rate_hz", *names, "detected"))]
        for row, frame, track in np.argwhere(kept):
            values = ",".join(map(repr, salient[row, frame, track].tolist()))
            said = int(reported[row, frame, track])
            lines.append(f"{row},{track},{frame},{1.0 / self.dt_s!r},{values},{said}")
        write_text(Path(path), "\n".join([*lines, ""]))
        return len(lines) - 1

    @abstractmethod
    def first_images(self) -> tuple[AnyArray, Any]:
        """Images ``[N, ...]`` that the detector is tried with, and the obstacles' boxes there."""

    def check_detector(self) -> None:
        """Whether the detector says the same of its first images again, and in another order.

        Raises:
            ConfigError: It does not.
            SimulationError: It raises something, or what is rendered or answered does not fit.
        """
        images, truth = self.first_images()
        turned = images[::-1], None if truth is None else truth[::-1]
        first, again, elsewhere = (
            self._answers(*given)[1] for given in ((images, truth), (images, truth), turned)
        )
        for other, when in ((again, AGAIN), (elsewhere[::-1], ELSEWHERE)):
            if not np.allclose(first, other, rtol=SAME_SCORE, atol=SAME_SCORE):
                place = int(np.argmax(np.abs(first - other)))
                one, two = first.flat[place], other.flat[place]
                message = f"simulator {self.name!r}: detect gives {one:.6g}, and {two:.6g} {when}"
                raise ConfigError(message)

    @property
    def _has_slots(self) -> bool:
        return hasattr(self.scenario, "slots")

    @property
    def _nominal(self) -> BoolArray:
        return np.array([slot.nominal for slot in self.slots_reported])

    def _names(self, *what: str) -> list[str]:
        if not self._has_slots:
            return list(what)
        return [
            re.sub(r"\W", "_", f"{w}_{slot.name}") for w in what for slot in self.slots_reported
        ]

    def _reported(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """What the detector said of each slot, ``[..., K]``."""
        return np.stack([signals[name] for name in self._names(FOUND)], axis=-1) > 0.0

    def _outcomes(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """The same as the scenario takes it: ``[...]``, or with slots ``[..., K]``."""
        reported = self._reported(signals)
        return reported if self._has_slots else reported[..., 0]

    def _own_signals(
        self, images: Any, truth: Any, signals: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """What the detector says of images of states whose signals are ``[N]``."""
        count = len(next(iter(signals.values())))
        found, score = self._answers(self._checked(images, count), truth)
        if self._has_slots:
            found = np.where(self.scenario.present(signals), found, self._nominal)
        columns = np.concatenate([found, score], axis=1, dtype=np.float64)
        return dict(zip(self._names(FOUND, SCORE), columns.T.copy(), strict=True))

    def _checked(self, images: Any, count: int) -> AnyArray:
        fits = isinstance(images, np.ndarray) and images.dtype == np.uint8 and images.ndim in (3, 4)
        if not fits or len(images) != count or not images.size:
            what = described(images)
            if isinstance(images, np.ndarray):
                what = f"{images.dtype} of shape {images.shape}"
            self._refuse(f"render gives {what} for {count} states", IMAGES)
        return images

    def _answers(self, images: AnyArray, truth: Any) -> tuple[BoolArray, FloatArray]:
        """Whether each slot is found ``[N, K]``, and with which score: so many at a time."""
        count, slots, size = len(images), len(self.slots_reported), self.images_at_a_time
        labelled = np.zeros((count, 0, 4))
        if self.boxes is not None:
            given = np.asarray(truth, dtype=np.float64)
            wanted = (count, slots, 4) if self._has_slots else (count, 4)
            if given.shape != wanted:
                what = f"boxes gives shape {given.shape} for {count} states"
                self._refuse(what, f"must be {wanted}")
            labelled = given.reshape(count, slots, 4)
        found, score = np.zeros((count, slots), dtype=np.bool_), np.zeros((count, slots))
        for start in range(0, count, size):
            rows = slice(start, min(start + size, count))
            filled = np.minimum(np.arange(start, start + size), count - 1)
            try:
                answer = self.detect(images[filled])
            except BaseException as error:  # a detector of the user's may raise anything
                blame(error, f"simulator {self.name}: detect")
            here = rows.stop - start
            if self.boxes is None:
                score[rows] = self._scores(answer, start)[:here]
                found[rows] = score[rows] >= self.threshold
            else:
                boxes, scores = (part[:here] for part in self._boxes_of(answer, start))
                found[rows], score[rows] = self._matched(labelled[rows], boxes, scores)
        return found, score

    def _matched(
        self, labelled: FloatArray, boxes: FloatArray, scores: FloatArray
    ) -> tuple[BoolArray, FloatArray]:
        """Which obstacles are found, and the best score of a box that overlaps enough."""
        there = np.asarray(np.isfinite(labelled).all(axis=-1))
        found = matched(
            labelled,
            boxes,
            obstacle_counts=there,
            detection_counts=scores >= self.threshold,
            above=self.iou_above,
        )
        overlap = (iou(labelled, boxes) > self.iou_above) & there[..., None]
        return found, np.where(overlap, scores[:, None, :], 0.0).max(axis=2, initial=0.0)

    def _scores(self, answer: Any, start: int) -> FloatArray:
        """An answer to images from ``start`` on as scores, ``[n, K]``."""
        score, slots = self._numbers(answer, start), len(self.slots_reported)
        size = self.images_at_a_time
        wanted = (size, slots) if self._has_slots else (size,)
        if score.shape != wanted:
            what = f"detect gives shape {score.shape} for {size} images"
            self._refuse(what, f"must be {wanted}")
        return score.reshape(size, slots)

    def _boxes_of(self, answer: Any, start: int) -> tuple[FloatArray, FloatArray]:
        """An answer to images from ``start`` on as boxes and scores."""
        if not isinstance(answer, tuple | list) or len(answer) != 2:
            why = "must be two arrays, boxes [n, D, 4] and scores [n, D]"
            self._refuse(f"detect gives {described(answer)}", why)
        boxes, scores = np.asarray(answer[0], dtype=np.float64), self._numbers(answer[1], start)
        size = self.images_at_a_time
        if scores.ndim != 2 or len(scores) != size or boxes.shape != (*scores.shape, 4):
            what = f"detect gives boxes {boxes.shape} and scores {scores.shape} for {size} images"
            self._refuse(what, f"must be ({size}, D, 4) and ({size}, D)")
        return boxes, scores

    def _numbers(self, answer: Any, start: int) -> FloatArray:
        score = np.asarray(answer) if isinstance(answer, np.ndarray) else np.array(None)
        if score.dtype.kind not in "bf":
            why = "must be an array of truth values or scores"
            self._refuse(f"detect gives {described(answer)}", why)
        if not np.isfinite(score).all():
            first = np.argwhere(~np.isfinite(score))[0]
            rollouts = range(start + int(first[0]), start + int(first[0]) + 1)
            what = f"detect gives a score of {score[tuple(first)]}"
            self._refuse(what, "must be a finite number", rollouts)
        return score.astype(np.float64)

    def _refuse(self, what: str, why: str, rollouts: range | None = None) -> NoReturn:
        raise SimulationError(f"simulator {self.name!r}: {what}", why=why, rollouts=rollouts)


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectorInTheLoop(Detecting):
    """A simulator with the detector itself in the loop, in place of an error model.

    ``pemviz.build_experiment(config, simulator=DetectorInTheLoop(scenario, ...))`` takes no error
    model; the same scenario with one says how near the error model comes. All that is random about
    a rollout is the scenario's latents: what an image shows beside the state, as light and noise,
    ``initial`` and ``step`` make of them and keep in the states' memory.

    Signals ``found`` (0 or 1) and ``score`` are those of the image of the same state; with slots
    ``found_NAME`` and ``score_NAME`` for each, and an outcome is whether all are right.

    Attributes:
        scenario: A :class:`pemviz.Simulator`, with latents or without, or a
            :class:`pemviz.SlotSimulator`; its ``salient`` is not looked at.
        render: States ``[N]`` to their images ``[N, height, width]`` or
            ``[N, height, width, channels]``, uint8; a state's image is its own, whatever is beside.

    ``detect``, ``boxes``, ``threshold``, ``iou_above`` and ``images_at_a_time`` are those of
    :class:`pemviz.simulators.detector_loop.Detecting`. What does not fit is refused in one line: a
    ``pemviz.ConfigError`` as it is tried before a run, a ``pemviz.RunError`` with rollout and step
    during one.
    """

    render: Callable[[StateBatch], AnyArray]

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The scenario's initial states, with what the detector makes of them."""
        return self._looked_at(begun(self.scenario, count=count, start=start))

    def step(
        self,
        states: StateBatch,
        detected: BoolArray,  # noqa: ARG002  what the detector said is among the signals
        noise: FloatArray | None = None,
    ) -> StateBatch:
        """The scenario's next states after what the detector said of ``states [N]``."""
        own = {signal.name for signal in self.scenario.signals}
        before = replace(
            states,
            signals={name: values for name, values in states.signals.items() if name in own},
            memory={name: values for name, values in states.memory.items() if name != CERTAIN},
        )
        outcomes = self._outcomes(states.signals)
        return self._looked_at(stepped(self.scenario, before, outcomes, noise))

    def first_images(self) -> tuple[AnyArray, Any]:
        """Of some rollouts' first states, with random starts."""
        start = np.random.default_rng(3).standard_normal((TRIED, self.latents.at_start))
        states = begun(self.scenario, count=TRIED, start=start)
        truth = None if self.boxes is None else np.asarray(self.boxes(states))
        return self._checked(self.render(states), TRIED), truth

    def _looked_at(self, states: StateBatch) -> StateBatch:
        images = self.render(states)
        truth = None if self.boxes is None else self.boxes(states)
        said = self._own_signals(images, truth, states.signals)
        certain = np.ones(states.shape, dtype=np.bool_)
        return replace(
            states,
            signals={**states.signals, **said},
            memory={**states.memory, CERTAIN: certain},
        )


def own_image(environment: Any) -> AnyArray:
    """What an environment renders of its present state."""
    return environment.render()


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectorEpisodes(Detecting):
    """The same for an environment that can only be reset and stepped, as CARLA or gymnasium's.

    A :class:`pemviz.EpisodicSimulator` around another one, which renders after each reset and step.
    Its images are looked at one by one.

    Attributes:
        scenario: A :class:`pemviz.EpisodicSimulator`, such as :class:`pemviz.GymnasiumEpisodes`.
        render: The environment to the image of its present state, ``[height, width]`` or
            ``[height, width, channels]``, uint8; what its method ``render`` gives by default.
    """

    render: Callable[[Any], AnyArray] = own_image
    images_at_a_time: int = 1
    _now: dict[str, float] = field(init=False, repr=False, default_factory=dict[str, float])

    def reset(self, *start: Any) -> Mapping[str, float]:
        """The environment's signals after a reset, with what the detector makes of its image."""
        return self._looked_at(self.scenario.reset(*start))

    def step(self, outcome: Any, *noise: Any) -> tuple[Mapping[str, float], bool]:  # noqa: ARG002
        """The same after a step with what the detector said, and whether the episode has ended."""
        said = self._outcomes({name: np.array(value) for name, value in self._now.items()})
        values, ended = self.scenario.step(said.tolist(), *noise)
        return self._looked_at(values), ended

    def first_images(self) -> tuple[AnyArray, Any]:
        """Of the state after a reset."""
        self.scenario.reset(*([np.zeros(self.latents.at_start)] if self.latents.at_start else []))
        return self._checked(self._image(), 1), self._truth()

    def _looked_at(self, values: Mapping[str, float]) -> dict[str, float]:
        signals = {name: np.array([value], dtype=np.float64) for name, value in values.items()}
        said = self._own_signals(self._image(), self._truth(), signals)
        self._now.clear()
        self._now.update(values, **{name: float(one[0]) for name, one in said.items()})
        return dict(self._now)

    def _image(self) -> AnyArray:
        return np.asarray(self.render(self.scenario))[None]

    def _truth(self) -> AnyArray | None:
        return None if self.boxes is None else np.asarray(self.boxes(self.scenario))[None]


def detecting(simulator: object) -> Detecting | None:
    """The detector in the loop of a simulator, whatever wraps it; ``None``: there is none."""
    return next((part for part in parts_of(simulator) if isinstance(part, Detecting)), None)
