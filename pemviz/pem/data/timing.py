"""Time in tables of tracks: rates by time stamps, gaps, and frames that are there again.

What is wrong without a doubt is refused; what may be meant is told in words. A rate is never
guessed: it is the table's, the user's, or that of the sequence's own time stamps.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.columns import Columns

SLOWEST_HZ, FASTEST_HZ = 0.01, 1e4
AGREE = 0.05
"""By how much rates differ that count as one."""
IRREGULAR = 0.2
"""Of an interval: off by more than this share of the usual one it is irregular."""
GAP = 1.5
"""Usual intervals beyond which a track has a gap."""
FEW = 0.02
"""Share of intervals of which nothing is said."""
CERTAIN_RUNS = 0.9
"""Share of states that last equally many frames, above which frames were logged again."""
SUSPECT_RUNS = 0.05
FEWEST_RUNS = 20
FEWEST_CHANGES = 30
ALL_CHANGES = 0.97
HELD_FRAMES = (2, 3, 4)


def rates_of(
    time_s: FloatArray, *, sequence: IntArray, track: IntArray, names: NDArray[np.str_], where: str
) -> FloatArray:
    """Frames a second of each row's sequence ``[n]``: the median of its tracks' intervals.

    Args:
        time_s: Time stamps of rows ``[n]`` [s].
        sequence: Which sequence each is of ``[n]``, counted from 0.
        track: Which obstacle over all sequences ``[n]``.
        names: Of the sequences.
        where: The file, for messages.

    Raises:
        PemError: No obstacle of a sequence is seen twice, or its rate is none that video has.
    """
    order = np.lexsort((time_s, track))
    follows = np.diff(track[order]) == 0
    steps_s, of_step = np.diff(time_s[order])[follows], sequence[order][1:][follows]
    del order, follows  # of logs with millions of rows
    by_sequence = np.argsort(of_step, kind="stable")
    steps_s, ends = (
        steps_s[by_sequence],
        np.searchsorted(of_step[by_sequence], range(len(names) + 1)),
    )
    rate_hz = np.empty(len(names))
    for index, name in enumerate(names):
        own = steps_s[ends[index] : ends[index + 1]]
        if not own.size:
            raise PemError(
                f"{where}: no obstacle of sequence {name} is seen twice, so that its times tell no "
                "rate; give a column rate_hz, or leave the sequence out"
            )
        step_s = float(np.median(own))
        if step_s <= 0.0 or not SLOWEST_HZ <= 1.0 / step_s <= FASTEST_HZ:
            raise PemError(
                f"{where}: times of sequence {name} are {step_s:.4g} s apart in the middle, "
                f"allowed: {1 / FASTEST_HZ:g} to {1 / SLOWEST_HZ:g} s; are they in another unit "
                '(unit = "ms", "us" or "ns" in the mapping)?'
            )
        rate_hz[index] = 1.0 / step_s
    return rate_hz[sequence]


def check_rates(
    stated_hz: FloatArray, by_times_hz: FloatArray, sequence: NDArray[np.str_], *, where: str
) -> None:
    """Whether stated rates are those of time stamps, both ``[n]``; ``sequence [n]`` are names.

    Raises:
        PemError: They are not; one line says where.
    """
    off = np.abs(stated_hz / by_times_hz - 1.0) > AGREE
    if off.any():
        row = int(np.argmax(off))
        raise PemError(
            f"{where}: sequence {sequence[row]}: rate_hz is {stated_hz[row]:.4g}, but its times "
            f"are {1.0 / by_times_hz[row]:.4g} s apart in the middle ({by_times_hz[row]:.4g} Hz)"
        )


def check_not_twice(
    sequence: IntArray, track: IntArray, moment: FloatArray, columns: Columns
) -> None:
    """Whether no two rows are of one obstacle at one moment.

    Args:
        sequence: Of each row of the table ``[n]``.
        track: Of each row, within its sequence or over all ``[n]``.
        moment: Frame or time of each row ``[n]``.
        columns: The table.

    Raises:
        PemError: Two are; one line says which, and how many.
    """
    order = np.lexsort((moment, track, sequence))
    equal = [np.diff(values[order]) == 0 for values in (sequence, track, moment)]
    again = np.append(False, np.logical_and.reduce(equal))
    if not again.any():
        return
    place = int(np.argmax(again))
    first, second = sorted(int(row) for row in order[place - 1 : place + 1])
    raise PemError(
        f"{columns.place(second)}: the same sequence, track and moment as in row "
        f"{columns.lines[first]}; {np.count_nonzero(again)} rows are there again, though a miss "
        "counted twice makes misses seem to follow each other: give each once"
    )


def clock_words(since_s: FloatArray, rate_hz: FloatArray, sequence: IntArray) -> Iterator[str]:
    """What is to be known of tracks' times, in words.

    Args:
        since_s: Time since the track's row before ``[n]`` [s]; infinite at its first.
        rate_hz: Frames a second ``[n]``.
        sequence: Of each row ``[n]``.
    """
    _, first = np.unique(sequence, return_index=True)
    rates = np.sort(rate_hz[first])
    if rates.size and rates[-1] / rates[0] > 1.0 + AGREE:
        groups = np.split(rates, np.flatnonzero(np.diff(np.log(rates)) > AGREE) + 1)
        parts = ", ".join(f"{np.median(each):.4g} Hz in {each.size}" for each in groups)
        yield f"sequences have different rates, each is taken by its own: {parts}"
    steps = (since_s * rate_hz)[np.isfinite(since_s)]
    if not steps.size:
        return
    odd = np.abs(steps - np.maximum(np.round(steps), 1.0)) > IRREGULAR
    if np.mean(odd) > FEW:
        low, high = np.percentile(steps[odd], (5, 95))
        yield (
            f"{np.mean(odd):.0%} of the intervals are no whole number of frames (most from "
            f"{low:.2g} to {high:.2g} frames): times are taken as they stand"
        )
    if np.mean(steps > GAP) > FEW:
        yield (
            f"{np.mean(steps > GAP):.0%} of the intervals within tracks are gaps of over "
            f"{GAP:g} frames"
        )


def check_not_logged_again(
    salient: FloatArray | None,
    detected: BoolArray,
    *,
    follows: BoolArray,
    frame: IntArray,
    where: str,
) -> tuple[str, ...]:
    """Whether frames were logged several times under new numbers, by what repeats itself.

    Args:
        salient: States of rows ``[n, D]`` in the order of tracks; ``None`` if unknown.
        detected: Outcomes ``[n]``.
        follows: Whether the row before is of the same track ``[n]``.
        frame: Of each row ``[n]``.
        where: The file, for messages.

    Returns:
        What looks like it, but may be meant, in words.

    Raises:
        PemError: All frames were.
    """
    told: list[str] = []
    if salient is not None:
        lengths, mixed = _lasting_states(salient, detected, follows)
        told += _repeat_words(lengths, mixed, where=where)
    changed = np.append(False, detected[1:] != detected[:-1]) & follows
    changed &= np.append(False, np.diff(frame) == 1)
    changes = frame[changed]
    for held in HELD_FRAMES:
        if changes.size < FEWEST_CHANGES or told:
            break
        most = np.bincount(changes % held).max() / changes.size
        if most >= ALL_CHANGES:
            told.append(
                f"{most:.0%} of the {changes.size} changes between seen and missed are {held} "
                f"frames apart or a multiple of it: either each frame was logged {held} times, and "
                f"the memory of misses is an artefact, or the detector runs every {held} frames"
            )
    return tuple(told)


def _lasting_states(
    salient: FloatArray, detected: BoolArray, follows: BoolArray
) -> tuple[IntArray, BoolArray]:
    """How many rows each state lasts, of tracks that move, and whether outcomes differ within."""
    same = follows & np.append(False, (salient[1:] == salient[:-1]).all(axis=1))
    run = np.cumsum(~same) - 1
    lengths = np.bincount(run)
    seen = np.bincount(run, weights=detected)
    mixed = (seen > 0) & (seen < lengths)
    track_of_run = (np.cumsum(~follows) - 1)[~same]
    moves = np.bincount(track_of_run)[track_of_run] > 2
    inner = moves & np.append(track_of_run[1:] == track_of_run[:-1], False)
    return lengths[inner], mixed[inner]


def _repeat_words(lengths: IntArray, mixed: BoolArray, *, where: str) -> Iterator[str]:
    if lengths.size < FEWEST_RUNS:
        return
    usual = int(np.bincount(lengths).argmax())
    share = float(np.mean(lengths == usual))
    again = float(np.mean(lengths > 1))
    if usual > 1 and share >= CERTAIN_RUNS and not mixed.any():
        raise PemError(
            f"{where}: {share:.0%} of the states of obstacles that move last exactly {usual} "
            f"frames, to the last digit and with one outcome: each frame was logged {usual} times, "
            f"so that misses would seem to follow each other; keep one of {usual}"
        )
    if again > SUSPECT_RUNS:
        outcomes = "outcomes differ within" if mixed.any() else "with one outcome each"
        yield (
            f"{again:.0%} of the states of obstacles that move last several frames to the last "
            f"digit ({outcomes}): frames were logged again, or labels are held between frames"
        )
