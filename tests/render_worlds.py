"""Worlds and cameras for the renderer's tests, and what C MuJoCo sees of them."""

import mujoco
import numpy as np

from palm_jax.align import Camera
from palm_jax.render import Scene, make_scene

GEOMS = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
}


def pose_looking_at(eye, target):
    """Camera pose [4, 4] with OpenCV axes, upright."""
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return pose.astype(np.float32)


def camera_at(eye, target, height=48, width=64, fovy=50.0, skew=0.0):
    """A camera whose principal point is off the centre and whose pixels are not quite square."""
    focal = height / 2 / np.tan(np.deg2rad(fovy) / 2)
    intrinsics = [
        [focal, skew, width / 2 + 1.3],
        [0.0, 1.1 * focal, height / 2 - 2.7],
        [0.0, 0.0, 1.0],
    ]
    return Camera(np.asarray(intrinsics, np.float32), pose_looking_at(eye, target), height, width)


def random_model(seed, per_type=5):
    """A MuJoCo model: an infinite plane, a tilted finite one, `per_type` of everything else."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    world = spec.worldbody
    world.add_geom(type=GEOMS["plane"], size=[0, 0, 1])
    world.add_geom(
        type=GEOMS["plane"], size=[0.6, 0.4, 1], pos=[0.2, 0.1, 0.35], quat=[0.95, 0.15, -0.1, 0.2]
    )
    names = [name for name in GEOMS if name != "plane"] * per_type
    for name in rng.permutation(names):
        world.add_geom(
            type=GEOMS[name],
            size=rng.uniform(0.04, 0.25, 3),
            pos=rng.uniform([-1, -1, 0.1], [1, 1, 1.4]),
            quat=rng.normal(size=4),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def scene_of(model, data, **options) -> Scene:
    """The model as a `Scene`; options as in `make_scene`."""
    names = {int(value): name for name, value in GEOMS.items()}
    options.setdefault("rgb", np.full((model.ngeom, 3), 0.5))
    return make_scene(
        [names[int(kind)] for kind in model.geom_type],
        data.geom_xpos,
        data.geom_xmat.reshape(-1, 3, 3),
        model.geom_size,
        options.pop("rgb"),
        **options,
    )


def pixel_rays(camera):
    """Directions [H, W, 3] with depth 1 of all pixels, world frame, float64."""
    intrinsics, pose = np.asarray(camera.K, float), np.asarray(camera.cam_to_world, float)
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([column, row, np.ones_like(row)], -1)
    return pixels @ np.linalg.inv(intrinsics).T @ pose[:3, :3].T


def cast(model, data, camera):
    """By mj_multiRay: geom ids [H, W] (-1: none), planar depth (inf: none), normals [H, W, 3]."""
    rays = pixel_rays(camera)
    length = np.linalg.norm(rays, axis=-1)
    count = length.size
    ids, distance = np.zeros(count, np.int32), np.zeros(count)
    normals = np.zeros(3 * count)
    origin = np.asarray(camera.cam_to_world, float)[:3, 3].copy()
    directions = (rays / length[..., None]).reshape(-1, 1)
    mujoco.mj_multiRay(
        model, data, origin, directions, None, True, -1, ids, distance, normals, count, 1e10
    )
    ids = ids.reshape(length.shape)
    depth = np.where(ids >= 0, distance.reshape(length.shape) / length, np.inf)
    return ids, depth, normals.reshape(*length.shape, 3)


def away_from_edges(ids):
    """bool [H, W]: the four neighbours show the same geom."""
    padded = np.pad(ids, 1, mode="edge")
    around = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return np.all([side == ids for side in around], axis=0)
