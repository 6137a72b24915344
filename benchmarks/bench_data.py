"""`data align`: frames of 512 pixels a second, end to end, from files of several layouts.

From opening the file to the new one under its name: poses read and checked, the source hashed,
frames read and decompressed, aligned, compressed (gzip, level 1), checksummed and flushed to the
disk. The look for flipped images is left out: it takes the same seconds whatever the size of the
file. The files are in the system's cache when they are read.

`layouts`: for HDF5 the images as they are (raw), or a frame a chunk compressed by gzip or lzf, or
gzip with h5py's own chunks, which cut frames into pieces; raw with lens coefficients, so that
frames are undistorted first; an mp4 (H.264) of a LeRobot set, where PyAV and pyarrow are installed.
`peak_mb` is the memory of the process.
"""

import importlib.util
import json
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palm_jax.train import data
from palm_jax.train.data import output
from palm_jax.train.data.lerobot_writer import LeRobotWriter
from palm_jax.train.data.source import Source

EPISODES, LENGTH, FRAME, DISTINCT = 4, 256, 512, 32
LAYOUTS: dict[str, dict[str, Any]] = {
    "raw": {},
    "gzip": {"compression": "gzip", "chunks": (1, FRAME, FRAME, 3)},
    "pieces": {"compression": "gzip"},  # h5py's own chunks, as robomimic's --compress has them
    "lzf": {"compression": "lzf", "chunks": (1, FRAME, FRAME, 3)},
}
FOVY = 45.0


def run(*, repeats: int = 3) -> dict[str, Any]:
    """`file_frames_per_second` of uncompressed HDF5: the median."""
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        for layout in (*LAYOUTS, "lens", "mp4"):
            if layout == "mp4" and not all(map(importlib.util.find_spec, ("av", "pyarrow"))):
                continue
            rows[layout] = _measured(Path(folder) / layout, layout, repeats)
    return {
        "file_frames_per_second": rows["raw"]["per_second_median"],
        "layouts": rows,
        "frame": FRAME,
        "frames": EPISODES * LENGTH,
        "isal": importlib.util.find_spec("isal") is not None,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def _measured(folder: Path, layout: str, repeats: int) -> dict[str, Any]:
    folder.mkdir()
    path = folder / "recording.hdf5"
    record(path, layout if layout in LAYOUTS else "raw")
    dist = (-0.1, 0.02, 0.001, 0.001) if layout == "lens" else None
    if layout == "mp4":
        path = _as_video(path, folder / "set")
    seconds, cpu = [], []
    for _ in range(1 + repeats):
        start, before = time.perf_counter(), time.process_time()
        with data.open_recording(path, calibration(dist), camera="front") as recording:
            spec = data.paper_spec(FRAME)
            options = data.Options(format="robomimic")
            data.align_file(recording, spec, folder / "new.hdf5", options, trust=True)
        seconds.append(time.perf_counter() - start)
        cpu.append(time.process_time() - before)
        (folder / "new.hdf5").unlink()
    frames = EPISODES * LENGTH
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {
        "per_second": frames / min(seconds[1:]),
        "per_second_median": frames / float(np.median(seconds[1:])),
        "cpu_ms_each": 1e3 * float(np.mean(cpu[1:])) / frames,
        "kb_a_frame": size / frames / 1e3,
        "first_call_seconds": seconds[0],
    }


def calibration(dist: tuple[float, ...] | None = None) -> data.Calibration:
    """A camera one metre and a half above the workspace, looking down."""
    focal = FRAME / 2 / np.tan(np.radians(FOVY) / 2)
    K = np.array([[focal, 0, FRAME / 2], [0, focal, FRAME / 2], [0, 0, 1]])
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 1.5
    camera = data.CameraCalibration("front", K, FRAME, FRAME, pose, dist)
    return data.Calibration({"front": camera})


def pictures() -> np.ndarray:
    """[N, FRAME, FRAME, 3] smooth shapes under noise of a few grey levels, such as cameras have."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(40, 216, (DISTINCT, FRAME // 16, FRAME // 16, 3), dtype=np.uint8)
    smooth = coarse.repeat(16, 1).repeat(16, 2)
    return smooth + rng.integers(0, 4, smooth.shape, dtype=np.uint8)


def paths() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Poses [LENGTH, 4, 4] and openings [LENGTH] of each episode."""
    rng = np.random.default_rng(1)
    for _ in range(EPISODES):
        turn = np.linspace(0, 2 * np.pi, LENGTH)
        pose = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (LENGTH, 1, 1))
        centre = rng.uniform(-0.1, 0.1, 2)
        pose[:, 0, 3] = centre[0] + 0.15 * np.cos(turn)
        pose[:, 1, 3] = centre[1] + 0.15 * np.sin(turn)
        pose[:, 2, 3] = 0.2
        yield pose, (turn < np.pi).astype(float)


def record(path: Path, layout: str) -> None:
    """A robomimic file."""
    images = pictures()
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        group.attrs["env_args"] = json.dumps({"env_name": "bench"})
        for index, (pose, opening) in enumerate(paths()):
            demo = group.create_group(f"demo_{index}")
            demo.attrs["num_samples"] = LENGTH
            demo["actions"] = np.zeros((LENGTH, 7))
            demo["obs/tcp"], demo["obs/opening"] = pose, opening
            frames = images[np.arange(LENGTH) % DISTINCT]
            demo.create_dataset("obs/front_image", data=frames, **LAYOUTS[layout])


def _as_video(path: Path, folder: Path) -> Path:
    """The same recording as a LeRobot set with one mp4 an episode."""
    with data.open_source(path) as source:
        with output.begun(folder, {}) as partial:
            with LeRobotWriter(
                partial, source, keep="numbers", encoding="h264", prefix="front", instead=False
            ) as writer:
                for name in source.episodes:
                    writer.begin(name, LENGTH, {})
                    for block in _blocks(source, name):
                        writer.add(block, {})
                    writer.end()
                content = writer.complete()
            partial.publish(content)
    path.unlink()
    return folder


def _blocks(source: Source, name: str) -> Iterator[np.ndarray]:
    yield from source.blocks(name, "obs/front_image", DISTINCT)
