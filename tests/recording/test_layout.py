"""Every view shows something, every path is documented, texts say what is left out."""

import ast
import subprocess
import unicodedata
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from pemviz.config import ExperimentConfig
from pemviz.recording import Recorder, paths, text
from pemviz.recording.open import viewer_program
from pemviz.recording.views import (
    ContainerSpec,
    Subject,
    ViewSpec,
    all_views,
    blueprint,
    keep_views,
    shown,
    shown_stages,
    views_with_data,
)
from pemviz.reports.estimate_words import interval_text, short_probability
from pemviz.reports.headline_words import range_words
from pemviz.runs.answers import answers
from pemviz.runs.engine import run
from pemviz.runs.events import RunDone, StageDone
from pemviz.runs.experiment import build_experiment
from pemviz.simulators.drawn_scene import drawn_scene
from pemviz.types import Diagnostic
from tests.recording.conftest import LEARNING, record, with_blind_pem
from tests.recording.read_back import chunks, entities, texts, titles

PACKAGE = Path(text.__file__).parent
TABS = ["Scene", "Worst case", "Learning", "Rollouts", "Answer", "Config"]


def subject_of(recorded, **changes) -> Subject:
    started = recorded.events[0]
    config = started.config
    subject = Subject(
        stages=started.stages,
        repetitions=config.repetitions,
        signals=started.signals,
        robustness_unit="m",
        road=drawn_scene(started.simulator).road,
    )
    return replace(subject, **changes)


def views_of(spec: ViewSpec | ContainerSpec) -> list[ViewSpec]:
    """All views, in order."""
    if isinstance(spec, ViewSpec):
        return [spec]
    return [view for part in spec.parts for view in views_of(part)]


def empty_views(views, logged):
    return [
        (view.title, path)
        for view in views_of(views)
        for path in view.paths
        if not shown(path, logged)
    ]


def test_every_view_of_a_learning_run_points_at_something_logged(learned):
    assert empty_views(all_views(subject_of(learned)), entities(learned.path)) == []


def test_a_run_without_violations_says_so_and_every_view_points_at_something_logged(tmp_path):
    config = replace(LEARNING, method="monte-carlo", final_rollouts=20)
    recorded = record(build_experiment(config), tmp_path)
    logged = entities(recorded.path)
    kept = views_with_data(all_views(subject_of(recorded)), logged)
    titles = [view.title for view in views_of(kept)]
    assert all(shown(view.paths[-1], logged) for view in views_of(kept))
    assert empty_views(kept, logged) == []
    assert "Answer" in titles
    assert "Effective sample size against stage" not in titles
    found = texts(recorded.path)
    assert "no violation was seen" in found[paths.ANSWER]
    assert "no failure in 20 rollouts" in found[paths.WARNINGS]


def test_views_follow_repetitions_and_frames(tmp_path):
    pytest.importorskip("highway_env")
    short = replace(LEARNING.scenario, states=8)
    config = replace(
        LEARNING, method="naive", spec="always[0,7] (gap >= 14.9)", scenario=short, repetitions=2,
        final_rollouts=10,
    )  # fmt: skip
    recorded = record(with_blind_pem(config), tmp_path, frames=True)
    logged = entities(recorded.path)
    assert paths.FRAMES in logged
    pictures = [c for c in chunks(recorded.path) if c.entity_path == paths.FRAMES]
    rows = [c for c in pictures if not c.is_static]
    assert sum(c.num_rows for c in rows) == 8
    blob = rows[0].to_record_batch()["EncodedImage:blob"].to_pylist()[0][0]
    assert bytes(blob).startswith(b"\xff\xd8")
    wanted = subject_of(recorded, film="Rank 1 in highway-env, from above")
    assert empty_views(all_views(wanted), logged) == []


def test_tabs_read_in_order_and_titles_name_axes_with_units(learned):
    planned = all_views(subject_of(learned))
    assert [part.title for part in planned.parts] == TABS
    views = views_of(planned)
    same_in_every_rollout = {"Lead speed [m/s] against step"}
    assert set(titles(learned.path)) == {view.title for view in views} - same_in_every_rollout
    reader = rr.chunk.RrdReader(learned.path)
    assert len(reader.blueprints()) == 2, "one before the first stage, and one of it all"
    plots = [v.title for v in views if v.kind in ("plot", "series")]
    assert [title for title in plots if "against" not in title] == [
        "How far the answer is open (line: the answer)"
    ]
    assert any("[m/s]" in title for title in plots)


def test_the_first_tab_is_the_scene_below_the_answer_then_come_curves_then_text(learned):
    planned = all_views(subject_of(learned))
    first, *_ = planned.parts
    assert planned.active == 0
    assert [view.kind for view in views_of(first)][:2] == ["text", "scene"]
    assert views_of(first)[0].paths == (paths.STRIP,)
    kinds = [[view.kind for view in views_of(tab)] for tab in planned.parts]
    mostly_text = [kind.count("text") >= len(kind) / 2 for kind in kinds]
    assert mostly_text == [False, True, False, False, True, True]
    without_scene = all_views(subject_of(learned, road=None))
    assert views_of(without_scene)[0].paths == (paths.STRIP,)
    assert "scene" not in {view.kind for view in views_of(without_scene)}


def test_what_a_viewer_reads_first_is_a_layout(learned, tmp_path):
    """Else it shows one of its own, of all texts and the first curves, until it has read all."""
    for name, options in (("plain", {}), ("compact", {"compacted": True})):
        folder = tmp_path / name
        folder.mkdir()
        config = replace(LEARNING, method="naive", final_rollouts=10)
        path = record(with_blind_pem(config), folder, **options).path
        order = printed(path)
        (activated, *_) = [place for place, line in enumerate(order) if "Activation" in line]
        data = [place for place, line in enumerate(order) if " - /rollouts/" in line]
        assert activated < min(data), name


def printed(path: Path) -> list[str]:
    """A file's messages in their order, a line each."""
    words = [viewer_program(), "rrd", "print", path]
    return subprocess.run(words, capture_output=True, check=True, text=True).stdout.splitlines()


def test_the_strip_tells_how_likely_the_range_to_act_on_what_decides_it_and_the_sampling(learned):
    strip, result = texts(learned.path)[paths.STRIP], learned.result
    (answer,) = answers(result)
    plain = strip.replace("\\", "")
    assert short_probability(answer.estimate) in plain
    assert ", ".join(range_words(answer.open, result)) in plain
    assert "To act on" in plain
    assert "Sampling" in plain
    assert interval_text(answer.estimate, caveats=answer.caveats) in plain
    assert len(plain) < 600
    few = Diagnostic("few-effective-samples", 2.0, 10.0, "few effective samples")
    unsure = replace(result, estimate=replace(result.estimate, diagnostics=(few,)))
    assert "Sampling not ok" in text.strip_text(unsure, running=False)
    assert "goes on" in text.strip_text(result, running=True)
    nothing = replace(result, estimate=None, status="failed", message="out of memory")
    assert "out of memory" in text.strip_text(nothing, running=False)


def test_paths_are_spelled_out_in_one_module():
    for module in PACKAGE.glob("*.py"):
        if module.name == "paths.py":
            continue
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                roots = ("/answer", "/learning", "/rollouts", "/worst_case", "/config")
                assert not node.value.startswith(roots), f"{module.name}: {node.value}"


def test_every_logged_path_belongs_to_a_documented_root(learned):
    roots = ("/answer", "/learning", "/rollouts", "/worst_case", "/config", "/__properties")
    recording = entities(learned.path)
    layout = {p for p in recording if p.split("/")[1] in ("view", "container", "viewport")}
    panels = {p for p in recording if p.endswith("_panel")}
    assert [p for p in recording - layout - panels if not p.startswith(roots)] == []


def test_a_stopped_run_has_no_views_of_what_it_did_not_reach(tmp_path):
    class StopAfterFirstStage:
        stop = False

        def notify(self, event):
            self.stop |= isinstance(event, StageDone)

    watcher = StopAfterFirstStage()
    experiment = with_blind_pem(LEARNING)
    path = tmp_path / "run.rrd"
    stop = partial(getattr, watcher, "stop")
    result = run(experiment, observers=[Recorder(path), watcher], should_stop=stop)
    assert result.status == "stopped"
    logged = entities(path)
    assert paths.rollouts(0, "gap_m") in logged
    assert paths.rollouts(1, "gap_m") not in logged
    assert "The run stopped" in texts(path)[paths.ANSWER]
    kept = views_with_data(
        all_views(Subject(4, 1, experiment.problem.simulator.signals, "m")), logged
    )
    assert "Stage 1" not in str(kept)


def test_texts_tell_answer_config_and_what_is_recorded(learned):
    found = texts(learned.path)
    estimate = learned.result.estimate
    first, *_ = found[paths.ANSWER].splitlines()
    assert first.startswith("# Failure probability in one run: ")
    assert f"{short_probability(estimate)} if misses are independent" in first
    assert "always[0,99] (gap >= 2.0)" in found[paths.ANSWER]
    for warning in estimate.warnings:
        assert warning in found[paths.WARNINGS]
    assert 'method = "adaptive"' in found[paths.CONFIG]
    assert '"run_id": "a-run"' in found[paths.RESULT]
    assert "Every rollout is recorded" in found[paths.CONTENTS]
    assert learned.result.pem.digest in found[paths.PROVENANCE]
    assert found[paths.STAGE_TABLE].count("\n| ") == 2 + 4
    assert found[paths.WORST_SUMMARY].count("\n| ") == 2 + 20


def test_a_sample_of_rollouts_is_said_to_be_one(tmp_path):
    config = replace(LEARNING, method="naive", final_rollouts=200)
    recorded = record(with_blind_pem(config), tmp_path, rollout_limit=80)
    found = texts(recorded.path)[paths.CONTENTS]
    assert "the 20 least robust and an even sample of 60 others" in found


def test_two_runs_do_not_merge_in_a_viewer(tmp_path):
    config = replace(LEARNING, method="naive", final_rollouts=10)
    identifiers = set()
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        recorded = record(with_blind_pem(config), folder)
        identifiers |= {e.recording_id for e in rr.chunk.RrdReader(recorded.path).recordings()}
    assert len(identifiers) == 2


def test_shown_stages_are_all_or_spread_with_both_ends():
    assert shown_stages(12) == list(range(12))
    many = shown_stages(1002)
    assert many[0] == 0
    assert many[-1] == 1001
    assert len(many) == 14
    assert np.ptp(np.diff(many)) <= 1


def test_dropping_views_keeps_the_open_tab():
    views = [ViewSpec("text", name, (f"/x/{name}",)) for name in "abc"]
    tabs = ContainerSpec("tabs", "tabs", tuple(views), active=2)
    kept = keep_views(tabs, lambda view: view.title != "a")
    assert kept is not None
    assert kept.parts[kept.active].title == "c"
    assert keep_views(tabs, lambda view: False) is None


@pytest.mark.parametrize("stages", [1, 3, 200])
def test_blueprints_are_built_for_any_number_of_stages(stages):
    signals = build_experiment(ExperimentConfig()).problem.simulator.signals
    for repetitions in (1, 5):
        subject = Subject(stages, repetitions, signals, "m", film="A film")
        assert blueprint(all_views(subject)) is not None


def test_events_after_the_end_are_ignored(learned, tmp_path):
    recorder = Recorder(tmp_path / "run.rrd")
    recorder.notify(RunDone(result=learned.result))
    assert not (tmp_path / "run.rrd").exists()


def test_texts_are_in_letters_that_the_viewer_has(learned):
    """Its font has no pictures: at one it shows a box, and ends itself without a display."""
    for path, found in texts(learned.path).items():
        pictures = {sign for sign in found if unicodedata.category(sign) in ("So", "Cs", "Co")}
        assert not pictures, (path, pictures)
