"""The documentation holds: its code runs, its links lead somewhere, its tables match the code."""

import re
from pathlib import Path

import numpy as np
import pytest
import tiny
import worlds as compiled

from palm_jax.__main__ import VERBS
from palm_jax.envs import rollout
from palm_jax.envs.base import Env, State
from palm_jax.envs.rollout import Runner

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def readme_code() -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


def test_the_readme_example_runs() -> None:
    code, _, _ = readme_code()
    # A camera one metre above the table's centre that looks straight down; the hand below it.
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    cam_to_world, tcp = down.copy(), down.copy()
    cam_to_world[:3, 3], tcp[:3, 3] = (0.25, 0.0, 1.752), (0.25, 0.0, 0.9)
    names: dict[str, object] = {
        "cam_to_world": cam_to_world,
        "tcp": tcp,
        "opening": 1.0,
        "frame": np.full((512, 512, 3), 90, np.uint8),
    }
    exec(compile(code, "README.md", "exec"), names)
    image, proprio = np.asarray(names["image"]), np.asarray(names["proprio"])
    assert image.shape == (84, 84, 3) and image.dtype == np.uint8
    # The hand is turned like the camera: its x and y axes are the camera's. Then z, and the bit.
    np.testing.assert_allclose(proprio, [1, 0, 0, 0, 1, 0, 0.9, 1], atol=1e-6)
    # The TCP's white dot: in the middle column of the crop, 40 of 200 pixels above the middle.
    assert (image[round((100 - 40) / 200 * 84), 42] == 255).all()


def test_the_readme_worlds_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer worlds: those that the other tests have compiled."""
    _, code, _ = readme_code()
    asked = []

    def runner(env: Env, worlds: int) -> Runner:
        asked.append(worlds)
        return compiled.runner(env.task.name, env.robot.name)

    monkeypatch.setattr(rollout, "Runner", runner)
    names: dict[str, object] = {}
    exec(compile(code.replace("64", str(compiled.WORLDS)), "README.md", "exec"), names)
    state = names["state"]
    assert asked == [compiled.WORLDS] and isinstance(state, State)
    assert (np.asarray(state.step) == 1).all() and state.step.shape == (compiled.WORLDS,)
    assert np.ptp(np.asarray(names["params"].light_ambient)) > 0.1  # type: ignore[attr-defined]


def test_the_readme_policy_runs() -> None:
    *_, code = readme_code()
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    cam_to_world, tcp = down.copy(), down.copy()
    cam_to_world[:3, 3], tcp[:3, 3] = (0.25, 0.0, 1.752), (0.25, 0.0, 0.9)
    names: dict[str, object] = {
        "image": np.full((480, 640, 3), 90, np.uint8),
        "K": np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]),
        "cam_to_world": cam_to_world,
        "tcp": tcp,
        "opening": 1.0,
    }
    exec(compile(code.replace("runs/demo/palm", str(tiny.run())), "README.md", "exec"), names)
    assert np.asarray(names["target"]).shape == (4, 4) and names["gripper"] in (0.0, 1.0)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    local = [t for t in targets if "://" not in t and not t.startswith("docs/images/")]
    assert [t for t in local if not (page.parent / t).exists()] == []


def test_the_readme_lists_the_verbs() -> None:
    text = (ROOT / "README.md").read_text()
    listed = set(re.findall(r"^\| `python -m palm_jax[ .](\w+)", text, re.MULTILINE))
    assert listed == set(VERBS)


def test_the_layout_table_matches_the_code() -> None:
    from palm_jax.align.proprio import LAYOUTS

    text = (ROOT / "docs" / "conventions.md").read_text()
    table = {}
    for names, sizes in re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| .* \| ([\d, ]+) \|$", text, re.M):
        table |= dict(zip(re.findall(r"\w+", names), map(int, sizes.split(",")), strict=True))
    assert table == LAYOUTS
