import pytest

from pemviz.cli.record_arguments import parse


@pytest.mark.parametrize(
    ("words", "lines"),
    [
        (
            ["--method", "monte-carlo", "--rollouts", "500", "--final-rollouts", "50"],
            ["rollouts = 500: monte-carlo does not look at it, but at final_rollouts"],
        ),
        (["--method", "monte-carlo", "--final-rollouts", "50", "--metric", "agm"], []),
        (["--method", "mixture", "--rollouts", "50", "--alpha", "0.3"], []),
        (
            ["--method", "splitting", "--alpha", "0.3", "--rollouts", "20"],
            ["alpha = 0.3: splitting does not look at it, but at rollouts, stages"],
        ),
        (["--preset", "paper-algorithm", "--method", "monte-carlo"], []),  # its settings stay
    ],
)
def test_a_setting_that_the_method_does_not_look_at_is_told(words, lines):
    assert list(parse(words).notes) == lines
