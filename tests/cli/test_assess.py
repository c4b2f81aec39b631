"""``pemviz assess``: the commands that it prints are what it does, and nonsense is told at once."""

import json
import re
import shlex

import pytest

from pemviz.cli import assess
from pemviz.cli.main import main, run_command
from pemviz.cli.parsing import parse_arguments
from pemviz.pem.model_files import load_pem
from tests.cli.command_kinds import COMMANDS
from tests.comparable_results import comparable_result
from tests.pem import test_argoverse
from tests.pem.detector_files import write_kitti, write_lines, write_mot_challenge, write_tracking
from tests.pem.ros_files import write_mcap
from tests.pem.test_labelled_images import coco_files, fiftyone_file
from tests.pem.test_nuscenes import annotation, beside, detection, write_nuscenes
from tests.pem.test_rosbag import scene


def assess_words(files, out, *words):
    labels, detections = files
    return ["assess", "--labels", str(labels), "--detections", str(detections), "--out", str(out),
            *words]  # fmt: skip


def write_cars_of_nuscenes(folder):
    """Two cars in three samples of a scene, of which one is missed twice."""
    folder.mkdir()
    cars = [
        (who, f"s{n}", beside(x, 10.0 + n)) for n in range(3) for who, x in (("a", 0), ("b", 4))
    ]
    found = [one for one in cars if one[:2] not in {("b", "s0"), ("b", "s1")}]
    results = {f"s{n}": [detection(place, sample_token=sample) for _, sample, place in found
                         if sample == f"s{n}"] for n in range(3)}  # fmt: skip
    labels = [annotation(place, who=who, sample=sample) for who, sample, place in cars]
    paths = write_nuscenes(folder, labels, results)
    return paths["labels"], paths["detections"]


def printed(text):
    """The words of each command that was printed, without ``pemviz``."""
    return [shlex.split(line)[2:] for line in text.splitlines() if line.startswith("$ pemviz ")]


@pytest.fixture
def planned(monkeypatch):
    """Carries out ``pem collect``; of the other commands it only reads the words."""

    def read(name, words):
        command = f"pem {words[0]}" if name == "pem" else name
        if command == "pem collect":
            return run_command(name, words)
        given = words[1:] if name == "pem" else words
        arguments = parse_arguments(COMMANDS[command], given, command=command)
        if command == "record":
            (arguments.out / "a-run").mkdir(parents=True)
        if command == "pem memory" and arguments.json:
            print(json.dumps({"memory": {"fit": {"memory": {"tau_s": 0.25, "frailty": 0.5}}}}))
        return 0

    monkeypatch.setattr(assess, "run_command", read)


@pytest.mark.parametrize(
    ("write", "options", "expected"),
    [
        (write_tracking, {}, ["pem collect", "pem fit --memory", "record", "report"]),
        (
            write_tracking,
            {"places": True},
            ["pem collect", "pem fit --memory", "pem fit --position-errors",
             "record --position-errors", "report"],
        ),
        (write_tracking, {"sequences": 1}, ["pem collect", "pem fit", "record", "report"]),
        (
            write_kitti,
            {},
            ["pem collect", "pem fit", "pem fit --position-errors", "record --position-errors",
             "report"],
        ),
        (write_mot_challenge, {}, ["pem collect", "pem memory", "record --memory-s", "report"]),
        (
            write_cars_of_nuscenes,
            {},
            ["pem collect", "pem fit", "pem fit --position-errors", "record --position-errors",
             "report"],
        ),
    ],
)  # fmt: skip
def test_the_commands_follow_from_what_the_files_hold(
    planned, tmp_path, capsys, write, options, expected
):
    files = write(tmp_path / "files", **options)
    words = assess_words(files, tmp_path / "out", "--preset", "town01", "--target", "1e-6")
    assert main([*words, "--fail-above", "0.1", "--fail-on", "act-on"]) == 0
    commands = printed(capsys.readouterr().out)
    marks = ("--memory", "--position-errors", "--memory-s")
    told = [
        " ".join([*words[: 2 if words[0] == "pem" else 1], *(m for m in marks if m in words)])
        for words in commands
    ]
    assert told == expected
    record = next(words for words in commands if words[0] == "record")
    assert record[record.index("--preset") + 1] == "town01"
    assert record[record.index("--target") + 1] == "1e-06"
    assert record[record.index("--fail-on") + 1] == "act-on"
    assert commands[-1][1] == str(tmp_path / "out/runs/a-run")
    assert "--claim-below" in commands[-1]


@pytest.mark.parametrize(
    ("write", "options", "given", "expected"),
    [
        (write_tracking, {}, [], [["best", "4"]]),
        (write_tracking, {"sequences": 1}, [], [["lr", "0"]]),
        (write_kitti, {}, [], [["best", "5"]]),
        (write_kitti, {"frames": 2}, [], [["best", "5"], ["lr", "0"]]),
        (write_kitti, {}, ["--model", "gb-raw"], [["gb-raw", "0"]]),
    ],
)
def test_the_kind_of_model_is_chosen_where_files_tell(
    planned, tmp_path, capsys, monkeypatch, write, options, given, expected
):
    read = assess.run_command

    def fit_few(name, words):
        too_few = words[0] == "fit" and "best" in words and "frames" in options
        return (run_command if too_few else read)(name, words)

    monkeypatch.setattr(assess, "run_command", fit_few)
    files = write(tmp_path / "files", **options)
    words = assess_words(files, tmp_path / "out", "--no-position-errors", *given)
    assert main(words) == 0
    shown = capsys.readouterr()
    fits = [words for words in printed(shown.out) if words[:2] == ["pem", "fit"]]
    kinds = [[words[words.index(name) + 1] for name in ("--model", "--folds")] for words in fits]
    assert kinds == expected
    assert ("lr is fitted" in shown.err) == (kinds[-1][0] == "lr")


def write_argoverse(folder):
    paths = test_argoverse.files(folder)
    return paths["labels"], paths["detections"], []


def write_bag(folder):
    bag = write_mcap(folder / "drive.mcap", scene())
    return bag, bag, ["--labels-topic", "/truth", "--detections-topic", "/found"]


def write_coco(folder):
    paths = coco_files(folder)
    return paths["labels"], paths["detections"], []


def write_fiftyone(folder):
    path = fiftyone_file(folder)
    return path, path, ["--labels-field", "ground_truth", "--detections-field", "predictions"]


@pytest.mark.parametrize(
    ("write", "file_format", "expected"),
    [
        (write_argoverse, "argoverse", ["pem collect", "pem fit", "record", "report"]),
        (write_bag, "rosbag", ["pem collect", "pem fit", "record", "report"]),
        (write_coco, "coco", ["pem collect", "pem memory", "record", "report"]),
        (write_fiftyone, "fiftyone", ["pem collect", "pem memory", "record", "report"]),
    ],
)
def test_logs_and_images_are_assessed_too(planned, tmp_path, capsys, write, file_format, expected):
    labels, detections, options = write(tmp_path)
    given = ["--preset", "town01", "--no-position-errors", *options]
    assert main([*assess_words((labels, detections), tmp_path / "out"), *given]) == 0
    printed_text = capsys.readouterr()
    assert f"(format {file_format})" in printed_text.out
    commands = printed(printed_text.out)
    told = [" ".join(words[: 2 if words[0] == "pem" else 1]) for words in commands]
    assert told == expected
    assumed = "10 are assumed" in printed_text.err
    assert assumed == (file_format in ("coco", "fiftyone"))
    again = assess_words((labels, detections), tmp_path / "again", *given, "--rate-hz", "5")
    assert main(again) == 0
    assert "are assumed" not in capsys.readouterr().err


def test_a_bag_s_topics_are_asked_for(tmp_path, capsys):
    bag, _, _ = write_bag(tmp_path)
    assert main(assess_words((bag, bag), tmp_path / "out")) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "labels_topic, detections_topic: must be given with format rosbag" in line


def test_the_memory_of_files_without_places_goes_into_the_run(planned, tmp_path, capsys):
    assert main(assess_words(write_mot_challenge(tmp_path / "files"), tmp_path / "out")) == 0
    shown = capsys.readouterr()
    (record,) = (words for words in printed(shown.out) if words[0] == "record")
    assert record[record.index("--pem") + 1] == "ml-nn"
    assert record[record.index("--memory-s") + 1] == "0.25"
    assert record[record.index("--frailty") + 1] == "0.5"
    assert "these files know no places" in shown.err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"labels": "absent"}, "labels = .*absent: there is no such file or folder"),
        ({"detections": "files"}, "in it is found; allowed: KITTI results"),
        ({"labels": "empty"}, "labels = .*empty: the folder is empty"),
        ({"detections": "none"}, "none: of 720 obstacles all are missed: nothing to learn from"),
        ({"detections": "fewer"}, "0003.txt: no detections of this sequence"),
        ({"labels": "own.csv", "detections": "own.csv"}, "rows of a log; --mapping FILE.toml must"),
        ({"out": "own.csv"}, "out = .*own.csv: no folder can be made there"),
        ({"--preset": "cutin"}, r"preset = 'cutin': must be one of .*; did you mean cut-in\?"),
        ({"--target": "2"}, "target = 2"),
        ({"--fail-above": "often"}, "fail-above"),
        ({"--fail-on": "act-on"}, "fail-on = act-on: must be given with fail-above"),
        ({"--types": "car"}, "types: 'car' is no class, allowed: Car, Van"),
        ({"--types": "Tram"}, "labels = .*: no obstacle of Tram"),
        ({"--iou-above": "1.5"}, "iou_above is 1.5, allowed: 0 to below 1"),
        ({"--rate-hz": "0"}, "rate_hz is 0, allowed: above 0"),
        ({"--mapping": "absent.toml"}, "absent.toml"),
        ({"--mapping": "absent.toml", "--format": "mot"}, "mapping: must be given with format log"),
        ({"--format": "kitti"}, "15 columns|columns where|no detections"),
        ({"--model": "magic"}, "magic"),
        ({"--seed": "-1"}, "seed = -1"),
        ({"--score-from": "nan"}, "score_from is nan"),
        ({"--lables": "x"}, "--lables.*did you mean --labels"),
    ],
)
def test_nonsense_is_told_in_one_line(tmp_path, capsys, monkeypatch, change, words):
    monkeypatch.chdir(tmp_path)
    labels, detections = write_tracking(tmp_path / "files")
    (tmp_path / "empty").mkdir()
    write_lines(tmp_path, {"own.csv": ["a,b,c", "1,2,3"]})
    frames = {path.name: ["0,1,1,2,2,0.1"] for path in labels.iterdir()}
    write_lines(tmp_path / "none", frames)
    write_lines(tmp_path / "fewer", dict(sorted(frames.items())[:-1]))
    options = {"labels": labels, "detections": detections, "out": "out"}
    options |= {name: change[name] for name in options if name in change}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    change = {"--rate-hz": "10"} | change
    given += [word for name, value in change.items() if name[0] == "-" for word in (name, value)]
    assert main(["assess", *given]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.search(words, line), line


def test_what_must_be_given_is_asked_for(capsys):
    assert main(["assess"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == "pemviz: must be given: --labels, --detections (see pemviz assess --help)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "options", "own"),
    [
        (write_tracking, {"places": True, "sequences": 6}, []),
        (write_kitti, {}, ["--no-position-errors"]),
        (write_mot_challenge, {}, []),
    ],
)
def test_the_printed_commands_give_the_same_numbers(tmp_path, capsys, write, options, own):
    out, again = tmp_path / "out", tmp_path / "again"
    files = write(tmp_path / "files", **options)
    assert main(assess_words(files, out, "--model", "lr", "--preset", "town01", *own)) == 0
    commands = printed(capsys.readouterr().out)
    again.mkdir()
    for words in commands[:-1]:
        assert main([word.replace(str(out), str(again)) for word in words]) == 0
    (run,), (same) = (out / "runs").iterdir(), list((again / "runs").iterdir())
    assert commands[-1][1] == str(run)
    assert (out / "report.html").stat().st_size > 10_000
    assert [comparable_result(folder)["estimate"] for folder in same] == [
        comparable_result(run)["estimate"]
    ]
    for path in out.glob("detector.safetensors"):
        assert load_pem(str(path)).digest == load_pem(str(again / path.name)).digest
