"""The shipped models with a memory, and how a model carries one."""

import json

import pytest
from safetensors.numpy import save_file

from pemviz.pem import Memory, PemError, load_pem, memory_of, save_pem
from pemviz.pem.judging.memory_report import plain_view
from pemviz.pem.model_files import METADATA_KEY, read_tensors
from pemviz.pem.models.cards import fitted_memory
from studies.shipped_models.tracked import FLATTERY, SHIPPED_TRACKED, collect_detector
from tests.conftest import shared
from tests.pem.helpers import shipped_file

EVERY = pytest.mark.parametrize("name", SHIPPED_TRACKED)


@EVERY
def test_a_shipped_model_carries_its_memory(name):
    pem = load_pem(name)
    fitted = fitted_memory(pem.card.memory, where=name)
    assert memory_of(pem) == pem.memory == fitted.memory
    assert 0.0 < fitted.tau_interval_s[0] < fitted.memory.tau_s < fitted.tau_interval_s[1]
    assert fitted.frailty_interval[0] <= fitted.memory.frailty <= fitted.frailty_interval[1]
    assert fitted.rate_hz == 10.0


@EVERY
def test_its_card_says_how_flattering_its_data_is(name):
    page = shipped_file(name).with_suffix(".md").read_text()
    assert FLATTERY in page
    assert "passes for memory" in page
    rows = load_pem(name).card.memory["plain_view"]
    for row in rows:
        counts = (row["observations"], row["misses"], row["misses_after_miss"])
        assert f"| {row['name']} | {' | '.join(map(str, counts))} |" in page
    assert rows[0]["misses"] < rows[0]["observations"] / 100  # 0 to 15 m


@EVERY
def test_its_counts_are_those_of_the_data(name):
    tracks = collect_detector(shared("kitti_tracking"), SHIPPED_TRACKED[name])
    card = load_pem(name).card
    assert card.data_digest == tracks.obstacles.digest
    assert card.memory["fit"]["observations"] == len(tracks)
    assert plain_view(tracks) == card.memory["plain_view"]


def test_models_of_single_frames_have_no_memory():
    assert memory_of(load_pem("ml-nn")) is None
    assert memory_of(object()) is None


def test_a_model_of_ones_own_carries_one_as_an_attribute():
    class Own:
        name = "own"
        memory = Memory(tau_s=0.1)

    assert memory_of(Own()) == Memory(tau_s=0.1)
    Own.memory = 0.1
    with pytest.raises(PemError, match="own: its memory is a float, must be a Memory"):
        memory_of(Own())


def test_a_memory_stays_when_a_model_is_saved_again(tmp_path):
    path = tmp_path / "again.safetensors"
    save_pem(load_pem("rrc"), path)
    assert path.read_bytes() == shipped_file("rrc").read_bytes()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fit": {}}, "metadata field 'memory' is not as pemviz writes it"),
        ({"fit": {"memory": {"tau_s": -1.0, "frailty": 0.0}}}, "is not as pemviz writes it"),
        ({"rate_hz": "10"}, "metadata field 'memory' is not as pemviz writes it"),
    ],
)
def test_a_damaged_memory_is_refused_in_one_line(tmp_path, change, words):
    tensors, metadata = read_tensors(shipped_file("rrc"))
    header = json.loads(metadata[METADATA_KEY])
    header["card"]["memory"] |= change
    path = tmp_path / "damaged.safetensors"
    save_file(tensors, path, metadata={METADATA_KEY: json.dumps(header)})
    with pytest.raises(PemError, match=words) as caught:
        load_pem(str(path))
    assert "\n" not in str(caught.value)
