"""Worlds in which the rate of harm is known, and what somebody would know of its factors there."""

import numpy as np

from pemviz.analysis.risk import HazardFactors
from pemviz.analysis.risk_factors import Z95, counted_probability, counted_rate, stated


def stated_by(truth, *, kind, random, spread, source, most=np.inf):
    """A log-normal error around the truth, with the interval that belongs to it."""
    median = min(truth * np.exp(spread * random.standard_normal()), most)
    ends = median * np.exp(-Z95 * spread), min(median * np.exp(Z95 * spread), most)
    return stated(median, *ends, kind=kind, source=source, most=most)


def world(seed):
    """One to four hazards, every factor unknown: what is known of them, and the rate of harm."""
    random, hazards, truth = np.random.default_rng(seed), [], 0.0
    for place in range(int(random.integers(1, 5))):
        rate, hours = 10.0 ** random.uniform(-1.0, 1.5), 10.0 ** random.uniform(0.5, 2.5)
        if random.random() < 0.6:
            counted = int(random.poisson(rate * hours))
            encounters = counted_rate(counted, hours, source=f"e{place}")
        else:
            spread = random.uniform(0.1, 0.8)
            encounters = stated_by(
                rate, kind="encounters", random=random, spread=spread, source=f"e{place}"
            )
        violation = Probability(10.0 ** random.uniform(-9.0, -1.3), "violation", random, place)
        harm = Probability(10.0 ** random.uniform(-2.5, -0.05), "harm", random, place)
        hazards.append(HazardFactors(f"h{place}", encounters, violation.known, harm.known))
        truth += rate * violation.truth * harm.truth
    return hazards, truth


class Probability:
    """A probability, and what is known of it: counts where they tell something, else a range."""

    def __init__(self, truth, kind, random, place):
        self.truth, source = truth, f"{kind} {place}"
        if truth > 1e-4 and random.random() < 0.5:
            trials = int(10.0 ** random.uniform(1.3, 4.0))
            events = int(random.binomial(trials, truth))
            self.known = counted_probability(events, trials, kind=kind, source=source)
        else:
            spread = random.uniform(0.05, 0.8)
            self.known = stated_by(
                truth, kind=kind, random=random, spread=spread, source=source, most=1.0
            )
