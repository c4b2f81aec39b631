"""Records are read from plain values by the annotations of their fields, and by nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest

from pemviz.config.ranges import Range
from pemviz.config.records import read_record, read_value
from pemviz.errors import ConfigError


@dataclass(frozen=True)
class Wheel:
    size_m: Annotated[float, Range(low=0.0, low_open=True)]
    side: Literal["left", "right"] = "left"


@dataclass(frozen=True)
class Car:
    name: str
    wheels: tuple[Wheel, ...]
    spare: Wheel | None
    seats: int = 4
    prices: Mapping[str, float] | None = None
    is_new: bool = False


WHEEL = {"size_m": 0.5}
CAR = {"name": "a", "wheels": [WHEEL, {"size_m": 1, "side": "right"}], "spare": None}


def test_a_record_is_read_with_all_that_lies_in_it():
    car = read_record(Car, {**CAR, "prices": {"today": 3}, "is_new": True})
    assert car == Car("a", (Wheel(0.5), Wheel(1.0, "right")), None, 4, {"today": 3.0}, True)
    assert isinstance(car.wheels[1].size_m, float)
    assert read_record(Car, {**CAR, "spare": car.wheels[1]}).spare is car.wheels[1]
    assert read_value(tuple[Wheel, ...], [WHEEL], name="x") == (Wheel(0.5),)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": 3}, "car.name = 3: must be a text"),
        ({"name": None}, "car.name = None: must be a text"),
        ({"seats": 4.0}, "car.seats = 4.0: must be a whole number"),
        ({"seats": True}, "car.seats = True: must be a whole number"),
        ({"is_new": 1}, "car.is_new = 1: must be true or false"),
        ({"wheels": WHEEL}, "car.wheels = {'size_m': 0.5}: must be a list"),
        ({"wheels": [WHEEL, 2]}, "car.wheels[1] = 2: must be a table"),
        ({"wheels": [{}]}, "car.wheels[0].size_m: is missing"),
        ({"wheels": [{"size_m": 0.0}]}, "car.wheels[0].size_m = 0.0: must be a number, above 0"),
        (
            {"spare": {**WHEEL, "side": "up"}},
            "car.spare.side = 'up': must be one of left, right",
        ),
        ({"spare": {**WHEEL, "sise": 1}}, "car.spare.sise: no such field; did you mean side?"),
        ({"spare": {**WHEEL, "q": 1}}, "car.spare.q: no such field; allowed are side, size_m"),
        ({"prices": {"today": "x"}}, "car.prices.today = 'x': must be a number"),
        ({"prices": {"\udc80": 1.0}}, r"car.prices = '\udc80': must be a name"),
    ],
)
def test_what_does_not_fit_is_named_with_what_is_allowed(changes, message):
    with pytest.raises(ConfigError) as caught:
        read_record(Car, {**CAR, **changes}, name="car")
    assert str(caught.value) == message


def test_a_field_of_several_types_is_no_field_of_a_record():
    for annotation in (int | str, int | str | None):
        with pytest.raises(TypeError, match="one type, None aside"):
            read_value(annotation, 3, name="x")


def test_what_is_unknown_may_be_ignored_all_the_way_down():
    table = {**CAR, "doors": 5, "wheels": [{**WHEEL, "spokes": [1]}]}
    assert read_record(Car, table, ignore_unknown=True).wheels == (Wheel(0.5),)
    with pytest.raises(ConfigError, match=r"^wheels\[0\]\.spokes: no such field"):
        read_record(Car, {**CAR, "wheels": [{**WHEEL, "spokes": [1]}]})
