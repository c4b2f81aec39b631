import numpy as np
import pytest

from pemviz.recording import paths
from pemviz.recording.pages import Page, write_pages
from pemviz.reproduce.recording import write_recording
from tests.recording.read_back import chunks


@pytest.fixture(scope="module")
def written(tmp_path_factory, made):
    path = tmp_path_factory.mktemp("reproduction") / "reproduction.rrd"
    write_recording(made, path)
    assert [entry.name for entry in path.parent.iterdir()] == ["reproduction.rrd"]
    return made, path


def values(path, entity, component):
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity:
            for field, column in zip(batch.schema, batch.columns, strict=True):
                if field.name.endswith(component):
                    yield column.to_pylist()


def test_every_page_is_there_with_its_picture(written):
    made, path = written
    logged = {chunk.entity_path for chunk in chunks(path)}
    for one in made.artefacts:
        assert paths.page(one.name, "text") in logged
        assert (paths.page(one.name, "picture") in logged) == (one.png is not None)
    assert paths.page("all", "text") in logged


def test_pictures_and_curves_are_the_reproductions_own(written):
    made, path = written
    (picture,) = [one.png for one in made.artefacts if one.name == "least_safe"]
    ((row,),) = values(path, paths.page("least_safe", "picture"), ":blob")
    assert bytes(np.ravel(row).astype(np.uint8)) == picture
    (rows,) = values(path, paths.page("least_safe", "series"), ":scalars")
    gaps = np.array(rows)
    expected = np.stack([found.gap_m for found in made.search.found], axis=1)
    np.testing.assert_array_equal(gaps, expected)


def test_a_page_of_text_alone_needs_nothing_beside_it(tmp_path):
    write_pages(tmp_path / "a.rrd", [Page(name="a", title="A", markdown="# a")], name="a")
    assert {c.entity_path for c in chunks(tmp_path / "a.rrd")} >= {paths.page("a", "text")}
