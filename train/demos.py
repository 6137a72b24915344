"""Demonstrations: a robomimic-style HDF5 file of states, and the images rendered from it on demand.

Layout: `data/demo_i/{states, actions, obs/{tcp, opening, qpos, qvel, stage}, env_params/*}`.
`states` rows are time, qpos, qvel as in robomimic; a demo's attributes hold `num_samples`,
`model_file` (MJCF), `camera_info` (JSON: intrinsics and camera-to-world extrinsics of the 512-pixel
front image, OpenCV axes), its seed and the mocap poses. `data` has `total`, `env_args` (JSON) and
the provenance. No pixels: they depend on the method.

Where `stage` changes from one row to the next the global policy has moved the hand in between.
Actions are what was commanded, so that jump is in none of them.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec, Camera
from palm_jax.envs.base import PAPER_FRAME, Env, EnvParams, State
from palm_jax.envs.expert import Demonstrator, Recording
from palm_jax.envs.rollout import Runner, repeat_params, take_params
from palm_jax.train.files import hdf5 as hdf5_files
from palm_jax.train.files.metrics import write_atomic

FORMAT = "palm_jax-demos"
VERSION = 2
"""2: frames have a stage, mocap poses begin with the distractors', and `env_params` has all that
can shift now."""


_DIGEST = "sha256"


class DemoFileError(ValueError):
    """A demonstration file that cannot be used; the message says which and why."""


@dataclasses.dataclass(frozen=True)
class Demos:
    """Demonstrations as flat arrays over N frames of E episodes."""

    qpos: np.ndarray  # [N, nq]
    tcp: np.ndarray  # [N, 4, 4]
    opening: np.ndarray  # [N]
    actions: np.ndarray  # [N, 10]
    episode: np.ndarray  # [N] index of the frame's episode
    stages: np.ndarray  # [N] stage of the task; between two of them the hand is repositioned
    mocap_pos: np.ndarray  # [E, nmocap, 3]
    mocap_quat: np.ndarray  # [E, nmocap, 4]
    camera_to_world: np.ndarray  # [E, 4, 4]
    params: EnvParams  # leading axis [E]
    attempts: int  # episodes that the expert needed
    digest: str  # SHA-256 of everything in the file

    @property
    def episodes(self) -> int:
        return len(self.camera_to_world)


def collect(
    runner: Runner,
    path: Path,
    *,
    count: int,
    seed: int,
    noise: float,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Records `count` successful demonstrations of the perturbed expert into `path`.

    Args:
      runner: compiled environment.
      path: the file; written at the end, whole or not at all.
      count: successful demonstrations to keep.
      seed: every scene and disturbance follows from it.
      noise: standard deviation of the disturbance, metres.
      progress: told how many were kept after each batch.

    Raises:
      FileExistsError: `path` exists; nothing is ever overwritten.
      OSError: it cannot be written, e.g. on a full disk.
      RuntimeError: the expert fails so often that `count` is out of reach.
    """
    if path.exists():
        raise FileExistsError(
            f"{path} exists and is not overwritten: move it, or choose another name"
        )
    demonstrator = Demonstrator(runner)
    params = repeat_params(runner.env.default_params(), runner.worlds)
    root = jax.random.fold_in(jax.random.key(seed), 0xDE305)
    kept = attempts = 0
    # In memory, a few dozen kB a demonstration: on a full disk HDF5 cannot even close a file.
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        data = file.create_group("data")
        for batch in range(4 * (count // runner.worlds + 1)):
            key, scenes = jax.random.split(jax.random.fold_in(root, batch))
            keys = jax.random.split(scenes, runner.worlds)
            recording = demonstrator(key, keys, params, noise=noise)
            for world in np.flatnonzero(recording.success)[: count - kept]:
                attempts_now = attempts + int(world) + 1
                _write_demo(data, kept, runner.env, recording, int(world), params, (seed, batch))
                kept += 1
            attempts = attempts_now if kept == count else attempts + runner.worlds
            if progress:
                progress(kept)
            if kept == count:
                break
        else:
            raise RuntimeError(f"the expert solved only {kept} of {attempts} scenes")
        _write_header(data, runner.env, seed=seed, noise=noise, attempts=attempts)
        data.attrs[_DIGEST] = _digest(data)
        file.flush()
        content = file.id.get_file_image()
    return write_atomic(path, content)


def _digest(data: h5py.Group) -> str:
    """SHA-256 of every array and attribute: HDF5 does not notice a flipped bit."""
    digest = hashlib.sha256()

    def add(name: str, value: Any) -> None:
        array = np.asarray(value)
        content = repr(array.tolist()).encode() if array.dtype.kind in "OU" else array.tobytes()
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + content)

    def visit(name: str, item: Any) -> None:
        for key in sorted(item.attrs):
            if key != _DIGEST:
                add(f"{name}@{key}", item.attrs[key])
        if isinstance(item, h5py.Dataset):
            add(name, item[()])

    visit("", data)
    data.visititems(visit)
    return digest.hexdigest()


def _write_demo(
    data: h5py.Group,
    index: int,
    env: Env,
    recording: Recording,
    world: int,
    params: EnvParams,
    seed: tuple[int, int],
) -> None:
    length = int(recording.length[world])
    frames = jax.tree.map(lambda x: x[:length, world], recording.frames)
    start = jax.tree.map(lambda x: np.asarray(x[world]), recording.start)
    demo = data.create_group(f"demo_{index}")
    time = np.arange(length, dtype=np.float32)[:, None] / 20.0
    demo["states"] = np.concatenate([time, frames.qpos, frames.qvel], -1).astype(np.float32)
    demo["actions"] = frames.action.astype(np.float32)
    demo["dones"] = frames.success.astype(np.uint8)
    demo["rewards"] = frames.success.astype(np.float32)
    for name in ("tcp", "opening", "qpos", "qvel"):
        demo[f"obs/{name}"] = getattr(frames, name).astype(np.float32)
    demo["obs/stage"] = frames.stage.astype(np.int32)
    for field in dataclasses.fields(EnvParams):
        demo[f"env_params/{field.name}"] = np.asarray(getattr(params, field.name)[world])
    focal = PAPER_FRAME / 2 / np.tan(np.radians(float(params.camera_fovy[world])) / 2)
    half = PAPER_FRAME / 2
    demo.attrs.update(
        {
            "num_samples": length,
            "model_file": env.xml,
            "camera_info": json.dumps(
                {
                    "front": {
                        "intrinsics": [[focal, 0.0, half], [0.0, focal, half], [0.0, 0.0, 1.0]],
                        "extrinsics": start.camera_to_world.tolist(),
                    }
                }
            ),
            "seed": list(seed) + [world],
            "camera_to_world": start.camera_to_world,
            "mocap_pos": start.data.mocap_pos.reshape(-1, 3),
            "mocap_quat": start.data.mocap_quat.reshape(-1, 4),
        }
    )


def _write_header(data: h5py.Group, env: Env, *, seed: int, noise: float, attempts: int) -> None:
    data.attrs.update(
        {
            "total": sum(int(demo.attrs["num_samples"]) for demo in data.values()),
            "env_args": json.dumps(
                {
                    "env_name": env.task.name,
                    "env_type": "palm_jax",
                    "env_kwargs": {"task": env.task.name, "robot": env.robot.name},
                }
            ),
            "format": FORMAT,
            "version": VERSION,
            "task": env.task.name,
            "robot": env.robot.name,
            "seed": seed,
            "noise": noise,
            "attempts": attempts,
            "label": "commanded body-frame delta relative to the measured TCP pose",
        }
    )


def load(path: Path, *, task: str, robot: str, count: int | None = None) -> Demos:
    """Reads demonstrations and checks that they are what is asked for.

    Args:
      path: file written by `collect`.
      task, robot: what the file must be of.
      count: number of demonstrations to use; all by default.

    Raises:
      DemoFileError: truncated, of another task, robot or version, or with too few demonstrations.
    """
    with _opened(path) as data:
        return _read(data, path, task, robot, count)


def collected_with(path: Path) -> dict[str, Any]:
    """`seed` and `noise` (metres) that a file was collected with; None where it does not say.

    Raises:
      DemoFileError: it is no file of demonstrations.
    """
    with _opened(path) as data:
        return {name: np.asarray(data.attrs.get(name)).item() for name in ("seed", "noise")}


@contextmanager
def _opened(path: Path) -> Iterator[h5py.Group]:
    """The demonstrations in a file; whatever is wrong with it becomes a DemoFileError."""
    try:
        with h5py.File(path, "r") as file:
            if wrong := hdf5_files.way_out(file):
                raise DemoFileError(f"{path}: {wrong}")
            yield file["data"]
    except DemoFileError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise DemoFileError(
            f"{path} is not a whole demonstration file ({error}); move it away and collect again"
        ) from error


def _read(data: h5py.Group, path: Path, task: str, robot: str, count: int | None) -> Demos:
    expected = {"format": FORMAT, "version": VERSION, "task": task, "robot": robot}
    for name, value in expected.items():
        found = data.attrs.get(name)
        found = found.item() if isinstance(found, np.generic) else found  # readable in a message
        if found != value:
            advice = "; move it away and collect again" if name == "version" else ""
            raise DemoFileError(f"{path}: expected {name} {value!r}, found {found!r}{advice}")
    digest = _digest(data)
    if data.attrs.get(_DIGEST, digest) != digest:
        raise DemoFileError(
            f"{path}: the content differs from what was written; move it away and collect again"
        )
    demos = [data[f"demo_{i}"] for i in range(len(data))]
    if count is not None:
        if len(demos) < count:
            raise DemoFileError(f"{path}: expected {count} demonstrations, found {len(demos)}")
        demos = demos[:count]
    lengths = [len(demo["actions"]) for demo in demos]
    params = {
        f.name: np.stack([demo[f"env_params/{f.name}"][()] for demo in demos])
        for f in dataclasses.fields(EnvParams)
    }
    arrays = {
        "qpos": np.concatenate([demo["obs/qpos"][()] for demo in demos]),
        "tcp": np.concatenate([demo["obs/tcp"][()] for demo in demos]),
        "opening": np.concatenate([demo["obs/opening"][()] for demo in demos]),
        "actions": np.concatenate([demo["actions"][()] for demo in demos]),
        "stages": np.concatenate([demo["obs/stage"][()] for demo in demos]),
    }
    for name, array in arrays.items():
        if len(array) != sum(lengths) or not np.isfinite(array).all():
            raise DemoFileError(f"{path}: {name} is incomplete or not finite; collect again")
    return Demos(
        **arrays,
        episode=np.repeat(np.arange(len(demos)), lengths),
        mocap_pos=np.stack([demo.attrs["mocap_pos"] for demo in demos]),
        mocap_quat=np.stack([demo.attrs["mocap_quat"] for demo in demos]),
        camera_to_world=np.stack([demo.attrs["camera_to_world"] for demo in demos]),
        params=EnvParams(**{name: jnp.asarray(value) for name, value in params.items()}),
        attempts=int(data.attrs["attempts"]),
        digest=digest,
    )


def states(runner: Runner, demos: Demos) -> Iterator[tuple[State, EnvParams]]:
    """Every frame of the demonstrations as states to look at, `runner.worlds` at a time; the last
    batch is filled up with the last frame."""
    total, worlds = len(demos.qpos), runner.worlds
    for first in range(0, total, worlds):
        rows = np.minimum(np.arange(first, first + worlds), total - 1)
        episode = demos.episode[rows]
        params = take_params(demos.params, episode)
        state = runner.restore(
            jnp.asarray(demos.qpos[rows]),
            jnp.asarray(demos.mocap_pos[episode], jnp.float32),
            jnp.asarray(demos.mocap_quat[episode], jnp.float32),
            jnp.asarray(demos.camera_to_world[episode], jnp.float32),
            params,
        )
        yield state, params


def render_observations(
    runner: Runner, demos: Demos, spec: AlignSpec, *, frame: int
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """What a policy would have seen in every frame of the demonstrations.

    Args:
      runner: compiled environment; its number of worlds is the batch size here.
      demos: states to render.
      spec, frame: see `Env.observe`.

    Returns:
      images [N, size, size, 3] uint8, proprioception [N, P] float32, and the cameras of the images
      (leaves [N, ...]).
    """
    total = len(demos.qpos)
    images, proprio, cameras = [], [], []
    for state, params in states(runner, demos):
        seen = runner.observe(state, params, spec, frame=frame)
        images.append(np.asarray(seen.image))
        proprio.append(np.asarray(seen.proprio))
        cameras.append(runner.window_camera(state, params, spec, frame=frame))
    camera = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:total], *cameras)
    return np.concatenate(images)[:total], np.concatenate(proprio)[:total], camera


def summary(demos: Demos) -> dict[str, Any]:
    """Numbers worth printing."""
    lengths = np.bincount(demos.episode)
    return {
        "demonstrations": demos.episodes,
        "frames": len(demos.qpos),
        "steps per demonstration": f"{lengths.mean():.0f} ({lengths.min()}-{lengths.max()})",
        "expert success": f"{demos.episodes}/{demos.attempts}",
    }
