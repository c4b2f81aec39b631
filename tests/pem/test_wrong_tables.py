"""Tables that look sound and lead to a wrong number: refused, or told of."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, feather, parquet

from pemviz.cli.main import main
from pemviz.pem import PemError, SalientTable, load_table, save_table
from pemviz.pem.data.collect import collect_tracks
from pemviz.pem.data.columns import numbers_of
from pemviz.pem.data.table import load_tracks
from pemviz.pem.judging.cross_validation import split_folds
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS
from tests.pem.detector_files import observations, write_lines
from tests.pem.helpers import braking_rows, random_rows

HEADER = ",".join(("sequence", "frame", "track", "rate_hz", *SALIENT_COLUMNS, "detected"))


def tracks_file(path, *, frames_each=1, jitter=0.0, header=HEADER, when=None, seed=3):
    """A table of cars that move and are missed independently, each frame so many times."""
    random = np.random.default_rng(seed)
    lines = [header]
    for sequence in range(4):
        for track in range(6):
            gap_m = random.uniform(10.0, 40.0)
            for frame in range(40):
                gap_m += random.normal(0.0, 0.3)
                detected = int(random.random() < 0.7)
                for again in range(frames_each):
                    row = braking_rows([gap_m + jitter * random.normal()])[0]
                    number = frame * frames_each + again
                    who = [sequence, number, track, 10] if when is None else when(sequence, number)
                    who = who if when is None else [sequence, *who, track]
                    cells = [*who, *(f"{value:.10g}" for value in row), detected]
                    lines.append(",".join(str(cell) for cell in cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_every_frame_logged_twice_is_refused(tmp_path):
    assert load_tracks(tracks_file(tmp_path / "once.csv")).doubts == ()
    twice = tracks_file(tmp_path / "twice.csv", frames_each=2)
    for load in (load_tracks, load_table):
        with pytest.raises(PemError, match=r"last exactly 2 frames.*keep one of 2"):
            load(twice)


def test_outcomes_that_change_in_pairs_of_frames_alone_are_told(tmp_path):
    """States that are not the same to the last digit hide it, the changes of outcomes do not."""
    twice = tracks_file(tmp_path / "twice.csv", frames_each=2, jitter=1e-3)
    (doubt,) = load_tracks(twice).doubts
    assert doubt.startswith("100% of the")
    assert "each frame was logged 2 times" in doubt


def test_rows_that_are_there_again_are_refused_where_they_stand(tmp_path):
    path = tracks_file(tmp_path / "tracks.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[7]]) + "\n")
    with pytest.raises(PemError, match=r"tracks\.csv:962: the same sequence, track and moment as"):
        load_table(path)
    with pytest.raises(PemError, match="track 0 of sequence 0 is there twice in frame 6"):
        load_tracks(path)


TIMED = HEADER.replace("frame,track,rate_hz", "time_s,track")


def test_each_sequence_has_the_rate_of_its_own_time_stamps(tmp_path):
    path = tracks_file(
        tmp_path / "tracks.csv",
        header=TIMED,
        when=lambda sequence, number: [1.7e9 + number * (0.05 if sequence == 3 else 0.1)],
    )
    tracks = load_tracks(path)
    step_s = tracks.since_s[tracks.follows]
    expected = np.where(tracks.sequence[tracks.follows] == 3, 0.05, 0.1)
    np.testing.assert_allclose(step_s, expected, atol=1e-6)
    assert tracks.gaps == 0
    (doubt,) = tracks.doubts
    assert doubt.endswith("10 Hz in 3, 20 Hz in 1")


@pytest.mark.parametrize(
    ("when", "words"),
    [
        (lambda sequence, n: [n * 1e8], 'times of sequence 0 are 1e.08 s apart .*"ns"'),
        (lambda sequence, n: [n // 2 * 0.1], "same sequence, track and moment as in row"),
        (lambda sequence, n: [1e300 * 1e10 * n], "'time_s' must be finite|nan"),
    ],
)
def test_times_that_cannot_be_are_refused(tmp_path, when, words):
    with pytest.raises(PemError, match=words):
        load_tracks(tracks_file(tmp_path / "tracks.csv", header=TIMED, when=when))


def test_a_stated_rate_must_be_that_of_the_times(tmp_path):
    header = HEADER.replace("frame,track,rate_hz", "rate_hz,time_s,track")
    path = tracks_file(
        tmp_path / "tracks.csv", header=header, when=lambda sequence, n: [10, n * 0.05]
    )
    with pytest.raises(PemError, match=r"rate_hz is 10, but its times are 0.05 s apart"):
        load_tracks(path)


def test_irregular_times_and_gaps_are_told(tmp_path):
    random = np.random.default_rng(1)
    path = tracks_file(
        tmp_path / "tracks.csv",
        header=TIMED,
        when=lambda sequence, n: [n * 0.1 + 0.03 * random.random() + (n > 20) * 0.5],
    )
    assert any("gaps of over" in doubt for doubt in load_tracks(path).doubts)
    path = tracks_file(
        path, header=TIMED, when=lambda sequence, n: [n * 0.1 + 0.06 * random.random()]
    )
    (doubt,) = load_tracks(path).doubts
    assert "no whole number of frames" in doubt


@pytest.mark.parametrize(
    ("columns", "factor", "words"),
    [
        (("length_m",), 100.0, 'length_m of class Car is 500 .* 2 to 9 m; in cent.*5 m: .*"cm"'),
        (("height_m", "width_m", "length_m"), 1000.0, 'height_m of class Car .*unit = "mm"'),
        (("height_m", "width_m", "length_m"), 1 / 0.3048, 'height_m of .*feet .*1.53 m: .*"ft"'),
        (("x_m", "z_m"), 100.0, r'the distance is 2\d\d\d .* 2\d(\.\d)? m: say unit = "cm"'),
        (("x_m", "z_m"), 1e-3, 'the distance is .*unit = "km"'),
        (("rotation_y_rad", "alpha_rad"), 180 / np.pi, 'rotation_y_rad is 90.* 1.57 rad: .*"deg"'),
    ],
)
def test_other_units_than_the_columns_say_are_refused(tmp_path, columns, factor, words):
    gaps_m = np.linspace(5.0, 45.0, 50)
    rows, path = braking_rows(gaps_m), tmp_path / "table.csv"
    save_table(SalientTable(rows, gaps_m < 30.0, "sound"), path)
    assert len(load_table(path)) == 50
    for name in columns:
        rows[:, COLUMN[name]] *= factor
    save_table(SalientTable(rows, gaps_m < 30.0, "other"), path)
    with pytest.raises(PemError, match=words) as caught:
        load_table(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_shares_in_per_cent_are_refused(tmp_path):
    rows = braking_rows(np.linspace(5.0, 45.0, 50))
    rows[:, COLUMN["truncation"]] = 40.0
    save_table(SalientTable(rows, np.arange(50) % 2 == 0, "x"), tmp_path / "table.csv")
    with pytest.raises(PemError, match=r"truncation is 40, .* per cent it would be 0.4"):
        load_table(tmp_path / "table.csv")


def shifted_files(folder, by):
    """Labels of cars that cross the image, and detections so many frames late."""
    labels, found = {}, {}
    for sequence, frame, track, _, z, detected in observations(sequences=2):
        name = f"{sequence:04d}.txt"
        left = 50.0 * track + 6.0 * frame
        sides = f"{left:.1f} 150 {left + 60:.1f} 200"
        labels.setdefault(name, []).append(
            f"{frame + 2} {track} Car 0 0 -1.57 {sides} 1.5 1.7 4.1 0 1.65 {z:.2f} -1.57"
        )
        if detected:
            found.setdefault(name, []).append(f"{frame + 2 + by},{sides.replace(' ', ',')},0.9")
    write_lines(folder / "labels", labels)
    write_lines(folder / "found", found)
    return {"labels": folder / "labels", "detections": folder / "found", "out": folder / "t.csv"}


def test_detections_that_are_late_are_told(tmp_path, capsys):
    assert collect_tracks(**shifted_files(tmp_path / "0", 0)).doubts == ()
    for by, words in ((1, "1 frame late"), (-2, "2 frames early")):
        (doubt,) = collect_tracks(**shifted_files(tmp_path / str(by), by)).doubts
        assert words in doubt
    files = shifted_files(tmp_path / "1", 1)
    given = [word for name, path in files.items() for word in (f"--{name}", str(path))]
    assert main(["pem", "collect", "--format", "mot", *given]) == 0
    assert "warning: labels overlap" in capsys.readouterr().err


TABLE = f"{','.join(SALIENT_COLUMNS)},detected\n0,0,0,0,1.5,1.6,4,0,1.6,20,1.5,1\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty"),
        (TABLE.replace(",", ";").encode(), "separated by semicolons .* must be by commas"),
        (TABLE.encode("utf-16"), "zero bytes, as UTF-16"),
        (TABLE.replace("y_m", "x_m").encode(), "column 'x_m' stands twice"),
        (TABLE.splitlines()[0].encode(), "the table has no rows"),
    ],
)
def test_files_that_are_no_table_are_refused(tmp_path, content, words):
    path = tmp_path / "own.csv"
    path.write_bytes(content)
    with pytest.raises(PemError, match=words):
        load_table(path)


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path):
    path = tmp_path / "own.csv"
    path.write_bytes(TABLE.encode("utf-8-sig"))
    assert load_table(path).salient[0, COLUMN["z_m"]] == 20.0


def test_comments_and_blank_lines_change_nothing(tmp_path):
    rows = random_rows(np.random.default_rng(0), 30)
    save_table(SalientTable(rows, np.arange(30) % 3 > 0, "x"), tmp_path / "plain.csv")
    text = (tmp_path / "plain.csv").read_text().replace("\n", "\n# said, so\n\n", 5)
    (tmp_path / "said.csv").write_text(text)
    plain, said = (load_table(tmp_path / f"{name}.csv") for name in ("plain", "said"))
    np.testing.assert_array_equal(plain.salient, said.salient)
    np.testing.assert_array_equal(plain.salient, rows)


def test_quotes_about_names_and_cells_are_no_part_of_them(tmp_path):
    """As Arrow's and R's writers put them."""
    path = tracks_file(tmp_path / "tracks.csv")
    csv.write_csv(csv.read_csv(path), tmp_path / "quoted.csv")
    assert (tmp_path / "quoted.csv").read_text().startswith('"sequence","frame"')
    quoted = load_table(tmp_path / "quoted.csv")
    np.testing.assert_array_equal(quoted.salient, load_table(path).salient)
    (tmp_path / "said.csv").write_text((tmp_path / "quoted.csv").read_text() + "# said, so\n")
    assert load_table(tmp_path / "said.csv").digest == quoted.digest


@pytest.mark.parametrize("suffix", [".parquet", ".feather"])
def test_the_same_table_in_arrow_s_formats(tmp_path, suffix):
    path = tracks_file(tmp_path / "tracks.csv")
    write = {".parquet": parquet.write_table, ".feather": feather.write_feather}[suffix]
    write(csv.read_csv(path), tmp_path / f"tracks{suffix}")
    one, other = load_tracks(path), load_tracks(tmp_path / f"tracks{suffix}")
    np.testing.assert_array_equal(one.obstacles.salient, other.obstacles.salient)
    np.testing.assert_array_equal(one.track, other.track)
    assert load_table(tmp_path / f"tracks{suffix}").digest == load_table(path).digest


def test_what_helps_where_folds_lack_an_outcome_is_said():
    sequence = np.repeat(np.arange(6), 20)
    rows = random_rows(np.random.default_rng(0), 120)
    one = SalientTable(rows, sequence != 2, "x", sequence=sequence)
    with pytest.raises(PemError, match="no number of folds helps: 1 of 6 sequences hold"):
        split_folds(one, folds=5)
    two = SalientTable(rows, (sequence != 2) & (sequence != 3), "x", sequence=sequence)
    with pytest.raises(PemError, match="a fold of sequences lacks an outcome; give 2"):
        split_folds(two, folds=5)


def test_numbers_of_every_type_and_which_cells_are_none():
    """Nanoseconds of today are beyond 2^53, and no double holds each."""
    nanoseconds = [1_700_000_000_000_000_001, 1_700_000_000_100_000_000]
    stamps = pa.array(nanoseconds, pa.timestamp("ns"))
    words = pa.array(["1.5", "two", None, "-3e2"])
    for column, expected, wrong in (
        (pa.array(nanoseconds, pa.int64()), np.float64(nanoseconds), []),
        (pa.array(nanoseconds, pa.uint64()), np.float64(nanoseconds), []),
        (stamps, np.float64(nanoseconds) / 1e9, []),
        (words, [1.5, np.nan, np.nan, -300.0], [1, 2]),
        (words.dictionary_encode(), [1.5, np.nan, np.nan, -300.0], [1, 2]),
        (pa.array(["1_5", "15"]), [np.nan, 15.0], [0]),
        (pa.array([b"1_5", b"15", b"\xff"]), [np.nan, 15.0, np.nan], [0, 2]),
        (pa.array([True, False, None]), [1.0, 0.0, np.nan], [2]),
        (pa.array([2, None]), [2.0, np.nan], [1]),
    ):
        values, none = numbers_of(pa.chunked_array([column]))
        np.testing.assert_array_equal(values, expected)
        assert np.flatnonzero(none).tolist() == wrong
