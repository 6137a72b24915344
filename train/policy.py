"""A trained policy on a robot of its user's: camera image and TCP pose in, target pose out.

    policy = load("runs/demo/palm", image_size=(480, 640))
    policy.reset()
    target, gripper = policy.act(image, K, cam_to_world, tcp, opening)

What the network is shown is made by `palm_jax.align`, as in training, and has the field of view of
the training's camera, whatever the user's camera is: see `Contract`. Inputs that contradict what
the policy was trained with are refused by name, and an action that is not finite is never returned.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import sys
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from palm_jax import _checks
from palm_jax.align import (
    Aligned,
    AlignSpec,
    Camera,
    DtypeError,
    OptionError,
    ProjectionError,
    ShapeError,
    align_like,
    apply_delta,
    undistort,
)
from palm_jax.align.camera import check_tcp_in_view
from palm_jax.align.lens import LENGTHS
from palm_jax.align.proprio import LAYOUTS
from palm_jax.envs.base import (
    CAMERA_FOVY,
    CONTROL_RATE,
    PAPER_FRAME,
    WIDE_FRAME,
    front_camera,
)
from palm_jax.envs.registry import TASKS
from palm_jax.envs.tasks import WORKSPACE_CENTRE
from palm_jax.train import checkpoint, methods, workspace
from palm_jax.train.config import Config, Recorded
from palm_jax.train.evaluate import VIEW
from palm_jax.train.files import records
from palm_jax.train.learner import (
    Learner,
    PolicyState,
    compiler_options,
    make_learner,
    to_action,
)
from palm_jax.train.reporting import runs

IMAGE_SIZE = (480, 640)
"""Rows and columns of the images for which a policy is compiled unless told otherwise."""

_OPENING_SLACK = 0.05  # a gripper's sensor may be off by this much beyond 0 and 1
_LEAST_MARGIN = 0.05  # metres beyond the training's heights, where these hardly vary
_MAX_SIZES = 8  # image sizes that are compiled for; a camera has one
_KEPT = 1000  # latencies

_log = logging.getLogger(__name__)


class PolicyError(ValueError):
    """A policy that cannot be loaded, or cannot act on what it was given."""


class CalibrationError(PolicyError):
    """The camera's intrinsics or its pose are missing."""


class OutsideTrainingError(PolicyError):
    """An input so far from all training data that no answer would mean anything."""


class NonFiniteActionError(PolicyError):
    """The network's answer is not finite."""


# ---------------------------------------------------------------------------------------- contract


@dataclasses.dataclass(frozen=True)
class Contract:
    """What a policy was trained with, as far as its user's inputs have to agree with it.

    The policy sees the field of view that it was trained with. `spec.crop` counts pixels of a frame
    with the intrinsics `K`; of a camera with the focal length f it is crop * f / K[0][0] pixels
    (with another resolution, other pixels of the same view). Equal angles are equal sizes at equal
    distances: for a camera that stands much nearer or farther than `distance`, see `load`'s `zoom`.

    Attributes:
      method, task, robot: of the run; of recordings no robot is known ("").
      step: of the checkpoint.
      spec: what the policy sees.
      K: 3 x 3 intrinsics of the frame that the spec's pixels are counted in.
      frame: rows and columns of that frame.
      rendered: trained on rendered windows (`align_window`), not on camera images (`align`).
      distance: metres from the training's camera to the middle of the workspace; of recordings, to
        the TCP on average.
      heights: lowest and highest z of the TCP in training, metres, world; None if not an input.
      rate: actions a second.
    """

    method: str
    task: str
    robot: str
    step: int
    spec: AlignSpec
    K: tuple[tuple[float, float, float], ...]
    frame: tuple[int, int]
    rendered: bool
    distance: float
    heights: tuple[float, float] | None
    rate: float

    def reference(self, zoom: float = 1.0) -> Camera:
        """The training's camera, its pose left open; with `zoom` times the focal length."""
        intrinsics = np.asarray(self.K, np.float32)
        intrinsics[:2, :2] *= zoom
        return Camera(intrinsics, np.eye(4), *self.frame)


def contract_of(config: Config, step: int) -> Contract:
    """The contract of a run in the simulator, but for its heights, which its data say.

    Windows of the wide frame never reach its border in training: neither are they moved to stay
    inside of it here.
    """
    method = methods.find(config.method[0])
    spec = method.spec(TASKS[config.task], config.image_size)
    if method.frame == WIDE_FRAME:
        spec = dataclasses.replace(spec, border="edge")
    focal = PAPER_FRAME / 2 / math.tan(math.radians(CAMERA_FOVY / 2))
    middle = method.frame / 2
    apart = np.asarray(front_camera())[:3, 3] - np.asarray(WORKSPACE_CENTRE)
    return Contract(
        method=method.name,
        task=config.task,
        robot=config.robot,
        step=step,
        spec=spec,
        K=((focal, 0.0, middle), (0.0, focal, middle), (0.0, 0.0, 1.0)),
        frame=(method.frame, method.frame),
        rendered=True,
        distance=float(np.linalg.norm(apart)),
        heights=None,
        rate=CONTROL_RATE,
    )


def contract_of_recorded(values: Mapping[str, Any], step: int) -> Contract:
    """The contract of a run on recordings, but for its heights.

    Args:
      values: of the run's config.json, see `train.recorded`.
      step: of the checkpoint.
    """
    spec: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in values["spec"].items()
    }
    height, width = values["frame"]
    return Contract(
        method=values["method"],
        task=values["task"],
        robot="",
        step=step,
        spec=AlignSpec(**spec),
        K=tuple((float(row[0]), float(row[1]), float(row[2])) for row in values["K"]),
        frame=(int(height), int(width)),
        rendered=False,
        distance=float(values["distance"]),
        heights=None,
        rate=float(values["rate"]),
    )


def _heights(spec: AlignSpec, state: PolicyState) -> tuple[float, float]:
    """The range of the TCP's height in training: in every layout the number before the last."""
    ranges, place = state.normalizer.proprio, LAYOUTS[spec.layout] - 2
    return float(ranges.low[place]), float(ranges.high[place])


# ---------------------------------------------------------------------------------------- answers


class Decision(NamedTuple):
    """What a policy answers to one observation."""

    target: NDArray[np.float32]  # [4, 4] the TCP's next pose, in the frame of the pose given
    gripper: float  # 1 open, 0 close
    action: NDArray[np.float32]  # [10] the same as body-frame delta (6D rotation, xyz) and gripper
    coverage: float  # share of the policy's view that lies inside the camera's image


@dataclasses.dataclass(frozen=True)
class Latency:
    """How long the latest calls of `Policy.act` took, checks and transfers included."""

    count: int
    median_ms: float
    p95_ms: float
    worst_ms: float

    def __str__(self) -> str:
        if not self.count:
            return "no calls yet"
        return (
            f"median {self.median_ms:.1f} ms, 95 % within {self.p95_ms:.1f} ms, "
            f"worst {self.worst_ms:.1f} ms ({self.count} calls)"
        )


class _Observation(NamedTuple):
    """Checked inputs of one call; the camera is that of `image`."""

    image: NDArray[np.uint8]  # [H, W, 3]
    K: NDArray[np.float32]  # [3, 3]
    cam_to_world: NDArray[np.float32]  # [4, 4]
    tcp: NDArray[np.float32]  # [4, 4]
    opening: NDArray[np.float32]  # []
    mask: NDArray[np.bool_] | None  # [H, W]

    @property
    def camera(self) -> Camera:
        return Camera(self.K, self.cam_to_world, *self.image.shape[:2])


# ---------------------------------------------------------------------------------------- policy


class Policy:
    """A trained policy; made by `load`.

    Attributes:
      contract: what it was trained with.
      state: its parameters and normalisation.
      zoom: see `load`.
    """

    def __init__(
        self,
        learner: Learner,
        state: PolicyState,
        contract: Contract,
        *,
        zoom: float = 1.0,
        off_centre: float = _checks.OFF_CENTRE,
        noise_seed: int | None = None,
        dist: tuple[float, ...] | None = None,
    ) -> None:
        """See `load`, which checks what is given here."""
        self._dist = dist
        self.contract, self.zoom = contract, zoom
        self._learner, self.state, self._off_centre = learner, state, off_centre
        self._noise = None if noise_seed is None else jax.random.key(noise_seed)
        self._step = 0
        self._sizes: set[tuple[int, int]] = set()
        self._seconds: deque[float] = deque(maxlen=_KEPT)
        self._decide = jax.jit(self.decide_arrays, compiler_options=compiler_options())
        self._see = jax.jit(self._inputs)

    @property
    def latency(self) -> Latency:
        """Of the latest thousand calls, without those that had to compile."""
        if not self._seconds:
            return Latency(0, math.nan, math.nan, math.nan)
        times = 1e3 * np.asarray(self._seconds)
        return Latency(len(times), *(float(np.percentile(times, p)) for p in (50, 95, 100)))

    def reset(self) -> None:
        """Begin an episode: the noise on the inputs, if asked for, starts anew.

        The policy itself remembers nothing from one action to the next.
        """
        self._step = 0

    def act(
        self,
        image: ArrayLike,
        K: ArrayLike,
        cam_to_world: ArrayLike,
        tcp: ArrayLike,
        opening: ArrayLike,
        *,
        mask: ArrayLike | None = None,
    ) -> tuple[NDArray[np.float32], float]:
        """The next target of the TCP, to be reached within 1 / `contract.rate` seconds.

        Args:
          image: uint8 [H, W, 3], RGB, the camera's whole image, upright; lens distortion removed
            unless `load` was told of it. The first of another size than `load` knows takes seconds.
          K: [3, 3] intrinsics in pixels of this image.
          cam_to_world: [4, 4] pose of the camera, OpenCV axes (x right, y down, z forward).
          tcp: [4, 4] pose of the TCP (z the direction of approach, y the opening axis), in the same
            frame as the camera's. Heights are to be those of the training: `contract.heights`.
          opening: of the gripper, 0 closed to 1 open.
          mask: bool [H, W] of the gripper and the task's objects; only for policies that were
            trained with isolation (`contract.spec.isolate`).

        Returns:
          target: [4, 4] pose of the TCP in the frame of `tcp`.
          gripper: 1 open, 0 close.

        Raises:
          ShapeError, DtypeError: arrays of other shapes or types.
          CalibrationError: K or cam_to_world is None.
          CameraError: K is not that of a pinhole camera, or does not belong to the image.
          PoseError: a pose that is not finite or not rigid.
          ProjectionError: the TCP is behind the camera or outside the image.
          OptionError: an opening outside of 0 to 1; a mask that is missing or not wanted.
          OutsideTrainingError: the TCP is far above or below all of the training.
          NonFiniteActionError: the network's answer is not finite.
        """
        decision = self.decide(image, K, cam_to_world, tcp, opening, mask=mask)
        return decision.target, decision.gripper

    def decide(
        self,
        image: ArrayLike,
        K: ArrayLike,
        cam_to_world: ArrayLike,
        tcp: ArrayLike,
        opening: ArrayLike,
        *,
        mask: ArrayLike | None = None,
    ) -> Decision:
        """`act`, with all there is to know of the answer."""
        start = time.perf_counter()
        seen = self._checked(image, K, cam_to_world, tcp, opening, mask)
        compiled = self._compiled_for(seen.image.shape[:2])
        key = None if self._noise is None else jax.random.fold_in(self._noise, self._step)
        found = self._decide(self.state, key, *seen)
        target, action, valid, coverage = (np.asarray(value) for value in found)
        _require_in_view(bool(valid), seen)
        if not (np.isfinite(target).all() and np.isfinite(action).all()):
            raise NonFiniteActionError(
                f"the network's answer is not finite: {action.tolist()}; stop the robot, and train "
                "again or choose another checkpoint"
            )
        self._step += 1
        if compiled:
            self._seconds.append(time.perf_counter() - start)
        return Decision(target, float(action[-1]), action, float(coverage))

    def see(
        self,
        image: ArrayLike,
        K: ArrayLike,
        cam_to_world: ArrayLike,
        tcp: ArrayLike,
        opening: ArrayLike,
        *,
        mask: ArrayLike | None = None,
    ) -> Aligned:
        """What the network is shown (before the learner's centre crop): look at it before anything
        moves. Arguments and errors as of `act`."""
        seen = self._checked(image, K, cam_to_world, tcp, opening, mask)
        aligned: Aligned = jax.tree.map(np.asarray, self._see(*seen)[0])
        _require_in_view(bool(aligned.valid), seen)
        return aligned

    def warm_up(self, height: int, width: int) -> float:
        """Compile for images of this size; returns the milliseconds of a call after that.

        Raises:
          ShapeError: too many sizes, see `act`.
        """
        self._compiled_for((height, width))
        sample = self._sample(height, width)
        seconds = []
        for _ in range(4):
            start = time.perf_counter()
            key = None if self._noise is None else jax.random.fold_in(self._noise, 0)
            jax.block_until_ready(self._decide(self.state, key, *sample))
            seconds.append(time.perf_counter() - start)
        return 1e3 * min(seconds[1:])

    def decide_arrays(
        self,
        state: PolicyState,
        key: jax.Array | None,
        image: jax.Array,
        K: jax.Array,
        cam_to_world: jax.Array,
        tcp: jax.Array,
        opening: jax.Array,
        mask: jax.Array | None = None,
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """`decide` as a pure function of arrays, for `jax.jit` and `jax.export`.

        Args:
          state: parameters and normalisation.
          key: of the noise on proprioception; None for none.
          image, K, cam_to_world, tcp, opening, mask: see `act`; no value is checked.

        Returns:
          target [4, 4], action [10], valid [] (the TCP is in the image), coverage []: see
          `Decision`.
        """
        aligned, coverage = self._inputs(image, K, cam_to_world, tcp, opening, mask)
        images, proprio = {VIEW: aligned.image[None]}, aligned.proprio[None]
        if key is None:
            prediction, _ = self._learner.predict(state, images, proprio)
            action = to_action(state.normalizer.action.denormalize(prediction))[0]
        else:
            action = self._learner.act(key, state, images, proprio)[0]
        return apply_delta(tcp, action[:9]), action, aligned.valid, coverage

    # -- internals ---------------------------------------------------------------------------------

    def _inputs(
        self,
        image: jax.Array,
        K: jax.Array,
        cam_to_world: jax.Array,
        tcp: jax.Array,
        opening: jax.Array,
        mask: jax.Array | None,
    ) -> tuple[Aligned, jax.Array]:
        if self._dist is not None:
            image = undistort(image, K, np.asarray(self._dist, np.float32))
        return align_like(
            image,
            Camera(K, cam_to_world, *image.shape[:2]),
            self.contract.reference(self.zoom),
            tcp,
            opening,
            self.contract.spec,
            mask=mask,
            rendered=self.contract.rendered,
        )

    def _compiled_for(self, size: tuple[int, ...]) -> bool:
        """Whether calls with images of this size run at once; notes that they will."""
        height, width = size
        if (height, width) in self._sizes:
            return True
        if len(self._sizes) >= _MAX_SIZES:
            raise ShapeError(
                f"image: expected one of the {_MAX_SIZES} sizes seen so far, got {height} x "
                f"{width}; a policy is compiled for each, so give it images of one size"
            )
        if self._sizes:
            _log.warning(
                "compiling for images of %d x %d: pass image_size=(%d, %d) to load",
                *(height, width, height, width),
            )
        self._sizes.add((height, width))
        return False

    def _sample(self, height: int, width: int) -> _Observation:
        """Inputs of the right shapes: a TCP one metre in front of a camera."""
        K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
        pose, tcp = np.eye(4, dtype=np.float32), np.eye(4, dtype=np.float32)
        tcp[2, 3] = 1.0
        mask = np.ones((height, width), bool) if self.contract.spec.isolate else None
        image = np.zeros((height, width, 3), np.uint8)
        return _Observation(image, K, pose, tcp, np.ones((), np.float32), mask)

    def _checked(
        self,
        image: ArrayLike,
        K: ArrayLike,
        cam_to_world: ArrayLike,
        tcp: ArrayLike,
        opening: ArrayLike,
        mask: ArrayLike | None,
    ) -> _Observation:
        pixels = _image(image)
        height, width = pixels.shape[:2]
        intrinsics = self._intrinsics(K, height, width)
        pose = _array(cam_to_world, "cam_to_world", (4, 4), "the camera's pose, OpenCV axes")
        _checks.check_pose(pose, "cam_to_world")
        hand = _array(tcp, "tcp", (4, 4), "the TCP's pose")
        _checks.check_pose(hand, "tcp")
        self._check_height(float(hand[2, 3]))
        return _Observation(
            pixels,
            intrinsics.astype(np.float32),
            pose.astype(np.float32),
            hand.astype(np.float32),
            _opening(opening),
            self._mask(mask, height, width),
        )

    def _intrinsics(self, K: ArrayLike, height: int, width: int) -> NDArray[np.float64]:
        matrix = _array(K, "K", (3, 3), "the camera's intrinsics")
        _checks.check_intrinsics(matrix, "K")
        _checks.check_centre(
            matrix,
            height,
            width,
            self._off_centre,
            "K",
            "K belongs to another image size: scale it with the image (Camera.scaled). For an "
            "image cut out of another one pass a larger off_centre to load",
        )
        return matrix

    def _check_height(self, height: float) -> None:
        if self.contract.heights is None:
            return
        low, high = self.contract.heights
        margin = max(high - low, _LEAST_MARGIN)
        if not low - margin <= height <= high + margin:
            raise OutsideTrainingError(
                f"tcp: expected a height near those of the training, {low:.3f} to {high:.3f} m, "
                f"got {height:.3f} m; give poses in a frame whose table is as high as the "
                "training's (simulator: 0.752 m)"
            )

    def _mask(self, mask: ArrayLike | None, height: int, width: int) -> NDArray[np.bool_] | None:
        if (mask is not None) != self.contract.spec.isolate:
            wanted = "one" if self.contract.spec.isolate else "none"
            raise OptionError(
                f"mask: method {self.contract.method} takes {wanted}: expected "
                + (
                    "a bool [H, W] of the gripper and the task's objects (mask=...), got None"
                    if mask is None
                    else "mask=None, got one"
                )
            )
        if mask is None:
            return None
        shown = np.asarray(mask)
        if shown.shape != (height, width) or shown.dtype != np.bool_:
            raise ShapeError(
                f"mask: expected bool [{height}, {width}], the image's, got {shown.dtype} "
                f"{list(shown.shape)}"
            )
        return shown


def _require_in_view(valid: bool, seen: _Observation) -> None:
    """Raises ProjectionError unless the TCP is in the image."""
    if not valid:
        check_tcp_in_view(seen.camera, jnp.asarray(seen.tcp), "tcp")
        raise ProjectionError("tcp: expected the TCP inside the image, got it on its very edge")


def _image(image: ArrayLike) -> NDArray[np.uint8]:
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8:
        raise DtypeError(
            f"image: expected uint8 (0..255), got {pixels.dtype}; convert floats in 0..1 with "
            "(255 * image).round().astype(np.uint8)"
        )
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ShapeError(
            f"image: expected one RGB image [H, W, 3], got {list(pixels.shape)}; drop batch axes "
            "and alpha, move a leading channel axis to the end"
        )
    return pixels


def _array(
    value: ArrayLike | None, name: str, shape: tuple[int, ...], what: str
) -> NDArray[np.float64]:
    if value is None:
        error = ShapeError if name == "tcp" else CalibrationError
        raise error(
            f"{name}: expected {what}, {list(shape)}, got None; PALM needs a calibrated camera "
            "(docs/deploy.md)"
        )
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise DtypeError(f"{name}: expected numbers {list(shape)}, got {value!r}") from error
    if array.shape != shape:
        raise ShapeError(f"{name}: expected {what}, {list(shape)}, got {list(array.shape)}")
    return array


def _opening(opening: ArrayLike) -> NDArray[np.float32]:
    value = _array(opening, "opening", (), "the gripper's opening") if opening is not None else None
    if value is None or not -_OPENING_SLACK <= value <= 1 + _OPENING_SLACK:
        raise OptionError(
            f"opening: expected a number from 0 (closed) to 1 (open), got {opening!r}; divide the "
            "fingers' distance by its largest"
        )
    return np.asarray(value, np.float32)


# ---------------------------------------------------------------------------------------- loading


def load(
    run: str | Path,
    *,
    image_size: tuple[int, int] | None = IMAGE_SIZE,
    zoom: float = 1.0,
    off_centre: float = _checks.OFF_CENTRE,
    noise_seed: int | None = None,
    dist: Sequence[float] | None = None,
) -> Policy:
    """The policy of a finished run, ready to act: its best checkpoint by in-domain success, with
    the averaged parameters, as in the run's own evaluation.

    Args:
      run: folder of one run (with several methods, each has its own).
      image_size: rows and columns of the images to come; the policy is compiled for them here. None
        leaves that to the first call.
      zoom: how much larger the policy is to be shown the scene than equal angles make it. 1 is
        right for a camera about as far away as the training's (`contract.distance`); at another
        distance, its ratio to that makes objects as large as in training: 0.5 at half of it.
      off_centre: how far the principal point may lie from the middle, as a share of the image's
        size; a K of another image size is found out by it.
      noise_seed: add the noise on proprioception that evaluations add, drawn from this seed; None
        for none, and equal actions for equal inputs.
      dist: lens coefficients of the camera (OpenCV's 4, 5 or 8), to give `act` its images as they
        are; they are undistorted in the same compiled call. None for images without distortion.

    Prints how long an action takes, to standard error, if it compiles here.

    Raises:
      PolicyError: no run, several runs, no whole and scored checkpoint, parameters that are not
        finite, or an option outside its range.
    """
    folder = Path(run)
    if not (zoom > 0 and math.isfinite(zoom)):
        raise PolicyError(f"zoom: expected a positive number, got {zoom}")
    if not off_centre >= 0:
        raise PolicyError(f"off_centre: expected a share of the image, got {off_centre}")
    if image_size is not None and min(image_size) < 1:
        raise PolicyError(f"image_size: expected rows and columns, got {image_size}")
    if dist is not None and (len(dist) not in LENGTHS or not np.isfinite(dist).all()):
        raise PolicyError(
            f"dist: expected {', '.join(map(str, LENGTHS))} finite lens coefficients, got {dist}"
        )
    _check_one_run(folder)
    try:
        values = records.load_json(folder / "config.json")
        step, path = workspace.best_checkpoint(folder)
        config: Config | Recorded
        if values.get("kind") == workspace.RECORDED:
            config = workspace.config_in(folder, Recorded)
            contract = contract_of_recorded(values, step)
        else:
            config = workspace.stored_config(folder)
            contract = contract_of(config, step)
        learner = make_learner(
            config.learner(methods.find(config.method[0])), contract.spec.proprio_size, (VIEW,)
        )
        state = learner.policy_state(checkpoint.load(path, learner.abstract_state()))
    except (ValueError, TypeError, KeyError) as error:
        raise PolicyError(f"{folder}: {error}") from error
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)):
        raise PolicyError(f"{path}: the parameters are not finite; train again")
    contract = dataclasses.replace(contract, heights=_heights(contract.spec, state))
    policy = Policy(
        learner,
        state,
        contract,
        zoom=zoom,
        off_centre=off_centre,
        noise_seed=noise_seed,
        dist=None if dist is None else tuple(map(float, dist)),
    )
    if image_size is not None:
        took = policy.warm_up(*image_size)
        height, width = image_size
        print(
            f"{folder}: {took:.1f} ms an action for images of {height} x {width}", file=sys.stderr
        )
    return policy


def _check_one_run(folder: Path) -> None:
    """Raises PolicyError unless the folder is that of one run."""
    if (folder / "config.json").is_file():
        return
    below = runs.find_runs(folder) if folder.is_dir() else []
    if below:
        raise PolicyError(
            f"{folder}: expected the folder of one run, got one with {len(below)}: choose "
            + ", ".join(str(path) for path in below[:5])
        )
    raise PolicyError(f"{folder}: no run here (no config.json); train one first")


def describe(policy: Policy) -> dict[str, Any]:
    """A policy's contract in terms of what JSON and msgpack have."""
    contract = policy.contract
    return {
        **{field.name: getattr(contract, field.name) for field in dataclasses.fields(contract)},
        "spec": dataclasses.asdict(contract.spec),
        "zoom": policy.zoom,
    }
