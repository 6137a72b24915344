"""The stages of a physics step that are ours (tree, constraints, solver), each against C MuJoCo in
float64, on a model that has all they cover; and that other models get MJX's own."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from palm_jax.envs import constraints, physics, solver, tree

# A branching arm with anchors off the origin, a slide on a hinge, limits that are exceeded, a free
# body on the floor, another in the air, a mocap body that something touches, sites and geoms that
# are turned. Balls against planes and balls, whose contacts MJX and C agree on.
MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" iterations="30" tolerance="1e-8"
          jacobian="dense" impratio="2"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" contype="0" conaffinity="0"/>
    <body name="base" pos="0.1 -0.2 0.5" euler="10 20 30">
      <joint name="shoulder" axis="0 0 1" pos="0.02 0.01 0" range="-0.3 0.3" limited="true"
             damping="0.5" armature="0.1"/>
      <geom type="box" size="0.1 0.05 0.07" pos="0.03 0 0.1" euler="5 0 40" mass="2"/>
      <site name="on_base" pos="0.1 0 0" euler="0 45 0"/>
      <body name="upper" pos="0 0 0.3" quat="0.9 0.1 0.3 0.2">
        <joint name="elbow" axis="0.6 0.8 0" pos="0 0.05 -0.1"/>
        <geom type="capsule" size="0.03 0.1" pos="0 0 0.1" mass="1"/>
        <body name="rail" pos="0.05 0 0.2" euler="0 30 0">
          <joint name="slider" type="slide" axis="0 0.6 0.8" pos="0.01 0.02 0.03"
                 range="-0.05 0.05" limited="true" stiffness="3" solreflimit="-200 -20"/>
          <geom name="tip" size="0.06" pos="0.02 0 0.05" mass="0.4" contype="0" conaffinity="0"/>
          <site name="tcp" pos="0.03 0 0.02" euler="30 0 10"/>
        </body>
        <body name="fixed" pos="0 0.1 0.1" euler="0 0 70"><geom size="0.02" mass="0.1"/></body>
      </body>
      <body name="other" pos="0 0.2 0.1">
        <joint name="wrist" axis="1 0 0"/>
        <geom type="box" size="0.02 0.03 0.04" pos="0.01 0 0" mass="0.3"/>
      </body>
    </body>
    <body name="ball" pos="1 0 0.1">
      <freejoint/>
      <geom name="ball" size="0.1" pos="0.01 0.02 0" mass="0.7" contype="0" conaffinity="0"/>
    </body>
    <body name="flying" pos="0 1 1">
      <freejoint/>
      <geom type="box" size="0.05 0.1 0.15" mass="1.3" contype="0" conaffinity="0"/>
    </body>
    <body name="hand" mocap="true" pos="0.5 0.5 0.5">
      <geom name="hand" size="0.08" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="ball" geom2="floor" condim="3" friction="0.7 0.4 0.005 0.0001 0.0001"/>
    <pair geom1="tip" geom2="hand" condim="3" solref="0.01 1"/>
    <pair geom1="ball" geom2="hand" condim="3" solimp="0.8 0.97 0.002 0.4 3"/>
    <pair geom1="tip" geom2="ball" condim="3"/>
  </contact>
  <actuator><position joint="elbow" kp="20" kv="2"/><position joint="slider" kp="50"/></actuator>
</mujoco>
"""

OTHER_MODELS = {
    "ball joint": '<joint type="ball"/>',
    "two joints": '<joint axis="1 0 0"/><joint axis="0 1 0"/>',
}


def c_model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def random_state(model: mujoco.MjModel, seed: int) -> mujoco.MjData:
    """A state in which limits are exceeded and things touch, with forces on it."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:] += rng.normal(size=model.nq) * 0.4
    ball = int(model.body("ball").jntadr[0])
    address = int(model.jnt_qposadr[ball])
    data.qpos[address + 2] = 0.09
    data.qvel[:] = rng.normal(size=model.nv)
    data.ctrl[:] = rng.normal(size=model.nu) * 0.2
    data.xfrc_applied[1:] = rng.normal(size=(model.nbody - 1, 6))
    data.qfrc_applied[:] = rng.normal(size=model.nv)
    data.mocap_quat[:] += rng.normal(size=4) * 0.2  # not a unit quaternion: MuJoCo makes it one
    mujoco.mj_kinematics(model, data)
    # The hand between the ball and the tip of the arm, overlapping one of them.
    data.mocap_pos[:] = data.geom("tip").xpos + 0.13 * rng.normal(size=3) / np.sqrt(3)
    if seed % 2:
        data.mocap_pos[:] = data.geom("ball").xpos + np.array([0.05, 0.1, 0.1])
    return data


def on_device(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[mjx.Model, mjx.Data]:
    ours = mjx.put_model(model)
    names = ("qpos", "qvel", "ctrl", "xfrc_applied", "qfrc_applied", "mocap_pos", "mocap_quat")
    values = {name: jnp.asarray(getattr(data, name), jnp.float32) for name in names}
    return ours, mjx.make_data(ours).replace(**values)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[mujoco.MjData, mjx.Data]]:
    """C MuJoCo's `mj_forward`, and the same by our stages, of six states."""
    model = c_model()
    ours = mjx.put_model(model)
    forward = physics.jit_physics(lambda data: physics.forward(ours, data))
    result = []
    for seed in range(6):
        data = random_state(model, seed)
        start = on_device(model, data)[1]
        mujoco.mj_forward(model, data)
        result.append((data, forward(start)))
    return result


POSES = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat",
         "site_xpos", "site_xmat")  # fmt: skip
DYNAMICS = ("subtree_com", "cinert", "cdof", "cvel", "cdof_dot", "qfrc_bias", "qfrc_passive",
            "qfrc_smooth", "qacc_smooth")  # fmt: skip


@pytest.mark.parametrize("name", (*POSES, *DYNAMICS))
def test_poses_velocities_and_forces_are_mujocos(
    pairs: list[tuple[mujoco.MjData, mjx.Data]], name: str
) -> None:
    for theirs, ours in pairs:
        want = np.asarray(getattr(theirs, name))
        got = np.asarray(getattr(ours._impl if name == "cinert" else ours, name)).reshape(
            want.shape
        )
        if name == "xquat":
            got = got * np.sign((got * want).sum(-1, keepdims=True))
        # Accelerations are as ill-conditioned as the mass matrix.
        bound = 3e-5 if name == "qacc_smooth" else 3e-6
        np.testing.assert_allclose(got, want, atol=bound * max(1.0, np.abs(want).max()))


def test_accelerations_under_constraints_are_mujocos(
    pairs: list[tuple[mujoco.MjData, mjx.Data]],
) -> None:
    touching = []
    for theirs, ours in pairs:
        scale = np.abs(theirs.qacc).max()
        np.testing.assert_allclose(ours.qacc, theirs.qacc, atol=1e-5 * scale)
        np.testing.assert_allclose(
            ours.qfrc_constraint, theirs.qfrc_constraint,
            atol=1e-5 * max(1.0, np.abs(theirs.qfrc_constraint).max()),
        )  # fmt: skip
        touching.append((theirs.ncon, theirs.nefc - 4 * theirs.ncon))
    # Contacts of two pairs at least and a limit, or the comparison says little.
    assert max(contacts for contacts, _ in touching) >= 2
    assert max(limits for _, limits in touching) >= 1


def test_rows_are_mjxs(pairs: list[tuple[mujoco.MjData, mjx.Data]]) -> None:
    """All rows, also those of contacts that do not touch, in MJX's order."""
    model = mjx.put_model(c_model())
    reference = jax.jit(mjx.make_constraint)
    for _, ours in pairs:
        theirs = reference(model, ours)
        for name in ("efc_J", "efc_D", "efc_aref", "efc_pos", "efc_margin", "efc_frictionloss"):
            want, got = (np.asarray(getattr(data._impl, name)) for data in (theirs, ours))
            np.testing.assert_allclose(got, want, atol=2e-6 * max(1.0, np.abs(want).max()))


def test_the_solver_ends_at_the_minimum(pairs: list[tuple[mujoco.MjData, mjx.Data]]) -> None:
    """The gradient of MuJoCo's cost, in float64, against the size of its parts."""
    for _, ours in pairs:
        impl = ours._impl
        inertia, jacobian, weight, reference, smooth, qacc = (
            np.asarray(value, np.float64)
            for value in (
                impl.M, impl.efc_J, impl.efc_D, impl.efc_aref, ours.qacc_smooth, ours.qacc,
            )
        )  # fmt: skip
        push = -weight * np.minimum(jacobian @ qacc - reference, 0.0)
        pull = inertia @ (qacc - smooth)
        largest = np.abs(inertia) @ np.abs(qacc) + np.abs(jacobian).T @ push
        assert (np.abs(pull - jacobian.T @ push) <= 1e-5 * largest.max()).all()
        np.testing.assert_allclose(impl.efc_force, push, atol=2e-4 * max(1.0, push.max()))


def test_a_batch_gives_each_world_what_it_gets_alone(
    pairs: list[tuple[mujoco.MjData, mjx.Data]],
) -> None:
    """A world that is done waits for the others without moving on."""
    model = mjx.put_model(c_model())
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(ours for _, ours in pairs))
    together = physics.jit_physics(jax.vmap(lambda data: solver.solve(model, data)))(batch)
    alone = physics.jit_physics(lambda data: solver.solve(model, data))
    for world, (_, ours) in enumerate(pairs):
        want = np.asarray(alone(ours).qacc)
        np.testing.assert_allclose(together.qacc[world], want, atol=1e-5 * np.abs(want).max())


@pytest.mark.parametrize("name", list(OTHER_MODELS))
def test_other_models_get_mjxs_own(name: str) -> None:
    xml = (
        '<mujoco><option cone="elliptic" jacobian="dense"/><worldbody>'
        '<geom name="floor" type="plane" size="9 9 1" contype="0" conaffinity="0"/>'
        f'<body pos="0 0 0.09">{OTHER_MODELS[name]}'
        '<geom name="ball" size="0.1" pos="0.01 0 0" contype="0" conaffinity="0"/></body>'
        '</worldbody><contact><pair geom1="floor" geom2="ball"/></contact></mujoco>'
    )
    c = mujoco.MjModel.from_xml_string(xml)
    model, data = mjx.put_model(c), mujoco.MjData(c)
    data.qvel[:] = np.arange(1.0, c.nv + 1)
    start = mjx.make_data(model).replace(qvel=jnp.asarray(data.qvel, jnp.float32))
    assert tree.tree_of(model) is None
    assert not constraints.covers(model, start) and not solver.covers(model, start)
    ours = physics.jit_physics(physics.step)(model, start)
    mujoco.mj_step(c, data)
    assert data.ncon == 1
    np.testing.assert_allclose(ours.qpos, data.qpos, atol=1e-5)
    np.testing.assert_allclose(ours.qvel, data.qvel, atol=1e-3)
