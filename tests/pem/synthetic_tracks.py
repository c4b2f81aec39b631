"""Tracks drawn from the model of memory itself, outcome by outcome, in plain Python."""

import math
from statistics import NormalDist

import numpy as np

from pemviz.pem.data.table import track_table
from pemviz.pem.models.protocol import SALIENT_COLUMNS


def draw_tracks(
    *, seed, tau_s, frailty, sequences=20, tracks_each=12, frames=20, rate_hz=10.0, keep=1.0
):
    """A table of tracks and the true logits of P(detected), in the table's order."""
    random = np.random.default_rng(seed)
    normal = NormalDist()
    rows = []
    for sequence in range(sequences):
        for track in range(tracks_each):
            u = random.standard_normal()
            p = 0.25 / (1.0 + math.exp(random.normal(0.0, 1.0)))
            missed = None
            for frame in range(frames):
                p = min(max(p * math.exp(random.normal(0.0, 0.1)), 1e-3), 0.6)
                mine = normal.cdf(normal.inv_cdf(p) * math.sqrt(1 + frailty**2) + frailty * u)
                rho = math.exp(-1.0 / rate_hz / tau_s) if tau_s > 0 and missed is not None else 0.0
                missed = random.random() < mine + (float(bool(missed)) - mine) * rho
                rows.append((sequence, track, frame, p, not missed))
    kept = [row for row in rows if random.random() < keep]
    sequence, track, frame, p, detected = (np.array(column) for column in zip(*kept, strict=True))
    salient = np.zeros((len(kept), len(SALIENT_COLUMNS)))
    salient[:, 9] = np.log(p)
    who = {"sequence": sequence, "track": track, "frame": frame}
    table = tracks_of(detected, **who, rate_hz=rate_hz, salient=salient)
    p = np.exp(table.obstacles.salient[:, 9])
    return table, np.log1p(-p) - np.log(p)


def tracks_of(detected, *, sequence, track, frame, rate_hz=10.0, salient=None):
    """A table of tracks, in the same state throughout if none is given."""
    count = len(detected)
    return track_table(
        salient=np.zeros((count, len(SALIENT_COLUMNS))) if salient is None else salient,
        detected=detected.astype(bool),
        sequence=sequence,
        track=track,
        frame=frame.astype(np.int64),
        rate_hz=np.broadcast_to(rate_hz, count),
        source="synthetic",
    )
