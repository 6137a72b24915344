"""Data files for tests: robosuite's recordings, changed copies of them, and a LeRobot data set made
with pyarrow and PyAV alone."""

import copy
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from palm_jax.train.data import commands
from palm_jax.train.data.calibration import Calibration

SAMPLES = Path(__file__).parent / "data"
LIFT, CAN = SAMPLES / "robosuite_lift.hdf5", SAMPLES / "robosuite_can.hdf5"
IMAGES = "obs/agentview_image"


def robosuite(path: Path = LIFT, **options: Any) -> Calibration:
    """The calibration that `data calibrate --from robosuite` makes."""
    config = commands.Calibrate("robosuite", Path("unused.json"), file=path, **options)
    return commands.make_calibration(config)


def changed(path: Path, folder: Path, change: Callable[[h5py.File], None]) -> Path:
    """A copy of a file, changed."""
    copy = folder / path.name
    shutil.copyfile(path, copy)
    with h5py.File(copy, "r+") as file:
        change(file)
    return copy


def replace(group: h5py.Group, key: str, values: np.ndarray, **options: Any) -> None:
    """Another array under the same key."""
    del group[key]
    group.create_dataset(key, data=values, **options)


def frames(path: Path, episode: str = "demo_0") -> np.ndarray:
    """All images of an episode, read by h5py."""
    with h5py.File(path) as file:
        return file[f"data/{episode}/{IMAGES}"][()]


def digest(path: Path) -> str:
    """Of a file, or of all files in a folder, with their times."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    content = hashlib.sha256()
    for file in files:
        if file.is_file():
            content.update(f"{file.name} {file.stat().st_mtime_ns}".encode() + file.read_bytes())
    return content.hexdigest()


ODD = (None, [], {}, "x", -1, 1e400, True, [[1]], {"a": 1})
"""What no entry of a file means, or few."""


def spoiled(content: Any) -> Iterator[tuple[str, Any]]:
    """JSON with each of its entries in turn left out or replaced by something odd, and where."""
    if not isinstance(content, (dict, list)):
        return
    for key in content if isinstance(content, dict) else range(len(content)):
        for odd in ODD:
            other = copy.copy(content)
            other[key] = odd
            yield f"{key} = {odd}", other
        if isinstance(content, dict):
            yield f"no {key}", {k: v for k, v in content.items() if k != key}
        for place, inner in spoiled(content[key]):
            other = copy.copy(content)
            other[key] = inner
            yield f"{key}.{place}", other


def lerobot(folder: Path, *, fps: int = 20, short_video: int = 0) -> Path:
    """A LeRobot v3 data set of the Lift recording: one table and one video for both episodes,
    poses as x, y, z and three angles about fixed axes.

    Args:
      folder: where it is made.
      fps: that it claims.
      short_video: frames that the video lacks at its end.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq
    from scipy.spatial.transform import Rotation

    root, key = folder / "set", "observation.images.front"
    video = root / "videos" / key / "chunk-000" / "file-000.mp4"
    columns: dict[str, list] = {}
    rows, images, begin = [], [], 0
    with h5py.File(LIFT) as file:
        for number, demo in enumerate(file["data"].values()):
            angles = Rotation.from_quat(demo["obs/robot0_eef_quat"][()]).as_euler("xyz")
            hand = np.concatenate([demo["obs/robot0_eef_pos"][()], angles], 1)
            grip = np.abs(demo["obs/robot0_gripper_qpos"][()]).mean(1, keepdims=True)
            length = len(hand)
            for name, values in {
                "observation.state": np.concatenate([hand, grip], 1).astype(np.float32).tolist(),
                "action": demo["actions"][()].astype(np.float32).tolist(),
                "timestamp": (np.arange(length) / fps).astype(np.float32).tolist(),
                "frame_index": list(range(length)),
                "episode_index": [number] * length,
                "index": list(range(begin, begin + length)),
                "task_index": [0] * length,
            }.items():
                columns.setdefault(name, []).extend(values)
            place = {"chunk_index": 0, "file_index": 0}
            rows.append(
                {"episode_index": number, "tasks": ["lift"], "length": length}
                | {f"data/{k}": v for k, v in place.items()}
                | {"dataset_from_index": begin, "dataset_to_index": begin + length}
                | {f"videos/{key}/{k}": v for k, v in place.items()}
                | {
                    f"videos/{key}/from_timestamp": begin / fps,
                    f"videos/{key}/to_timestamp": (begin + length) / fps,
                }
            )
            images += list(demo[IMAGES][()])
            begin += length
    for name, table in {
        "data/chunk-000/file-000.parquet": pa.table(columns),
        "meta/episodes/chunk-000/file-000.parquet": pa.Table.from_pylist(rows),
        "meta/tasks.parquet": pa.table({"task_index": [0], "task": ["lift"]}),
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, root / name)
    _write_video(video, images[: len(images) - short_video], fps)
    info = json.dumps(_info(key, fps, episodes=len(rows), frames=begin))
    (root / "meta" / "info.json").write_text(info)
    return root


def _write_video(path: Path, images: list[np.ndarray], fps: int) -> None:
    import av

    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "8", "g": "6"})
        stream.width = stream.height = 128
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def _info(key: str, fps: int, *, episodes: int, frames: int) -> dict[str, Any]:
    """The content of meta/info.json."""
    one = {"shape": [1], "names": None}
    features = {
        key: {"dtype": "video", "shape": [3, 128, 128], "names": ["channels", "height", "width"]},
        "observation.state": {"dtype": "float32", "shape": [7], "names": None},
        "action": {"dtype": "float32", "shape": [7], "names": None},
        "timestamp": {"dtype": "float32", **one},
    } | {
        name: {"dtype": "int64", **one}
        for name in ("frame_index", "episode_index", "index", "task_index")
    }
    return {
        "codebase_version": "v3.0",
        "robot_type": "panda",
        "fps": fps,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
        "splits": {"train": f"0:{episodes}"},
    }


def lerobot_calibration(**options: Any) -> Calibration:
    """For `lerobot`."""
    import dataclasses

    found = robosuite()
    camera = dataclasses.replace(found.cameras["agentview"], name="front", by_episode={})
    keys = {
        "pose": "observation.state[0:6]",
        "rotation": "euler_xyz",
        "opening": "observation.state[6]",
        "closed": 0.0,
        "open": 0.04,
    } | options
    return Calibration({"front": camera}, found.ee_to_tcp, commands.RobotKeys(**keys))
