"""Alignment and augmentation by OpenCV, torchvision and kornia.

Each operation takes a batch of NumPy arrays as its package wants them (conversion is not timed) and
does what ours does: the same window, the same corners, the same strokes as far as the package can
draw them. `bench_align` compares the pictures before it compares the speed.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from benchmarks.peers import imported

Operation = Callable[[], Any]

_COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


class Inputs(NamedTuple):
    """A batch of B images, and where the TCP is."""

    frames: np.ndarray  # uint8 [B, 512, 512, 3]
    small: np.ndarray  # float32 [B, 84, 84, 3] in 0..1
    backgrounds: np.ndarray  # float32 [B, 84, 84, 3]
    corners: np.ndarray  # float32 [B, 4, 2] (u, v): where the corners of `small` go
    points: np.ndarray  # float32 [B, 4, 2] (u, v) in `frames`: TCP, tips of its axes
    rotation: np.ndarray  # float32 [B, 3, 3] of the TCP in the camera frame
    height: np.ndarray  # float32 [B] of the TCP
    origin: np.ndarray  # int [B, 2] (row, column) of the window round the TCP
    crop: int
    size: int

    @property
    def outer(self) -> np.ndarray:
        """[4, 2] corners (u, v) of `small`."""
        return outer_corners(self.small.shape[1])


def outer_corners(side: int) -> np.ndarray:
    """[4, 2] corners (u, v) of a square image, clockwise from the top left."""
    return np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)


def peers(inputs: Inputs) -> dict[str, dict[str, Operation]]:
    """Operations by package and name; each returns images [B, H, W, 3] (or [B, 3, H, W]), or a
    pair of them and the proprioception [B, 8]."""
    found = {}
    for name, modules, build in (
        ("opencv", ("cv2",), _opencv),
        ("torchvision", ("torch", "torchvision.transforms.v2.functional"), _torchvision),
        ("kornia", ("torch", "kornia"), _kornia),
    ):
        ready = imported(name, *modules)
        if ready is not None:
            found[name] = build(*ready, inputs)
    return found


def proprio(inputs: Inputs) -> np.ndarray:
    """[B, 8]: two columns of the rotation, height, gripper."""
    columns = inputs.rotation[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    return np.concatenate(
        [columns, inputs.height[:, None], np.ones((len(columns), 1), np.float32)], 1
    )


# -- OpenCV: an image at a time, one thread a core -------------------------------------------------


def _opencv(cv2: Any, inputs: Inputs) -> dict[str, Operation]:
    cv2.setNumThreads(1)  # images are too small to be divided; whole images are spread over threads
    threads = ThreadPoolExecutor(os.cpu_count())
    batch, outer = len(inputs.frames), inputs.outer

    def each(one: Callable[[int], np.ndarray], into: np.ndarray) -> Operation:
        pieces = np.array_split(np.arange(batch), os.cpu_count() or 1)

        def some(indices: np.ndarray) -> None:
            for i in indices:
                into[i] = one(i)

        def call() -> np.ndarray:
            list(threads.map(some, pieces))
            return into

        return call

    def window(i: int) -> np.ndarray:
        row, column = inputs.origin[i]
        return inputs.frames[i, row : row + inputs.crop, column : column + inputs.crop]

    def aligned(i: int) -> np.ndarray:
        image = np.ascontiguousarray(window(i))
        points = np.floor(inputs.points[i]).astype(int) - inputs.origin[i][::-1]
        for tip, colour in zip(points[1:], _COLOURS, strict=True):
            arrow = 10.0 / max(float(np.hypot(*(tip - points[0]))), 1.0)
            cv2.arrowedLine(image, points[0].tolist(), tip.tolist(), colour, 2, tipLength=arrow)
        cv2.circle(image, points[0].tolist(), 5, (0, 0, 0), -1)
        return cv2.resize(image, (inputs.size, inputs.size), interpolation=cv2.INTER_LINEAR)

    def warped(i: int) -> np.ndarray:
        matrix = cv2.getPerspectiveTransform(outer - 0.5, inputs.corners[i] - 0.5)
        return cv2.warpPerspective(inputs.small[i], matrix, inputs.small.shape[2:0:-1])

    whole = each(aligned, np.zeros((batch, inputs.size, inputs.size, 3), np.uint8))
    return {
        "tcp_crop": each(window, np.zeros((batch, inputs.crop, inputs.crop, 3), np.uint8)),
        "align": lambda: (whole(), proprio(inputs)),
        "perspective": each(warped, np.zeros_like(inputs.small)),
        "overlay": each(
            lambda i: cv2.addWeighted(inputs.small[i], 0.5, inputs.backgrounds[i], 0.5, 0.0),
            np.zeros_like(inputs.small),
        ),
    }


# -- PyTorch, channels first -----------------------------------------------------------------------


def _channels_first(torch: Any, images: np.ndarray) -> Any:
    return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2)))


def _torch_windows(torch: Any, inputs: Inputs) -> Operation:
    frames = _channels_first(torch, inputs.frames)

    def call() -> Any:
        size = inputs.crop
        return torch.stack(
            [
                frame[:, row : row + size, column : column + size]
                for frame, (row, column) in zip(frames, inputs.origin.tolist(), strict=True)
            ]
        )

    return call


def _torchvision(torch: Any, functional: Any, inputs: Inputs) -> dict[str, Operation]:
    small, backgrounds = (_channels_first(torch, x) for x in (inputs.small, inputs.backgrounds))
    inwards = np.where(inputs.outer > 0, 1, 0)  # torchvision names the corners' pixel centres
    starts = (inputs.outer - inwards).astype(int).tolist()
    ends = np.round(inputs.corners - inwards).astype(int).tolist()

    def warped() -> Any:
        return torch.stack(
            [
                functional.perspective(
                    image, starts, end, functional.InterpolationMode.BILINEAR, fill=0
                )
                for image, end in zip(small, ends, strict=True)
            ]
        )

    return {
        "tcp_crop": _torch_windows(torch, inputs),
        "perspective": warped,
        "overlay": lambda: torch.lerp(small, backgrounds, 0.5),
    }


def _kornia(torch: Any, kornia: Any, inputs: Inputs) -> dict[str, Operation]:
    small, backgrounds = (_channels_first(torch, x) for x in (inputs.small, inputs.backgrounds))
    outer = torch.from_numpy(np.repeat(inputs.outer[None] - 0.5, len(small), 0))
    corners = torch.from_numpy(inputs.corners - 0.5)
    size = tuple(inputs.small.shape[1:3])

    def warped() -> Any:
        matrix = kornia.geometry.get_perspective_transform(outer, corners)
        return kornia.geometry.warp_perspective(small, matrix, size)

    return {
        "tcp_crop": _torch_windows(torch, inputs),
        "perspective": warped,
        "overlay": lambda: kornia.enhance.add_weighted(small, 0.5, backgrounds, 0.5, 0.0),
    }
