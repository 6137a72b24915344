"""Ten physics steps of 128 worlds with 24 degrees of freedom each: a program of its own, because
test_physics.py wants to see it end."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from palm_jax.envs import physics

WORLDS, BODIES = 128, 4


def model_xml() -> str:
    """Free balls, one of them on the floor: a matrix for the solver, one for the integrator."""
    balls = "".join(
        f'<body pos="{i} 0 0.1"><freejoint/><geom name="ball{i}" size="0.1" mass="1"'
        ' contype="0" conaffinity="0"/></body>'
        for i in range(BODIES)
    )
    return (
        '<mujoco><option integrator="implicitfast" iterations="2" jacobian="dense"/><worldbody>'
        '<geom name="floor" type="plane" size="9 9 1" contype="0" conaffinity="0"/>'
        f'{balls}</worldbody><contact><pair geom1="ball0" geom2="floor"/></contact></mujoco>'
    )


def main() -> None:
    model = mjx.put_model(mujoco.MjModel.from_xml_string(model_xml()))
    data = mjx.make_data(model)
    data = jax.tree.map(lambda x: jnp.broadcast_to(x, (WORLDS, *jnp.shape(x))), data)
    steps = physics.jit_physics(jax.vmap(lambda d: physics.substeps(model, d, 10)))
    print(bool(jnp.isfinite(steps(data).qpos).all()))


if __name__ == "__main__":
    main()
