"""Batches of rollouts simulated by workers: cut into pieces, and whatever is lost done again."""

import contextlib
import itertools
import logging
import math
import os
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, field
from typing import Any, NoReturn

from pemviz.cluster import scheduler_is_gone, worker_was_killed
from pemviz.errors import RunError
from pemviz.faults import SimulationError, counted_from
from pemviz.heartbeat import POLL_S, SILENT_S
from pemviz.pem.models.protocol import Pem
from pemviz.processes import DIED, machine_bytes, resident_bytes
from pemviz.sampling.rollouts.apart import simulate_apart
from pemviz.sampling.rollouts.losing import marked, without_the_rest
from pemviz.sampling.rollouts.runners import BatchTask, by_numpy
from pemviz.types import RolloutBatch, Simulator

LOG = logging.getLogger(__name__)
AHEAD_S = 30.0
"""Work that is handed in ahead, for each worker, so that none waits for the slowest of a batch."""
MOST_AHEAD, SLOW_S = 20_000, 0.005
"""Rollouts ahead at most, which wait until they are scored; and what one takes that is slow."""
MOST_LOST = 3
"""Workers that were at a rollout."""
REMEMBERED = 32
"""Pieces whose times tell what the next will take."""
FEW, MANY = 5, 64
"""Rollouts of a first piece, where a simulator is given so many at once: it may step them side by
side, so that they take hardly longer than one."""
PIECE_S = 0.5
"""What a piece takes, if a rollout takes less: long beside handing it in, short beside a stage."""
SCHEDULER_GONE = "the cluster's scheduler is gone, or cannot be reached any more"

START_S = 120.0
"""Within which a worker process is there."""

GROWN_BYTES, GROWN_SHARE = 2**30, 0.25
"""What a worker may grow by after its first piece, and all of them as a share of the machine's."""
LEAST_PIECES = 20
"""That a worker does, however it grows: starting one takes as long as some."""


@dataclass(frozen=True)
class Simulated:
    """What a worker returns.

    Attributes:
        rollouts: Those of the piece.
        took_s: How long it took to simulate them [s].
        process: Which one did.
        resident_bytes: Memory that it holds.
    """

    rollouts: RolloutBatch
    took_s: float
    process: int
    resident_bytes: int


@dataclass
class _Held:
    """Memory of a worker: after its first piece, and after the newest of so many."""

    first_bytes: int
    pieces: int = 0
    now_bytes: int = 0


class LostError(Exception):
    """A worker was lost with what it was at, or what it was at broke the simulator."""


@dataclass
class PooledRunner:
    """Cuts every batch into pieces for worker processes; a ``BatchRunner``.

    A rollout does not depend on the others of its batch: the pieces, put together in their
    order, are to the last bit what one process would have simulated, however they were cut. So what
    was lost with a worker that died, or that stalls, is simulated again.

    Attributes:
        submit: Takes a function and its arguments, all of which can be pickled, to a worker,
            as :meth:`concurrent.futures.Executor.submit` does.
        workers: How many there are.
        recount: Tells how many there are now, where some may come or go; ``None``: none do.
        is_there: Tells whether what is handed in can still be done.
        renew: Ends all workers and starts others, where one is lost, and tells how that ended, as
            far as it is known; ``None``: what submits sees to it itself.
        retire: Starts others for what comes next, where workers grow; ``None``: they may.
        limit_s: A worker that a piece has waited for so long is lost [s]; ``None``: never.
        pause: Called several times a second while a worker is waited for; what it raises ends that.
        loses: Whether a rollout that cannot be simulated is kept as far as it came, in place of a
            fault; see :mod:`pemviz.sampling.rollouts.losing`.
        lost: How many workers were lost so far.
        retired: How often others were started for workers that had grown.
    """

    submit: Callable[..., Future[Any]]
    workers: int
    recount: Callable[[], int] | None = None
    is_there: Callable[[], bool] = lambda: True
    renew: Callable[[], str] | None = None
    retire: Callable[[], None] | None = None
    limit_s: float | None = None
    pause: Callable[[], None] = lambda: None
    loses: bool = False
    lost: int = field(default=0, init=False)
    retired: int = field(default=0, init=False)
    _is_new: bool = field(default=True, init=False)
    _alone_s: deque[float] = field(
        default_factory=lambda: deque[float](maxlen=REMEMBERED), init=False
    )
    _took: deque[tuple[int, float]] = field(
        default_factory=lambda: deque[tuple[int, float]](maxlen=REMEMBERED), init=False
    )
    _held: dict[int, _Held] = field(default_factory=dict[int, _Held], init=False)

    def __call__(
        self, simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
    ) -> Iterator[RolloutBatch]:
        """The batches of ``tasks``, in their order, as they are done.

        Raises:
            SimulationError: Something raised in a worker, or a rollout ends or stalls whichever is
                at it.
            RunError: The cluster's scheduler is gone.
        """
        ahead: deque[Sequence[_Piece]] = deque()
        if self.recount is not None:
            self.workers = self.recount()
        try:
            for task in tasks:
                ahead.append(self._pieces(simulator, pem, task))
                if len(ahead) > self._most_ahead(len(task.uniforms)):
                    yield _joined(ahead)
                    ahead.popleft()
            while ahead:
                yield _joined(ahead)
                ahead.popleft()
        except Exception as error:
            self._tell_if_gone(error)
            raise
        finally:
            for piece in itertools.chain.from_iterable(ahead):
                piece.future.cancel()

    def _most_ahead(self, count: int) -> int:
        """Batches of so many rollouts under way beside the one that is waited for."""
        if self._rollout_s < SLOW_S:
            return 1
        batch_s = count * self._rollout_s / self.workers
        return max(1, min(math.ceil(AHEAD_S / batch_s), MOST_AHEAD // count))

    def _pieces(self, simulator: Simulator, pem: Pem, task: BatchTask) -> "Sequence[_Piece]":
        """A batch that is handed in; of the first of all, one rollout a worker before the rest.

        These tell how long a rollout takes, and so how many make a piece; of a large batch a few
        rollouts a worker come next, which tell what each takes beside others.
        """
        pieces: list[_Piece] = []
        for each in (1, FEW) if len(task.uniforms) > MANY else (1,):
            count = each * self.workers
            known = self._took if each > 1 else self._took or self._alone_s
            if known or len(task.uniforms) <= count:
                continue
            first, task = task.take(slice(count)), task.take(slice(count, None))
            pieces += [_Piece(self, simulator, pem, one) for one in first.split(self.workers)]
            self._wait_for_half(pieces[-self.workers :])
        pieces_s = self._rollout_s * len(task.uniforms)
        parts = task.split(max(self.workers, round(pieces_s / PIECE_S)))
        return [*pieces, *(_Piece(self, simulator, pem, one) for one in parts)]

    @property
    def _rollout_s(self) -> float:
        """What one rollout more takes: medians of late pieces, as first ones begin with imports.

        Where a piece of many takes hardly longer than one rollout alone, it is little.
        """
        each_s = [*self._alone_s, *(took_s / count for count, took_s in self._took)]
        if not each_s:
            return 0.0
        found = statistics.median(each_s)
        if self._alone_s and self._took:
            count, took_s = map(statistics.median, zip(*self._took, strict=True))
            more_s = max(took_s - statistics.median(self._alone_s), 0.0)
            found = min(found, more_s / (count - 1))
        return found

    def _wait_for_half(self, pieces: "Sequence[_Piece]") -> None:
        """For half of first pieces, which may differ; the others go on."""
        futures, enough = [piece.future for piece in pieces], (len(pieces) + 1) // 2
        self._wait(lambda: sum(future.done() for future in futures) >= enough, futures)
        for future in futures:
            if future.done() and future.exception() is None:
                self._remember(future.result())

    def _remember(self, simulated: Simulated) -> None:
        count, took_s = simulated.rollouts.count, simulated.took_s
        if count == 1:
            self._alone_s.append(took_s)
        else:
            self._took.append((count, took_s))

    def _wait(self, is_over: Callable[[], bool], futures: Sequence[Future[Simulated]]) -> None:
        """Until something is over, but no longer than a piece may take.

        Raises:
            RunError: The cluster's scheduler is gone.
        """
        end_s = time.monotonic() + (math.inf if self.limit_s is None else self.limit_s)
        silent_s = time.monotonic() + SILENT_S
        while not is_over() and (left_s := end_s - time.monotonic()) > 0.0:
            self.pause()
            if not self.is_there():
                raise RunError(SCHEDULER_GONE)
            wait(
                [each for each in futures if not each.done()], min(POLL_S, left_s), FIRST_COMPLETED
            )
            if time.monotonic() >= silent_s:
                limit = "" if self.limit_s is None else f"; step_time_limit_s = {self.limit_s:g}"
                LOG.warning("nothing has come of a worker for %g s%s", SILENT_S, limit)
                silent_s = math.inf

    def start(self, simulator: Simulator, pem: Pem) -> None:
        """Have a worker there that has imported what it needs, which is no rollout's time."""
        if self.renew is None or not self._is_new:
            return
        with contextlib.suppress(BrokenExecutor):  # the rollout itself will say so
            wait([self.submit(_nothing, simulator, pem)], timeout=START_S)
        self._is_new = False

    @property
    def has_spare_workers(self) -> bool:
        """Whether one may be idle for long while another is at the last rollout of a stage."""
        return self.workers > 1 and self._rollout_s >= SLOW_S

    def hand_in(self, simulator: Simulator, pem: Pem, task: BatchTask) -> Future[Simulated]:
        """Rollouts to be simulated beside what is waited for.

        Raises:
            RunError: The cluster's scheduler is gone.
        """
        try:
            return self.submit(_simulated, simulator, pem, task)
        except BrokenExecutor as error:  # a worker died before
            lost: Future[Simulated] = Future()
            lost.set_exception(error)
            return lost
        except Exception as error:
            self._tell_if_gone(error)
            raise

    def _tell_if_gone(self, error: Exception) -> None:
        if self.renew is None and scheduler_is_gone(error):
            raise RunError(SCHEDULER_GONE) from error

    def answer_if_any(self, future: Future[Simulated]) -> RolloutBatch | None:
        """What a worker returns, once it does; ``None`` if it does not, which nobody is told."""
        self._wait(future.done, [future])
        if not future.done() or future.cancelled() or future.exception() is not None:
            return None
        return self._kept(future.result().rollouts)

    def answer(self, future: Future[Simulated]) -> RolloutBatch:
        """What a worker returns, once it does.

        Raises:
            LostError: It died, or takes too long, and others are there; or what it is at breaks the
                simulator, and that is no fault.
            SimulationError: Something raised, or no other workers can be started.
        """
        self._wait(future.done, [future])
        if not future.done():
            why = f"one rollout takes longer than step_time_limit_s = {self.limit_s:g}"
            self._replace(LostError(why), what="worker process stalls")
        try:
            simulated = future.result()
        except BrokenExecutor as error:
            what, why = DIED.split(": ", 1)
            self._replace(LostError(why), what=what, cause=error)
        except SimulationError as error:
            if not (self.loses and error.broke):
                raise
            raise LostError(str(error)) from error
        except Exception as error:
            if not worker_was_killed(error):
                raise
            self.lost += 1  # the cluster has others
            raise LostError("killed, or the machine is out of memory") from error
        self._remember(simulated)
        own = self._held.setdefault(simulated.process, _Held(simulated.resident_bytes))
        own.pieces, own.now_bytes = own.pieces + 1, simulated.resident_bytes
        return self._kept(simulated.rollouts)

    def _kept(self, rollouts: RolloutBatch) -> RolloutBatch:
        return marked(rollouts) if self.loses else rollouts

    def retire_if_grown(self) -> bool:
        """Have other workers where one holds much more than after its first piece; whether so."""
        most = min(GROWN_BYTES, GROWN_SHARE * machine_bytes() / self.workers)
        grown = any(
            held.pieces >= LEAST_PIECES and held.now_bytes - held.first_bytes > most
            for held in self._held.values()
        )
        if self.retire is None or not grown:
            return False
        self.retire()
        self._held.clear()
        self.retired += 1
        self._is_new = True
        return True

    def _replace(
        self, lost: LostError, *, what: str, cause: BaseException | None = None
    ) -> NoReturn:
        self.lost += 1
        if self.renew is None:
            raise SimulationError(f"a {what}", why=str(lost)) from cause
        how = self.renew()
        self._is_new = True
        raise LostError(how) if how else lost from cause


class _Piece:
    """A part of a batch that is under way."""

    def __init__(
        self, runner: PooledRunner, simulator: Simulator, pem: Pem, task: BatchTask
    ) -> None:
        self.task = task
        self.runner, self._simulator, self._pem = runner, simulator, pem
        self.hand_in()

    def hand_in(self) -> None:
        self.future = self._submit(self.task)

    def _submit(self, task: BatchTask) -> Future[Simulated]:
        return self.runner.hand_in(self._simulator, self._pem, task)

    def hand_in_if_lost(self) -> None:
        """Again, where it was under way, or handed in, when a worker was lost."""
        done = self.future.done() and not self.future.cancelled()
        if not done or isinstance(self.future.exception(), BrokenExecutor):
            self.hand_in()

    def alone(self, task: BatchTask, *, lost: int) -> RolloutBatch:
        """A task that was lost so often, with nothing beside it, the smaller the oftener it is.

        So it is found out whether it was at fault, and which of its rollouts.
        """
        self.runner.start(self._simulator, self._pem)
        try:
            return self.runner.answer(self._submit(task))
        except LostError as error:
            lost += 1
            if len(task.uniforms) == 1 and lost >= MOST_LOST:
                if self.runner.loses:
                    return self._as_far_as_it_came(task, error)
                what = f"{lost} worker processes were lost one after the other"
                raise SimulationError(what, why=str(error), rollouts=range(1)) from error
            known = getattr(error.__cause__, "rollouts", None)
        parts: list[RolloutBatch] = []
        for some in _apart(task, known):
            with counted_from(sum(part.count for part in parts)):
                parts.append(self.alone(some, lost=lost))
        return RolloutBatch.concatenate(parts)

    def _as_far_as_it_came(self, task: BatchTask, lost: LostError) -> RolloutBatch:
        """A rollout that cannot be simulated; where only its process tells how far, in another."""
        fault = SimulationError("a rollout cannot be begun", why=str(lost), rollouts=range(1))
        broke = lost.__cause__ if isinstance(lost.__cause__, SimulationError) else None
        if broke is None:
            limit_s = self.runner.limit_s
            came = simulate_apart(self._simulator, self._pem, task, limit_s=limit_s)
            if came.rollouts is not None:
                return marked(came.rollouts)
            outcomes = len(came.given)
        else:
            outcomes = broke.outcomes

        def simulate(stays: BatchTask) -> RolloutBatch:
            try:
                return self.runner.answer(self._submit(stays))
            except LostError as error:
                again = SimulationError(str(error))
                again.broke, again.outcomes = True, stays.stays_from
                raise again from error

        return without_the_rest(outcomes, task, fault, simulate)


def _apart(task: BatchTask, rollouts: range | None) -> Sequence[BatchTask]:
    """The rollout that is known to be at fault and those beside it; halves where it is not."""
    if rollouts is None or len(rollouts) != 1:
        return task.split(2)
    (row,) = rollouts
    edges = itertools.pairwise(sorted({0, row, row + 1, len(task.uniforms)}))
    return [task.take(rows) for rows in itertools.starmap(slice, edges)]


def losing_here(
    simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
) -> Iterator[RolloutBatch]:
    """One batch after the other, in the thread that wants it, none ahead; a ``BatchRunner``.

    Rollouts that cannot be simulated are kept as far as they came.

    Raises:
        SimulationError: Other people's code but the simulator's raises something, or the simulator
            before a first outcome.
    """
    runner = PooledRunner(_at_once, 1, loses=True)
    for task in tasks:
        yield from runner(simulator, pem, [task])


def _at_once(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """As a pool's ``submit``; what is no fault of a simulation's is raised here."""
    future: Future[Any] = Future()
    try:
        future.set_result(function(*arguments))
    except SimulationError as error:
        future.set_exception(error)
    return future


def _joined(ahead: Sequence[Sequence[_Piece]]) -> RolloutBatch:
    """The first of the batches that are under way."""
    parts: list[RolloutBatch] = []
    for piece in ahead[0]:
        runner = piece.runner
        with counted_from(sum(part.count for part in parts)):
            before = runner.lost
            try:
                parts.append(runner.answer(piece.future))
            except LostError:
                parts.append(piece.alone(piece.task, lost=1))
                ended = runner.renew is not None and runner.lost > before
                for other in itertools.chain.from_iterable(ahead) if ended else ():
                    if other is not piece:
                        other.hand_in_if_lost()
            if runner.retire_if_grown():
                for other in itertools.chain.from_iterable(ahead):
                    if other.future.cancel():  # no worker is at it
                        other.hand_in()
    return RolloutBatch.concatenate(parts)


def _nothing(simulator: Simulator, pem: Pem) -> None:
    """All that comes before a batch in a worker."""


def _simulated(simulator: Simulator, pem: Pem, task: BatchTask) -> Simulated:
    """A batch's rollouts, in a worker."""
    began = time.perf_counter()
    rollouts = by_numpy(simulator, pem, task)
    took_s = time.perf_counter() - began
    return Simulated(rollouts, took_s, process=os.getpid(), resident_bytes=resident_bytes())
