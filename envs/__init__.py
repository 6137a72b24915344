"""MJX worlds: robots, tasks, control, experts and distribution shifts.

`make(task, robot)` builds an environment; see `palm_jax.envs.base.Env`.
"""

if __name__ != "palm_jax.envs":
    raise ImportError(
        "import this package as `palm_jax.envs`, not as `envs`: a second copy under another name "
        "would have its own, incompatible classes (`palm_jax/envs` is a link to `envs/`)."
    )

from palm_jax._quiet import without_lines

with without_lines():
    import mujoco.mjx  # noqa: F401  first here, where what it prints is dropped

from palm_jax.envs.registry import ROBOTS as ROBOTS
from palm_jax.envs.registry import TASKS as TASKS
from palm_jax.envs.registry import make as make
