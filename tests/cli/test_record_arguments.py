import pytest

from pemviz.cli.main import main
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


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--seed", "abc"], "--seed 'abc': must be a whole number (see pemviz record --help)"),
        (["--precision", "x"], "--precision 'x': must be a number (see pemviz record --help)"),
        (["--memory-s", "long"], "--memory-s 'long': must be a number (see pemviz record --help)"),
        (["--chains", "1.5"], "--chains '1.5': must be a whole number (see pemviz record --help)"),
    ],
)
def test_what_is_no_number_is_told_alike_where_it_may_be_left_out(words, complaint, capsys):
    assert main(["record", *words]) == 2
    assert capsys.readouterr().err == f"pemviz: {complaint}\n"
