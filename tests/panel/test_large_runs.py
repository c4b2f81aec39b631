"""A run whose rollouts stay on disk shows the same as one that is read, in bounded memory."""

import shutil
import threading
import time
import tracemalloc
import zipfile
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pemviz.errors import InputError
from pemviz.files.array_files import map_arrays, read_arrays
from pemviz.panel import controller as controller_thread
from pemviz.panel import run_data
from pemviz.panel.loading import LoadedRuns, load_run
from pemviz.panel.ranking import elites, rank, ranking_csv, row, scoring
from pemviz.panel.rollout_charts import track
from pemviz.panel.rollout_details import details
from pemviz.panel.rollout_tables import thinned
from pemviz.panel.weights_page import drawn_points, least_gaps
from pemviz.panel.why_page import failures_of, standing_for_all, why
from pemviz.runs.experiment import build_experiment
from pemviz.runs.run_folder import create_run_folder, record
from tests.comparable_results import without_digests
from tests.panel.conftest import NAIVE, wait_until

METRICS = ("classical", "agm", "smooth-cumulative")
PART = 7


@pytest.fixture
def in_small_parts(monkeypatch):
    monkeypatch.setattr(run_data, "PART_ROWS", PART)


@pytest.fixture(scope="module")
def latent_folder(tmp_path_factory):
    """A run with rules and with latents at its start and of its steps."""
    rules = {"gap": "always[0,99] (gap >= 2.0)", "far": "always[0,99] (gap >= 3.0)"}
    config = replace(NAIVE, position_errors="pointpillars").with_rules(rules)
    folder = create_run_folder(tmp_path_factory.mktemp("latents"), label="naive")
    record(build_experiment(config), folder)
    return folder


def both(folder):
    """The run read, and the run mapped."""
    read, mapped = load_run(folder), load_run(folder, most_read_bytes=0)
    assert (read.mapped, mapped.mapped) == (False, True)
    return read, mapped


def assert_equal_runs(read, mapped):
    for metric in METRICS:
        for among in ("carrying", "all"):
            for by_share in (False, True):
                first, second = (
                    rank(run, metric, among=among, by_share=by_share) for run in (read, mapped)
                )
                np.testing.assert_array_equal(first.robustness, second.robustness)
                np.testing.assert_array_equal(first.share, second.share)
                np.testing.assert_array_equal(first.order, second.order)
    np.testing.assert_array_equal(read.log_weight, mapped.log_weight)
    ranking = rank(read, "classical")
    assert ranking_csv(read, ranking) == ranking_csv(mapped, ranking)
    entry = row(read, ranking, 3)
    assert entry == row(mapped, ranking, 3)
    assert details(read, entry) == details(mapped, entry)
    np.testing.assert_array_equal(track(read, entry).values, track(mapped, entry).values)
    np.testing.assert_array_equal(least_gaps(read).gap_m, least_gaps(mapped).gap_m)
    assert why(read) == why(mapped)


@pytest.mark.usefixtures("in_small_parts")
def test_a_mapped_run_shows_what_a_read_one_does(kept):
    read, mapped = both(kept[0])
    assert_equal_runs(read, mapped)
    for first, second in zip(read.curves, mapped.curves, strict=True):
        np.testing.assert_array_equal(first.detection, second.detection)


@pytest.mark.usefixtures("in_small_parts")
def test_so_it_does_with_latents_and_rules(latent_folder):
    read, mapped = both(latent_folder)
    assert_equal_runs(read, mapped)
    assert np.ptp(read.log_weight) > 1.0
    first, second = (rank(run, "classical", rule="far") for run in (read, mapped))
    np.testing.assert_array_equal(first.order, second.order)


def test_equal_robustness_is_ranked_in_the_order_of_the_tables(naive_run):
    table = dict(naive_run.rollouts) | {"robustness": np.repeat([1.0, -1.0, 0.0], 20)}
    tied = type(naive_run)(
        result=naive_run.result, gap_m=naive_run.gap_m, pem_detection=naive_run.pem_detection,
        parts=(table,), simulated=60,
    )  # fmt: skip
    order = rank(tied, "classical").order.tolist()
    assert order == [*range(20, 40), *range(40, 60), *range(20)]
    by_share = rank(tied, "classical", by_share=True)
    expected = sorted(range(60), key=lambda i: (-by_share.share[i], table["robustness"][i], i))
    assert by_share.order.tolist() == expected


def test_elites_of_interleaved_stages_are_found_stage_by_stage(loaded_run):
    """Against a loop over stages; the tables' order plays no part."""
    ranking = rank(loaded_run, "agm")
    stage = loaded_run.rollouts["stage"]
    chosen = elites(loaded_run, ranking, sigma=0.8)
    for one in np.unique(stage):
        inside = np.sort(ranking.robustness[stage == one])[::-1]
        level = max(inside[int(0.8 * inside.size)], 0.0)
        np.testing.assert_array_equal(
            chosen[stage == one], ranking.robustness[stage == one] <= level
        )


def rewritten(folder, target, **changed):
    """A copy of a run's folder with arrays of its rollouts replaced."""
    target.mkdir()
    for name in ("config.toml", "result.json", "proposals.safetensors"):
        (target / name).write_bytes((folder / name).read_bytes())
    np.savez(target / "rollouts.npz", **read_arrays(folder / "rollouts.npz") | changed)
    return target


def test_numbers_of_a_mapped_run_are_checked_when_they_are_looked_at(kept, tmp_path):
    gap_m = read_arrays(kept[0] / "rollouts.npz")["gap_m"].copy()
    gap_m[3, 5] = np.nan
    damaged = rewritten(kept[0], tmp_path / "damaged", gap_m=gap_m)
    without_digests(damaged)
    with pytest.raises(InputError, match="gap_m must hold numbers between"):
        load_run(damaged)
    run = load_run(damaged, most_read_bytes=0)
    ranking = rank(run, "classical")
    place = int(np.flatnonzero(ranking.order == 3)[0])
    assert track(run, row(run, ranking, place - 1)).values.size == 100
    with pytest.raises(InputError, match="gap_m must hold numbers between"):
        track(run, row(run, ranking, place))
    with pytest.raises(InputError, match="gap_m must hold numbers between"):
        rank(run, "agm")
    cut = rewritten(kept[0], tmp_path / "cut", gap_m=gap_m[:, :-1])
    with pytest.raises(InputError, match="gap_m has shape"):
        load_run(cut, most_read_bytes=0)


def test_scoring_a_mapped_run_takes_the_memory_of_a_part(kept, tmp_path, monkeypatch):
    """200 rollouts repeated 40 times are 33 MB; parts of 100 rollouts are scored."""
    table = read_arrays(kept[0] / "rollouts.npz")
    many = {name: np.concatenate([values] * 40) for name, values in table.items()}
    folder = rewritten(kept[0], tmp_path / "many", **many)
    size = (folder / "rollouts.npz").stat().st_size
    scores = rank(load_run(kept[0]), "agm").robustness
    monkeypatch.setattr(run_data, "PART_ROWS", 100)
    tracemalloc.start()
    try:
        run = load_run(folder, most_read_bytes=0)
        held, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        ranking = rank(run, "agm")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert size > 30e6
    assert held < size / 20
    assert peak < size / 10
    np.testing.assert_array_equal(ranking.robustness, np.tile(scores, 40))


def test_archives_are_mapped_only_as_far_as_they_hold_what_they_claim(tmp_path):
    path = tmp_path / "arrays.npz"
    arrays = {"a": np.arange(12.0).reshape(3, 4), "b": np.arange(3), "c": np.empty((0, 4))}
    arrays["f"] = np.asfortranarray(arrays["a"])
    np.savez(path, **arrays)
    for name, values in map_arrays(path).items():
        np.testing.assert_array_equal(values, arrays[name])
        assert values.size == 0 or name == "b" or not values.flags.writeable
    np.savez_compressed(path, **arrays)
    np.testing.assert_array_equal(map_arrays(path)["a"], arrays["a"])
    np.savez(path, a=arrays["a"])
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        claims = archive.read("a.npy").replace(b"(3, 4)", b"(9, 4)")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", claims)
    with pytest.raises(InputError, match="asks for 288 bytes, there are 96"):
        map_arrays(path)
    for damaged in (whole[:40], b"", whole.replace(b"PK\x03\x04", b"PK\x03\x05")):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot be read"):
            map_arrays(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", b"no array")
    with pytest.raises(InputError, match="is no array"):
        map_arrays(path)


def test_a_scan_tells_how_far_it_is_and_is_done_once():
    some, may_end, heard = run_data.Scans(), threading.Event(), threading.Event()
    calls = []

    def scan(report):
        calls.append(None)
        report(7_000)
        heard.set()
        assert may_end.wait(30.0)
        return "scores"

    assert some.begin("small", scan, count=run_data.AT_ONCE) is None
    assert not calls  # left to whoever asks for its value
    count = run_data.AT_ONCE + 1
    assert some.begin("key", scan, count=count) is not None
    assert heard.wait(30.0)
    assert some.begin("key", scan, count=count) == run_data.ScanProgress(7_000, count)
    assert some.under_way
    may_end.set()
    assert some.value("key", scan) == "scores"
    assert some.begin("key", scan, count=count) is None
    assert not some.under_way
    assert len(calls) == 1


def test_what_a_scan_raises_is_told_to_everybody_who_asks():
    some = run_data.Scans()

    def scan(report):
        report(1)
        message = "cannot be scored"
        raise InputError(message)

    some.begin("key", scan, count=run_data.AT_ONCE + 1)
    for _ in range(2):
        with pytest.raises(InputError, match="cannot be scored"):
            some.value("key", scan)
    assert some.begin("key", scan, count=run_data.AT_ONCE + 1) is None


def test_scores_of_a_large_run_are_computed_beside(loaded_run, monkeypatch):
    monkeypatch.setattr(run_data, "AT_ONCE", 10)
    run = load_run(loaded_run.folder)
    end_s = time.monotonic() + 60.0
    while scoring(run, "agm") is not None:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    expected = rank(loaded_run, "agm").robustness
    np.testing.assert_array_equal(rank(run, "agm").robustness, expected)


def test_thinned_parts_are_the_thinned_whole(naive_run):
    (table,) = naive_run.parts
    parts = [{name: values[a:b] for name, values in table.items()} for a, b in ((0, 9), (9, 60))]
    (whole,) = thinned([table], stages=naive_run.result.stages, limit=20)
    (few,) = thinned(parts, stages=naive_run.result.stages, limit=20)
    assert few["violated"].size == 20
    for name, values in whole.items():
        np.testing.assert_array_equal(few[name], values)


def test_a_run_under_way_keeps_the_heaviest_violations_of_its_final_stage(
    controller, naive_run, monkeypatch
):
    monkeypatch.setattr(controller_thread, "thinned", partial(thinned, limit=8))
    controller.start(NAIVE, keep=False)
    run = wait_until(controller).run
    assert (run.kept, run.simulated) == (8, 60)
    table = naive_run.rollouts
    weight = np.where(table["violated"], naive_run.log_weight, -np.inf)
    assert np.isin(np.argsort(-weight, kind="stable")[:4], run.rollouts["rollout"]).all()
    assert int(np.argmin(table["robustness"])) in run.rollouts["rollout"]


def test_a_run_too_large_to_hold_shows_all_its_rollouts_once_it_is_done(controller, monkeypatch):
    monkeypatch.setattr(controller_thread, "thinned", partial(thinned, limit=8))
    held = []
    publish = controller._publish

    def watch(run, progress):
        held.append(run.kept)
        publish(run, progress)

    monkeypatch.setattr(controller, "_publish", watch)
    controller.start(NAIVE)
    run = wait_until(controller).run
    assert max(held) == 8
    assert run.kept == run.simulated == 60
    assert rank(run, "classical").order.size == 60


def test_points_drawn_hold_violations_up_to_half_and_the_least_robust(naive_run):
    table = dict(naive_run.rollouts) | {"violated": np.arange(60) % 10 == 3}
    run = replace(naive_run, parts=(table,))
    least = int(np.argmin(table["robustness"]))
    few = drawn_points(run, most=14)
    assert few.size == 14
    assert {*np.flatnonzero(table["violated"]).tolist(), least} <= set(few.tolist())
    fewest = drawn_points(run, most=8)
    heaviest = np.argsort(-rank(run, "classical").share, kind="stable")[:4]
    assert {*heaviest.tolist(), least} <= set(fewest.tolist())
    assert fewest.size == 8


def test_few_violations_stand_for_all_in_weight():
    rng = np.random.default_rng(1)
    weight = rng.exponential(size=5_000) ** 3
    weight /= weight.sum()
    values = rng.normal(size=5_000) + 10.0 * weight / weight.max()
    places, standing = standing_for_all(weight, most=400)
    assert places.size == standing.size == np.unique(places).size == 400
    assert standing.sum() == pytest.approx(1.0, rel=1e-12)
    heavy = np.argsort(-weight)[:200]
    np.testing.assert_array_equal(standing[np.searchsorted(places, heavy)], weight[heavy])
    # what is left to chance is the other half's: its standard deviation from the weights
    rest = np.setdiff1d(places, heavy)
    sd = np.sqrt(np.sum(standing[np.isin(places, rest)] ** 2))
    assert abs(standing @ values[places] - weight @ values) < 4.0 * sd
    every, same = standing_for_all(weight[:300], most=400)
    np.testing.assert_array_equal(every, np.arange(300))
    np.testing.assert_array_equal(same, weight[:300])


def test_the_words_say_of_how_many_violations_some_are_shown(naive_run, monkeypatch):
    monkeypatch.setattr("pemviz.panel.why_page.MOST_EXPLAINED", 6)
    run = load_run(naive_run.folder)
    failures = failures_of(run)
    total = int(run.rollouts["violated"].sum())
    assert failures.missed.shape[0] == 6
    assert f"From 6 of {total} violations" in why(run)


def test_large_files_are_held_to_the_result_beside(latent_folder, tmp_path):
    folder, loaded = tmp_path / "run", LoadedRuns()
    shutil.copytree(latent_folder, folder)
    assert loaded.disagreement(folder) is None
    rollouts = folder / "rollouts.npz"
    rollouts.write_bytes(rollouts.read_bytes() + b"\0")
    assert load_run(folder, most_read_bytes=0).mapped
    assert loaded.disagreement(folder) is None  # one look for all who open it
    assert "files.rollouts.npz = " in str(LoadedRuns().disagreement(folder))
