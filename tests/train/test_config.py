"""Command lines: presets, overrides, and what wrong ones are told."""

import dataclasses
from pathlib import Path

import pytest

from palm_jax.envs.shifts import DOMAINS
from palm_jax.train import config as configs
from palm_jax.train import methods
from palm_jax.train.config import PRESETS, Config, ConfigError, command, default_out, parse


def test_nothing_means_quick() -> None:
    assert parse([]) == Config() == configs.quick()


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_whole(name: str) -> None:
    config = parse(["--preset", name])
    assert config.preset == name and config == PRESETS[name]()
    assert parse([f"--preset={name}"]) == config
    for method in methods.METHODS.values():
        learner = config.learner(method)
        assert learner.steps == config.steps
        # A method without augmentation is trained without any of it.
        assert (learner.overlay_fraction > 0) == method.augment
        assert (learner.perspective_probability > 0) == method.augment
        assert (max(learner.turn) > 0) == (method.augment and max(config.turn) > 0)
        assert learner.turn_proprio == (method.layout == "cam6d_z")


def test_the_papers_numbers() -> None:
    """Width-64 trunk, batch norm, Adam 1e-4 constant, batch 64, 50 scenes; 600 epochs of 10 000."""
    config = PRESETS["paper"]()
    assert (config.width, config.norm, config.batch_size, config.scenes) == (64, "batch", 64, 50)
    assert (config.learning_rate, config.schedule) == (1e-4, "constant")
    assert config.on(10_000).steps == 600 * 10_000 / 64


def test_the_other_robot_is_another_one() -> None:
    """By default the first of the table that is not the demonstrations'."""
    assert parse([]).second_robot == "ur5"
    assert parse(["--robot", "ur5"]).second_robot == "panda"
    chosen = parse(["--robot", "ur5", "--other-robot", "panda"])
    assert chosen.second_robot == "panda"
    assert parse(command(chosen)[3:]) == chosen


def test_further_robots_are_named() -> None:
    """They demonstrate, or take over from any other; no default is theirs."""
    assert parse(["--other-robot", "xarm7"]).second_robot == "xarm7"
    assert parse(["--robot", "xarm7"]).second_robot == "panda"


def test_any_composition_of_shifts_is_a_domain() -> None:
    assert parse([]).domains == DOMAINS and len(DOMAINS) == 8
    given = ["in_domain", "lighting", "viewpoint_cone+object_color", "embodiment+distractors"]
    assert parse(["--domains", *given]).domains == tuple(given)


def test_options_override_the_preset() -> None:
    words = "--preset cpu --task lift_spam --steps 7 --method bc --domains in_domain viewpoint"
    config = parse([*words.split(), "--no-sweep", "--out", "somewhere", "--select-from=0"])
    assert config == dataclasses.replace(
        configs.cpu(),
        task="lift_spam",
        steps=7,
        epochs=None,
        method=("bc",),
        domains=("in_domain", "viewpoint"),
        sweep=False,
        out=Path("somewhere"),
        select_from=0.0,
    )


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--preset", "cpu", "--seed", "3"],
        ["--method", "palm", "--no-sweep", "--learning-rate", "3e-4"],
        ["--preset", "paper", "--task", "lift_spam", "--out", "with space/x", "--data", "d.hdf5"],
        ["--preset", "cpu", "--steps", "9"],
        ["--preset", "cpu", "--epochs", "None"],
        ["--preset", "paper", "--epochs", "0.5"],
        ["--method", "bc", "palm-paper-frame", "--domains", "in_domain", "--weight-decay", "1e-6"],
    ],
)
def test_a_command_gives_its_configuration_again(words: list[str]) -> None:
    config = parse(words)
    line = command(config)
    assert line[:3] == ["python", "-m", "palm_jax.train"]
    assert parse(line[3:]) == config
    resumed = parse(command(config, resume=True)[3:])
    assert resumed == dataclasses.replace(config, resume=True)


def test_epochs_become_steps() -> None:
    config = dataclasses.replace(configs.quick(), epochs=2.5, batch_size=32)
    assert config.on(100) == dataclasses.replace(config, steps=8, epochs=None)  # 7.8
    assert config.on(1).steps == 1
    assert configs.quick().on(100) == configs.quick()


def test_folders_are_named_after_what_is_in_them() -> None:
    config = parse(["--task", "lift_spam", "--seed", "2"])
    assert default_out(config) == Path("runs/quick-lift_spam-palm-bc-s2")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--preset", "qick"], r"unknown preset 'qick' \(did you mean 'quick'\?\); known: .*cpu"),
        (["--task", "lift_lids"], r"unknown task 'lift_lids' .*known: .*lift_spam"),
        (["--robot", "ur"], "unknown robot 'ur'.*known: panda"),
        (["--method", "palm", "bcc"], r"unknown method 'bcc' .*known: palm.*bc"),
        (
            ["--domains", "in_domain", "workspace+light"],
            r"unknown domain 'light' \(did you mean 'lighting'\?\); known: in_domain, workspace",
        ),
        (["--domains", "in_domain", "lighting+lighting"], "domains: .*'lighting' twice"),
        (["--domains", "in_domain", "in_domain+workspace"], "domains: .*in_domain"),
        (
            ["--domains", "in_domain", "workspace+viewpoint", "viewpoint+workspace"],
            r"domains: workspace\+viewpoint and viewpoint\+workspace are the same: give one",
        ),
        (["--other-robot", "panda"], "other_robot: expected another robot than robot = 'panda'"),
        (["--other-robot", "ur3"], r"unknown robot 'ur3' \(did you mean 'ur5'\?\)"),
        (["--domains", "viewpoint"], "domains must contain in_domain"),
        (["--turn", "90", "0"], r"turn: expected degrees from 0 to 80, got \(90.0, 0.0\)"),
        (["--learning-rate", "-1"], "learning_rate is -1.0; expected 0 or more"),
        (["--stepps", "3"], r"unknown option --stepps \(did you mean --steps\?\); known: .*--task"),
        (["--steps", "0"], "steps: expected at least 1, got 0"),
        (["--eval-seed", "500"], "eval_seed: 500 is that of the scenes by which checkpoints are"),
        (["--epochs", "0"], "epochs: expected more than 0, got 0.0"),
        (["--steps", "9", "--epochs", "2"], "steps and epochs = 2.0: give one of them"),
        (["--scenes=-1"], "scenes: expected at least 1, got -1"),
        (
            ["--image-size", "50", "--random-crop", "51"],
            "random_crop: expected at most image_size = 50, got 51",
        ),
        (["--backgrounds", "no/such/folder"], "backgrounds: no/such/folder is not a folder"),
    ],
)
def test_wrong_commands_say_what_was_expected(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(words)


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--norm", "layer"], "norm is 'layer'; known: "), (["--ema", "1"], "ema is 1.0; expected")],
)
def test_the_learner_checks_its_own_values(words: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(words)


def test_unknown_methods_list_the_known_ones() -> None:
    with pytest.raises(ValueError, match="unknown method 'x'; known: palm, "):
        methods.find("x")
