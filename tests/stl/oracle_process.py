"""Classical robustness at step 0 by other libraries; runs in their own environment.

Reads {"library": name, "cases": [{"formula": text, "signals": {name: [..]}}]} from
standard input, writes the list of values.
"""

import json
import sys


def by_rtamt(formula, signals):
    import rtamt  # noqa: PLC0415

    spec = rtamt.StlDiscreteTimeSpecification()
    for name in signals:
        spec.declare_var(name, "float")
    spec.set_sampling_period(1, "s", 0.1)
    spec.spec = formula
    spec.parse()
    steps = len(next(iter(signals.values())))
    return spec.evaluate({"time": list(range(steps)), **signals})[0][1]


def by_sentil(formula, signals):
    import sentil  # noqa: PLC0415

    steps = len(next(iter(signals.values())))
    trace = sentil.Trace([float(step) for step in range(steps)], signals)
    return sentil.Formula.parse(formula).robustness(trace)


def by_tidystl(formula, signals):
    import numpy as np  # noqa: PLC0415
    import tidystl  # noqa: PLC0415

    steps = len(next(iter(signals.values())))
    signal = tidystl.Signal.from_dict(
        times=np.arange(steps, dtype=float),
        values={name: np.array([values]) for name, values in signals.items()},
    )
    return float(tidystl.robustness(tidystl.parse(formula), signal)[0, 0])


LIBRARIES = {"rtamt": by_rtamt, "sentil": by_sentil, "tidystl": by_tidystl}


def main():
    request = json.load(sys.stdin)
    evaluate = LIBRARIES[request["library"]]
    values = [evaluate(case["formula"], case["signals"]) for case in request["cases"]]
    json.dump(values, sys.stdout)


if __name__ == "__main__":
    main()
