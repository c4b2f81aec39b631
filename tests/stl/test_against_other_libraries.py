"""Classical robustness against independent libraries, each in its own dialect.

Their environment is made by
    python3.11 -m venv .venv-oracles
    .venv-oracles/bin/pip install -r tests/stl/oracle_requirements.txt
or is any other whose Python PEMVIZ_ORACLE_PYTHON names, which then must be there.
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pemviz.stl import Classical, robustness
from pemviz.stl import formulas as fo

from .strategies import formulas, lawful, rollouts, row

ROOT = Path(__file__).resolve().parents[2]
CASES = 500


@pytest.fixture(scope="module")
def oracle_python():
    path = os.environ.get("PEMVIZ_ORACLE_PYTHON") or str(ROOT / ".venv-oracles/bin/python")
    if not Path(path).exists():
        if "PEMVIZ_ORACLE_PYTHON" in os.environ:
            pytest.fail(f"PEMVIZ_ORACLE_PYTHON = {path}: there is no such file")
        pytest.skip(f"no environment with the other libraries at {path}")
    return path


def dialect(formula, library):
    """The formula as ``library`` writes it.

    tidystl's until is the inclusive one. rtamt's and sentil's ask the left side only
    before t', so their right side must ask for both.
    """
    word = {"tidystl": {fo.Always: "G", fo.Eventually: "F"}}.get(
        library, {fo.Always: "always", fo.Eventually: "eventually"}
    )

    def interval(node):
        return f"[{node.first}{':' if library == 'rtamt' else ','}{node.last}]"

    def text(node):
        match node:
            case fo.Predicate(left=left, right=right, comparison=comparison):
                return f"({left} {comparison} {right})"
            case fo.Not(operand=a):
                return f"(not {text(a)})"
            case fo.And(parts=parts) | fo.Or(parts=parts):
                return f"({f' {node.word} '.join(text(part) for part in parts)})"
            case fo.Implies(premise=a, conclusion=b):
                return f"((not {text(a)}) or {text(b)})"
            case fo.Always(operand=a) | fo.Eventually(operand=a):
                return f"({word[type(node)]}{interval(node)} {text(a)})"
            case fo.Until(left=a, right=b):
                a, b = text(a), text(b)
                if library == "tidystl":
                    return f"({a} U{interval(node)} {b})"
                return f"({a} until{interval(node)} ({a} and {b}))"
        raise AssertionError(node)

    return text(formula)


signals = st.sampled_from(("gap", "ego_speed")).map(fo.Signal)
simple = st.one_of(
    signals,
    st.builds(fo.Sum, signals, signals),
    st.builds(fo.Difference, signals, signals),
    signals.map(fo.Absolute),
)
positive = st.integers(1, 80).map(lambda value: fo.Constant(value / 4))
atoms = st.builds(fo.Predicate, simple, st.sampled_from((">=", ">", "<=", "<")), positive)


@pytest.fixture(scope="module")
def cases():
    """Formulas with one rollout each (rtamt wants two states at least)."""
    cases = []

    @settings(lawful, max_examples=CASES, database=None, phases=[Phase.generate])
    @given(formulas(3, atoms, truth=False), st.integers(0, 2**32 - 1))
    def collect(formula, seed):
        cases.append((formula, rollouts(seed, formula.horizon_steps() + 2, 1)))

    collect()
    return cases


@pytest.mark.parametrize("library", ["rtamt", "sentil", "tidystl"])
def test_classical_agrees(library, oracle_python, cases):
    request = {
        "library": library,
        "cases": [
            {
                "formula": dialect(formula, library),
                "signals": row({name: batch[name] for name in ("gap", "ego_speed")}, 0),
            }
            for formula, batch in cases
        ],
    }
    answer = subprocess.run(
        [oracle_python, Path(__file__).with_name("oracle_process.py")],
        input=json.dumps(request),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert answer.returncode == 0, answer.stderr
    theirs = np.array(json.loads(answer.stdout))
    ours = np.array([robustness(f, batch, Classical())[0] for f, batch in cases])
    assert len(ours) >= CASES
    np.testing.assert_allclose(theirs, ours, rtol=1e-12, atol=1e-12)
