"""Tracks drawn from the model of memory itself, outcome by outcome, in plain Python."""

import math

import numpy as np

from pemviz.pem.data.table import track_table
from pemviz.pem.models.protocol import SALIENT_COLUMNS


def draw_tracks(
    *, seed, tau_s, frailty, sequences=20, tracks_each=12, frames=20, rate_hz=10.0, keep=1.0
):
    """A table of tracks and the true logits of P(detected), in the table's order."""
    random = np.random.default_rng(seed)
    normal = _Normal()
    rows = []
    for sequence in range(sequences):
        for track in range(tracks_each):
            u = random.standard_normal()
            p = 0.25 / (1.0 + math.exp(random.normal(0.0, 1.0)))
            missed = None
            for frame in range(frames):
                p = min(max(p * math.exp(random.normal(0.0, 0.1)), 1e-3), 0.6)
                mine = normal.cdf(normal.quantile(p) * math.sqrt(1 + frailty**2) + frailty * u)
                rho = math.exp(-1.0 / rate_hz / tau_s) if tau_s > 0 and missed is not None else 0.0
                missed = random.random() < mine + (float(bool(missed)) - mine) * rho
                rows.append((sequence, track, frame, p, not missed))
    kept = [row for row in rows if random.random() < keep]
    columns = [np.array(column) for column in zip(*kept, strict=True)]
    sequence, track, frame, p, detected = columns
    salient = np.zeros((len(kept), len(SALIENT_COLUMNS)))
    salient[:, 9] = np.log(p)
    table = track_table(
        salient=salient,
        detected=detected.astype(bool),
        sequence=sequence,
        track=track,
        frame=frame.astype(np.int64),
        rate_hz=np.full(len(kept), rate_hz),
        source="synthetic",
    )
    p = np.exp(table.obstacles.salient[:, 9])
    return table, np.log1p(-p) - np.log(p)


class _Normal:
    """The standard normal distribution, by the standard library."""

    def __init__(self):
        from statistics import NormalDist  # noqa: PLC0415

        self._of = NormalDist()

    def cdf(self, x):
        return self._of.cdf(x)

    def quantile(self, p):
        return self._of.inv_cdf(p)
