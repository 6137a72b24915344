"""Whether a policy knows its demonstrations by heart: how well it foretells them, and new ones.

    python examples/memorised.py RUN
    python examples/memorised.py runs/demo/palm --data runs/demo/demos/lift_lid-panda.hdf5

New demonstrations are drawn as those of the training were, from another seed. A policy that
foretells the old ones well and the new ones badly knows the old ones by heart; one that foretells
neither has not trained for long enough, or cannot see what it would need.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any


def line(name: str, found: dict[str, Any]) -> str:
    """For people: what `held_out.measure` found; x and y are the hand's sideways motions."""
    shares = {axis: found["r2"][axis] for axis in ("x", "y", "z")}
    r2 = ", ".join(f"{a} -" if r is None else f"{a} {r:.2f}" for a, r in shares.items())
    error, motion = (found["translation_mm"][key] for key in ("median_error", "standing_still"))
    return (
        f"{name}: {found['frames']} frames; share of variance explained: {r2}; "
        f"off by {error:.1f} mm of {motion:.1f} (medians)"
    )


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a training run (one method)")
    parser.add_argument("--data", type=Path, help="its demonstrations, where its config names none")
    parser.add_argument("--demos", type=int, default=40, help="how many, of the old and the new")
    parser.add_argument("--seed", type=int, default=1, help="of the new ones")
    options = parser.parse_args()

    from palm_jax.train import demos, held_out, workspace
    from palm_jax.train.evaluate import VIEW, Runners
    from palm_jax.train.learner import Batch

    config = workspace.stored_config(options.run)
    data = options.data or config.data
    if data is None or options.seed == config.demo_seed:
        parser.error(
            f"expected --data FILE.hdf5, and another --seed than {config.demo_seed}: that of the "
            "run's own demonstrations"
        )
    runners = Runners.of(config.task, config.robot, config.second_robot, options.demos)
    evaluator, policy = workspace.load_policy(options.run, runners)
    runner, method = runners.first, evaluator.method
    spec = method.spec(evaluator.task, evaluator.image_size)
    with tempfile.TemporaryDirectory() as folder:
        new = demos.collect(
            runner,
            Path(folder) / "new.hdf5",
            count=options.demos,
            seed=options.seed,
            noise=config.demo_noise,
        )
        for name, path in (("its demonstrations", data), ("new ones", new)):
            known = demos.load(path, task=config.task, robot=config.robot, count=options.demos)
            images, proprio, _ = demos.render_observations(runner, known, spec, frame=method.frame)
            seen = Batch({VIEW: images}, proprio, known.actions)
            print(line(name, held_out.measure(evaluator.learner, policy, seen)), flush=True)


if __name__ == "__main__":
    main()
