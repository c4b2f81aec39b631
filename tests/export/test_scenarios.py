"""OpenSCENARIO and CommonRoad files, read back by the formats' own libraries."""

import xml.etree.ElementTree as ET
from importlib.metadata import files

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.runs.kept_rollout import read_kept_rollout
from pemviz.runs.rollout_files import load_rollouts
from pemviz.simulators.braking.contact import first_contact

ABSENT = "needs the extra pemviz[export], which is not installed"
EXACT_M = 1e-6


def rows_of(folder, rank):
    """Gaps and speeds of the rollout as the folder keeps them."""
    found = read_kept_rollout(folder, rank=rank)
    table = load_rollouts(folder)
    row = np.flatnonzero(
        (table["repetition"] == found.repetition) & (table["stage"] == found.stage)
    )[found.rollout]
    return {name: table[name][row] for name in ("gap_m", "ego_speed_mps", "lead_speed_mps")}


def exported(folder, tmp_path, form, *, rank=1, name="one"):
    out = tmp_path / name / f"rollout.{'xosc' if form == 'openscenario' else 'xml'}"
    out.parent.mkdir()
    words = ["--format", form, "--rank", str(rank), "--out", str(out)]
    assert main(["export", str(folder), *words]) == 0
    return out


def check_bumpers(kept, *, front_m, rear_m):
    """The space between ego's front and lead's rear is the gap but for the camera's place."""
    space_m = rear_m - front_m
    np.testing.assert_allclose(space_m, kept["gap_m"] - 2.0, atol=EXACT_M)
    contact = first_contact(kept["gap_m"], dt_s=0.05)
    touching = np.flatnonzero(space_m <= 1e-9)
    assert touching.size == 0 if contact is None else touching[0] == contact.step


@pytest.mark.parametrize("rank", [1, 174])  # a contact, and none
def test_openscenario_comes_back(rank, sample_run, tmp_path):
    xosc = pytest.importorskip("scenariogeneration", reason=ABSENT).xosc
    out = exported(sample_run, tmp_path, "openscenario", rank=rank)
    kept = rows_of(sample_run, rank)
    scenario = xosc.Scenario.parse(ET.parse(out).getroot())  # noqa: S314  made here
    assert scenario.roadnetwork.road_file == "rollout.xodr"
    cars = {one.name: one.entityobject for one in scenario.entities.scenario_objects}
    (act,) = scenario.storyboard.stories[0].acts
    where = {}
    for group in act.maneuvergroup:
        action = group.maneuvers[0].events[0].action[0].action
        line = action.trajectory.shapes
        np.testing.assert_allclose(line.time, 0.05 * np.arange(70), atol=1e-9)
        assert {(p.y, p.h) for p in line.positions} == {(0.0, 0.0)}
        where[group.actors.actors[0].entity] = np.array([p.x for p in line.positions])
    assert set(where) == set(cars) == {"Ego", "Lead"}
    for name, signal in (("Ego", "ego_speed_mps"), ("Lead", "lead_speed_mps")):
        np.testing.assert_allclose(np.diff(where[name]) / 0.05, kept[signal][:-1], atol=EXACT_M)
    boxes = {name: car.boundingbox for name, car in cars.items()}
    front_m = where["Ego"] + boxes["Ego"].center.x + boxes["Ego"].boundingbox.length / 2
    rear_m = where["Lead"] + boxes["Lead"].center.x - boxes["Lead"].boundingbox.length / 2
    check_bumpers(kept, front_m=front_m, rear_m=rear_m)
    told = dict(cars["Ego"].properties.properties)
    missed = read_kept_rollout(sample_run, rank=rank).detected[""]
    assert [int(step) for step in told["missed_steps"].split()] == np.flatnonzero(~missed).tolist()


@pytest.mark.parametrize("rank", [1, 174])
def test_commonroad_comes_back(rank, sample_run, tmp_path):
    reader = pytest.importorskip("commonroad.common.file_reader", reason=ABSENT)
    out = exported(sample_run, tmp_path, "commonroad", rank=rank)
    kept = rows_of(sample_run, rank)
    scenario, problems = reader.CommonRoadFileReader(str(out)).open()
    assert scenario.dt == 0.05
    ends_m = {}
    for name, number in (("ego", 10), ("lead", 11)):
        car = scenario.obstacle_by_id(number)
        states = [car.initial_state, *car.prediction.trajectory.state_list]
        assert [state.time_step for state in states] == list(range(70))
        speeds = [state.velocity for state in states]
        np.testing.assert_allclose(speeds, kept[f"{name}_speed_mps"], atol=EXACT_M)
        assert {(state.position[1], state.orientation) for state in states} == {(0.0, 0.0)}
        centre_m = np.array([state.position[0] for state in states])
        np.testing.assert_allclose(np.diff(centre_m) / 0.05, speeds[:-1], atol=EXACT_M)
        half_m = car.obstacle_shape.length / 2
        ends_m[name] = centre_m - half_m, centre_m + half_m
        boxes = [car.occupancy_at_time(step).shapely_object.bounds for step in (0, 69)]
        np.testing.assert_allclose([box[0] for box in boxes], ends_m[name][0][[0, 69]])
        inside = scenario.lanelet_network.find_lanelet_by_position([states[0].position])
        assert inside == [[1]]
    check_bumpers(kept, front_m=ends_m["ego"][1], rear_m=ends_m["lead"][0])
    start = problems.planning_problem_dict[100].initial_state
    assert start.position[0] == pytest.approx(2.5, abs=EXACT_M)
    assert start.velocity == pytest.approx(kept["ego_speed_mps"][0], abs=EXACT_M)
    assert "missed_steps: " in out.read_text(encoding="utf-8")


def test_files_are_valid_by_the_formats_own_schemas(sample_run, tmp_path):
    pytest.importorskip("scenariogeneration", reason=ABSENT)
    pytest.importorskip("commonroad", reason=ABSENT)
    etree = pytest.importorskip("lxml.etree", reason=ABSENT)
    out = exported(sample_run, tmp_path, "openscenario")
    other = exported(sample_run, tmp_path, "commonroad", name="two")
    schemas = {
        path.name: path.locate()
        for package in ("scenariogeneration", "commonroad-io")
        for path in files(package) or ()
        if path.suffix == ".xsd"
    }
    for path, name in (
        (out, "OpenSCENARIO_1_1.xsd"),
        (out.with_suffix(".xodr"), "opendrive_17_core.xsd"),
        (other, "XML_commonRoad_XSD.xsd"),
    ):
        schema = etree.XMLSchema(etree.parse(str(schemas[name])))
        assert schema.validate(etree.parse(str(path))), schema.error_log
        root = etree.fromstring(path.read_bytes())
        root.append(etree.SubElement(root, "unknown"))
        assert not schema.validate(root)


@pytest.mark.parametrize("form", ["openscenario", "commonroad"])
def test_the_same_run_gives_the_same_bytes(form, sample_run, tmp_path):
    pytest.importorskip("scenariogeneration", reason=ABSENT)
    pytest.importorskip("commonroad", reason=ABSENT)
    one, two = (exported(sample_run, tmp_path, form, name=name) for name in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()
    assert b'date="1970-01-01' in one.read_bytes()  # 'sample' does not say when it began
    if form == "openscenario":
        roads = [path.with_suffix(".xodr").read_bytes() for path in (one, two)]
        assert roads[0] == roads[1]
