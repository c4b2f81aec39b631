"""Valid inputs, all made here: the seeds that the mutators damage. Nothing comes from KITTI."""

import random
import shutil
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from safetensors.numpy import save

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import config_text
from pemviz.pem import PemCard, load_pem, load_position_errors, save_pem, save_table
from pemviz.pem.data.support import summarise_support
from pemviz.pem.exchange.autoware import NoiseFile, configuration_of, noise_yaml
from pemviz.pem.exchange.averages import averages, fixed_obstacles
from pemviz.pem.models.ensemble import EnsemblePem
from pemviz.pem.models.network import PAPER_INPUTS, Layer, NetworkPem
from pemviz.pem.models.tabulated import TabulatedPem
from pemviz.pem.models.trees import LEAF, TreesPem
from pemviz.proposals.gap_network import GapNetwork
from pemviz.runs.engine import run
from pemviz.runs.events import StageDone
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result_file import write_result
from pemviz.runs.run_folder import RunStore
from studies.synthetic_obstacles import synthetic_table
from tests.toy import constant_pem

FRAMES = ("000000", "000007")
SCENARIO = ScenarioConfig(states=12, dt_s=0.4)
SPEC = "always[0,11] (gap >= 2.0)"
CONFIGS = (
    ExperimentConfig(spec=SPEC, scenario=SCENARIO),
    ExperimentConfig(
        method="mixture",
        metric="agm",
        spec="G[0:9] (F[1:2] !(gap <= 1e-3) && true) || ego_speed < 0.5",
        target=1e-12,
        reference=True,
        seed=7,
        scenario=SCENARIO,
    ),
    ExperimentConfig(method="naive", final_rollouts=30, spec=SPEC, scenario=SCENARIO),
    ExperimentConfig(),
)


def label_file(rng: random.Random, *, obstacles: int = 4) -> str:
    """A KITTI label file of made-up obstacles."""
    kinds = ("Car", "Van", "Pedestrian", "Cyclist", "Misc", "DontCare")
    return "".join(_label(rng, rng.choice(kinds)) + "\n" for _ in range(obstacles))


def result_file(rng: random.Random, *, detections: int = 4) -> str:
    """A KITTI result file of made-up detections."""
    lines = [f"{_label(rng, 'Car')} {rng.random():.2f}\n" for _ in range(detections)]
    return "".join(lines)


def _label(rng: random.Random, kind: str) -> str:
    left, top = rng.uniform(0, 900), rng.uniform(100, 200)
    box = (left, top, left + rng.uniform(5, 300), top + rng.uniform(5, 170))
    pose = (1.5, 1.6, 3.9, rng.uniform(-9, 9), 1.65, rng.uniform(4, 60), rng.uniform(-3, 3))
    cells = (f"{value:.2f}" for value in (rng.uniform(-3, 3), *box, *pose))
    return " ".join((kind, "0.00", str(rng.randrange(4)), *cells))


def yolo_file(rng: random.Random) -> str:
    """Four detections as shares of the image."""
    return "".join(
        f"{rng.randrange(3)} {rng.uniform(0.2, 0.8):.3f} 0.5 0.1 0.2 {rng.random():.2f}\n"
        for _ in range(4)
    )


def coco_document(rng: random.Random) -> dict[str, object]:
    """A COCO object with two images and three detections."""
    return {
        "images": [{"id": k, "file_name": f"image_2/{f}.png"} for k, f in enumerate(FRAMES)],
        "categories": [{"id": 3, "name": "Car"}, {"id": 1, "name": "Cyclist"}],
        "annotations": [
            {
                "image_id": rng.randrange(2),
                "category_id": 3,
                "bbox": [rng.uniform(0, 900), 150.0, 60.5, 40],
                "score": rng.random(),
            }
            for _ in range(3)
        ],
    }


@dataclass(frozen=True)
class ValidFiles:
    """Valid files, written once under a folder and read when first wanted."""

    folder: Path

    @cached_property
    def pems(self) -> dict[str, bytes]:
        """Error models of every stored kind, as the bytes of their files."""
        made = {
            "network": _network(1),
            "trees": _trees(2),
            "table": TabulatedPem(_card("table"), np.arange(5.0), np.linspace(-3.0, 3.0, 5)),
            "ensemble": EnsemblePem(_card("some"), (_network(3), _network(4))),
            "tree-ensemble": EnsemblePem(_card("trees"), (_trees(5), _trees(6), _trees(7))),
        }
        contents: dict[str, bytes] = {}
        for name, pem in made.items():
            path = self.folder / f"{name}.safetensors"
            save_pem(pem, path)
            load_pem(str(path))
            contents[name] = path.read_bytes()
        contents["authors"] = save(authors_tensors(), metadata={"source": "made up"})
        return contents

    @cached_property
    def noise(self) -> str:
        """Noise parameters of scenario_simulator_v2."""
        pem, errors = load_pem("lr"), load_position_errors("pointrcnn")
        obstacles = fixed_obstacles((20.0,), sensor_ahead_m=0.0)
        table = averages(pem, obstacles, edges_m=(20.0,), errors=errors)
        return noise_yaml(NoiseFile((configuration_of(table, subtype="CAR"),)))

    @cached_property
    def table(self) -> str:
        """A table of obstacles."""
        path = self.folder / "obstacles.csv"
        save_table(synthetic_table(obstacles=12, seed=3), path)
        return path.read_text()

    @cached_property
    def run(self) -> Path:
        """A finished run folder, with proposals of the paper's kind."""
        config = replace(CONFIGS[0], method="naive", final_rollouts=10, repetitions=2)
        folder = self.folder / "run"
        folder.mkdir()
        result = run(build_experiment(config), run_id="run", observers=[RunStore(folder)])
        adaptive = replace(config, method="adaptive")
        write_result(folder, replace(result, config=adaptive))
        (folder / "config.toml").write_text(config_text(adaptive))
        tensors = {
            f"repetition.{repetition}.stage.{stage}.{name}": array
            for repetition in range(2)
            for stage in range(2)
            for name, array in _gap_network(stage).arrays().items()
        }
        (folder / "proposals.safetensors").write_bytes(save(tensors))
        return folder

    @cached_property
    def begun(self) -> Path:
        """A run folder as a killed run leaves it: a file a stage."""
        config = replace(CONFIGS[0], method="naive", final_rollouts=10, repetitions=2)
        folder = self.folder / "begun"
        folder.mkdir()
        done = []
        first = SimpleNamespace(
            notify=lambda event: done.extend([0] * isinstance(event, StageDone))
        )
        run(
            build_experiment(config),
            run_id="begun",
            observers=[RunStore(folder), first],
            should_stop=lambda: bool(done),
        )
        return folder

    @cached_property
    def stages(self) -> Path:
        """A run folder as an older version left it: likelihoods in the stages' files."""
        folder = self.folder / "stages-run"
        shutil.copytree(self.run, folder)
        (folder / "rollouts.npz").unlink()
        parts = folder / "stages"
        parts.mkdir()
        with np.load(self.run / "rollouts.npz") as arrays:
            table = {name: arrays[name] for name in arrays.files}
        for repetition in range(2):
            chosen = table["repetition"] == repetition
            np.savez(
                parts / f"repetition-{repetition:05d}-stage-00000.npz",
                allow_pickle=False,
                **{name: array[chosen] for name, array in table.items()},
            )
        return folder

    @cached_property
    def recording(self) -> bytes:
        """A recording of a tiny run."""
        from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

        config = replace(CONFIGS[2], final_rollouts=6)
        experiment = build_experiment(config)
        pem = constant_pem(detection_probability=0.5)
        problem = replace(experiment.problem, pem=pem)
        path = self.folder / "run.rrd"
        recorder = Recorder(path, frames=False)
        run(replace(experiment, problem=problem), run_id="run", observers=[recorder])
        return path.read_bytes()


def _card(name: str) -> PemCard:
    table = synthetic_table(obstacles=50, seed=1)
    return PemCard(
        name=name,
        model="ml-nn",
        data="made up",
        licence="none",
        scores={"bce": 0.25},
        support=summarise_support(table).to_json(),
    )


def _network(seed: int) -> NetworkPem:
    rng = np.random.default_rng(seed)
    sizes = (len(PAPER_INPUTS), 4, 3, 1)
    layers = tuple(
        Layer(weight=rng.normal(size=(after, before)), bias=rng.normal(size=after))
        for before, after in pairwise(sizes)
    )
    return NetworkPem(_card("net"), np.array([0.0, 1.6, 25.0, 0.0]), np.ones(4), layers)


def _trees(seed: int) -> TreesPem:
    """Two trees of five nodes."""
    rng = np.random.default_rng(seed)
    feature = np.array([4, LEAF, 1, LEAF, LEAF] * 2, dtype=np.uint8)
    left = np.array([1, 0, 3, 0, 0, 6, 0, 8, 0, 0], dtype=np.int32)
    return TreesPem(
        _card("trees"),
        "paper",
        feature=feature,
        number=np.round(rng.normal(size=10) * 10.0, 0) / 8.0,
        left=left,
        root=np.array([0, 5], dtype=np.int32),
        calibration=np.array([0.9, 0.1]),
    )


def authors_tensors() -> dict[str, np.ndarray]:
    """Tensors by the authors' names, with numbers of our own."""
    rng = np.random.default_rng(11)
    tensors = {"input_mean": np.zeros(11), "input_std": np.ones(11)}
    for linear, norm, before in (("ff_nn.0", "ff_nn.1", 14), ("ff_nn.3", "ff_nn.4", 4)):
        tensors |= {
            f"{linear}.weight": rng.normal(size=(4, before)),
            f"{linear}.bias": rng.normal(size=4),
            f"{norm}.weight": rng.normal(size=4),
            f"{norm}.bias": rng.normal(size=4),
            f"{norm}.running_mean": rng.normal(size=4),
            f"{norm}.running_var": rng.random(4),
        }
    tensors |= {"ff_nn.6.weight": rng.normal(size=(1, 4)), "ff_nn.6.bias": rng.normal(size=1)}
    return {name: array.astype(np.float32) for name, array in tensors.items()}


def _gap_network(seed: int) -> GapNetwork:
    rng = np.random.default_rng(seed)
    shapes = ((32, 1), (32, 32), (2, 32))
    return GapNetwork(
        weights=tuple(rng.normal(size=shape) for shape in shapes),
        biases=tuple(rng.normal(size=shape[0]) for shape in shapes),
    )
