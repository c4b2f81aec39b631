"""Small tables as nuScenes has them, and a file of detections."""

import json

from scipy.spatial.transform import Rotation

EGO_M = (100.0, 200.0, 0.0)
LIDAR_M = (0.94, 0.0, 1.84)
CATEGORIES = ("vehicle.car", "vehicle.bicycle", "vehicle.bus.rigid", "human.pedestrian.adult")
LEVELS = ("v0-40", "v40-60", "v60-80", "v80-100")


def quaternion(rotation):
    x, y, z, w = rotation.as_quat().tolist()
    return [w, x, y, z]


def yaw(degrees):
    return Rotation.from_euler("z", degrees, degrees=True)


NORTH = yaw(90)


def annotation(place, *, who="a", sample="s0", turned=NORTH, visible="4", points=5, **own):
    """A labelled box; a and b are cars, c a bicycle, d a bus, e a person."""
    return {
        "token": f"{who}-{sample}",
        "sample_token": sample,
        "instance_token": who,
        "attribute_tokens": [],
        "visibility_token": visible,
        "translation": list(place),
        "size": [1.8, 4.5, 1.5],
        "rotation": quaternion(turned),
        "num_lidar_pts": points,
        "num_radar_pts": 0,
        **own,
    }


def detection(place, *, name="car", score=0.5, **own):
    """A reported box of the same size."""
    return {
        "sample_token": "s0",
        "translation": list(place),
        "size": [1.8, 4.5, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0],
        "detection_name": name,
        "detection_score": score,
        "attribute_name": "",
        **own,
    }


def write_nuscenes(folder, annotations, results, *, ego=NORTH):
    """One scene of three samples, half a second apart; the ego heads along the global y axis."""
    tables, samples = folder / "v1.0-mini", ("s0", "s1", "s2")
    tables.mkdir()
    kinds = {"a": 0, "b": 0, "c": 1, "d": 2, "e": 3}
    content = {
        "scene": [{"token": "scene", "name": "scene-0061"}],
        "sample": [
            {"token": token, "timestamp": 1_532_402_927_000_000 + 500_000 * index,
             "scene_token": "scene"}
            for index, token in reversed(list(enumerate(samples)))
        ],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP"},
                   {"token": "camera", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {"token": "on-car", "sensor_token": "lidar", "translation": list(LIDAR_M)},
            {"token": "front", "sensor_token": "camera", "translation": [1.7, 0.0, 1.5]},
        ],
        "sample_data": [
            {"token": f"{kind}-{token}-{is_key}", "sample_token": token,
             "ego_pose_token": f"pose-{token}" if is_key and kind == "lidar" else "elsewhere",
             "calibrated_sensor_token": place, "is_key_frame": is_key}
            for token in samples
            for kind, place in (("lidar", "on-car"), ("camera", "front"))
            for is_key in (True, False)
        ],
        "ego_pose": [
            {"token": "elsewhere", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]},
            *({"token": f"pose-{token}", "translation": list(EGO_M), "rotation": quaternion(ego)}
              for token in samples),
        ],
        "category": [{"token": f"kind-{name}", "name": name} for name in CATEGORIES],
        "attribute": [{"token": "ridden", "name": "cycle.with_rider"}],
        "visibility": [{"token": str(n), "level": level} for n, level in enumerate(LEVELS, 1)],
        "instance": [{"token": who, "category_token": f"kind-{CATEGORIES[kind]}"}
                     for who, kind in kinds.items()],
        "sample_annotation": annotations,
    }  # fmt: skip
    for name, rows in content.items():
        (tables / f"{name}.json").write_text(json.dumps(rows, indent=0))
    submitted = {"meta": {"use_lidar": True}, "results": results}
    (folder / "results.json").write_text(json.dumps(submitted))
    return {"labels": tables, "detections": folder / "results.json", "out": folder / "own.csv"}
