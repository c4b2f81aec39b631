"""A run folder is believed as it is, and no longer once figures are others than its rollouts'."""

from dataclasses import replace

from pemviz.runs.coherence import recount
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result_file import read_kept

BARS = ("probability", "std_error", "ci_low", "ci_high")


def assert_recounted(folder):
    result = read_whole_run(folder)
    assert result.status == "done"
    assert list(recount(folder, result)) == []
    assert set(read_kept(folder).files) >= {"config.toml", "rollouts.npz"}
    (first, *others) = result.repetitions
    for field in BARS:
        value = getattr(first, field)
        if value is not None and value > 1e-9 * first.probability:  # else as good as 0
            scaled = replace(first, **{field: value * 1.01})
            (words, *_) = recount(folder, replace(result, repetitions=(scaled, *others)))
            told = f"repetitions[0].{field} = {value * 1.01!r}: rollouts.npz give"
            assert words.startswith(told)
    for number, rule in enumerate(result.rules):
        scaled = replace(rule.estimate, probability=rule.estimate.probability * 1.01)
        rules = [replace(r, estimate=scaled) if r is rule else r for r in result.rules]
        if rule.estimate.probability:
            (words, *_) = recount(folder, replace(result, rules=tuple(rules)))
            assert words.startswith(f"rules[{number}].estimate.probability")
