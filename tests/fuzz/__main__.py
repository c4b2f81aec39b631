"""``python -m tests.fuzz``: many cases, counts by target, and how to repeat what was found."""

import argparse
import sys
from collections.abc import Sequence

from tests.fuzz.harness import Counts, carry_out, valid_files
from tests.fuzz.log_targets import TARGETS as LOG_TARGETS
from tests.fuzz.pem_targets import TARGETS as PEM_TARGETS
from tests.fuzz.run_targets import TARGETS as RUN_TARGETS
from tests.fuzz.text_targets import TARGETS as TEXT_TARGETS

TARGETS = {
    target.name: target for target in (*TEXT_TARGETS, *PEM_TARGETS, *RUN_TARGETS, *LOG_TARGETS)
}
SHOWN = 3
"""Findings told of each target."""


def shares(cases: int, names: Sequence[str]) -> dict[str, int]:
    """How many of the cases each target gets, by weight; at least one, all together not less."""
    total = sum(TARGETS[name].weight for name in names)
    return {name: -int(-cases * TARGETS[name].weight // total) for name in names}


def main(words: Sequence[str] | None = None) -> int:
    """Carry out the cases; 1 if anything undocumented came out."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000, help="cases over all targets")
    parser.add_argument("--target", choices=sorted(TARGETS), help="one target instead of all")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first case of a target")
    arguments = parser.parse_args(words)
    names = [arguments.target] if arguments.target else list(TARGETS)
    every: list[Counts] = []
    findings = 0
    print(f"{'target':<20}{'cases':>8}{'rejected':>10}{'accepted':>10}{'findings':>10}{'s':>9}")
    with valid_files() as valid:
        for name, cases in shares(arguments.cases, names).items():
            counts = Counts(name)
            seeds = range(arguments.seed, arguments.seed + cases)
            found = list(carry_out(TARGETS[name], seeds, valid=valid, counts=counts))
            every.append(counts)
            findings += len(found)
            _tell(counts, findings=len(found))
            for finding in found[:SHOWN]:
                print(f"FINDING: python -m tests.fuzz --cases 1 --target {finding.target} "
                      f"--seed {finding.seed}\n{finding.what}", file=sys.stderr)  # fmt: skip
    figures = [(one.cases, one.rejected, one.accepted, one.wall_s) for one in every]
    _tell(Counts("all", *map(sum, zip(*figures, strict=True))), findings=findings)
    return 1 if findings else 0


def _tell(counts: Counts, *, findings: int) -> None:
    print(
        f"{counts.target:<20}{counts.cases:>8}{counts.rejected:>10}{counts.accepted:>10}"
        f"{findings:>10}{counts.wall_s:>9.1f}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
