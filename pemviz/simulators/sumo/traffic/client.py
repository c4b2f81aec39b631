"""An episode in a process of SUMO's own, as an environment that is reset and stepped."""

import array
import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import weakref
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scipy.special import ndtr

from pemviz.arrays import FloatArray
from pemviz.errors import RunError
from pemviz.latents import LatentCounts
from pemviz.simulators.sumo.engine import check_installed
from pemviz.simulators.sumo.traffic.facts import TrafficSettings, signal_names
from pemviz.simulators.sumo.traffic.host import ENDED, RESET, STEP, WRONG
from pemviz.simulators.sumo.traffic.pipe import Pipe
from pemviz.simulators.sumo.traffic.signals import traffic_signals
from pemviz.types import Signal

LARGEST_SEED = 2**31 - 1
NAMES = signal_names()
GONE = "its process ended without a word"


class _Host:
    """The process that makes processes; one for each of those that have episodes."""

    def __init__(self) -> None:
        self.pid = -1
        self.socket: socket.socket | None = None

    def connected(self) -> Pipe:
        """A pipe to a new process with libsumo."""
        if self.socket is None or self.pid != os.getpid():
            self._start()
        ours, theirs = socket.socketpair()
        with theirs:
            assert self.socket is not None  # noqa: S101  started above
            socket.send_fds(self.socket, [b"1"], [theirs.fileno()])
        return Pipe(ours)

    def _start(self) -> None:
        check_installed()
        ours, theirs = socket.socketpair()
        package = str(Path(__file__).resolve().parents[4])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            process = subprocess.Popen(  # noqa: S603  our own module
                [sys.executable, "-m", "pemviz.simulators.sumo.traffic.host", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            )
        self.socket, self.pid = ours, os.getpid()
        weakref.finalize(self, _ended, ours, process)


def _ended(ours: socket.socket, process: "subprocess.Popen[bytes]") -> None:
    """Have the process end, as it does once its socket is closed."""
    ours.close()
    process.wait()


HOST = _Host()


class TrafficEpisodes:
    """One episode at a time; a :class:`pemviz.EpisodicSimulator`, told the ego's accelerations."""

    name = "sumo"
    latents = LatentCounts(seeds=1)

    def __init__(self, settings: TrafficSettings, *, states: int) -> None:
        """Nothing is started yet.

        Args:
            settings: What SUMO is told.
            states: In a rollout.
        """
        self.settings, self.states = settings, states
        self._pipe: Pipe | None = None
        self._asked: list[bytes] = []

    @property
    def dt_s(self) -> float:
        """Of a step [s]."""
        return self.settings.step_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What SUMO's process tells, and the speed that the ego wants."""
        return traffic_signals()

    def begin_reset(self, *given: Any) -> None:
        """Have the next :meth:`reset` begin before it is called."""
        seed = min(int(ndtr(float(given[0][0])) * LARGEST_SEED), LARGEST_SEED - 1)
        self._ask(RESET + struct.pack("q", seed))

    def begin_step(self, *given: Any) -> None:
        """Have the next :meth:`step` begin before it is called."""
        self._ask(STEP + struct.pack("d", float(given[0])))

    def reset(self, *given: Any) -> Mapping[str, float]:
        """Begin with SUMO's seed, for standard normals ``[1]``.

        Raises:
            RunError: SUMO fails, or the ego does not enter.
        """
        if not self._asked:
            self.begin_reset(*given)
        values, _ = self._answer()
        return dict(zip(NAMES, values, strict=True))

    def step(self, *given: Any) -> tuple[Mapping[str, float], bool]:
        """One step with the ego's acceleration [m/s^2].

        Raises:
            RunError: SUMO fails.
        """
        if not self._asked:
            self.begin_step(*given)
        values, ended = self._answer()
        return dict(zip(NAMES, values, strict=True)), ended

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Speed of the ego; what perception looks at is the simulator's that wraps this."""
        return signals["ego_speed"][..., None]

    def _ask(self, asked: bytes) -> None:
        if self._pipe is None:
            self._pipe = HOST.connected()
            self._pipe.send(json.dumps(asdict(self.settings)).encode())
        self._asked = [asked]
        with contextlib.suppress(OSError):  # it is gone, which the answer tells
            self._pipe.send(asked)

    def _answer(self) -> tuple[list[float], bool]:
        assert self._pipe is not None  # noqa: S101  asked before
        self._asked = []
        try:
            answer = self._pipe.receive()
        except (EOFError, OSError):
            self._pipe.close()
            self._pipe = None
            raise self._failed(GONE) from None
        if answer[:1] == WRONG:
            raise self._failed(answer[1:].decode())
        values = array.array("d")
        values.frombytes(answer[1:])
        return values.tolist(), answer[:1] == ENDED

    def _failed(self, words: str) -> RunError:
        return RunError(f"sumo.config {self.settings.config}: SUMO: {words}")
