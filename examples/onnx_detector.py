"""A car comes upon a standing one in fog; its detector, an ONNX file, looks at rendered images.

First with the detector itself in the loop, then with an error model of what it said: is that near?
It takes the extra ``onnx``; the file may be any detector's, here a tiny one is made.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import helper as make

import pemviz
from pemviz import BoolArray, FloatArray, LatentCounts, Signal, StateBatch, quantiles
from pemviz.pem import fit_pem, load_table


@dataclass(frozen=True)
class StandingCar:  # as any pemviz.Simulator, told at each step whether the car was detected
    name: str = "standing-car"
    states: int = 36
    dt_s: float = 0.1
    signals: tuple[Signal, ...] = (
        Signal(name="gap", key="gap_m", unit="m", low=-20.0, high=45.0),
        Signal(name="speed", key="speed_mps", unit="m/s", low=0.0, high=20.0),
        Signal(name="fog", key="fog_pm", unit="1/m", low=0.0, high=0.3),
    )
    latents = LatentCounts(start=2, noise=1)  # fog and the first spray; the next spray
    salient_names = ("gap", "fog")  # what an error model will know

    def initial(self, *, count: int, start: FloatArray) -> StateBatch:
        fog_pm = quantiles.log_normal(start[:, 0], median=0.03, spread=0.5)
        signals = {"gap": np.full(count, 40.0), "speed": np.full(count, 14.0), "fog": fog_pm}
        return StateBatch(np.array(0), signals, {"spray": start[:, 1]})

    def step(self, states: StateBatch, detected: BoolArray, noise: FloatArray) -> StateBatch:
        gap_m, speed_mps = states.signals["gap"], states.signals["speed"]
        brakes = detected & (gap_m < 6.0 + speed_mps**2 / 10.0)
        later_mps = np.maximum(speed_mps - np.where(brakes, 7.0, 0.0) * self.dt_s, 0.0)
        moved = {"gap": gap_m - speed_mps * self.dt_s, "speed": later_mps}
        return StateBatch(states.step + 1, {**states.signals, **moved}, {"spray": noise[:, 0]})

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return np.stack([signals["gap"], signals["fog"]], axis=-1)


def render(states: StateBatch) -> np.ndarray[Any, Any]:  # [N, 32, 32], uint8
    gap_m = np.maximum(states.signals["gap"], 1.0)[:, None, None]
    spray = quantiles.log_normal(states.memory["spray"], median=1.0, spread=0.3)
    seen = np.exp(-(states.signals["fog"] * spray)[:, None, None] * gap_m)  # Koschmieder's law
    aside_px = np.abs(np.arange(32) - 15.5)
    is_car = np.maximum(aside_px[:, None], aside_px) < np.minimum(60.0 / gap_m, 12.0)
    return np.rint(140.0 - 80.0 * seen * is_car).astype(np.uint8)


def write_network(path: Path) -> None:  # how much darker 3 x 3 pixels are than a ring around them
    weights = np.full((1, 1, 5, 5), 1.0 / 16.0, dtype=np.float32)
    weights[..., 1:4, 1:4] = -1.0 / 9.0
    nodes = [make.make_node("Conv", ["images", "w"], ["dark"], pads=[0, 0, 0, 0])]
    nodes += [make.make_node("GlobalMaxPool", ["dark"], ["score"])]
    shapes = {"images": ["n", 1, 32, 32], "score": ["n", 1, 1, 1]}
    ends = [make.make_tensor_value_info(name, 1, shape) for name, shape in shapes.items()]
    held = [onnx.numpy_helper.from_array(weights, "w")]
    graph = make.make_graph(nodes, "spot", ends[:1], ends[1:], held)
    onnx.save(make.make_model(graph, opset_imports=[make.make_opsetid("", 13)], ir_version=8), path)


@dataclass(frozen=True)
class Detector:  # worker processes are sent the path, and open the file themselves
    path: str

    @cached_property
    def session(self) -> Any:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # more wait for each other with images this small
        return onnxruntime.InferenceSession(self.path, options, providers=["CPUExecutionProvider"])

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path}

    def __call__(self, images: Any) -> FloatArray:  # a score an image
        return self.session.run(None, {"images": images[:, None].astype(np.float32)})[0].ravel()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        network, table = Path(folder) / "spot.onnx", Path(folder) / "frames.csv"
        write_network(network)
        spec = "always[0,35] (gap >= 0.0)"
        config = pemviz.ExperimentConfig(
            method="monte-carlo", spec=spec, final_rollouts=2000, seed=1
        )
        loop = pemviz.DetectorInTheLoop(
            StandingCar(), render=render, detect=Detector(str(network)), threshold=12.0
        )
        worst, kept = pemviz.LeastRobust(), pemviz.KeptStages()
        experiment = pemviz.build_experiment(config, simulator=loop)
        print(pemviz.summary_text(pemviz.run(experiment, observers=[worst, kept])), worst, sep="\n")

        driven = kept.stages[-1].scored.rollouts.take(slice(0, 250))
        loop.write_frames(table, driven, where=driven.signals["gap"][:, :-1] > 0.0)
        labelled = load_table(table, features=StandingCar.salient_names)
        model = fit_pem(labelled)  # what 'pemviz pem fit --features gap,fog' does
        experiment = pemviz.build_experiment(config, simulator=StandingCar(), pem=model)
        print(pemviz.summary_text(pemviz.run(experiment)))
