"""Slow references in NumPy (float64) and PIL, written from the facts; nothing from palm_jax.

Conventions as in palm_jax.align: OpenCV camera axes, cam_to_world poses, (u, v) in pixels.
"""

import pathlib

import numpy as np
from PIL import Image, ImageDraw

GOLDEN = pathlib.Path(__file__).parent / "golden"
# From the reference's camera axes (x left, y up, z forward) to OpenCV's.
TO_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
AXIS_COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def golden_align() -> dict[str, np.ndarray]:
    """Numbers of the reference implementation, with cameras in OpenCV's convention added."""
    with np.load(GOLDEN / "align.npz") as file:
        numbers = dict(file)
    numbers["K"] = np.abs(numbers["K"])
    numbers["cam_to_world"] = numbers["cam_to_world_coppelia"] @ TO_OPENCV
    return numbers


def golden_image(size: int = 512) -> np.ndarray:
    """The synthetic picture the golden crops were cut from."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    red = 127 + 120 * np.sin(x / 23) * np.cos(y / 31)
    blue = 127 + 100 * np.cos((x + 2 * y) / 41)
    return np.stack([red, x / 2, blue], -1).clip(0, 255).astype(np.uint8)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniform rotation by QR."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """4x4 pose."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def random_pose(rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    """Random rotation, normal position."""
    return pose(random_rotation(rng), spread * rng.normal(size=3))


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera pose at `eye`, its z axis through `target`, its image upright."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return pose(np.stack([x, np.cross(z, x), z], -1), eye)


def project(intrinsics: np.ndarray, cam_to_world: np.ndarray, points: np.ndarray) -> tuple:
    """uv and depth by the homogeneous product K [I 0] inv(pose) p."""
    homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)
    local = homogeneous @ np.linalg.inv(np.asarray(cam_to_world, np.float64)).T
    image = local[..., :3] @ np.asarray(intrinsics, np.float64).T
    return image[..., :2] / image[..., 2:], local[..., 2]


def crop(
    image: np.ndarray, uv: np.ndarray, size: int, offset: tuple = (0, 0), border: str = "shift"
) -> np.ndarray:
    """TCP-centric crop on a padded copy of the image."""
    height, width = image.shape[:2]
    column = int(np.floor(uv[0] + offset[0] - size // 2))
    row = int(np.floor(uv[1] + offset[1] - size // 2))
    if border == "shift":
        column, row = min(max(column, 0), width - size), min(max(row, 0), height - size)
        return image[row : row + size, column : column + size]
    far = 2000
    padded = np.pad(image, ((far, far), (far, far), (0, 0)), mode=border)
    return padded[row + far : row + far + size, column + far : column + far + size]


def resize(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Bilinear, half-pixel centres, as floats: one output pixel after the other."""
    height, width = image.shape[:2]
    out = np.zeros((rows, columns, image.shape[2]))
    for i in range(rows):
        for j in range(columns):
            y = min(max((i + 0.5) * height / rows - 0.5, 0), height - 1)
            x = min(max((j + 0.5) * width / columns - 0.5, 0), width - 1)
            out[i, j] = bilinear(image, x, y)
    return out


def bilinear(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Value at pixel indices (x, y); zero beyond the image."""
    left, top = int(np.floor(x)), int(np.floor(y))
    total = np.zeros(image.shape[2])
    for row in (top, top + 1):
        for column in (left, left + 1):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                weight = (1 - abs(x - column)) * (1 - abs(y - row))
                total += weight * image[row, column]
    return total


def draw_overlay(
    image: np.ndarray,
    intrinsics: np.ndarray,
    cam_to_world: np.ndarray,
    tcp: np.ndarray,
    axis_length: float = 0.1,
    thickness: int = 2,
    arrow_length: float = 10.0,
    arrow_width: float = 10.0,
    dot_radius: int = 5,
) -> np.ndarray:
    """The reference's drawing, by PIL."""
    canvas = Image.fromarray(image)
    pen = ImageDraw.Draw(canvas)
    ends = np.concatenate([np.zeros((1, 3)), axis_length * np.eye(3)])
    world = tcp[:3, 3] + ends @ tcp[:3, :3].T
    origin, *tips = np.trunc(project(intrinsics, cam_to_world, world)[0])
    for tip, color in zip(tips, AXIS_COLORS, strict=True):
        length = np.hypot(*(tip - origin))
        if length == 0:
            continue
        along = (tip - origin) / length
        neck, side = tip - arrow_length * along, arrow_width / 2 * np.array([-along[1], along[0]])
        pen.line([*origin, *neck], fill=color, width=thickness)
        pen.polygon([*tip, *(neck + side), *(neck - side)], fill=color)
    box = [*(origin - dot_radius), *(origin + dot_radius)]
    pen.ellipse(box, fill=(255, 255, 255))
    return np.array(canvas)


def rotation_6d(matrix: np.ndarray) -> np.ndarray:
    """First two columns, one after the other."""
    return np.array([matrix[row, column] for column in (0, 1) for row in range(3)])


def delta(tcp: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Body-frame motion by matrix inversion."""
    motion = np.linalg.inv(tcp) @ target
    return np.concatenate([rotation_6d(motion[:3, :3]), motion[:3, 3]])


def gripper_labels(opening: np.ndarray, threshold: float = 0.02) -> np.ndarray:
    """One frame after the other."""
    labels, label = [], float(opening[0] > 0.9)
    for now, then in zip(opening[:-1], opening[1:], strict=True):
        if then - now > threshold:
            label = 1.0
        elif then - now < -threshold:
            label = 0.0
        labels.append(label)
    return np.array([*labels, labels[-1]])


def perspective(image: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Warp by the homography that solves the eight equations of four corners, as floats."""
    height, width = image.shape[:2]
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    rows, values = [], []
    for (u, v), (x, y) in zip(corners, source, strict=True):
        rows += [[u, v, 1, 0, 0, 0, -u * x, -v * x], [0, 0, 0, u, v, 1, -u * y, -v * y]]
        values += [x, y]
    pull = np.append(np.linalg.solve(np.array(rows), np.array(values)), 1).reshape(3, 3)
    out = np.zeros(image.shape)
    for i in range(height):
        for j in range(width):
            x, y, w = pull @ [j + 0.5, i + 0.5, 1]
            out[i, j] = bilinear(image, x / w - 0.5, y / w - 0.5)
    return out


def turned_pose(pose: np.ndarray, pan: float, tilt: float) -> np.ndarray:
    """A camera's pose after a turn about the world's z and one about its own x, its place kept."""
    vertical = np.array([[np.cos(pan), -np.sin(pan), 0], [np.sin(pan), np.cos(pan), 0], [0, 0, 1]])
    own = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    out = np.array(pose, float)
    out[:3, :3] = vertical @ out[:3, :3] @ own
    return out


def turn_view(image: np.ndarray, camera, turned) -> np.ndarray:
    """The ray of each pixel of the turned camera, looked up in the old image; as floats."""
    height, width = image.shape[:2]
    old, new = (np.asarray(c.K, float) for c in (camera, turned))
    old_pose, new_pose = (np.asarray(c.cam_to_world, float) for c in (camera, turned))
    out = np.zeros(image.shape)
    for i in range(height):
        for j in range(width):
            ray = new_pose[:3, :3] @ np.linalg.solve(new, [j + 0.5, i + 0.5, 1])
            x, y, z = old @ np.linalg.solve(old_pose[:3, :3], ray)
            x, y = np.clip([x / z - 0.5, y / z - 0.5], 0, [width - 1, height - 1])
            out[i, j] = bilinear(image, x, y)
    return out


def grid_crop(image: np.ndarray, start: np.ndarray, size: int) -> np.ndarray:
    """The reference's crop grid: `size` samples over size / n of the span of the pixel centres."""
    height, width = image.shape[:2]
    across = start[0] + np.linspace(0, size / width * (width - 1), size)
    down = start[1] + np.linspace(0, size / height * (height - 1), size)
    return np.array([[bilinear(image, x, y) for x in across] for y in down])


def reframed(image: np.ndarray, camera, other) -> np.ndarray:
    """The ray of each pixel of the other camera, looked up in the image; as floats."""
    height, width = image.shape[:2]
    out = np.zeros((other.height, other.width, image.shape[2]))
    for i in range(other.height):
        for j in range(other.width):
            ray = np.linalg.solve(np.asarray(other.K, float), [j + 0.5, i + 0.5, 1])
            x, y, _ = np.asarray(camera.K, float) @ ray
            x, y = np.clip([x - 0.5, y - 0.5], 0, [width - 1, height - 1])
            out[i, j] = bilinear(image, x, y)
    return out
