"""The policy network: CoordConv, ResNet-18 and an MLP, in Flax NNX.

Topology of torchvision's ResNet-18 (stem 7x7 stride 2, max pool, four stages of two basic blocks),
so that its ImageNet weights can be imported; the trunk's base `width` is 64 there, and 16 in the
presets for CPUs. Around it the authors' released network: CoordConv in front, global average
pool, a linear projection of each view to `embed` numbers, then an MLP on the projections of all
views and the proprioception (paper, section III-D; CoordConv from the released code only).

Conventions: images are NHWC, float, already normalised; kernels are HWIO. Parameters and running
statistics leave this module as pure nested dicts of arrays (`init`), and come back as such
(`apply`), so that no checkpoint depends on a Flax class.

Three things here are written for the speed of XLA on CPUs, each equal in value to the plain form:
the stem works on 2x2 blocks of pixels (`stem_convolution`), CoordConv's second 1x1 convolution is
multiplied into the stem's kernel, and the max pool is a maximum over strided slices, whose gradient
is several times cheaper than that of a windowed reduction.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import lax

from palm_jax.train.files import torch as torch_files

Params = dict[str, Any]  # nested dict of arrays
NORMS = ("batch", "group")
STAGES = 4
BLOCKS_PER_STAGE = 2
EPSILON = 1e-5  # of both norms, as in torch
BATCH_MOMENTUM = 0.1  # weight of the newest batch in the running statistics, as in torch
GROUPS_IN_STEM = 4  # GroupNorm: the groups keep the stem's channel count all through the trunk


class Normals:
    """Kaiming-normal kernels, cut one after the other from one vector of standard normals.

    One draw for the whole network, because XLA compiles a random generator per shape that is drawn:
    several seconds for a ResNet, on a CPU. Without a vector, kernels are zeros and only `used`
    counts: how long the vector has to be.
    """

    def __init__(self, numbers: jax.Array | None = None):
        self.numbers = numbers
        self.used = 0

    def __call__(self, shape: tuple[int, ...], fan: int) -> jax.Array:
        """A kernel of deviation sqrt(2 / fan): fan-in, or fan-out for the trunk as torchvision."""
        size = math.prod(shape)
        start, self.used = self.used, self.used + size
        if self.numbers is None:
            return jnp.zeros(shape)
        return math.sqrt(2 / fan) * self.numbers[start : start + size].reshape(shape)


def convolution(
    x: jax.Array, kernel: jax.Array, *, stride: int, padding: Sequence[tuple[int, int]]
) -> jax.Array:
    """Cross-correlation of x [B, H, W, I] with kernel [h, w, I, O], in the dtype of `x`."""
    return lax.conv_general_dilated(
        x,
        kernel.astype(x.dtype),
        (stride, stride),
        list(padding),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def space_to_depth(x: jax.Array) -> jax.Array:
    """[B, H, W, C] -> [B, H/2, W/2, 4C]: each 2x2 block of pixels becomes one pixel."""
    b, h, w, c = x.shape
    blocks = x.reshape(b, h // 2, 2, w // 2, 2, c).transpose(0, 1, 3, 2, 4, 5)
    return blocks.reshape(b, h // 2, w // 2, 4 * c)


def stem_convolution(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """7x7 convolution of stride 2 and padding 3, computed as a 4x4 one of stride 1 on 2x2 blocks.

    Args:
      x: [B, H, W, I].
      kernel: [7, 7, I, O].

    Returns:
      [B, ceil(H / 2), ceil(W / 2), O], equal to the direct form up to the order of the sums. With
      three channels the direct form leaves most of the vector unit idle, above all in its gradient.
    """
    _, h, w, _ = x.shape
    if h % 2 or w % 2:  # the row of zeros is part of the padding that the direct form adds anyway
        x = jnp.pad(x, ((0, 0), (0, h % 2), (0, w % 2), (0, 0)))
    inputs, outputs = kernel.shape[2:]
    padded = jnp.pad(kernel, ((1, 0), (1, 0), (0, 0), (0, 0)))
    blocks = padded.reshape(4, 2, 4, 2, inputs, outputs).transpose(0, 2, 1, 3, 4, 5)
    blocks = blocks.reshape(4, 4, 4 * inputs, outputs)
    return convolution(space_to_depth(x), blocks, stride=1, padding=((2, 1), (2, 1)))


def max_pool(x: jax.Array) -> jax.Array:
    """3x3 max pool of stride 2 and padding 1: [B, H, W, C] -> [B, ceil(H / 2), ceil(W / 2), C]."""

    def along(x: jax.Array, axis: int) -> jax.Array:
        size = x.shape[axis]
        out = (size + 1) // 2
        pad = [(0, 0)] * x.ndim
        pad[axis] = (1, 2 * out - size)
        x = jnp.pad(x, pad, constant_values=-jnp.inf)
        parts = [
            lax.slice_in_dim(x, start, start + 2 * out - 1, stride=2, axis=axis)
            for start in range(3)
        ]
        return jnp.maximum(jnp.maximum(parts[0], parts[1]), parts[2])

    return along(along(x, 2), 1)


class Conv(nnx.Module):
    """Convolution without bias, padded by half the kernel's size."""

    def __init__(self, inputs: int, outputs: int, size: int, *, stride: int = 1, normals: Normals):
        shape = (size, size, inputs, outputs)
        self.kernel = nnx.Param(normals(shape, size * size * outputs))
        self.stride = stride

    def __call__(self, x: jax.Array) -> jax.Array:
        pad = self.kernel.shape[0] // 2
        return convolution(x, self.kernel[...], stride=self.stride, padding=((pad, pad),) * 2)


class Linear(nnx.Module):
    """x [..., I] -> [..., O]; kaiming-normal kernel, zero bias."""

    def __init__(self, inputs: int, outputs: int, *, normals: Normals):
        self.kernel = nnx.Param(normals((inputs, outputs), inputs))
        self.bias = nnx.Param(jnp.zeros(outputs))

    def __call__(self, x: jax.Array) -> jax.Array:
        return x @ self.kernel[...].astype(x.dtype) + self.bias[...].astype(x.dtype)


def _channel_sums(x: jax.Array) -> jax.Array:
    """[B, H, W, C] -> [B, C] float32, over the pixels.

    A product with a vector of ones: on CPUs twice as fast as XLA's reduction of the inner axes.
    """
    b, h, w, c = x.shape
    ones, flat = jnp.ones((b, 1, h * w)), x.astype(jnp.float32).reshape(b, h * w, c)
    return jnp.einsum("bip,bpc->bic", ones, flat, precision=lax.Precision.HIGHEST)[:, 0]


def _scale_shift(x: jax.Array, factor: jax.Array, offset: jax.Array) -> jax.Array:
    """x factor + offset, float32; factor and offset are [B | 1, C]."""
    return x.astype(jnp.float32) * factor[:, None, None] + offset[:, None, None]


@jax.custom_vjp
def group_norm(x: jax.Array, scale: jax.Array, bias: jax.Array, average: jax.Array) -> jax.Array:
    """Group normalisation (Wu and He 2018), scaled and shifted.

    Both moments come from one pass over the data, and the channels of the feature map are never
    split into groups: sums per channel are averaged within groups by a small matrix. The gradient
    is written out in the same terms, which takes half the time of the derived one on a CPU.

    Args:
      x: [B, H, W, C]; moments are float32 whatever its dtype.
      scale: [C].
      bias: [C].
      average: [C, C], maps sums over pixels to means over pixels and groups; a constant.
    """
    return _group_norm_forward(x, scale, bias, average)[0]


def _group_norm_forward(
    x: jax.Array, scale: jax.Array, bias: jax.Array, average: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    wide = x.astype(jnp.float32)
    mean, square = _mix(_channel_sums(wide), average), _mix(_channel_sums(wide * wide), average)
    inverse = lax.rsqrt(jnp.maximum(square - mean * mean, 0.0) + EPSILON)
    factor = inverse * scale
    y = _scale_shift(wide, factor, bias - mean * factor).astype(x.dtype)
    return y, (x, mean, inverse, scale, average)


def _group_norm_backward(
    saved: tuple[jax.Array, ...], dy: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, None]:
    # With n = (x - mean) inverse, y = n scale + bias and M the mean over a group:
    # dx = inverse (scale dy - M[scale dy] - n M[scale dy n]).
    x, mean, inverse, scale, average = saved
    wide, dy = x.astype(jnp.float32), dy.astype(jnp.float32)
    dy_sum = _channel_sums(dy)
    dyn_sum = (_channel_sums(dy * wide) - mean * dy_sum) * inverse
    first = inverse * _mix(dy_sum * scale, average)
    second = inverse * inverse * _mix(dyn_sum * scale, average)
    dx = _scale_shift(dy, inverse * scale, second * mean - first) - wide * second[:, None, None]
    return dx.astype(x.dtype), dyn_sum.sum(0), dy_sum.sum(0), None


def _mix(sums: jax.Array, average: jax.Array) -> jax.Array:
    return jnp.dot(sums, average, precision=lax.Precision.HIGHEST)


group_norm.defvjp(_group_norm_forward, _group_norm_backward)


class GroupNorm(nnx.Module):
    """`group_norm` with learnt scale and bias."""

    def __init__(self, channels: int, *, groups: int):
        if channels % groups:
            raise ValueError(
                f"GroupNorm: {channels} channels do not divide into {groups} groups; "
                "choose a width that is a multiple of 4"
            )
        self.scale = nnx.Param(jnp.ones(channels))
        self.bias = nnx.Param(jnp.zeros(channels))
        self.groups = groups

    def __call__(self, x: jax.Array, *, train: bool) -> jax.Array:
        del train  # the same in both modes
        _, h, w, c = x.shape
        size = c // self.groups
        members = np.kron(np.eye(self.groups), np.ones((size, size)))
        average = jnp.asarray(members / (h * w * size), jnp.float32)
        return group_norm(x, self.scale[...], self.bias[...], average)


class BatchNorm(nnx.Module):
    """Batch normalisation as torch does it: unbiased running variance, biased in the batch."""

    def __init__(self, channels: int):
        self.scale = nnx.Param(jnp.ones(channels))
        self.bias = nnx.Param(jnp.zeros(channels))
        self.mean = nnx.BatchStat(jnp.zeros(channels))
        self.var = nnx.BatchStat(jnp.ones(channels))

    def __call__(self, x: jax.Array, *, train: bool) -> jax.Array:
        if not train:
            return self._apply(x, self.mean[...], self.var[...])
        wide = x.astype(jnp.float32)
        mean = wide.mean((0, 1, 2))
        var = jnp.maximum(jnp.square(wide).mean((0, 1, 2)) - jnp.square(mean), 0.0)
        count = x.size // x.shape[-1]
        unbiased = var * (count / max(count - 1, 1))
        self.mean[...] = (1 - BATCH_MOMENTUM) * self.mean[...] + BATCH_MOMENTUM * mean
        self.var[...] = (1 - BATCH_MOMENTUM) * self.var[...] + BATCH_MOMENTUM * unbiased
        return self._apply(x, mean, var)

    def _apply(self, x: jax.Array, mean: jax.Array, var: jax.Array) -> jax.Array:
        factor = lax.rsqrt(var + EPSILON) * self.scale[...]
        shift = self.bias[...] - mean * factor
        return _scale_shift(x, factor[None], shift[None]).astype(x.dtype)


def _norm(kind: str, channels: int, width: int) -> nnx.Module:
    if kind == "batch":
        return BatchNorm(channels)
    return GroupNorm(channels, groups=channels // max(width // GROUPS_IN_STEM, 1))


class BasicBlock(nnx.Module):
    """Two 3x3 convolutions and a shortcut, which is a 1x1 convolution where the shape changes."""

    def __init__(
        self, inputs: int, outputs: int, *, stride: int, norm: str, width: int, normals: Normals
    ):
        self.conv1 = Conv(inputs, outputs, 3, stride=stride, normals=normals)
        self.norm1 = _norm(norm, outputs, width)
        self.conv2 = Conv(outputs, outputs, 3, normals=normals)
        self.norm2 = _norm(norm, outputs, width)
        self.projects = stride != 1 or inputs != outputs
        if self.projects:
            self.shortcut = Conv(inputs, outputs, 1, stride=stride, normals=normals)
            self.shortcut_norm = _norm(norm, outputs, width)

    def __call__(self, x: jax.Array, *, train: bool) -> jax.Array:
        y = jax.nn.relu(self.norm1(self.conv1(x), train=train))
        y = self.norm2(self.conv2(y), train=train)
        if self.projects:
            x = self.shortcut_norm(self.shortcut(x), train=train)
        return jax.nn.relu(x + y)


class ResNet18(nnx.Module):
    """The trunk: images [B, H, W, C] -> feature map [B, ceil(H / 32), ceil(W / 32), 8 width]."""

    def __init__(self, *, width: int, norm: str, channels: int = 3, normals: Normals):
        self.conv1 = Conv(channels, width, 7, stride=2, normals=normals)
        self.norm1 = _norm(norm, width, width)
        inputs = width
        for name, outputs, stride in self._blocks(width):
            block = BasicBlock(
                inputs, outputs, stride=stride, norm=norm, width=width, normals=normals
            )
            setattr(self, name, block)
            inputs = outputs
        self.width = width

    @staticmethod
    def _blocks(width: int) -> Iterator[tuple[str, int, int]]:
        """Name, output channels and stride of each block, e.g. ("layer2_0", 2 width, 2)."""
        for stage in range(STAGES):
            for block in range(BLOCKS_PER_STAGE):
                stride = 2 if stage > 0 and block == 0 else 1
                yield f"layer{stage + 1}_{block}", width * 2**stage, stride

    def __call__(
        self, x: jax.Array, *, train: bool, input_mix: jax.Array | None = None
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Feature map and named intermediates.

        Args:
          x: [B, H, W, C].
          train: batch statistics from this batch (and update the running ones) or running ones.
          input_mix: [C, C], a 1x1 convolution without bias to be applied to `x` first. It is
            multiplied into the stem's kernel: exact also at the border, where both pad with zeros.
        """
        kernel = self.conv1.kernel[...]
        if input_mix is not None:
            kernel = jnp.einsum("ij,hwjo->hwio", input_mix, kernel)
        out = {"stem": self.norm1(stem_convolution(x, kernel), train=train)}
        x = jax.nn.relu(max_pool(out["stem"]))  # commute, and this way ReLU sees a quarter
        for name, _, _ in self._blocks(self.width):
            x = out[name] = getattr(self, name)(x, train=train)
        return x, out


class CoordConv(nnx.Module):
    """Append the pixel's x and y in [-1, 1], 1x1 convolution, ReLU, 1x1 convolution (no biases).

    Returns the activations after the ReLU [B, H, W, C] and the second kernel [C, C], which the
    trunk multiplies into its stem.
    """

    def __init__(self, channels: int = 3, *, normals: Normals):
        self.expand = nnx.Param(normals((channels + 2, channels), channels + 2))
        self.mix = nnx.Param(normals((channels, channels), channels))

    def __call__(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, h, w, c = x.shape
        kernel = self.expand[...].astype(x.dtype)
        cols, rows = jnp.meshgrid(jnp.linspace(-1.0, 1.0, w), jnp.linspace(-1.0, 1.0, h))
        grid = jnp.stack([cols, rows], axis=-1).astype(x.dtype)
        return jax.nn.relu(x @ kernel[:c] + grid @ kernel[c:]), self.mix[...]


class Encoder(nnx.Module):
    """One view's images [B, H, W, 3] -> embedding [B, embed] and named intermediates."""

    def __init__(self, *, width: int, norm: str, coord_conv: bool, embed: int, normals: Normals):
        self.coord = CoordConv(normals=normals) if coord_conv else None
        self.trunk = ResNet18(width=width, norm=norm, normals=normals)
        self.project = Linear(8 * width, embed, normals=normals)

    def __call__(self, images: jax.Array, *, train: bool) -> tuple[jax.Array, dict[str, jax.Array]]:
        x, mix = (images, None) if self.coord is None else self.coord(images)
        features, out = self.trunk(x, train=train, input_mix=mix)
        out["pooled"] = features.astype(jnp.float32).mean((1, 2))
        out["embedding"] = self.project(out["pooled"].astype(images.dtype))
        return out["embedding"], out


class Policy(nnx.Module):
    """Images of every view and proprioception -> action, all normalised.

    One encoder per view, not shared; the head's input is the views' embeddings in the order of
    `views`, then the proprioception.
    """

    def __init__(
        self,
        *,
        views: Sequence[str],
        proprio_dim: int,
        action_dim: int = 10,
        width: int = 16,
        norm: str = "group",
        coord_conv: bool = True,
        embed: int = 64,
        hidden: Sequence[int] = (1024, 1024),
        dtype: Any = jnp.float32,
        normals: Normals,
    ):
        if norm not in NORMS:
            raise ValueError(f"norm is {norm!r}; known: {', '.join(NORMS)}")
        if width < 1:
            raise ValueError(f"width is {width}; expected at least 1")
        if not views:
            raise ValueError("no views: a policy needs at least one image")
        self.views = tuple(views)
        self.dtype = dtype
        self.encoders = nnx.Dict(
            {
                view: Encoder(
                    width=width, norm=norm, coord_conv=coord_conv, embed=embed, normals=normals
                )
                for view in self.views
            }
        )
        sizes = (embed * len(self.views) + proprio_dim, *hidden)
        self.head = nnx.Dict(
            {
                f"layer{i}": Linear(sizes[i], sizes[i + 1], normals=normals)
                for i in range(len(hidden))
            },
            output=Linear(sizes[-1], action_dim, normals=normals),
        )
        self.depth = len(hidden)

    def __call__(
        self, images: Mapping[str, jax.Array], proprio: jax.Array, *, train: bool
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Predict actions.

        Args:
          images: view -> [B, H, W, 3] float, normalised by channel.
          proprio: [B, P] in [-1, 1].
          train: use (and update) the batch's statistics where the norm is "batch".

        Returns:
          actions [B, action_dim] in normalised units, float32, and the named intermediates
          "VIEW/stem", "VIEW/layer1_0", ..., "VIEW/pooled", "VIEW/embedding", "features",
          "hidden0", ...: unused ones cost nothing under `jit`.
        """
        out: dict[str, jax.Array] = {}
        embeddings = []
        for view in self.views:
            embedding, inner = self.encoders[view](images[view].astype(self.dtype), train=train)
            embeddings.append(embedding)
            out.update({f"{view}/{name}": value for name, value in inner.items()})
        x = jnp.concatenate([*embeddings, proprio.astype(self.dtype)], axis=-1)
        out["features"] = x
        for i in range(self.depth):
            x = out[f"hidden{i}"] = jax.nn.relu(self.head[f"layer{i}"](x))
        return self.head["output"](x).astype(jnp.float32), out


@dataclasses.dataclass(frozen=True)
class Network:
    """A network as two pure functions of pure dicts."""

    init: Callable[[jax.Array], tuple[Params, Params]]
    """key -> (params, batch_stats)."""
    apply: Callable[..., tuple[jax.Array, dict[str, jax.Array], Params]]
    """(params, batch_stats, images, proprio, *, train) -> (actions, intermediates, batch_stats)."""


def _arrays(module: nnx.Module) -> tuple[Params, Params]:
    """Parameters and running statistics as pure nested dicts."""
    params, stats = (
        nnx.to_pure_dict(state) for state in nnx.split(module, nnx.Param, nnx.BatchStat)[1:]
    )
    return params, stats


def make_network(**options: Any) -> Network:
    """Pure functions around a `Policy`; `options` are its keyword arguments, all but `normals`."""
    # Only shapes: allocates and computes nothing, and raises on wrong options here and now.
    counter = Normals()
    abstract = nnx.eval_shape(lambda: Policy(**options, normals=counter))
    graph = nnx.split(abstract, nnx.Param, nnx.BatchStat)[0]
    total = counter.used

    def init(key: jax.Array) -> tuple[Params, Params]:
        return _arrays(Policy(**options, normals=Normals(jax.random.normal(key, (total,)))))

    def apply(
        params: Params,
        batch_stats: Params,
        images: Mapping[str, jax.Array],
        proprio: jax.Array,
        *,
        train: bool,
    ) -> tuple[jax.Array, dict[str, jax.Array], Params]:
        policy = nnx.merge(graph, params, batch_stats)
        actions, out = policy(images, proprio, train=train)
        return actions, out, nnx.to_pure_dict(nnx.state(policy, nnx.BatchStat))

    return Network(init, apply)


@dataclasses.dataclass(frozen=True)
class PretrainedTrunk:
    """Weights of a ResNet-18 of width 64 with batch norm, as read from a file; a pytree."""

    params: Params
    batch_stats: Params
    sha256: str
    """Of the whole file: belongs into the run's record."""
    source: str
    """The file's name."""


jax.tree_util.register_dataclass(
    PretrainedTrunk, data_fields=["params", "batch_stats"], meta_fields=["sha256", "source"]
)


def load_torchvision_resnet18(path: str | Path) -> PretrainedTrunk:
    """Read torchvision's ResNet-18 weights from `.pth` / `.pt` / `.safetensors`, without torch.

    Nothing in the file is executed: see `torch_files`. The classifier (`fc.*`) and the batch
    counters are left out; every other tensor must be there with exactly the expected shape.

    Args:
      path: a state dict with torchvision's names, e.g. saved by
        `torch.save(torchvision.models.resnet18(weights="IMAGENET1K_V1").state_dict(), path)`.

    Raises:
      ValueError: the file cannot be read, or names or shapes differ; the first few are named.
    """
    tensors, digest = torch_files.read_tensors(path)
    template = nnx.eval_shape(lambda: ResNet18(width=64, norm="batch", normals=Normals()))
    problems: list[str] = []
    used: set[str] = set()

    def take(path: Any, leaf: Any) -> np.ndarray:
        name = _torchvision_name([entry.key for entry in path])
        used.add(name)
        if name not in tensors:
            problems.append(f"{name} is missing")
            return np.zeros(leaf.shape, np.float32)
        value = np.asarray(tensors[name], np.float32)
        if value.ndim == 4:
            value = value.transpose(2, 3, 1, 0)  # OIHW -> HWIO
        if value.shape != leaf.shape:
            problems.append(f"{name} has shape {tensors[name].shape}, not that of a ResNet-18")
        elif not np.isfinite(value).all():
            problems.append(f"{name} has non-finite values")
        return np.ascontiguousarray(value)

    params, stats = (jax.tree.map_with_path(take, tree) for tree in _arrays(template))
    extra = sorted(
        name
        for name in set(tensors) - used
        if not name.startswith("fc.") and not name.endswith("num_batches_tracked")
    )
    problems += [f"{name} is not a ResNet-18's" for name in extra]
    if problems:
        more = f" (and {len(problems) - 5} more)" if len(problems) > 5 else ""
        raise ValueError(
            f"{path}: expected the state dict of torchvision's resnet18: "
            + "; ".join(problems[:5])
            + more
        )
    return PretrainedTrunk(params, stats, digest, Path(path).name)


def _torchvision_name(path: Sequence[str]) -> str:
    """("layer2_0", "shortcut_norm", "mean") -> "layer2.0.downsample.1.running_mean"."""
    *modules, leaf = path
    is_norm = "norm" in modules[-1]
    leaf_name = {
        "kernel": "weight",
        "scale": "weight",
        "bias": "bias",
        "mean": "running_mean",
        "var": "running_var",
    }[leaf]
    module = {
        "shortcut": "downsample.0",
        "shortcut_norm": "downsample.1",
    }.get(modules[-1], modules[-1].replace("norm", "bn") if is_norm else modules[-1])
    outer = [name.replace("_", ".") for name in modules[:-1]]
    return ".".join([*outer, module, leaf_name])


def with_trunk(
    params: Params, batch_stats: Params, trunk: PretrainedTrunk
) -> tuple[Params, Params]:
    """Copies of `params` and `batch_stats` with the trunk of every view's encoder replaced.

    CoordConv, projection and head keep their values: the released code trains them from scratch
    too, with the encoder's learning rate.

    Raises:
      ValueError: the network is not of width 64 with batch norm, which these weights need.
    """

    def replaced(tree: Params, new: Params, what: str) -> Params:
        encoders = {}
        for view, encoder in tree["encoders"].items():
            old_shapes = jax.tree.map(jnp.shape, encoder["trunk"])
            if old_shapes != jax.tree.map(jnp.shape, new):
                raise ValueError(
                    f"{what} of the trunk for view {view!r} do not fit the imported ResNet-18: "
                    'it needs width=64 and norm="batch"'
                )
            encoders[view] = {**encoder, "trunk": jax.tree.map(jnp.asarray, new)}
        return {**tree, "encoders": encoders}

    if "encoders" not in batch_stats:
        raise ValueError('the network has no batch statistics: imported weights need norm="batch"')
    return (
        replaced(params, trunk.params, "parameters"),
        replaced(batch_stats, trunk.batch_stats, "batch statistics"),
    )
