"""Speed of every part, beside peers where they are installed: `python -m palm_jax bench`."""

import os
import sys

# MuJoCo reads this once, when it is imported; the OpenGL renderer is one of those compared.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")
