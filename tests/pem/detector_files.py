"""Small files of a detector in every format that is read, of cars that are missed in bursts."""

import numpy as np

FRAMES = 60
KITTI = (
    "Car 0.00 0 -1.57 {left:.2f} 150.00 {right:.2f} 200.00 1.50 1.70 4.10 {x:.2f} 1.65 {z:.2f} "
    "-1.57"
)


def observations(*, sequences=4, tracks=3, frames=FRAMES, seed=5):
    """Who is where and whether it is detected: ``(sequence, frame, track, x, z, detected)``."""
    random = np.random.default_rng(seed)
    for sequence in range(sequences):
        for track in range(tracks):
            z = random.uniform(8.0, 40.0)
            missed = False
            for frame in range(frames):
                z = float(np.clip(z + random.normal(0.0, 0.5), 5.0, 60.0))
                p = min(0.05 + z / 150.0, 0.5)
                missed = random.random() < (p + (float(missed) - p) * 0.6)
                yield sequence, frame, track, 4.0 * track - 4.0, z, not missed


def box(track):
    """Left and right of an obstacle, apart from the others'."""
    return 100.0 + 200.0 * track, 180.0 + 200.0 * track


def write_lines(folder, lines):
    """A file of lines by name in a folder; those without lines are empty."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in lines.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{row}\n" for row in rows))


def write_tracking(folder, *, places=False, **options):
    """KITTI tracking labels and boxes by frame, with 3D boxes if ``places``."""
    labels, found = {}, {}
    for sequence, frame, track, x, z, detected in observations(**options):
        name = f"{sequence:04d}.txt"
        left, right = box(track)
        label = KITTI.format(left=left, right=right, x=x, z=z).replace("0.00 0", "0 0", 1)
        labels.setdefault(name, []).append(f"{frame} {track} {label}")
        boxes = found.setdefault(name, [])
        sides = f"{left + 2:.1f},150.0,{right:.1f},200.0"
        if detected and places:
            off = np.sin(frame) * z / 100.0
            size = f"1.5,1.7,4.1,{x:.2f},1.65,{z + off:.3f},-1.57,-1.57"
            boxes.append(f"{frame},2,{sides},0.9,{size}")
        elif detected:
            boxes.append(f"{frame},{sides},0.9")
    write_lines(folder / "labels", labels)
    write_lines(folder / "found", found)
    return folder / "labels", folder / "found"


def write_mot_challenge(folder, **options):
    """MOTChallenge's folders: truth and detections of each sequence together."""
    lines = {}
    for sequence, frame, track, _, _, detected in observations(**options):
        left, right = box(track)
        where = f"{left:.0f},150,{right - left:.0f},50"
        truth = lines.setdefault(f"S-{sequence:02d}/gt/gt.txt", [])
        truth.append(f"{frame + 1},{track + 1},{where},1,1,1")
        found = lines.setdefault(f"S-{sequence:02d}/det/det.txt", [])
        if detected:
            found.append(f"{frame + 1},-1,{where},0.9")
    write_lines(folder, lines)
    return folder, folder


def write_kitti(folder, *, frames=20):
    """KITTI labels and results, a file a frame."""
    labels, found = {}, {}
    for _, frame, track, x, z, detected in observations(sequences=1, frames=frames):
        left, right = box(track)
        label = KITTI.format(left=left, right=right, x=x, z=z)
        labels.setdefault(f"{frame:06d}.txt", []).append(label)
        boxes = found.setdefault(f"{frame:06d}.txt", [])
        if detected:
            boxes.append(f"{label} 0.9")
    write_lines(folder / "label_2", labels)
    write_lines(folder / "results", found)
    return folder / "label_2", folder / "results"
