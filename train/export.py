"""`python -m palm_jax export RUN`: a policy as one StableHLO program, its parameters inside.

Three files: OUT, the program in StableHLO's portable form, for whatever compiles that (XLA's PJRT
plug-ins, IREE); OUT.jax, the same for `jax.export.deserialize`; and OUT.json, which says what goes
in and what comes out. The program is the whole of `Policy.decide` for images of one size: crop,
overlay, proprioception, network, target pose. It checks nothing: a caller does, by OUT.json.
"""

import dataclasses
import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import flatbuffers as flatbuffers  # jax.export asks for it only when it writes
import jax
import numpy as np
import tyro
from jax import export as jax_export

from palm_jax._checks import check_choice
from palm_jax.train.files.metrics import write_atomic, write_json
from palm_jax.train.policy import IMAGE_SIZE, Policy, PolicyError, describe, load
from palm_jax.train.reporting import console as terminal

FORMAT = "palm_jax.export"
VERSION = 1
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
OUTPUTS = ("target", "action", "valid", "coverage")
_MEANINGS = {
    "image": "RGB, 0 to 255, the camera's whole image without lens distortion",
    "K": "intrinsics in pixels of the image; positive focal lengths, last row 0 0 1",
    "cam_to_world": "pose of the camera, OpenCV axes (x right, y down, z forward), metres",
    "tcp": "pose of the TCP (z approach, y opening axis) in the camera pose's frame, metres",
    "opening": "of the gripper, 0 closed to 1 open",
    "mask": "the pixels of the gripper and the task's objects",
    "target": "the TCP's next pose, in the frame of tcp",
    "action": "the same as delta in the TCP's frame: 6D rotation (two columns), xyz; then the "
    "gripper, 1 open, 0 close",
    "valid": "the TCP is in front of the camera and inside its image; otherwise do not act",
    "coverage": "share of the policy's view that lies inside the image",
}


@dataclasses.dataclass(frozen=True)
class ExportConfig:
    """Write the policy of a finished run as a StableHLO program with its parameters inside.

    Attributes:
      run: the run folder.
      out: file to write; OUT.jax and OUT.json are written beside it.
      image_size: rows and columns of the images, fixed.
      zoom: see palm_jax.policy.load.
      platforms: what it is to run on: cpu, cuda, rocm, tpu.
    """

    run: Annotated[Path, tyro.conf.Positional]
    out: Path = Path("policy.stablehlo")
    image_size: tuple[int, int] = IMAGE_SIZE
    zoom: float = 1.0
    platforms: tuple[str, ...] = ("cpu",)


def exported(
    policy: Policy, image_size: tuple[int, int], platforms: Sequence[str] = ("cpu",)
) -> jax_export.Exported:
    """The program: (image uint8 [H, W, 3], K [3, 3], cam_to_world [4, 4], tcp [4, 4], opening []
    [, mask bool [H, W]]) -> (target [4, 4], action [10], valid bool [], coverage []).

    Args:
      policy: from `load`.
      image_size: (H, W).
      platforms: of `jax.export`, e.g. ("cpu", "cuda").

    Raises:
      OptionError: an unknown platform.
    """
    for platform in platforms:
        check_choice(platform, "platforms", PLATFORMS)
    height, width = image_size

    def decide(*observation: jax.Array) -> tuple[jax.Array, ...]:
        return policy.decide_arrays(policy.state, None, *observation)

    shapes: list[tuple[tuple[int, ...], Any]] = [
        ((height, width, 3), np.uint8),
        ((3, 3), np.float32),
        ((4, 4), np.float32),
        ((4, 4), np.float32),
        ((), np.float32),
    ]
    if policy.contract.spec.isolate:
        shapes.append(((height, width), np.bool_))
    arguments = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    return jax_export.export(jax.jit(decide), platforms=list(platforms))(*arguments)


def write(policy: Policy, config: ExportConfig) -> list[Path]:
    """Write the three files; returns their paths."""
    program = exported(policy, config.image_size, config.platforms)
    names = ("image", "K", "cam_to_world", "tcp", "opening", "mask")
    files = {
        config.out: program.mlir_module_serialized,
        _beside(config.out, ".jax"): bytes(program.serialize()),
    }
    paths = [write_atomic(path, content) for path, content in files.items()]
    contract = {
        "format": FORMAT,
        "version": VERSION,
        "inputs": _described(names, program.in_avals),
        "outputs": _described(OUTPUTS, program.out_avals),
        "policy": describe(policy),
        "platforms": list(program.platforms),
        "calling_convention": program.calling_convention_version,
        "jax": jax.__version__,
        "sha256": {
            path.name: hashlib.sha256(content).hexdigest() for path, content in files.items()
        },
    }
    return [*paths, write_json(_beside(config.out, ".json"), contract)]


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def _described(names: Sequence[str], avals: Sequence[Any]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "dtype": str(aval.dtype),
            "shape": list(aval.shape),
            "meaning": _MEANINGS[name],
        }
        for name, aval in zip(names, avals, strict=False)
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    config = tyro.cli(ExportConfig, args=argv, prog="python -m palm_jax export")
    console = terminal.make_console()
    wanted = [config.out, *(_beside(config.out, suffix) for suffix in (".jax", ".json"))]
    taken = [path for path in wanted if path.exists()]
    if taken:
        print(f"error: {taken[0]} exists: move it, or choose another --out", file=sys.stderr)
        return 2
    try:
        console.print(f"Loading {config.run} ...", markup=False)
        policy = load(config.run, image_size=None, zoom=config.zoom)
        for path in write(policy, config):
            size = path.stat().st_size / 1e6
            console.print(f"{path}  {size:.2f} MB", markup=False)
    except (PolicyError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
