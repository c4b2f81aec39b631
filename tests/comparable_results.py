"""What a run's ``result.json`` tells, without what differs from one run of a kind to the next."""

import json

VARYING = ("schema", "files", "digest", "timings_s")


def comparable(document):
    """A document without timings, and without the digests that stand in a run folder alone."""
    return {name: value for name, value in document.items() if name not in VARYING}


def comparable_result(folder):
    """The same of a run folder's."""
    return comparable(json.loads((folder / "result.json").read_text(encoding="utf-8")))


def without_digests(folder):
    """Make the run folder's result one of an older version, that has none."""
    path = folder / "result.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["files"], document["digest"]
    path.write_text(json.dumps({**document, "schema": 1}), encoding="utf-8")
