"""The network against NumPy, and the import of weights without torch.

The oracles below work on torch's layout (NCHW, OIHW) with explicit loops over the kernel, in
float64; they share nothing with the package.
"""

import io
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from palm_jax.train import model
from palm_jax.train.files import torch as torch_files

Array = np.ndarray


# ---------------------------------------------------------------------------------------- oracles


def conv_np(x: Array, weight: Array, stride: int, pad: int) -> Array:
    """x [B, I, H, W], weight [O, I, h, w]."""
    x = np.pad(x.astype(np.float64), ((0, 0), (0, 0), (pad, pad), (pad, pad)))
    size = weight.shape[2]
    rows = (x.shape[2] - size) // stride + 1
    columns = (x.shape[3] - size) // stride + 1
    out = np.zeros((x.shape[0], weight.shape[0], rows, columns))
    for i in range(size):
        for j in range(size):
            part = x[:, :, i : i + stride * rows : stride, j : j + stride * columns : stride]
            out += np.einsum("bihw,oi->bohw", part, weight[:, :, i, j].astype(np.float64))
    return out


def pool_np(x: Array) -> Array:
    padded = np.pad(x, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    rows, columns = ((n - 1) // 2 + 1 for n in x.shape[2:])
    out = np.empty((*x.shape[:2], rows, columns))
    for i in range(rows):
        for j in range(columns):
            window = padded[:, :, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3]
            out[:, :, i, j] = window.max(axis=(2, 3))
    return out


def batch_norm_np(x: Array, state: dict[str, Array], name: str) -> Array:
    def of(entry: str) -> Array:
        return state[f"{name}.{entry}"].astype(np.float64)[:, None, None]

    normal = (x - of("running_mean")) / np.sqrt(of("running_var") + 1e-5)
    return normal * of("weight") + of("bias")


def block_np(x: Array, state: dict[str, Array], name: str, stride: int) -> Array:
    y = conv_np(x, state[f"{name}.conv1.weight"], stride, 1)
    y = np.maximum(batch_norm_np(y, state, f"{name}.bn1"), 0)
    y = batch_norm_np(conv_np(y, state[f"{name}.conv2.weight"], 1, 1), state, f"{name}.bn2")
    if f"{name}.downsample.0.weight" in state:
        x = conv_np(x, state[f"{name}.downsample.0.weight"], stride, 0)
        x = batch_norm_np(x, state, f"{name}.downsample.1")
    return np.maximum(x + y, 0)


def group_norm_np(x: Array, scale: Array, bias: Array, groups: int) -> Array:
    b, h, w, c = x.shape
    split = x.astype(np.float64).reshape(b, h, w, groups, c // groups)
    mean = split.mean(axis=(1, 2, 4), keepdims=True)
    var = split.var(axis=(1, 2, 4), keepdims=True)
    return ((split - mean) / np.sqrt(var + 1e-5)).reshape(x.shape) * scale + bias


def nchw(x: Any) -> Array:
    return np.asarray(x).transpose(0, 3, 1, 2)


def nhwc(x: Array) -> Array:
    return x.transpose(0, 2, 3, 1)


def normal(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


# ------------------------------------------------------------------------------------------ parts


@pytest.mark.parametrize(("height", "width"), [(12, 12), (11, 14), (7, 9)])
def test_stem_convolution(height: int, width: int) -> None:
    x, kernel = normal(0, 2, height, width, 3), normal(1, 7, 7, 3, 5)
    expected = conv_np(nchw(x), kernel.transpose(3, 2, 0, 1), 2, 3)
    result = model.stem_convolution(jnp.asarray(x), jnp.asarray(kernel))
    np.testing.assert_allclose(nchw(result), expected, atol=2e-4)


@pytest.mark.parametrize(("height", "width"), [(8, 8), (7, 10), (1, 3)])
def test_max_pool_and_its_gradient(height: int, width: int) -> None:
    x = normal(0, 2, height, width, 3)
    result, pull = jax.vjp(model.max_pool, jnp.asarray(x))
    np.testing.assert_array_equal(nchw(result), pool_np(nchw(x)))

    weights = normal(1, *result.shape)
    expected = np.zeros_like(x)  # each output's weight goes to the one input that is its maximum
    for index in np.ndindex(result.shape):
        b, i, j, c = index
        row = [n for n in (2 * i - 1, 2 * i, 2 * i + 1) if 0 <= n < height]
        column = [n for n in (2 * j - 1, 2 * j, 2 * j + 1) if 0 <= n < width]
        _, r, s = max((x[b, r, s, c], r, s) for r in row for s in column)
        expected[b, r, s, c] += weights[index]
    np.testing.assert_allclose(pull(jnp.asarray(weights))[0], expected, atol=1e-6)


def _average(groups: int, channels: int, pixels: int) -> Array:
    size = channels // groups
    same = np.arange(channels)[:, None] // size == np.arange(channels)[None, :] // size
    return (same / (pixels * size)).astype(np.float32)


def test_group_norm_and_its_gradient() -> None:
    x, scale, bias = 2 * normal(0, 3, 5, 4, 8) + 1, normal(1, 8), normal(2, 8)
    average = _average(4, 8, 20)
    result = model.group_norm(x, scale, bias, average)
    np.testing.assert_allclose(result, group_norm_np(x, scale, bias, 4), atol=1e-4)

    def f(x: jax.Array, scale: jax.Array, bias: jax.Array) -> jax.Array:
        return model.group_norm(x, scale, bias, average)

    check_grads(f, (x, scale, bias), order=1, modes=["rev"], eps=1e-2, atol=2e-2, rtol=2e-2)


def test_norm_of_a_constant_image_is_finite() -> None:
    x = jnp.full((2, 4, 4, 8), 3.0)
    y, pull = jax.vjp(
        lambda x: model.group_norm(x, jnp.ones(8), jnp.full(8, 0.5), _average(2, 8, 16)), x
    )
    np.testing.assert_allclose(y, 0.5, atol=1e-2)
    assert np.isfinite(pull(jnp.ones_like(y))[0]).all()


def test_batch_norm_statistics() -> None:
    """Normalises by the batch in training, and keeps torch's running statistics."""
    norm = model.BatchNorm(3)
    x = normal(0, 4, 5, 6, 3) * np.array([1, 2, 3], np.float32) + 1
    result = norm(jnp.asarray(x), train=True)
    flat = x.reshape(-1, 3).astype(np.float64)
    np.testing.assert_allclose(
        np.asarray(result).reshape(-1, 3),
        (flat - flat.mean(0)) / np.sqrt(flat.var(0) + 1e-5),
        atol=1e-4,
    )
    np.testing.assert_allclose(norm.mean[...], 0.1 * flat.mean(0), rtol=1e-5)
    np.testing.assert_allclose(norm.var[...], 0.9 + 0.1 * flat.var(0, ddof=1), rtol=1e-5)
    still = norm(jnp.asarray(x), train=False)
    mean, var = 0.1 * flat.mean(0), 0.9 + 0.1 * flat.var(0, ddof=1)
    np.testing.assert_allclose(
        np.asarray(still).reshape(-1, 3), (flat - mean) / np.sqrt(var + 1e-5), atol=1e-4
    )


# ---------------------------------------------------------------------------------------- network


def small(**changes: Any) -> dict[str, Any]:
    options: dict[str, Any] = {
        "views": ("front",), "proprio_dim": 8, "width": 8, "embed": 6, "hidden": (12, 7),
    }  # fmt: skip
    return {**options, **changes}


def count(tree: Any) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


def test_size_and_initialisation_of_the_paper_network() -> None:
    network = model.make_network(**small(width=64, norm="batch", embed=64, hidden=(1024, 1024)))
    params, stats = jax.jit(network.init)(jax.random.key(0))
    encoder = params["encoders"]["front"]
    # torchvision's resnet18 has 11 689 512 parameters, of which its classifier 512 x 1000 + 1000.
    assert count(encoder["trunk"]) == 11_689_512 - 513_000
    # 20 batch norms, a mean and a variance each: 64 x 5 + 128 x 5 + 256 x 5 + 512 x 5 channels.
    assert count(stats) == 2 * (64 * 5 + 128 * 5 + 256 * 5 + 512 * 5)
    assert count(encoder["coord"]) == 5 * 3 + 3 * 3
    assert params["head"]["layer0"]["kernel"].shape == (72, 1024)
    for kernel, fan in (
        (encoder["trunk"]["conv1"]["kernel"], 7 * 7 * 64),  # fan-out
        (encoder["trunk"]["layer3_0"]["conv1"]["kernel"], 9 * 256),
        (encoder["project"]["kernel"], 512),  # fan-in
        (params["head"]["layer1"]["kernel"], 1024),
    ):
        np.testing.assert_allclose(np.std(kernel), np.sqrt(2 / fan), rtol=0.05)
        assert abs(np.mean(kernel)) < 5 * np.std(kernel) / np.sqrt(kernel.size)
    assert not np.any(params["head"]["layer1"]["bias"])
    other, _ = jax.jit(network.init)(jax.random.key(1))
    assert not np.array_equal(other["head"]["output"]["kernel"], params["head"]["output"]["kernel"])


def test_shapes_and_names_of_the_intermediates() -> None:
    network = model.make_network(**small(views=("front", "wrist"), width=16))
    images = {
        view: jax.ShapeDtypeStruct((2, 76, 76, 3), jnp.float32) for view in ("front", "wrist")
    }
    proprio = jax.ShapeDtypeStruct((2, 8), jnp.float32)
    params, stats = jax.eval_shape(network.init, jax.eval_shape(lambda: jax.random.key(0)))

    def forward(*arguments: Any) -> Any:
        return network.apply(*arguments, train=False)

    actions, out, _ = jax.eval_shape(forward, params, stats, images, proprio)
    assert actions.shape == (2, 10)
    sides = {"stem": 38, "layer1_1": 19, "layer2_1": 10, "layer3_0": 5, "layer4_1": 3}
    for name, side in sides.items():
        channels = 16 * 2 ** max(int(name[5]) - 1, 0) if name.startswith("layer") else 16
        assert out[f"wrist/{name}"].shape == (2, side, side, channels)
    assert out["front/pooled"].shape == (2, 128)
    assert out["features"].shape == (2, 6 + 6 + 8)
    assert out["hidden1"].shape == (2, 7)
    assert set(params["encoders"]) == {"front", "wrist"}  # not shared


@pytest.fixture(scope="module")
def forward() -> Callable[..., Any]:
    """A compiled network in evaluation mode, its parameters, and inputs."""
    network = model.make_network(**small())
    params, stats = jax.jit(network.init)(jax.random.key(3))
    images, proprio = normal(0, 2, 20, 20, 3), normal(1, 2, 8)
    apply = jax.jit(lambda p, x, q: network.apply(p, stats, {"front": x}, q, train=False)[:2])
    return lambda: (apply, params, images, proprio)


def test_coord_conv_and_head_in_numpy(forward: Callable[..., Any]) -> None:
    apply, params, images, proprio = forward()
    actions, out = apply(params, images, proprio)
    encoder = jax.tree.map(np.asarray, params["encoders"]["front"])
    # CoordConv: two 1x1 convolutions in front of the stem, which the network folds into it.
    line = np.linspace(-1, 1, 20)
    grid = np.broadcast_to(np.stack(np.meshgrid(line, line), axis=-1), (2, 20, 20, 2))
    x = np.maximum(np.concatenate([images, grid], axis=-1) @ encoder["coord"]["expand"], 0)
    x = nchw(x @ encoder["coord"]["mix"])
    stem = nhwc(conv_np(x, encoder["trunk"]["conv1"]["kernel"].transpose(3, 2, 0, 1), 2, 3))
    stem = group_norm_np(stem, np.ones(8), np.zeros(8), 4)
    np.testing.assert_allclose(out["front/stem"], stem, atol=1e-3)
    # Everything behind the trunk.
    pooled = np.asarray(out["front/layer4_1"]).mean(axis=(1, 2))
    embedding = pooled @ encoder["project"]["kernel"] + encoder["project"]["bias"]
    x = np.concatenate([embedding, proprio], axis=-1)
    for name in ("layer0", "layer1", "output"):
        layer = params["head"][name]
        x = x @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"])
        x = np.maximum(x, 0) if name != "output" else x
    np.testing.assert_allclose(actions, x, rtol=1e-4, atol=1e-4)


def test_samples_do_not_mix_and_position_matters(forward: Callable[..., Any]) -> None:
    apply, params, images, proprio = forward()
    actions, _ = apply(params, images, proprio)
    swapped, _ = apply(params, images[::-1], proprio[::-1])
    np.testing.assert_allclose(swapped[::-1], actions, atol=1e-5)
    _, out = apply(params, np.zeros_like(images), proprio)
    assert np.std(np.asarray(out["front/stem"])[0, 4:-4, 4:-4]) > 1e-3  # CoordConv's doing


def test_bfloat16_is_close(forward: Callable[..., Any]) -> None:
    apply, params, images, proprio = forward()
    network = model.make_network(**small(dtype=jnp.bfloat16))
    run = jax.jit(lambda p, x, q: network.apply(p, {}, {"front": x}, q, train=False)[:2])
    actions, rough = run(params, images, proprio)
    assert actions.dtype == jnp.float32
    # Behind the second stage: at the end of so small a network, norms are over two numbers.
    assert rough["front/layer2_1"].dtype == jnp.bfloat16
    exact = np.asarray(apply(params, images, proprio)[1]["front/layer2_1"])
    error = np.asarray(rough["front/layer2_1"], np.float32) - exact
    assert 0 < np.sqrt(np.mean(error**2)) < 0.03 * np.sqrt(np.mean(exact**2))


def test_wrong_options_are_refused() -> None:
    with pytest.raises(ValueError, match="norm is 'layer'; known: batch, group"):
        model.make_network(**small(norm="layer"))
    with pytest.raises(ValueError, match="do not divide into"):
        model.make_network(**small(width=14))
    with pytest.raises(ValueError, match="no views"):
        model.make_network(**small(views=()))


# --------------------------------------------------------------------------------- torch's weights


def torchvision_state() -> dict[str, Array]:
    """A state dict with the names and shapes of torchvision's resnet18, random numbers."""
    rng = np.random.default_rng(5)
    state: dict[str, Array] = {}

    def conv(name: str, outputs: int, inputs: int, size: int) -> None:
        deviation = np.sqrt(2 / (outputs * size * size))
        values = rng.standard_normal((outputs, inputs, size, size), dtype=np.float32)
        state[f"{name}.weight"] = values * np.float32(deviation)

    def norm(name: str, channels: int) -> None:
        for entry in ("weight", "bias", "running_mean", "running_var"):
            values = (
                rng.uniform(0.5, 1.5, channels)
                if entry[-1] in "tr"
                else rng.normal(0, 0.3, channels)
            )
            state[f"{name}.{entry}"] = values.astype(np.float32)
        state[f"{name}.num_batches_tracked"] = np.array(7, np.int64)

    conv("conv1", 64, 3, 7)
    norm("bn1", 64)
    inputs = 64
    for stage, outputs in enumerate((64, 128, 256, 512), start=1):
        for block in range(2):
            name = f"layer{stage}.{block}"
            conv(f"{name}.conv1", outputs, inputs, 3)
            norm(f"{name}.bn1", outputs)
            conv(f"{name}.conv2", outputs, outputs, 3)
            norm(f"{name}.bn2", outputs)
            if inputs != outputs:
                conv(f"{name}.downsample.0", outputs, inputs, 1)
                norm(f"{name}.downsample.1", outputs)
            inputs = outputs
    state["fc.weight"] = np.zeros((1000, 512), np.float32)
    state["fc.bias"] = np.zeros(1000, np.float32)
    return state


class Storage:
    """Stands for a torch storage while a state dict is written."""

    def __init__(self, key: str, values: Array):
        names = {"f": "FloatStorage", "i": "LongStorage"}
        self.key, self.values, self.type = key, values, FAKE_TORCH[names[values.dtype.kind]]


class Tensor:
    """Pickles as torch's tensors do: a call of `torch._utils._rebuild_tensor_v2`."""

    def __init__(self, key: str, values: Array):
        self.storage, self.values = Storage(key, values.ravel(order="K")), values

    def __reduce__(self) -> tuple[Any, ...]:
        strides = tuple(s // self.values.itemsize for s in self.values.strides)
        arguments = (self.storage, 0, self.values.shape, strides, False, OrderedDict())
        return FAKE_TORCH["_rebuild_tensor_v2"], arguments


FAKE_TORCH: dict[str, Any] = {}


@pytest.fixture(scope="module", autouse=True)
def fake_torch() -> Iterator[None]:
    """Modules with the names that `torch.save` writes; pickle insists that they can be imported."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    for name in ("FloatStorage", "LongStorage"):
        FAKE_TORCH[name] = type(name, (), {"__module__": "torch"})
        setattr(torch, name, FAKE_TORCH[name])

    def _rebuild_tensor_v2(*arguments: Any) -> None:
        raise AssertionError("the reader must not call what it finds")

    _rebuild_tensor_v2.__module__ = "torch._utils"
    _rebuild_tensor_v2.__qualname__ = "_rebuild_tensor_v2"
    FAKE_TORCH["_rebuild_tensor_v2"] = _rebuild_tensor_v2
    utils._rebuild_tensor_v2 = _rebuild_tensor_v2  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "torch", torch)
        patch.setitem(sys.modules, "torch._utils", utils)
        yield


class Pickler(pickle.Pickler):
    legacy = False

    def persistent_id(self, item: Any) -> Any:
        if not isinstance(item, Storage):
            return None
        name = ("storage", item.type, item.key, "cpu", item.values.size)
        return (*name, None) if self.legacy else name


class LegacyPickler(Pickler):
    legacy = True


def tensors_of(state: dict[str, Array]) -> OrderedDict[str, Tensor]:
    return OrderedDict((name, Tensor(str(i), v)) for i, (name, v) in enumerate(state.items()))


def write_zip(path: Path, content: Any, storages: list[Storage]) -> Path:
    stream = io.BytesIO()
    Pickler(stream, 2).dump(content)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", stream.getvalue())
        archive.writestr("archive/byteorder", "little")
        for storage in storages:
            archive.writestr(f"archive/data/{storage.key}", storage.values.tobytes())
        archive.writestr("archive/version", "3\n")
    return path


def write_pth(path: Path, state: dict[str, Array]) -> Path:
    tensors = tensors_of(state)
    return write_zip(path, tensors, [tensor.storage for tensor in tensors.values()])


def write_legacy(path: Path, state: dict[str, Array]) -> Path:
    tensors = tensors_of(state)
    with path.open("wb") as file:
        for header in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}):
            pickle.dump(header, file, 2)
        LegacyPickler(file, 2).dump(tensors)
        pickle.dump([tensor.storage.key for tensor in tensors.values()], file, 2)
        for tensor in tensors.values():
            file.write(struct.pack("<q", tensor.storage.values.size))
            file.write(tensor.storage.values.tobytes())
    return path


def write_safetensors(path: Path, state: dict[str, Array]) -> Path:
    import json

    header: dict[str, Any] = {"__metadata__": {"format": "pt"}}
    body = b""
    for name, values in state.items():
        raw = np.ascontiguousarray(values).tobytes()
        header[name] = {
            "dtype": {"f": "F32", "i": "I64"}[values.dtype.kind],
            "shape": list(values.shape),
            "data_offsets": [len(body), len(body) + len(raw)],
        }
        body += raw
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Array], Path]:
    state = torchvision_state()
    return state, write_pth(tmp_path_factory.mktemp("weights") / "resnet18.pth", state)


def test_imported_weights_compute_what_torchs_layout_says(
    weights: tuple[dict[str, Array], Path],
) -> None:
    state, path = weights
    trunk = model.load_torchvision_resnet18(path)
    assert count(trunk.params) == 11_689_512 - 513_000
    network = model.make_network(**small(width=64, norm="batch", coord_conv=False))
    params, stats = model.with_trunk(*jax.jit(network.init)(jax.random.key(0)), trunk)
    images = normal(0, 1, 22, 22, 3)

    @jax.jit
    def run(params: Any, stats: Any) -> Any:
        return network.apply(params, stats, {"front": images}, jnp.zeros((1, 8)), train=False)[1]

    out = run(params, stats)
    x = batch_norm_np(conv_np(nchw(images), state["conv1.weight"], 2, 3), state, "bn1")
    np.testing.assert_allclose(out["front/stem"], nhwc(x), atol=1e-4)
    x = np.maximum(pool_np(x), 0)
    for stage in range(1, 5):  # every tensor of the file, by name
        for block in range(2):
            stride = 2 if stage > 1 and block == 0 else 1
            x = block_np(x, state, f"layer{stage}.{block}", stride)
            result = out[f"front/layer{stage}_{block}"]
            np.testing.assert_allclose(result, nhwc(x), rtol=1e-3, atol=1e-3)


def test_the_hash_is_of_the_file(weights: tuple[dict[str, Array], Path]) -> None:
    import hashlib

    trunk = model.load_torchvision_resnet18(weights[1])
    assert trunk.sha256 == hashlib.sha256(weights[1].read_bytes()).hexdigest()
    assert trunk.source == "resnet18.pth"


def test_weights_for_another_network_are_refused(weights: tuple[dict[str, Array], Path]) -> None:
    trunk = model.load_torchvision_resnet18(weights[1])
    for changes in ({"width": 16, "norm": "batch"}, {"width": 64, "norm": "group"}):
        network = model.make_network(**small(**changes))
        shapes = jax.eval_shape(network.init, jax.eval_shape(lambda: jax.random.key(0)))
        with pytest.raises(ValueError, match='norm="batch"'):
            model.with_trunk(*shapes, trunk)


def test_missing_misshapen_and_foreign_tensors_are_named(tmp_path: Path) -> None:
    state = {name: np.zeros(1, np.float32) for name in ("conv1.weight", "head.bias", "fc.bias")}
    with pytest.raises(ValueError) as caught:
        model.load_torchvision_resnet18(write_pth(tmp_path / "a.pth", state))
    message = str(caught.value)
    assert "conv1.weight has shape (1,)" in message
    assert "is missing" in message
    assert "more)" in message


SMALL_STATE = {
    "a.weight": normal(0, 3, 2, 2, 2),
    "a.bias": normal(1, 3),
    "count": np.array(4, np.int64),
    "turned": normal(2, 4, 5).T,
}


@pytest.mark.parametrize(
    ("write", "suffix"),
    [(write_pth, ".pth"), (write_legacy, ".pth"), (write_safetensors, ".safetensors")],
)
def test_all_formats_read_alike(
    tmp_path: Path, write: Callable[[Path, dict[str, Array]], Path], suffix: str
) -> None:
    path = write(tmp_path / f"state{suffix}", SMALL_STATE)
    tensors, _ = torch_files.read_tensors(path)
    assert list(tensors) == list(SMALL_STATE)
    for name, values in SMALL_STATE.items():
        assert tensors[name].dtype == values.dtype
        np.testing.assert_array_equal(tensors[name], values)
    content = path.read_bytes()
    for cut in (0, 3, 9, len(content) // 2, len(content) - 8):
        path.write_bytes(content[:cut])
        with pytest.raises(ValueError, match="not a readable state dict"):
            torch_files.read_tensors(path)


class Exploit:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("legacy", [False, True])
def test_a_pickle_that_would_run_code_is_refused(tmp_path: Path, legacy: bool) -> None:
    trap = tmp_path / "executed"
    path = tmp_path / "evil.pth"
    if legacy:
        path.write_bytes(pickle.dumps(Exploit(trap), 2))
    else:
        write_zip(path, {"a": Exploit(trap)}, [])
    with pytest.raises(ValueError, match="refused, because unpickling it could run code"):
        torch_files.read_tensors(path)
    assert not trap.exists()


def test_a_tensor_beyond_its_storage_is_refused(tmp_path: Path) -> None:
    tensor = Tensor("0", normal(0, 6))
    tensor.values = np.zeros((2, 6), np.float32)  # shape of twelve numbers on a storage of six
    with pytest.raises(ValueError, match="with strides|beyond its storage|larger than its storage"):
        torch_files.read_tensors(write_zip(tmp_path / "a.pth", {"a": tensor}, [tensor.storage]))
    whole = Tensor("0", normal(0, 6))
    with pytest.raises(ValueError, match="not tensors: b"):
        torch_files.read_tensors(
            write_zip(tmp_path / "b.pth", {"a": whole, "b": 3}, [whole.storage])
        )
