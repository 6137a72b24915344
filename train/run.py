"""The main job: demonstrations, then training and evaluation of each method, a report."""

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
from rich.console import Console

from palm_jax.envs import physics, shifts
from palm_jax.envs.rollout import Runner
from palm_jax.train import (
    demos,
    learner,
    loop,
    methods,
    report,
    sweep,
    training,
    transforms,
    workspace,
)
from palm_jax.train.config import SELECTION_SEED, Config, ConfigError, default_out
from palm_jax.train.evaluate import (
    VIEW,
    Evaluator,
    Runners,
    evaluate,
    out_of_memory,
    quoted,
    turned,
)
from palm_jax.train.files import locks, records
from palm_jax.train.files.metrics import write_json
from palm_jax.train.host import devices, interrupts
from palm_jax.train.reporting import console as terminal
from palm_jax.train.reporting import figures, films, videos

Drawn = TypeVar("Drawn")

_FILMED = ("workspace+viewpoint", "workspace+viewpoint+embodiment")
"""Domains of which videos are made, where they are evaluated."""

_TRANSFORM_KEY = 1 << 20  # apart from the keys of the demonstrations


def execute(config: Config, console: Console) -> Path:
    """Runs a whole command; returns its folder.

    Of several processes the first does all of it, and the others take part in the training alone.

    Raises:
      ConfigError: the folder holds another run, or one on other data.
      DeviceError: the devices do not divide the batch.
      DemoFileError: the demonstrations cannot be used.
      StartPoseError: a domain asks for start poses that an arm cannot take.
      RecordError: a file of the folder is damaged.
      Busy: another process works in the folder.
      Interrupted: stopped on request.
    """
    out = config.out or default_out(config)
    config = dataclasses.replace(config, out=out)
    devices.Split.over(jax.devices()).check(config.batch_size)
    if not devices.is_first():
        _take_part(config)
        return out
    with locks.claim(out, take_over=config.take_over):
        return _execute(config, out, console)


def _execute(config: Config, out: Path, console: Console) -> Path:
    start = time.monotonic()
    folders = {name: out / name if len(config.method) > 1 else out for name in config.method}
    for name, folder in folders.items():
        workspace.begin(config, folder, name)
    terminal.header(
        console,
        "palm_jax",
        {
            "task": config.task,
            "methods": ", ".join(config.method),
            "preset": config.preset,
            "robot": _robots(config),
            "device": devices.described(),
            "folder": out,
        },
    )
    runners = Runners.of(
        config.task,
        config.robot,
        config.second_robot,
        _worlds(config),
        tell=lambda text: console.print(text, style="bold", markup=False),
    )
    data = _demonstrations(config, runners.first, console)
    config = config.on(len(data.actions))
    # One for each method throughout: what it has compiled, it keeps.
    evaluators = {
        name: workspace.make_evaluator(config, methods.find(name), runners) for name in folders
    }
    for name, folder in folders.items():
        workspace.bind_data(
            folder, workspace.DEMONSTRATIONS, data.digest, _demonstration_file(config)
        )
        workspace.bind_backgrounds(folder, config, methods.find(name))
    devices.wait()  # the others read what is written now
    _agree_on_data(config, data)
    for name, folder in folders.items():
        _one_method(config, evaluators[name], data, folder, console)
    if config.sweep:
        _sweeps(evaluators, folders, console, other_versions=config.other_versions)
    _gallery(folders, out, console)
    report.write_report(out)
    counts = {name: records.load_counts(folder / "eval.json") for name, folder in folders.items()}
    if len(folders) > 1:
        write_json(out / "summary.json", counts)
    terminal.results(console, counts)
    console.print(
        f"Report: {out / 'report.html'}   ({terminal.duration(time.monotonic() - start)})",
        markup=False,
    )
    devices.wait()
    return out


def _take_part(config: Config) -> None:
    """What every process but the first does: its share of every update. It writes nothing, and
    waits wherever the first one writes or evaluates (`devices.wait`, in the same order there)."""
    runners = Runners.of(config.task, config.robot, config.second_robot, _worlds(config))
    devices.wait()
    data = demos.load(
        _demonstration_file(config), task=config.task, robot=config.robot, count=config.demos
    )
    _agree_on_data(config, data)
    config = config.on(len(data.actions))
    for name in config.method:
        if devices.from_first(False):
            continue
        evaluator = workspace.make_evaluator(config, methods.find(name), runners)
        _share_training(config, evaluator, _samples(config, evaluator, data))
    devices.wait()


def _share_training(config: Config, evaluator: Evaluator, data: learner.Batch) -> None:
    stop = interrupts.Stop(training.PROMISE)
    together = devices.Together(stop)
    with stop.listening():
        loop.run(
            evaluator.learner,
            data,
            seed=config.seed,
            bank=training.backgrounds(config) if evaluator.method.augment else None,
            log_every=training.LOG_EVERY,
            checkpoint_every=config.checkpoint_every,
            on_checkpoint=lambda step, state: devices.wait(),
            should_stop=together,
            on_failure=lambda failure: devices.wait(),
            devices=jax.devices(),
        )
    if together.agreed:
        raise training.Interrupted


def _agree_on_data(config: Config, data: demos.Demos) -> None:
    """Raises ConfigError in a process whose demonstrations are not those of the first."""
    ours = np.frombuffer(bytes.fromhex(data.digest), np.uint8)
    if not np.array_equal(devices.from_first(ours), ours):
        raise ConfigError(
            f"{_demonstration_file(config)}: other demonstrations than those of the first process: "
            "--data must be the same file everywhere"
        )


def _robots(config: Config) -> str:
    if not any(map(shifts.other_robot, config.domains)):
        return config.robot
    return f"{config.robot}, {config.second_robot} in embodiment domains"


def _worlds(config: Config) -> int:
    """Worlds in a batch: a domain's scenes at once, within what a CPU takes."""
    limit = physics.MAX_CPU_WORLDS
    return config.scenes if config.scenes <= limit else limit // 2


def _demonstration_file(config: Config) -> Path:
    assert config.out is not None
    return config.data or config.out / "demos" / f"{config.task}-{config.robot}.hdf5"


def _demonstrations(config: Config, runner: Runner, console: Console) -> demos.Demos:
    path = _demonstration_file(config)

    def waiting() -> None:
        console.print(f"Waiting for another process that makes {path}")

    # Runs that share a file make it once. One that exists is read, whoever may write there.
    if not path.exists():
        with locks.locked(path, waiting=waiting):
            if not path.exists():
                _collect(config, runner, path, console)
    data = demos.load(path, task=config.task, robot=config.robot, count=config.demos)
    text = ", ".join(f"{value} {name}" for name, value in demos.summary(data).items())
    console.print(f"Demonstrations: {text}")
    return data


def _collect(config: Config, runner: Runner, path: Path, console: Console) -> None:
    with terminal.ProgressBar(console, config.demos, "demonstrate", unit="demo") as bar:
        done = 0

        def progress(kept: int) -> None:
            nonlocal done
            bar.advance(kept - done)
            done = kept

        try:
            demos.collect(
                runner,
                path,
                count=config.demos,
                seed=config.demo_seed,
                noise=config.demo_noise,
                progress=progress,
            )
        except jax.errors.JaxRuntimeError as error:
            if not out_of_memory(error):
                raise
            # Not with fewer: what is drawn depends on the number.
            why = str(error).partition("\n")[0]
            raise MemoryError(
                f"{runner.worlds} worlds do not fit into memory to collect demonstrations: "
                f"lower --scenes, which is their number, or give --data ({why})"
            ) from error


def _one_method(
    config: Config,
    evaluator: Evaluator,
    data: demos.Demos,
    folder: Path,
    console: Console,
) -> None:
    method = evaluator.method
    if devices.from_first(_finished(folder, console)):
        console.print(f"{method.name}: trained and evaluated already")
        return
    with workspace.session(config, folder) as notes:
        _training(config, evaluator, folder).train(_samples(config, evaluator, data), console)
        with training.timed(folder, "evaluation_s"):
            _evaluate(config, evaluator, folder, console)
        notes["worlds"] = dict(evaluator.runners.worlds)


def _samples(config: Config, evaluator: Evaluator, data: demos.Demos) -> learner.Batch:
    """The demonstrations as the method sees them."""
    runners = evaluator.runners
    return runners.fitting(runners.robot, lambda runner: _rendered(config, evaluator, runner, data))


def _rendered(
    config: Config, evaluator: Evaluator, runner: Runner, data: demos.Demos
) -> learner.Batch:
    """`_samples`, so many worlds at a time as the runner has."""
    method = evaluator.method
    spec = method.spec(evaluator.task, config.image_size)
    images, proprio, cameras = demos.render_observations(runner, data, spec, frame=method.frame)
    batch = learner.Batch(
        {VIEW: images}, proprio, data.actions, cameras={VIEW: cameras}, tcp=data.tcp[:, :3, 3]
    )
    if method.transform is None:
        return batch
    key = jax.random.fold_in(jax.random.key(config.demo_seed), _TRANSFORM_KEY)
    source = transforms.Source(runner, data, spec, method.frame, VIEW)
    return method.transform(key, source, batch)


def _finished(folder: Path, console: Console) -> bool:
    """Whether a method's results are there and whole; damaged ones are set aside, to be redone."""
    paths = [folder / "eval.json", folder / "eval.npz"]
    if not paths[0].exists():
        return False
    try:
        records.check_counts(paths[0], records.load_eval(paths[1]))
    except records.RecordError as error:
        for path in paths:
            if path.exists():
                os.replace(path, path.with_name(f"{path.name}.damaged"))
        console.print(
            f"{error}; both are set aside as *.damaged, the evaluation is repeated", markup=False
        )
        return False
    return True


def _training(config: Config, evaluator: Evaluator, folder: Path) -> training.Training:
    """Of a method; checkpoints are scored by their success in-domain."""
    model = evaluator.learner

    def score(step: int, state: learner.TrainState) -> training.Score | None:
        if step < config.select_from * config.steps:
            return None
        found = evaluator.domain(
            model.policy_state(state),
            "in_domain",
            seed=SELECTION_SEED,
            count=config.select_scenes,
            aligned=False,
        )
        success = float(found.solved.mean())
        return training.Score(success, {"in_domain_success": success})

    name = evaluator.method.name
    return training.Training(config, name, model, folder, score, evaluator.method.augment)


def _evaluate(config: Config, evaluator: Evaluator, folder: Path, console: Console) -> None:
    policy = workspace.best_policy(folder, evaluator.learner)
    traces: dict[tuple[str, str], films.Trace] = {}

    def watch(variant: str, domain: str) -> films.Trace:
        return traces.setdefault((variant, domain), films.Trace())

    label = f"evaluate {evaluator.method.name}"
    with terminal.ProgressBar(console, len(config.domains), label, unit="domain") as bar:
        results = evaluate(
            evaluator,
            policy,
            config.domains,
            seed=config.eval_seed,
            scenes=config.scenes,
            progress=bar.advance,
            watch=watch,
        )
    chosen = quoted(results)
    records.save_eval(folder / "eval.npz", results[chosen])
    variants = {name: records.counts(domains) for name, domains in results.items()}
    write_json(folder / "eval_variants.json", {"quoted": chosen, **variants})
    # A domain whose camera does not turn was run in the first variant only.
    shown = {d: t for (v, d), t in traces.items() if v == chosen or not turned(d)}
    _film(config, evaluator, shown, folder, aligned=chosen == "aligned")
    # Written last: its presence says that the method is finished.
    write_json(folder / "eval.json", variants[chosen])


def _film(
    config: Config,
    evaluator: Evaluator,
    traces: dict[str, films.Trace],
    folder: Path,
    *,
    aligned: bool,
) -> None:
    """Videos of a few successes and failures, and the first view of every domain."""
    method = evaluator.method
    spec = method.spec(evaluator.task, config.image_size)

    def drawn(domain: str, draw: Callable[[films.Camera], Drawn]) -> Drawn:
        scenes = evaluator.scenes(
            domain, seed=config.eval_seed, count=config.scenes, aligned=aligned
        )
        return evaluator.runners.fitting(
            evaluator.runners.plays(domain),
            lambda runner: draw(films.Camera(runner, scenes, spec, method.frame)),
        )

    views: dict[str, np.ndarray] = {}
    for domain, trace in traces.items():
        views[f"input/{domain}"], views[f"frame/{domain}"] = drawn(
            domain, functools.partial(films.Camera.first, trace=trace)
        )
    records.save_arrays(folder / "views.npz", views)
    for domain in [d for d in _FILMED if d in traces] or list(traces)[:1]:
        film = functools.partial(_film_domain, config, method, domain, traces[domain], folder)
        drawn(domain, film)


def _film_domain(
    config: Config,
    method: methods.Method,
    domain: str,
    trace: films.Trace,
    folder: Path,
    camera: films.Camera,
) -> None:
    """The first `config.videos` successes and failures of one domain."""
    solved = np.stack(trace.solved)[:, : config.scenes].any(axis=0)
    for outcome, worlds in (
        ("success", np.flatnonzero(solved)),
        ("failure", np.flatnonzero(~solved)),
    ):
        for number, world in enumerate(worlds[: config.videos]):
            film = camera.film(trace, int(world))
            frames = videos.episode_frames(
                film.inputs,
                film.frames,
                method=method.name,
                domain=domain,
                success=film.success,
                task=config.task,
            )
            name = f"{method.name}_{domain.replace('+', '_')}_{outcome}{number + 1}.mp4"
            videos.write_video(folder / "videos" / name, frames)


def _sweeps(
    evaluators: dict[str, Evaluator],
    folders: dict[str, Path],
    console: Console,
    *,
    other_versions: bool,
) -> None:
    """A coarse sweep of every policy; `python -m palm_jax sweep RUN` makes finer ones."""
    options = sweep.SweepConfig(run=Path(), camera="-30:30:3")
    job = sweep.job(options)
    for name, folder in folders.items():
        path, header = records.sweep_path(folder), sweep.header_of(options, folder)
        if path.exists() and sweep.is_of(path, header):
            continue
        evaluator = evaluators[name]
        with terminal.ProgressBar(console, job.episodes, f"sweep {name}", unit="episode") as bar:
            job.perform(
                path,
                evaluator,
                workspace.best_policy(folder, evaluator.learner),
                header=header,
                seed=options.seed,
                aligned=header["aligned"],
                progress=bar.advance,
                other_versions=other_versions,
            )


def _gallery(folders: dict[str, Path], out: Path, console: Console) -> None:
    """What each method sees in each domain, on the same scenes."""
    inputs: dict[str, dict[str, np.ndarray]] = {}
    frames: dict[str, np.ndarray] = {}
    for name, folder in folders.items():
        path = folder / "views.npz"
        try:
            views = records.load_views(path) if path.exists() else {}
        except records.RecordError as error:
            console.print(f"{error}; left out of the gallery", markup=False)
            continue
        if views:
            inputs[name] = _views(views, "input/")
            frames |= _views(views, "frame/")
    if inputs:
        figures.save(figures.gallery(inputs, frames=frames), out / "figures" / "gallery.png")


def _views(views: Mapping[str, np.ndarray], kind: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(kind): views[name] for name in views if name.startswith(kind)}
