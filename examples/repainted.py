"""How much of what another robot costs a policy is the colour of its hand.

    python examples/repainted.py RUN [RUN ...]
    python examples/repainted.py RUN --domain workspace+embodiment --scenes 50

The scenes are those of the training command's own evaluation: as they were; with every part of
the hand in the colour that most parts of the demonstrations' hand have; and with the finger tips in
that hand's second colour. Nothing else changes: the hand keeps its shape, the arm its look, the
policy its noise.

It is also an example of a shift of your own: everything that is drawn is a leaf of `EnvParams`.
"""

import argparse
import dataclasses
from collections import Counter
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from palm_jax.envs.base import Env
from palm_jax.envs.params import EnvParams


def hand_colours(env: Env) -> np.ndarray:
    """[2, 3] the two colours that most geoms of the hand have, 0..1."""
    scene = env.scene_model
    counts = Counter(map(tuple, scene.rgb[scene.hand].tolist()))
    return np.array([colour for colour, _ in counts.most_common(2)], np.float32)


def repainted(
    params: EnvParams, env: Env, hand: ArrayLike, tips: ArrayLike | None = None
) -> EnvParams:
    """`params` of `env`, any leading axes, with its hand in one colour [3], and its finger tips in
    another if one is given."""
    scene = env.scene_model
    names = [env.mj_model.geom(int(geom)).name for geom in scene.geoms]
    ends = scene.hand & np.array([name.endswith(("_tip", "_rubber")) for name in names])
    rgb = jnp.where(scene.hand[:, None], jnp.asarray(hand), jnp.asarray(params.geom_rgb))
    if tips is not None:
        rgb = jnp.where(ends[:, None], jnp.asarray(tips), rgb)
    return dataclasses.replace(params, geom_rgb=rgb)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "runs", type=Path, nargs="+", help="folders of training runs, one method each"
    )
    parser.add_argument("--domain", default="embodiment", help="one with another robot")
    parser.add_argument("--scenes", type=int, default=50)
    options = parser.parse_args()

    from palm_jax.train import workspace
    from palm_jax.train.evaluate import Runners, record, scene_key

    made: dict[tuple[str, str, str], Runners] = {}
    for run in options.runs:
        config = workspace.stored_config(run)
        about = (config.task, config.robot, config.second_robot)
        if about not in made:
            made[about] = Runners.of(*about, options.scenes)
        runners, robot = made[about], made[about].plays(options.domain)
        if robot == config.robot:
            parser.error(f"{options.domain}: expected a domain with another robot than {robot}")
        evaluator, policy = workspace.load_policy(run, runners)
        params = evaluator.scenes(
            options.domain,
            seed=config.eval_seed,
            count=options.scenes,
            aligned=workspace.quoted_variant(run) == "aligned",
        )
        env, (hand, tips) = runners.of_robot(robot).env, hand_colours(runners.first.env)
        looks = {
            f"as the {robot}'s is": params,
            f"in a colour of the {config.robot}'s": repainted(params, env, hand),
            "with tips in its second": repainted(params, env, hand, tips),
        }
        scenes = scene_key(config.eval_seed, options.domain)
        for look, painted in looks.items():
            found = record(evaluator.episodes(policy, scenes, painted, options.scenes, robot=robot))
            solved = f"{found.solved.sum()} of {len(found.solved)} solved"
            print(f"{run}: {solved}, hand {look}", flush=True)


if __name__ == "__main__":
    main()
