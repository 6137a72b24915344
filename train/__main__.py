"""`python -m palm_jax.train`: demonstrations, training, evaluation and report in one command."""

import sys
import traceback
import warnings
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns 0, or 2 for a command that cannot be run, 130 when interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not any(word in ("-h", "--help") or word.startswith("--distributed") for word in words):
        print("palm_jax: loading JAX and MuJoCo ...", flush=True)
    warnings.filterwarnings("ignore", message=".*donated buffers were not usable.*")
    from palm_jax._checks import OptionError
    from palm_jax.envs.rollout import StartPoseError
    from palm_jax.train import config as configuration
    from palm_jax.train import recorded, run, training
    from palm_jax.train.checkpoint import CheckpointError
    from palm_jax.train.data.errors import DataError
    from palm_jax.train.demos import DemoFileError
    from palm_jax.train.evaluate import out_of_memory
    from palm_jax.train.files.locks import Busy
    from palm_jax.train.files.records import RecordError
    from palm_jax.train.host import devices, interrupts
    from palm_jax.train.loop import NonFiniteError
    from palm_jax.train.reporting import console as terminal

    console = terminal.make_console()
    try:
        config = configuration.parse(words)
        if isinstance(config, configuration.Config) and config.distributed:
            devices.connect(config.distributed)
    except (configuration.ConfigError, devices.DeviceError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        with interrupts.raising():
            if isinstance(config, configuration.Config):
                run.execute(config, console)
            else:
                recorded.execute(config, console)
    except (
        configuration.ConfigError, devices.DeviceError, CheckpointError, DemoFileError,
        StartPoseError, RecordError, Busy,
    ) as error:  # fmt: skip
        print(f"error: {error}", file=sys.stderr)
        return devices.leave(2)
    except (DataError, OptionError) as error:
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except (NonFiniteError, MemoryError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return devices.leave(1)
    except KeyboardInterrupt as stop:
        if devices.is_first():
            terminal.interrupted(console, configuration.resume_command(config))
        # What all processes agreed on ends all of them in order.
        return 130 if isinstance(stop, training.Interrupted) else interrupts.leave(stop)
    except Exception as error:
        if out_of_memory(error):
            why = str(error).partition("\n")[0]
            print(
                "error: the devices' memory does not suffice: lower --batch-size, --image-size or "
                f"--width, or use devices with more ({why})",
                file=sys.stderr,
            )
            return devices.leave(1)
        if devices.alone():
            raise
        traceback.print_exc()
        return devices.leave(1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
