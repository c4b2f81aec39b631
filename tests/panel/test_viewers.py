from contextlib import contextmanager
from pathlib import Path

from pemviz.panel.recordings_folder import Viewers


def test_a_viewer_is_opened_once_and_the_oldest_is_closed():
    opened, closed = [], []

    @contextmanager
    def viewer(path):
        opened.append(path)
        yield f"http://127.0.0.1/{path}"
        closed.append(path)

    viewers = Viewers(viewer, limit=2)
    one, two, three = Path("1"), Path("2"), Path("3")
    assert viewers.open(one) == viewers.open(one) == "http://127.0.0.1/1"
    assert opened == [one]
    viewers.open(two)
    viewers.open(three)
    assert closed == [one]
    viewers.close()
    assert closed == [one, two, three]
    assert viewers.open(one) == "http://127.0.0.1/1"
