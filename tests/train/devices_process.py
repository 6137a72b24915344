"""Training shared by devices, in a process of its own, which must choose its devices at the start:

    python devices_process.py FOLDER DEVICES STEPS [PORT COUNT INDEX]

DEVICES are virtual ones of this process. It goes on from what it finds in FOLDER and leaves the
newest state in final.npz; of several processes the first alone writes.
"""

import sys
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_num_cpu_devices", int(sys.argv[2]))
if len(sys.argv) > 4:
    from palm_jax.train import devices

    devices.connect(f"127.0.0.1:{sys.argv[4]},{sys.argv[5]},{sys.argv[6]}")

from palm_jax.train import checkpoint, devices, learner  # noqa: E402

# Images large enough for 2 x 2 features at the end: a norm over single numbers would give zeros
# whose sign is rounding, and the gradient of a ReLU at zero depends on that sign.
CONFIG = learner.LearnerConfig(
    width=4, norm="batch", crop=40, embed=8, hidden=(16,), batch_size=8, steps=12,
    learning_rate=1e-3, warmup_steps=2, ema=0.9,
)  # fmt: skip


def data() -> learner.Batch:
    rng = np.random.default_rng(0)
    return learner.Batch(
        {"front": rng.integers(0, 256, (30, 44, 44, 3), dtype=np.uint8)},
        rng.normal(size=(30, 3)).astype(np.float32),
        rng.normal(size=(30, 10)).astype(np.float32),
    )


def train(folder: Path, steps: int) -> None:
    """Trains up to `steps` with a checkpoint every four."""
    model, store, state = learner.make_learner(CONFIG, 3), folder / "checkpoints", None
    if devices.is_first() and (found := checkpoint.latest_valid(store)):
        state = checkpoint.load(found[1], model.abstract_state())

    def on_checkpoint(step: int, state: learner.TrainState) -> None:
        if devices.is_first():
            checkpoint.save(store, step, state)
        devices.wait()

    # Backgrounds that only the first process has right: the others' do not count.
    bank = np.random.default_rng(1 + jax.process_index()).integers(0, 256, (5, 44, 44, 3), np.uint8)
    state = learner.run(
        model,
        data(),
        seed=0,
        state=state,
        bank=bank,
        steps=steps,
        checkpoint_every=4,
        on_checkpoint=on_checkpoint,
        devices=jax.devices(),
    )
    if devices.is_first():
        leaves = jax.tree_util.tree_leaves_with_path(state)
        arrays = {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in leaves}
        np.savez(folder / "final.npz", allow_pickle=False, **arrays)
    devices.wait()
    print(f"process {jax.process_index()} of {jax.process_count()}: {devices.described()}")


if __name__ == "__main__":
    train(Path(sys.argv[1]), int(sys.argv[3]))
