"""How many digits the ends of a range have."""

import pytest

from pemviz.reports.estimate_words import digits_of, end_text


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (7.3e-15, 9.4e-15, ("7.3e-15", "9.4e-15")),
        (0.0132, 0.0134, ("0.0132", "0.0134")),
        (1.0, 1.04, ("1.00", "1.04")),
        (0.25, 0.250001, ("0.2500", "0.2500")),  # four are enough
        (0.5, 0.5, ("0.50", "0.50")),
        (0.0, 0.03, ("0", "0.030")),
    ],
)
def test_ends_are_told_apart(low, high, told):
    digits = digits_of(low, high)
    assert (end_text(low, digits=digits), end_text(high, digits=digits)) == told
    assert digits_of(None, high) == digits_of(low, None) == 2
