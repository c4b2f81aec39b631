"""``pemviz pem collect``."""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast, get_args

from pemviz.bars import progress_bar
from pemviz.cli.help import HelpPage
from pemviz.cli.pem.checks import check_rate_hz, check_table_out, tell_doubts
from pemviz.errors import PemError
from pemviz.matching import PAPER_IOU
from pemviz.pem.data.argoverse import collect_argoverse
from pemviz.pem.data.coco import collect_coco
from pemviz.pem.data.collect import (
    NUMBERED_CLASSES,
    CollectedCounts,
    CollectOptions,
    TrackCounts,
    collect,
    collect_tracks,
)
from pemviz.pem.data.detections import DetectionFormat, SequenceFormat
from pemviz.pem.data.fiftyone import collect_fiftyone
from pemviz.pem.data.mapped_log import collect_log
from pemviz.pem.data.mot_challenge import collect_mot
from pemviz.pem.data.nuscenes import MATCHED_BELOW_M, collect_nuscenes
from pemviz.pem.data.recognise import CollectedFormat
from pemviz.pem.data.rosbag import BagOptions, collect_rosbag
from pemviz.pem.data.timed_boxes import TIME_TOLERANCE_S, MatchOptions

FASTEST_HZ = 1e4
DEFAULT_HZ = 10.0

PAGE = HelpPage(
    text="""
usage: pemviz pem collect --labels PATH --detections PATH [OPTIONS]
A table of every labelled obstacle, with whether the detector reported it.

Files
  --labels PATH          what was there: a folder of KITTI labels, of nuScenes'
                         tables, or of MOTChallenge's sequences
  --detections PATH      what the detector reported: a folder, or a json file
  --format NAME          kitti, yolo, coco; of sequences mot, ab3dmot, nuscenes,
                         motchallenge; log: --mapping FILE.toml has its columns;
                         rosbag: --labels-topic, --detections-topic
  --out FILE             the table [obstacles.csv]
What counts
  --types Car            classes that are obstacles; --drop-unknown
  --iou-above 0.5        overlap of boxes that makes a detection [0.01]
  --centres-below-m 2    distance that does, with nuscenes and rosbag
  --score-from X         detections of a lower score are ignored; --class-aware
  --rate-hz 10           frames a second of sequences
Examples
  pemviz pem collect --labels label_2 --detections found --out obstacles.csv
  pemviz pem collect --labels label_02 --detections boxes --format mot
  pemviz pem collect --labels v1.0-mini --detections my.json --format nuscenes
More: --help OPTION, such as --help format; --help-all for everything""",
)


@dataclass(frozen=True)
class CollectArguments:
    """Match KITTI labels with a detector's boxes: one row per obstacle, was it detected."""

    labels: Path
    """Folder of KITTI label files: label_2, one per frame; or of tracking labels (label_02), one
    per sequence, with a format of sequences; of nuScenes' tables (v1.0-mini), or of
    MOTChallenge's sequences (SEQUENCE/gt/gt.txt); or a file of COCO's ground truth."""
    detections: Path
    """Folder of text files, one per frame (kitti, yolo) or per sequence (mot, ab3dmot,
    motchallenge; there also SEQUENCE/det/det.txt), or a json file (coco, nuscenes)."""
    out: Path = Path("obstacles.csv")
    """Table to write: CSV, with format log also .parquet."""
    format: CollectedFormat = "kitti"
    """How the detections are written: KITTI results (with a 3D place, the table has x_error_m and
    z_error_m for pemviz pem fit --position-errors), YOLO text (shares of the image), COCO json; of
    sequences: mot (frame, left, top, right, bottom, score) or ab3dmot (frame, class, the four
    sides, score, 3D box). Tables of sequences keep sequence, frame, track and rate; so does that of
    nuscenes: its detection task's results, matched by the distance of centres, with position
    errors. motchallenge: its ground truth and detections, without places in the world: a table for
    pemviz pem memory --model guess-mu alone. coco with a file of COCO's ground truth as labels:
    boxes in images, in tracks where annotations have a track_id, for pem memory --model guess-mu
    and for pem fit --features; fiftyone likewise: two fields of a samples.json. argoverse:
    Argoverse 2's annotations and a file of detections (feather). rosbag: two topics of rosbags of
    ROS 2 (.mcap, or a folder), of vision_msgs' Detection3DArray or Detection2DArray,
    or of Autoware's detected or tracked objects (needs pemviz[logs]). log: a log of your own,
    matched already, whose columns --mapping tells: text, JSON lines (.jsonl), parquet, Arrow
    (.arrow, .feather)."""
    mapping: Path | None = None
    """TOML that says where a log's columns are, and in which units;
    assets/mappings/nuscenes-cars.toml is one.
    --labels and --detections are then the log, one file or two side by side."""
    labels_field: str = ""
    """With fiftyone: the field of labels."""
    detections_field: str = ""
    """With fiftyone: the field of what the detector reported."""
    labels_topic: str = ""
    """With rosbag: the topic of reference boxes, by whose ids obstacles are followed."""
    detections_topic: str = ""
    """With rosbag: the topic of what the detector reported."""
    ego_topic: str = ""
    """With rosbag, where boxes are in a fixed frame such as map: where the ego is (nav_msgs'
    Odometry, geometry_msgs' PoseStamped)."""
    time_tolerance_s: float = TIME_TOLERANCE_S
    """With rosbag: stamps of two messages that belong together differ by this at most (above 0)
    [s]."""
    rate_hz: float | None = None
    """Frames a second of sequences (above 0), by which memory times are in seconds; nuScenes'
    tables, MOTChallenge's seqinfo.ini and time stamps tell it themselves. Where nothing does, 10
    are assumed, and said to be."""
    types: tuple[str, ...] = ()
    """Classes that count as obstacles in sequences, such as Car; all if empty."""
    iou_above: float = PAPER_IOU
    """A pair of boxes counts as a detection above this overlap (0 to below 1)."""
    centres_below_m: float = MATCHED_BELOW_M
    """With nuscenes, rosbag, argoverse: below this distance of centres in the ground plane (above
    0) [m]."""
    class_aware: bool = False
    """Count only detections of the obstacle's own class."""
    score_from: float | None = None
    """Ignore detections with a lower score, on the detector's own scale (any number)."""
    drop_unknown: bool = False
    """Leave out obstacles of class Misc or unknown occlusion; no model can be fitted to them."""
    class_names: tuple[str, ...] = NUMBERED_CLASSES
    """Names of the classes 0, 1, ... where detections have numbers."""
    image_sizes: Path | None = None
    """CSV with the columns frame, width_px, height_px; YOLO text needs it."""
    missing_is_empty: bool = False
    """Take a frame without detections file as one in which nothing was detected."""
    skip_bad: bool = False
    """Count malformed lines and go on, instead of stopping at the first."""


def run(arguments: CollectArguments) -> int:
    """Write the table and say what is in it; gives the exit code.

    Raises:
        PemError: bad arguments or files; one line says what, where and what is allowed.
    """
    if not 0.0 <= arguments.iou_above < 1.0:
        raise PemError(f"iou_above is {arguments.iou_above:g}, allowed: 0 to below 1")
    score_from = -math.inf if arguments.score_from is None else arguments.score_from
    if arguments.score_from is not None and not math.isfinite(score_from):
        raise PemError(f"score_from is {score_from:g}, allowed: any finite number")
    options = CollectOptions(
        iou_above=arguments.iou_above,
        class_aware=arguments.class_aware,
        score_from=score_from,
        drop_unknown=arguments.drop_unknown,
        skip_bad=arguments.skip_bad,
    )
    _check_matching(arguments)
    check_table_out(arguments.out, with_parquet=arguments.format == "log")
    if arguments.mapping is not None:
        with progress_bar("thousandths of the log") as on_progress:
            log = collect_log(
                labels=arguments.labels,
                detections=arguments.detections,
                mapping=arguments.mapping,
                out=arguments.out,
                skip_bad=arguments.skip_bad,
                on_progress=on_progress,
            )
        return _report(arguments.out, log, f"{log.obstacles} obstacles, {log.missed} missed")
    if arguments.format in ("motchallenge", *get_args(SequenceFormat)):
        _check_sequences(arguments)
        unit = "sequences"
    elif is_of_images(arguments.format, arguments.labels):
        return _images(arguments, options)
    elif arguments.format in ("rosbag", "argoverse"):
        return _timed_boxes(arguments, score_from)
    else:
        unit = "samples" if arguments.format == "nuscenes" else "frames"
    with progress_bar(unit) as on_progress:
        counts, words = _collected(arguments, options, on_progress)
    return _report(arguments.out, counts, words)


def is_of_images(file_format: CollectedFormat, labels: Path) -> bool:
    """Whether labels are boxes in images, in a file of COCO's or FiftyOne's."""
    return file_format == "fiftyone" or (file_format == "coco" and labels.suffix == ".json")


def _images(arguments: CollectArguments, options: CollectOptions) -> int:
    check_rate_hz(arguments.rate_hz)
    if arguments.format == "coco":
        collect_from = partial(collect_coco, detections=arguments.detections)
    else:
        collect_from = partial(
            collect_fiftyone,
            labels_field=arguments.labels_field,
            detections_field=arguments.detections_field,
        )
    with progress_bar("images") as on_progress:
        counts = collect_from(
            labels=arguments.labels,
            out=arguments.out,
            rate_hz=_rate_hz(arguments),
            types=arguments.types,
            options=options,
            on_progress=on_progress,
        )
    _tell_assumed(arguments, counts)
    return _report(
        arguments.out,
        counts,
        f"{counts.sequences} sequences, {counts.tracks} tracks, {counts.observations} boxes, "
        f"{counts.missed} missed, {counts.gaps} gaps in tracks; left out: {counts.other_types} of "
        f"other classes, {counts.dropped} crowds or samples without a field, "
        f"{counts.ignored_detections} detections of lower score",
    )


def _timed_boxes(arguments: CollectArguments, score_from: float) -> int:
    options = MatchOptions(
        time_tolerance_s=arguments.time_tolerance_s,
        centres_below_m=arguments.centres_below_m,
        iou_above=arguments.iou_above,
        types=arguments.types,
        class_names=arguments.class_names,
        score_from=score_from,
    )
    paths = {"labels": arguments.labels, "detections": arguments.detections, "out": arguments.out}
    with progress_bar("logs") as on_progress:
        if arguments.format == "argoverse":
            counts = collect_argoverse(**paths, options=options, on_progress=on_progress)
        else:
            topics = BagOptions(
                labels_topic=arguments.labels_topic,
                detections_topic=arguments.detections_topic,
                ego_topic=arguments.ego_topic,
                **vars(options),
            )
            counts = collect_rosbag(**paths, options=topics, on_progress=on_progress)
    return _report(
        arguments.out,
        counts,
        f"{counts.sequences} logs, {counts.moments} moments, {counts.tracks} tracks, "
        f"{counts.observations} observations, {counts.missed} missed; left out: {counts.alone} "
        f"moments without detections, {counts.other_types} of other classes, {counts.dropped} "
        f"without a point of lidar, {counts.ignored_detections} detections of lower score; "
        "truncation and occlusion, which such boxes do not say, are 0",
    )


def _report(out: Path, counts: CollectedCounts, words: str) -> int:
    print(f"{out}: {words}")
    if counts.bad_lines:
        print(
            f"warning: {counts.bad_lines} malformed lines skipped, the first: {counts.first_bad}",
            file=sys.stderr,
        )
    tell_doubts(counts.doubts)
    return 0


def _rate_hz(arguments: CollectArguments) -> float:
    return DEFAULT_HZ if arguments.rate_hz is None else arguments.rate_hz


def _tell_assumed(arguments: CollectArguments, counts: TrackCounts) -> None:
    """Say where a rate is taken that nobody has said."""
    if arguments.rate_hz is None and counts.of_given_rate:
        counts.doubts += (
            f"no file tells the frames a second of {counts.of_given_rate} sequences: "
            f"{DEFAULT_HZ:g} are assumed, and memory times are as wrong as that is; say it by "
            "--rate-hz",
        )


def _collected(
    arguments: CollectArguments, options: CollectOptions, on_progress: Callable[[int, int], None]
) -> tuple[CollectedCounts, str]:
    """What was counted on the way to the table, and what of it is said."""
    labels, detections, out = arguments.labels, arguments.detections, arguments.out
    if arguments.format == "nuscenes":
        samples = collect_nuscenes(
            labels=labels,
            detections=detections,
            out=out,
            types=arguments.types,
            matched_below_m=arguments.centres_below_m,
            score_from=options.score_from,
            drop_unknown=options.drop_unknown,
            skip_bad=options.skip_bad,
            on_progress=on_progress,
        )
        return samples, (
            f"{samples.samples} samples, {samples.tracks} tracks, {samples.observations} "
            f"observations, {samples.missed} missed; left out: {samples.other_types} of other "
            f"classes, {samples.without_points} without a point of lidar or radar, "
            f"{samples.beyond} beyond their class's range, {samples.dropped} of unknown visibility"
        )
    if arguments.format in ("motchallenge", *get_args(SequenceFormat)):
        collect_sequences, dropped = (
            (collect_mot, "marked to be ignored")
            if arguments.format == "motchallenge"
            else (
                partial(collect_tracks, sequence_format=cast(SequenceFormat, arguments.format)),
                "Misc or of unknown occlusion",
            )
        )
        tracks = collect_sequences(
            labels=labels,
            detections=detections,
            out=out,
            rate_hz=_rate_hz(arguments),
            types=arguments.types,
            options=options,
            on_progress=on_progress,
        )
        _tell_assumed(arguments, tracks)
        return tracks, (
            f"{tracks.sequences} sequences, {tracks.tracks} tracks, {tracks.observations} "
            f"observations, {tracks.missed} missed, {tracks.gaps} gaps in tracks; left out: "
            f"{tracks.other_types} of other classes, {tracks.dropped} {dropped}, "
            f"{tracks.ignored_detections} detections of lower score"
        )
    frames = collect(
        labels=labels,
        detections=detections,
        out=out,
        detection_format=cast(DetectionFormat, arguments.format),
        options=options,
        class_names=arguments.class_names,
        image_sizes=arguments.image_sizes,
        missing_is_empty=arguments.missing_is_empty,
        on_progress=on_progress,
    )
    return frames, (
        f"{frames.frames} frames, {frames.obstacles} obstacles, {frames.missed} missed, "
        f"{frames.dropped} dropped (Misc or unknown occlusion)"
    )


def _check_matching(arguments: CollectArguments) -> None:
    """Refuse options that the format has no use for, or one missing that it needs.

    Raises:
        PemError: there is one, or a distance that none can be below.
    """
    if (arguments.format == "log") != (arguments.mapping is not None):
        raise PemError("mapping: must be given with format log, and with no other")
    is_bag = arguments.format == "rosbag"
    named = [arguments.labels_topic, arguments.detections_topic]
    if is_bag and not all(named):
        raise PemError("labels_topic, detections_topic: must be given with format rosbag")
    if not is_bag and any((*named, arguments.ego_topic)):
        raise PemError("labels_topic, detections_topic, ego_topic: only with format rosbag")
    if not 0.0 < arguments.time_tolerance_s < math.inf:
        raise PemError(f"time_tolerance_s is {arguments.time_tolerance_s:g}, allowed: above 0")
    fields = [arguments.labels_field, arguments.detections_field]
    if (arguments.format == "fiftyone") != all(fields) or any(fields) != all(fields):
        raise PemError("labels_field, detections_field: both with format fiftyone, and no other")
    is_nuscenes = arguments.format == "nuscenes"
    is_apart = is_nuscenes or is_bag or arguments.format == "argoverse"
    if not is_apart and arguments.centres_below_m != MATCHED_BELOW_M:
        raise PemError(
            "centres_below_m: only with nuscenes, rosbag, argoverse; boxes are matched by overlap"
        )
    if is_nuscenes and arguments.iou_above != PAPER_IOU:
        raise PemError("iou_above: not with format nuscenes, which centres_below_m matches")
    if is_nuscenes and arguments.rate_hz is not None:
        raise PemError("rate_hz: not with format nuscenes, whose tables tell it")
    if not 0.0 < arguments.centres_below_m < math.inf:
        raise PemError(f"centres_below_m is {arguments.centres_below_m:g}, allowed: above 0")


def _check_sequences(arguments: CollectArguments) -> None:
    """Refuse what sequences cannot have.

    Raises:
        PemError: a rate that is none, or matching by class.
    """
    if not 0.0 < _rate_hz(arguments) <= FASTEST_HZ:
        raise PemError(f"rate_hz is {_rate_hz(arguments):g}, allowed: above 0 to {FASTEST_HZ:g}")
    if arguments.class_aware:
        raise PemError("class_aware: sequences are matched whatever a detection's class; use types")
