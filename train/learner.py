"""Behaviour cloning: augmentation, loss, optimiser and update as pure functions of arrays.

`make_learner(config, ...)` returns a `Learner` whose `init`, `step` and `act` are pure: they can be
jitted, and vmapped over seeds. The loop around the jitted step is in `loop`.

Order of the operations on images, as in the authors' code (all inside the jitted step, which takes
uint8): random perspective, random overlay of half of the batch, normalisation by ImageNet's mean
and deviation, random crop, encoder. Ours is one more at the front, off by default: a random turn of
the camera, which the rotation input follows. The crop's bilinear weights sum to one, so that
cropping first and normalising the smaller image gives the same numbers, and is what is done.
Proprioception gets Gaussian noise in normalised units, in training and in `act` alike. The loss is
the mean square error over all ten action numbers, in normalised units.

Randomness: everything that a step draws comes from fold_in(key, state.step).
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike

from palm_jax import align
from palm_jax.train import model
from palm_jax.train.host.devices import Split

ACTION_DIM = 10  # 6D rotation, xyz, gripper
ROTATION = slice(0, 6)
GRIPPER = 9
GRIPPER_THRESHOLD = 0.5  # of the denormalised prediction; above is open
IMAGE_MEAN = (0.485, 0.456, 0.406)  # ImageNet, RGB in [0, 1]
IMAGE_STD = (0.229, 0.224, 0.225)
NOISE_ROWS = 4096  # samples that `act` has different noise for under one key
CONSTANT_RANGE = 1e-7  # a dimension that varies less is a constant, and maps to 0
SCHEDULES = ("constant", "cosine")
DTYPES = ("float32", "bfloat16")

# XLA's default fusion of convolutions into YNNPACK calls slows training on CPUs by a third.
CPU_OPTIONS: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": ""}


@dataclasses.dataclass(frozen=True)
class Failure:
    """A step whose loss or gradient is not finite, with all that it is computed from."""

    key: jax.Array
    state: "TrainState"  # before the step, whose number it holds
    batch: "Batch"
    bank: jax.Array | None


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """Everything that shapes a training run but the data; the defaults are for two cores.

    The paper's values (released configuration): width 64, norm "batch" with ImageNet weights,
    learning_rate 1e-4, schedule "constant", encoder_lr_scale 0.1 if pretrained, 600 epochs.
    """

    width: int = 16
    norm: str = "group"  # or "batch"
    coord_conv: bool = True
    crop: int | None = 76  # pixels of the random crop (centre crop in `act`); None for no crop
    embed: int = 64
    hidden: tuple[int, ...] = (1024, 1024)
    dtype: str = "float32"  # of the network's arithmetic; parameters are float32 always

    batch_size: int = 64
    steps: int = 4000
    learning_rate: float = 1e-3
    schedule: str = "cosine"  # to zero over `steps`, or "constant"; both after a linear warm-up
    warmup_steps: int = 200
    encoder_lr_scale: float = 1.0
    weight_decay: float = 0.0  # decoupled, as in AdamW
    grad_clip: float = 20.0  # global norm; 0 for none
    ema: float = 0.0  # decay of the averaged parameters that act; 0 for none
    max_skipped_steps: int = 10  # updates left out for a non-finite loss or gradient, in all

    proprio_noise: float = 0.005  # standard deviation, normalised units
    overlay_fraction: float = 0.5  # of the batch; 0 for no random overlay
    overlay_alpha: float = 0.5  # weight of the background
    overlay_warmup_steps: int = 0  # no overlay before this step
    perspective_distortion: float = 0.2
    perspective_probability: float = 0.5  # per sample; 0 for no random perspective
    turn: tuple[float, float] = (0.0, 0.0)  # largest pan and tilt of `align.random_turn`, radians
    turn_probability: float = 0.8  # per sample; 0 for none
    turn_proprio: bool = True  # proprioception begins with the 6D rotation seen by the camera

    @property
    def turns(self) -> bool:
        """Whether training images are turned, which needs their cameras."""
        return self.turn_probability > 0 and max(self.turn) > 0

    def __post_init__(self) -> None:
        for name, known in (
            ("norm", model.NORMS),
            ("schedule", SCHEDULES),
            ("dtype", DTYPES),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} is {getattr(self, name)!r}; known: {', '.join(known)}")
        for name in ("width", "embed", "batch_size", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 1")
        for name in (
            "learning_rate", "warmup_steps", "encoder_lr_scale", "weight_decay", "grad_clip",
            "max_skipped_steps", "proprio_noise", "overlay_warmup_steps",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected 0 or more")
        for name in (
            "overlay_fraction", "overlay_alpha", "perspective_distortion",
            "perspective_probability", "turn_probability",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected 0 to 1")
        if len(self.turn) != 2 or not all(0 <= angle <= 1.5 for angle in self.turn):
            raise ValueError(
                f"turn is {self.turn}; expected pan and tilt from 0 to 1.5 radians each"
            )
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema is {self.ema}; expected 0 (off) up to, not including, 1")


# ---------------------------------------------------------------------------------- normalisation


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Range:
    """Smallest and largest value of each dimension, [D] float32."""

    low: jax.Array
    high: jax.Array

    def normalize(self, x: jax.Array) -> jax.Array:
        """[..., D] -> [..., D]: [low, high] to [-1, 1]; constant dimensions to 0."""
        width = self.high - self.low
        varies = width >= CONSTANT_RANGE
        scaled = 2 * (x - self.low) / jnp.where(varies, width, 1) - 1
        return jnp.where(varies, scaled, 0)

    def denormalize(self, x: jax.Array) -> jax.Array:
        """The inverse; constant dimensions give their constant."""
        width = self.high - self.low
        varies = width >= CONSTANT_RANGE
        return jnp.where(varies, self.low + (x + 1) / 2 * width, self.low)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Normalizer:
    """Ranges of proprioception [P] and actions [10]."""

    proprio: Range
    action: Range


def fit_normalizer(proprio: ArrayLike, actions: ArrayLike) -> Normalizer:
    """Ranges over all frames of a data set.

    Args:
      proprio: [N, P].
      actions: [N, 10]; after any overwriting of labels, or a few jumps set the range.

    Raises:
      ValueError: wrong shapes, no frames, or non-finite values.
    """

    def fit(name: str, values: ArrayLike) -> Range:
        array = np.asarray(values, np.float32)
        if array.ndim != 2 or not len(array):
            raise ValueError(f"{name}: expected [N, D] with N > 0, got shape {array.shape}")
        if not np.isfinite(array).all():
            bad = int(np.nonzero(~np.isfinite(array).all(axis=1))[0][0])
            raise ValueError(f"{name}: frame {bad} has a non-finite value; filter the data first")
        return Range(jnp.asarray(array.min(axis=0)), jnp.asarray(array.max(axis=0)))

    return Normalizer(fit("proprio", proprio), fit("actions", actions))


# ------------------------------------------------------------------------------------------ state


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Batch:
    """Samples, and equally a whole data set: arrays with one leading axis."""

    images: dict[str, Any]  # view -> [B, H, W, 3] uint8
    proprio: Any  # [B, P] float32, in its own units
    actions: Any  # [B, 10] float32
    cameras: dict[str, align.Camera] = dataclasses.field(default_factory=dict)
    """view -> who took its images, leaves [B, ...]; only for `LearnerConfig.turn`."""
    tcp: Any = None  # [B, 3] float32 metres in the world; only for `LearnerConfig.turn`


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """What a step reads and writes; the whole of it is what a checkpoint holds."""

    step: jax.Array  # [] int32, updates done or skipped
    skipped: jax.Array  # [] int32, updates skipped for non-finite numbers
    params: model.Params
    batch_stats: model.Params  # empty with norm "group"
    opt_state: Any
    ema_params: model.Params  # empty unless config.ema > 0
    normalizer: Normalizer


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PolicyState:
    """What `act` needs."""

    params: model.Params
    batch_stats: model.Params
    normalizer: Normalizer


# ----------------------------------------------------------------------------------- loss, images


def mean_squared_error(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Mean of the squared differences over all elements.

    Raises:
      ValueError: the shapes differ. Broadcasting [B, 1] against [B] would give a plausible number.
    """
    if prediction.shape != target.shape:
        raise ValueError(
            f"prediction and target must have one shape, got {prediction.shape} and {target.shape}"
        )
    return jnp.mean(jnp.square(prediction - target))


def normalize_image(images: jax.Array) -> jax.Array:
    """[..., 3] uint8, or float in [0, 1] -> float32 with ImageNet's mean 0 and deviation 1."""
    top = 255.0 if images.dtype == jnp.uint8 else 1.0
    std = jnp.asarray(IMAGE_STD, jnp.float32)
    mean = jnp.asarray(IMAGE_MEAN, jnp.float32)
    return images.astype(jnp.float32) * (1 / (top * std)) - mean / std


def _turned_views(
    key: jax.Array, batch: Batch, view_of_proprio: str, config: LearnerConfig
) -> Batch:
    """The batch with `align.random_turn` applied to every view, and to the rotation input."""
    images, proprio = dict(batch.images), batch.proprio
    for index, (view, camera) in enumerate(sorted(batch.cameras.items())):
        images[view], turned = align.random_turn(
            jax.random.fold_in(key, index),
            images[view],
            camera,
            batch.tcp,
            pan=config.turn[0],
            tilt=config.turn[1],
            probability=config.turn_probability,
        )
        if config.turn_proprio and view == view_of_proprio:
            proprio = _seen_by(jnp.asarray(proprio), camera, turned)
    return dataclasses.replace(batch, images=images, proprio=proprio)


def check_cameras(batch: Batch, views: Sequence[str]) -> None:
    """Raise ValueError unless a batch, or a data set, has what turning its cameras needs."""
    if batch.tcp is None or set(batch.cameras) != set(views):
        raise ValueError(
            f"cameras, tcp: the configuration turns cameras, which needs those of {list(views)} "
            f"and the TCP's positions, got cameras of {list(batch.cameras)} and tcp "
            f"{None if batch.tcp is None else np.shape(batch.tcp)}; pass them, or set turn=(0, 0)"
        )


def _seen_by(proprio: jax.Array, camera: align.Camera, turned: align.Camera) -> jax.Array:
    """Proprioception [B, P] whose rotation (its first six numbers) is that seen by `turned`."""
    old, new = (jnp.asarray(c.cam_to_world)[:, :3, :3] for c in (camera, turned))
    columns = proprio[:, ROTATION].reshape(-1, 2, 3)
    # R_new^T R_old on each of the two columns.
    seen = jnp.einsum("bwn,bwo,bco->bcn", new, old, columns, precision=lax.Precision.HIGHEST)
    return proprio.at[:, ROTATION].set(seen.reshape(-1, 6))


def _random_views(
    key: jax.Array,
    images: Mapping[str, jax.Array],
    bank: jax.Array | None,
    step: jax.Array,
    config: LearnerConfig,
) -> dict[str, jax.Array]:
    """Augment and normalise every view, each with randomness of its own."""
    out = {}
    for index, (view, x) in enumerate(sorted(images.items())):
        keys = jax.random.split(jax.random.fold_in(key, index), 3)
        if config.perspective_probability > 0 and config.perspective_distortion > 0:
            x = align.random_perspective(
                keys[0],
                x,
                distortion=config.perspective_distortion,
                probability=config.perspective_probability,
            )
        if config.overlay_fraction > 0 and bank is not None:
            # A weight of zero while warming up, which changes nothing: cheaper than a branch.
            alpha = jnp.where(step >= config.overlay_warmup_steps, config.overlay_alpha, 0.0)
            x = align.random_overlay(
                keys[1], x, bank, fraction=config.overlay_fraction, alpha=alpha
            )
        if config.crop is not None:
            x = align.random_crop(keys[2], x, config.crop)
        out[view] = normalize_image(x)
    return out


# ---------------------------------------------------------------------------------------- learner


def _schedule(config: LearnerConfig) -> optax.Schedule:
    if config.schedule == "cosine":
        decay = optax.cosine_decay_schedule(
            config.learning_rate, max(config.steps - config.warmup_steps, 1)
        )
    else:
        decay = optax.constant_schedule(config.learning_rate)
    if config.warmup_steps == 0:
        return decay
    # From one n-th of the rate at step 0, so that no step is wasted on a rate of zero.
    first = config.learning_rate / config.warmup_steps
    warmup = optax.linear_schedule(first, config.learning_rate, max(config.warmup_steps - 1, 1))
    return optax.join_schedules([warmup, decay], [config.warmup_steps])


def _optimizer(config: LearnerConfig) -> optax.GradientTransformation:
    parts = [optax.clip_by_global_norm(config.grad_clip)] if config.grad_clip else []
    parts.append(optax.scale_by_adam())
    if config.weight_decay:
        parts.append(optax.add_decayed_weights(config.weight_decay))
    parts.append(optax.scale_by_learning_rate(_schedule(config)))
    return optax.chain(*parts)


def _by_name(tree: Any) -> dict[str, jax.Array]:
    """ "state/params/head/bias" -> leaf."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _flatten(params: model.Params) -> jax.Array:
    """All parameters as one vector [n], the encoders' first.

    The optimiser runs on this: one loop instead of several for each of the network's arrays, which
    saves a third of the compilation. The barrier keeps XLA from fusing the concatenation into the
    arithmetic, element by element.
    """
    return lax.optimization_barrier(ravel_pytree(params)[0])


def _unflatten(flat: jax.Array, like: model.Params) -> model.Params:
    return ravel_pytree(like)[1](lax.optimization_barrier(flat))


@dataclasses.dataclass(frozen=True)
class Learner:
    """Behaviour cloning as pure functions of a configuration; made by `make_learner`.

    Attributes:
      config: see `LearnerConfig`.
      proprio_dim: numbers of proprioception, P.
      views: names of the images, in the order in which the head concatenates them.
    """

    config: LearnerConfig
    proprio_dim: int
    views: tuple[str, ...]

    # -- pure functions ----------------------------------------------------------------------------

    def init(
        self, key: jax.Array, normalizer: Normalizer, *, trunk: model.PretrainedTrunk | None = None
    ) -> TrainState:
        """The state before the first step, optionally with a pretrained trunk in every encoder."""
        params, batch_stats = self._network.init(key)
        if trunk is not None:
            params, batch_stats = model.with_trunk(params, batch_stats, trunk)
        return TrainState(
            step=jnp.zeros((), jnp.int32),
            skipped=jnp.zeros((), jnp.int32),
            params=params,
            batch_stats=batch_stats,
            opt_state=_optimizer(self.config).init(_flatten(params)),
            ema_params=jax.tree.map(jnp.copy, params) if self.config.ema else {},
            normalizer=normalizer,
        )

    def step(
        self, key: jax.Array, state: TrainState, batch: Batch, bank: jax.Array | None = None
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """One update.

        Args:
          key: that of the run, the same at every step.
          state: from `init` or the step before.
          batch: see `Batch`.
          bank: backgrounds [K, H, W, 3] for the random overlay, None for none.

        Returns:
          The new state, and scalar metrics: `loss`, `grad_norm` (before clipping), `param_norm`,
          `update_norm`, `learning_rate`, `skipped` (updates left out so far).
        """
        check_batch(batch, self.proprio_dim, self.views, self.config.crop)
        images, proprio, target = self._inputs(key, state, batch, bank)

        def loss_of(params: model.Params) -> tuple[jax.Array, model.Params]:
            prediction, _, stats = self._network.apply(
                params, state.batch_stats, images, proprio, train=True
            )
            return mean_squared_error(prediction, target), stats

        (loss, stats), grads = jax.value_and_grad(loss_of, has_aux=True)(state.params)
        return self._updated(state, loss, stats, _flatten(grads))

    def examine(self, failure: Failure) -> dict[str, jax.Array]:
        """Everything that a step computes, by name and in that order: what it is given, what the
        augmentation makes of it, every layer, the loss, the gradient."""
        key, state, batch, bank = failure.key, failure.state, failure.batch, failure.bank
        out = _by_name({"state": state, "batch": batch, "bank": bank})
        images, proprio, target = self._inputs(key, state, batch, bank)
        out |= _by_name({"input": {"images": images, "proprio": proprio, "target": target}})

        names: list[str] = []  # JAX would sort a dictionary's entries

        def loss_of(params: model.Params) -> tuple[jax.Array, list[jax.Array]]:
            prediction, layers, _ = self._network.apply(
                params, state.batch_stats, images, proprio, train=True
            )
            names[:] = layers
            return mean_squared_error(prediction, target), [*layers.values(), prediction]

        (loss, layers), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params)
        out |= {f"layer {name}": value for name, value in zip(names, layers, strict=False)}
        out |= {"prediction": layers[-1], "loss": loss}
        return out | _by_name({"gradient": gradient})

    def predict(
        self, policy: PolicyState, images: Mapping[str, jax.Array], proprio: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """(actions [B, 10] in normalised units, intermediates): the network as it acts, but for
        the noise on proprioception."""
        return self._output(
            policy, images, policy.normalizer.proprio.normalize(jnp.asarray(proprio))
        )

    def act(
        self,
        key: jax.Array,
        policy: PolicyState,
        images: Mapping[str, jax.Array],
        proprio: jax.Array,
        rows: ArrayLike | None = None,
    ) -> jax.Array:
        """Actions [B, 10] in their own units: a rotation of two orthonormal columns, metres, and a
        gripper of exactly 0 or 1.

        Args:
          key: of the noise on proprioception.
          policy: from `policy_state`.
          images: view -> [B, H, W, 3] uint8.
          proprio: [B, P].
          rows: [B] int below `NOISE_ROWS`, which noise of those that the key stands for each sample
            gets; by default 0 to B - 1. With it a sample's noise does not depend on its batch.
        """
        chosen = None if rows is None else jnp.asarray(rows)
        noisy = self._noisy_proprio(key, policy.normalizer, jnp.asarray(proprio), chosen)
        prediction, _ = self._output(policy, images, noisy)
        return to_action(policy.normalizer.action.denormalize(prediction))

    def policy_state(self, state: TrainState) -> PolicyState:
        """The averaged parameters if the configuration asks for an average, else the newest."""
        params = state.ema_params if self.config.ema else state.params
        return PolicyState(params, state.batch_stats, state.normalizer)

    def abstract_state(self) -> TrainState:
        """Shapes and dtypes of a `TrainState`: the target to load a checkpoint into."""

        def start() -> TrainState:
            ranges = [Range(jnp.zeros(n), jnp.zeros(n)) for n in (self.proprio_dim, ACTION_DIM)]
            return self.init(jax.random.key(0), Normalizer(*ranges))

        return jax.eval_shape(start)

    # -- compiled ----------------------------------------------------------------------------------

    @functools.cached_property
    def jitted_init(self) -> Callable[..., TrainState]:
        """`init`, compiled."""
        return jax.jit(self.init)

    @functools.cached_property
    def jitted_step(self) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
        """`step`, compiled; it consumes the state that it is given."""
        return jax.jit(self.step, donate_argnums=1, compiler_options=compiler_options())

    def step_over(self, split: Split) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
        """`jitted_step` for the devices that share it."""
        if split.mesh is None:
            return self.jitted_step
        return split.compiled(self.step, donate_argnums=1, compiler_options=compiler_options())

    @functools.cached_property
    def jitted_act(self) -> Callable[..., jax.Array]:
        """`act`, compiled once per batch size."""
        return jax.jit(self.act, compiler_options=compiler_options())

    @functools.cached_property
    def jitted_predict(self) -> Callable[..., tuple[jax.Array, dict[str, jax.Array]]]:
        """`predict`, compiled once per batch size."""
        return jax.jit(self.predict, compiler_options=compiler_options())

    # -- internals ---------------------------------------------------------------------------------

    @functools.cached_property
    def _network(self) -> model.Network:
        config = self.config
        return model.make_network(
            views=self.views,
            proprio_dim=self.proprio_dim,
            action_dim=ACTION_DIM,
            width=config.width,
            norm=config.norm,
            coord_conv=config.coord_conv,
            embed=config.embed,
            hidden=config.hidden,
            dtype=jnp.dtype(config.dtype),
        )

    def _inputs(
        self, key: jax.Array, state: TrainState, batch: Batch, bank: jax.Array | None
    ) -> tuple[dict[str, jax.Array], jax.Array, jax.Array]:
        """(images, proprioception, target) of a step: augmented and normalised."""
        image_key, proprio_key = jax.random.split(jax.random.fold_in(key, state.step))
        if self.config.turns:
            check_cameras(batch, self.views)
            turn_key = jax.random.fold_in(image_key, len(self.views))
            batch = _turned_views(turn_key, batch, self.views[0], self.config)
        images = _random_views(image_key, batch.images, bank, state.step, self.config)
        proprio = self._noisy_proprio(proprio_key, state.normalizer, jnp.asarray(batch.proprio))
        target = state.normalizer.action.normalize(jnp.asarray(batch.actions))
        return images, proprio, target

    def _updated(
        self, state: TrainState, loss: jax.Array, stats: model.Params, gradient: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """The state after a gradient (a flat vector), and the step's metrics."""
        config, flat = self.config, _flatten(state.params)
        grad_norm = jnp.linalg.norm(gradient)
        updates, opt_state = _optimizer(config).update(gradient, state.opt_state, flat)
        # One bad batch must not poison the parameters, nor Adam's moments: leave it out, count it.
        finite = jnp.isfinite(loss) & jnp.isfinite(grad_norm)
        updates = jnp.where(finite, updates * self._rates(state.params), 0.0)
        opt_state, stats = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (opt_state, stats),
            (state.opt_state, state.batch_stats),
        )
        flat = flat + updates
        ema_params = state.ema_params
        if config.ema:
            averaged = config.ema * _flatten(ema_params) + (1 - config.ema) * flat
            ema_params = _unflatten(averaged, ema_params)
        skipped = state.skipped + ~finite
        rate = _schedule(config)(state.step - state.skipped)
        metrics = {
            "loss": loss,
            "grad_norm": grad_norm,
            "param_norm": jnp.linalg.norm(flat),
            "update_norm": jnp.linalg.norm(updates),
            "learning_rate": jnp.asarray(rate, jnp.float32),
            "skipped": skipped,
        }
        state = TrainState(
            step=state.step + 1,
            skipped=skipped,
            params=_unflatten(flat, state.params),
            batch_stats=stats,
            opt_state=opt_state,
            ema_params=ema_params,
            normalizer=state.normalizer,
        )
        return state, metrics

    def _rates(self, params: model.Params) -> jax.Array | float:
        """[n] factor on the learning rate of each number of the flat vector."""
        scale = self.config.encoder_lr_scale
        if scale == 1:
            return 1.0
        sizes = {name: sum(x.size for x in jax.tree.leaves(part)) for name, part in params.items()}
        return jnp.where(jnp.arange(sum(sizes.values())) < sizes["encoders"], scale, 1.0)

    def _noisy_proprio(
        self,
        key: jax.Array,
        normalizer: Normalizer,
        proprio: jax.Array,
        rows: jax.Array | None = None,
    ) -> jax.Array:
        x = normalizer.proprio.normalize(proprio)
        if rows is None:
            noise = jax.random.normal(key, x.shape, x.dtype)
        else:
            noise = jax.random.normal(key, (NOISE_ROWS, *x.shape[1:]), x.dtype)[rows]
        return x + self.config.proprio_noise * noise

    def _output(
        self, policy: PolicyState, images: Mapping[str, jax.Array], proprio: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        ready = {}
        for view in self.views:
            x = jnp.asarray(images[view])
            if self.config.crop is not None:
                x = align.center_crop(x, self.config.crop)
            ready[view] = normalize_image(x)
        prediction, out, _ = self._network.apply(
            policy.params, policy.batch_stats, ready, proprio, train=False
        )
        return prediction, out


def compiler_options() -> dict[str, Any]:
    """For every `jax.jit` around a network; they apply to CPUs only."""
    return dict(CPU_OPTIONS) if jax.default_backend() == "cpu" else {}


def make_learner(
    config: LearnerConfig, proprio_dim: int, views: Sequence[str] = ("front",)
) -> Learner:
    """A learner for data with `proprio_dim` numbers of proprioception and these `views`.

    Raises:
      ValueError: a negative `proprio_dim`, or a view named twice.
    """
    views = tuple(views)
    if proprio_dim < 0 or len(set(views)) != len(views):
        raise ValueError(
            f"expected proprio_dim >= 0 and different views, got {proprio_dim} and {views}"
        )
    return Learner(config, proprio_dim, views)


def to_action(prediction: jax.Array) -> jax.Array:
    """Denormalised prediction [..., 10] -> executable action [..., 10].

    The rotation's two columns become orthonormal (Gram-Schmidt), the gripper 0 or 1. A prediction
    with a number that is not finite becomes all NaN: neither step would let it be seen.
    """
    rotation = align.rotation_6d(align.matrix_from_6d(prediction[..., ROTATION]))
    gripper = (prediction[..., GRIPPER:] > GRIPPER_THRESHOLD).astype(prediction.dtype)
    action = jnp.concatenate([rotation, prediction[..., ROTATION.stop : GRIPPER], gripper], axis=-1)
    finite = jnp.isfinite(prediction).all(axis=-1, keepdims=True)
    return jnp.where(finite, action, jnp.nan)


def check_batch(batch: Batch, proprio_dim: int, views: Sequence[str], crop: int | None) -> int:
    """Check shapes and dtypes of a batch or a data set; returns the number of samples.

    Raises:
      ValueError: with what was expected and what came.
    """
    count = np.shape(batch.proprio)[0] if np.ndim(batch.proprio) else 0
    expected = {"proprio": (count, proprio_dim), "actions": (count, ACTION_DIM)}
    for name, shape in expected.items():
        if np.shape(getattr(batch, name)) != shape:
            raise ValueError(
                f"{name}: expected shape {shape}, got {np.shape(getattr(batch, name))}"
            )
    missing = [view for view in views if view not in batch.images]
    extra = [view for view in batch.images if view not in views]
    if missing or extra:
        raise ValueError(f"images: expected the views {list(views)}, got {list(batch.images)}")
    for view, x in batch.images.items():
        shape = np.shape(x)
        if len(shape) != 4 or shape[0] != count or shape[3] != 3 or x.dtype != np.uint8:
            raise ValueError(
                f"images[{view!r}]: expected uint8 [{count}, H, W, 3], got {x.dtype} {shape}"
            )
        if crop is not None and min(shape[1:3]) < crop:
            raise ValueError(
                f"images[{view!r}]: {shape[1]} x {shape[2]} pixels are less than the crop of {crop}"
            )
    return count
