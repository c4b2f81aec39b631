"""The three metrics written from their definitions, one value at a time.

Plain Python, recursion over the formula at every step, nothing shared with the package
but the syntax tree. Signals: {name: list of floats}, a single rollout.
"""

import math
import operator
from functools import cache

from pemviz.stl import formulas as fo


def number(node, signals, t):
    match node:
        case fo.Constant(value=value):
            return value
        case fo.Signal(name=name):
            return signals[name][t]
        case fo.Sum(left=a, right=b):
            return number(a, signals, t) + number(b, signals, t)
        case fo.Difference(left=a, right=b):
            return number(a, signals, t) - number(b, signals, t)
        case fo.Product(left=a, right=b):
            return number(a, signals, t) * number(b, signals, t)
        case fo.Quotient(left=a, right=b):
            return number(a, signals, t) / number(b, signals, t)
        case fo.Negative(operand=a):
            return -number(a, signals, t)
        case fo.Absolute(operand=a):
            return abs(number(a, signals, t))
        case fo.Minimum(operands=operands):
            return min(number(a, signals, t) for a in operands)
        case fo.Maximum(operands=operands):
            return max(number(a, signals, t) for a in operands)
    raise AssertionError(node)


def predicate_margin(node, signals, t):
    difference = number(node.left, signals, t) - number(node.right, signals, t)
    return difference if node.comparison in (">=", ">") else -difference


def classical(formula, signals, t=0):
    @cache
    def r(f, t):
        match f:
            case fo.Truth():
                return math.inf
            case fo.Predicate():
                return predicate_margin(f, signals, t)
            case fo.Not(operand=a):
                return -r(a, t)
            case fo.And(parts=parts):
                return min(r(a, t) for a in parts)
            case fo.Or(parts=parts):
                return max(r(a, t) for a in parts)
            case fo.Implies(premise=a, conclusion=b):
                return max(-r(a, t), r(b, t))
            case fo.Always(first=first, last=last, operand=a):
                return min(r(a, u) for u in range(t + first, t + last + 1))
            case fo.Eventually(first=first, last=last, operand=a):
                return max(r(a, u) for u in range(t + first, t + last + 1))
            case fo.Until(first=first, last=last, left=a, right=b):
                return max(
                    min(r(b, u), *(r(a, v) for v in range(t, u + 1)))
                    for u in range(t + first, t + last + 1)
                )
        raise AssertionError(f)

    return r(formula, t)


COMPARED = {">=": operator.ge, ">": operator.gt, "<=": operator.le, "<": operator.lt}


def holds(formula, signals, t=0):
    """Boolean semantics."""
    match formula:
        case fo.Truth():
            return True
        case fo.Predicate(left=a, right=b, comparison=comparison):
            return COMPARED[comparison](number(a, signals, t), number(b, signals, t))
        case fo.Not(operand=a):
            return not holds(a, signals, t)
        case fo.And(parts=parts):
            return all(holds(a, signals, t) for a in parts)
        case fo.Or(parts=parts):
            return any(holds(a, signals, t) for a in parts)
        case fo.Implies(premise=a, conclusion=b):
            return not holds(a, signals, t) or holds(b, signals, t)
        case fo.Always(first=first, last=last, operand=a):
            return all(holds(a, signals, u) for u in range(t + first, t + last + 1))
        case fo.Eventually(first=first, last=last, operand=a):
            return any(holds(a, signals, u) for u in range(t + first, t + last + 1))
        case fo.Until(first=first, last=last, left=a, right=b):
            return any(
                holds(b, signals, u) and all(holds(a, signals, v) for v in range(t, u + 1))
                for u in range(t + first, t + last + 1)
            )
    raise AssertionError(formula)


def interval(node, bounds):
    """Least and greatest value: the extremes over the corners and the kinks."""
    match node:
        case fo.Constant(value=value):
            return value, value
        case fo.Signal(name=name):
            return bounds[name]
        case fo.Negative(operand=a):
            low, high = interval(a, bounds)
            return -high, -low
        case fo.Absolute(operand=a):
            low, high = interval(a, bounds)
            corners = [abs(low), abs(high)]
            return (0.0 if low <= 0.0 <= high else min(corners)), max(corners)
        case fo.Minimum(operands=operands):
            ranges = [interval(a, bounds) for a in operands]
            return min(low for low, _ in ranges), min(high for _, high in ranges)
        case fo.Maximum(operands=operands):
            ranges = [interval(a, bounds) for a in operands]
            return max(low for low, _ in ranges), max(high for _, high in ranges)
    (a, b), (c, d) = interval(node.left, bounds), interval(node.right, bounds)
    match node:
        case fo.Sum():
            corners = [a + c, b + d]
        case fo.Difference():
            corners = [a - d, b - c]
        case fo.Product():
            corners = [a * c, a * d, b * c, b * d]
        case fo.Quotient():
            corners = [a / c, a / d, b / c, b / d]
    return min(corners), max(corners)


def agm_and(etas):
    m = len(etas)
    if any(eta <= 0 for eta in etas):
        return math.fsum(min(eta, 0.0) for eta in etas) / m
    return math.expm1(math.fsum(math.log1p(eta) for eta in etas) / m)


def agm_or(etas):
    m = len(etas)
    if any(eta >= 0 for eta in etas):  # published with >, which leaves the dual of agm_and at 0
        return math.fsum(max(eta, 0.0) for eta in etas) / m
    return -math.expm1(math.fsum(math.log1p(-eta) for eta in etas) / m)


def agm(formula, signals, bounds, t=0):
    @cache
    def r(f, t):
        match f:
            case fo.Truth():
                return 1.0
            case fo.Predicate():
                (a, b), (c, d) = interval(f.left, bounds), interval(f.right, bounds)
                width = (b - a) + (d - c)
                margin = predicate_margin(f, signals, t)
                if width == 0:
                    return float(margin > 0) - float(margin < 0)
                return margin / width
            case fo.Not(operand=a):
                return -r(a, t)
            case fo.And(parts=parts):
                return agm_and([r(a, t) for a in parts])
            case fo.Or(parts=parts):
                return agm_or([r(a, t) for a in parts])
            case fo.Implies(premise=a, conclusion=b):
                return agm_or([-r(a, t), r(b, t)])
            case fo.Always(first=first, last=last, operand=a):
                return agm_and([r(a, u) for u in range(t + first, t + last + 1)])
            case fo.Eventually(first=first, last=last, operand=a):
                return agm_or([r(a, u) for u in range(t + first, t + last + 1)])
            case fo.Until(first=first, last=last, left=a, right=b):
                return agm_or(
                    [
                        agm_and([r(b, u), agm_and([r(a, v) for v in range(t, u + 1)])])
                        for u in range(t + first, t + last + 1)
                    ]
                )
        raise AssertionError(f)

    return r(formula, t)


def log_sum_exp(values):
    top = max(values)
    if math.isinf(top):
        return top
    return top + math.log(math.fsum(math.exp(v - top) for v in values))


def soft_min(values, beta):
    return -log_sum_exp([-beta * v for v in values]) / beta


def soft_max(values, beta):
    return log_sum_exp([beta * v for v in values]) / beta


def log1p_exp(z):
    return z + math.log1p(math.exp(-z)) if z > 0 else math.log1p(math.exp(z))


def smooth(formula, signals, beta, positive, t=0):
    @cache
    def r(f, t, positive):
        match f:
            case fo.Truth():
                return math.inf if positive else 0.0
            case fo.Predicate():
                scaled = beta * predicate_margin(f, signals, t)
                return log1p_exp(scaled) / beta if positive else -log1p_exp(-scaled) / beta
            case fo.Not(operand=a):
                return -r(a, t, not positive)
            case fo.And(parts=parts):
                return soft_min([r(a, t, positive) for a in parts], beta)
            case fo.Or(parts=parts):
                return soft_max([r(a, t, positive) for a in parts], beta)
            case fo.Implies(premise=a, conclusion=b):
                return soft_max([-r(a, t, not positive), r(b, t, positive)], beta)
            case fo.Always(first=first, last=last, operand=a):
                window = range(t + first, t + last + 1)
                return soft_min([r(a, u, positive) for u in window], beta)
            case fo.Eventually(first=first, last=last, operand=a):
                window = range(t + first, t + last + 1)
                return sum(r(a, u, positive) for u in window)
            case fo.Until(first=first, last=last, left=a, right=b):
                return sum(
                    soft_min(
                        [
                            r(b, u, positive),
                            soft_min([r(a, v, positive) for v in range(t, u + 1)], beta),
                        ],
                        beta,
                    )
                    for u in range(t + first, t + last + 1)
                )
        raise AssertionError(f)

    return r(formula, t, positive)
