"""The training step of `bench_train` in PyTorch: same network, loss, optimiser, augmentation."""

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.peers import imported

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Setting(NamedTuple):
    """What both packages train."""

    images: np.ndarray  # uint8 [N, S, S, 3]
    proprio: np.ndarray  # float32 [N, P], normalised
    actions: np.ndarray  # float32 [N, A], normalised
    bank: np.ndarray  # uint8 [K, S, S, 3]
    width: int
    crop: int
    embed: int
    hidden: tuple[int, ...]
    batch_size: int
    learning_rate: float
    grad_clip: float
    distortion: float  # of the perspective, half of the batch
    proprio_noise: float


class Step(NamedTuple):
    """A training step, and how large the network is."""

    call: Callable[[], float]  # one update; the loss
    parameters: int


def peers(setting: Setting) -> dict[str, Step]:
    """By package: PyTorch, if it is installed."""
    ready = imported("pytorch", "torch")
    return {} if ready is None else {"pytorch": _pytorch(*ready, setting)}


def _pytorch(torch: Any, setting: Setting) -> Step:
    torch.manual_seed(0)
    torch.set_num_threads(os.cpu_count() or 1)
    policy = _policy(torch, setting).to(memory_format=torch.channels_last)
    optimiser = torch.optim.Adam(policy.parameters(), lr=setting.learning_rate, fused=True)
    images = torch.from_numpy(setting.images).permute(0, 3, 1, 2)
    bank = torch.from_numpy(setting.bank.copy()).permute(0, 3, 1, 2).float() / 255
    proprio, actions = torch.from_numpy(setting.proprio), torch.from_numpy(setting.actions)

    def step() -> float:
        chosen = torch.randperm(len(images))[: setting.batch_size]
        seen = _augmented(torch, images[chosen].float() / 255, bank, setting)
        state = proprio[chosen]
        state = state + setting.proprio_noise * torch.randn_like(state)
        loss = torch.nn.functional.mse_loss(policy(seen, state), actions[chosen])
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), setting.grad_clip)
        optimiser.step()
        return float(loss.detach())

    return Step(step, sum(p.numel() for p in policy.parameters()))


# -- augmentation: perspective, overlay, normalisation, crop ---------------------------------------


def _augmented(torch: Any, images: Any, bank: Any, setting: Setting) -> Any:
    images = _perspective(torch, images, setting.distortion)
    count = len(images) // 2
    blended = torch.randperm(len(images))[:count]
    drawn = torch.randint(len(bank), (count,))
    images[blended] = torch.lerp(images[blended], bank[drawn], 0.5)
    mean, deviation = (torch.tensor(x).view(1, 3, 1, 1) for x in (_MEAN, _DEVIATION))
    images = (images - mean) / deviation
    slack, size = images.shape[-1] - setting.crop, setting.crop
    corners = torch.randint(0, slack + 1, (len(images), 2)).tolist()
    crops = [
        image[:, v : v + size, u : u + size] for image, (v, u) in zip(images, corners, strict=True)
    ]
    return torch.stack(crops).contiguous(memory_format=torch.channels_last)


def _perspective(torch: Any, images: Any, distortion: float) -> Any:
    """Half of the images, on average, with their corners moved inwards."""
    chosen = torch.nonzero(torch.rand(len(images)) < 0.5)[:, 0]
    side, count = images.shape[-1], len(chosen)
    outer = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    moved = outer - outer * distortion * torch.rand(count, 4, 2)
    # The homography from where pixels go to where they come from: eight equations an image.
    x, y, u, v = moved[..., 0], moved[..., 1], outer[:, 0].expand(count, 4), outer[:, 1]
    v, one, zero = v.expand(count, 4), torch.ones(count, 4), torch.zeros(count, 4)
    rows = torch.cat(
        [
            torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y], -1),
            torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y], -1),
        ],
        1,
    )
    solved = torch.linalg.solve(rows, torch.cat([u, v], 1))
    matrix = torch.cat([solved, torch.ones(count, 1)], 1).view(count, 3, 3)
    centres = (torch.arange(side) + 0.5) * (2 / side) - 1
    down, across = torch.meshgrid(centres, centres, indexing="ij")
    points = torch.stack([across, down, torch.ones_like(down)], -1).view(-1, 3)
    sources = points @ matrix.transpose(1, 2)
    grid = (sources[..., :2] / sources[..., 2:]).view(count, side, side, 2)
    warped = torch.nn.functional.grid_sample(images[chosen], grid, align_corners=False)
    return images.index_copy(0, chosen, warped)


# -- the network -----------------------------------------------------------------------------------


def _policy(torch: Any, setting: Setting) -> Any:
    """CoordConv, ResNet-18 with GroupNorm, projection, MLP: as `palm_jax.train.model`."""
    nn, width = torch.nn, setting.width

    def norm(channels: int) -> Any:
        return nn.GroupNorm(channels // max(width // 4, 1), channels)

    def conv(inputs: int, outputs: int, size: int, stride: int = 1) -> Any:
        return nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)

    class Block(nn.Module):
        def __init__(self, inputs: int, outputs: int, stride: int) -> None:
            super().__init__()
            self.body = nn.Sequential(
                conv(inputs, outputs, 3, stride),
                norm(outputs),
                nn.ReLU(inplace=True),
                conv(outputs, outputs, 3),
                norm(outputs),
            )
            self.short = (
                nn.Identity()
                if stride == 1 and inputs == outputs
                else nn.Sequential(conv(inputs, outputs, 1, stride), norm(outputs))
            )

        def forward(self, x: Any) -> Any:
            return torch.relu(self.body(x) + self.short(x))

    class Policy(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            centres = torch.linspace(-1.0, 1.0, setting.crop)
            rows, columns = torch.meshgrid(centres, centres, indexing="ij")
            self.register_buffer("grid", torch.stack([columns, rows])[None])
            blocks, inputs = [], width
            for stage in range(4):
                for block in range(2):
                    outputs = width * 2**stage
                    blocks.append(Block(inputs, outputs, 2 if stage and not block else 1))
                    inputs = outputs
            self.trunk = nn.Sequential(
                conv(5, 3, 1),
                nn.ReLU(inplace=True),
                conv(3, 3, 1),
                conv(3, width, 7, 2),
                norm(width),
                nn.ReLU(inplace=True),
                nn.MaxPool2d(3, 2, 1),
                *blocks,
                nn.AdaptiveAvgPool2d(1),
                nn.Flatten(),
                nn.Linear(inputs, setting.embed),
            )
            sizes = (setting.embed + setting.proprio.shape[1], *setting.hidden)
            layers: list[Any] = []
            for one, other in zip(sizes[:-1], sizes[1:], strict=True):
                layers += [nn.Linear(one, other), nn.ReLU(inplace=True)]
            self.head = nn.Sequential(*layers, nn.Linear(sizes[-1], setting.actions.shape[1]))

        def forward(self, images: Any, proprio: Any) -> Any:
            grid = self.grid.expand(len(images), -1, -1, -1)
            features = self.trunk(torch.cat([images, grid], 1))
            return self.head(torch.cat([features, proprio], 1))

    return Policy()
