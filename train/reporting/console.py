"""What a command prints: header, progress with rate and remaining time, final table, farewells.

Everything goes through one `rich` console on standard output. On a terminal a progress bar is drawn
in place; without one (a pipe, a batch job) the same progress becomes a plain line about every ten
seconds, so that logs stay readable. Loops of under three seconds print nothing.
"""

import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table
from rich.text import Text

from palm_jax.train.reporting import paper
from palm_jax.train.reporting.stats import degradation, success_rate, wilson_interval

T = TypeVar("T")

# Before a loop has run this long it prints nothing; without a terminal it then prints this often.
QUIET_SECONDS = 3.0
LINE_SECONDS = 10.0


def make_console() -> Console:
    """A console on standard output; plain and at least 100 columns wide if that is no terminal."""
    console = Console(highlight=False, soft_wrap=False)
    if not console.is_terminal and console.width < 100:
        console = Console(highlight=False, width=100)
    return console


def duration(seconds: float) -> str:
    """Seconds as people say them: 4.2 s, 3 min 20 s, 2 h 05 min."""
    if seconds < 0 or seconds != seconds or seconds == float("inf"):
        return "?"
    if seconds < 10:
        return f"{seconds:.1f} s"
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    minutes, seconds = divmod(seconds, 60)
    if minutes < 60:
        return f"{minutes} min {seconds:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min"


def header(console: Console, title: str, rows: Mapping[str, object]) -> None:
    """A panel with the title and one line per entry of `rows`."""
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column()
    for name, value in rows.items():
        table.add_row(escape(str(name)), escape(str(value)))
    console.print(Panel(table, title=f"[bold]{escape(title)}[/]", title_align="left", expand=False))


class ProgressBar:
    """Progress of one loop. A context manager; call `advance` after each piece of work.

    Args:
      console: where to print.
      total: pieces of work.
      label: what is being done, e.g. "train palm".
      unit: what a piece is, for the rate, e.g. "step".
      done: pieces already done, of a resumed loop; they do not count for the rate.
      clock: seconds; replaced in tests.
    """

    def __init__(
        self,
        console: Console,
        total: int,
        label: str,
        *,
        unit: str = "step",
        done: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.console, self.total, self.label, self.unit = console, total, label, unit
        self.done, self._first, self._clock = done, done, clock
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._note = ""

    def __enter__(self) -> Self:
        self._start = self._clock()
        self._next_line = self._start + QUIET_SECONDS
        return self

    def advance(self, pieces: int = 1, **notes: object) -> None:
        """Count finished pieces; keyword arguments are shown at the end of the line.

        Floats are shown with three significant digits.
        """
        self.done += pieces
        if notes:
            self._note = "  ".join(
                f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
                for name, value in notes.items()
            )
        now = self._clock()
        if self.console.is_terminal:
            self._draw(now)
        elif now >= self._next_line and self.done < self.total:
            self.console.print(Text(self._line(now)))
            self._next_line = now + LINE_SECONDS

    def _draw(self, now: float) -> None:
        if self._bar is None:
            if now < self._next_line:
                return
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(bar_width=28),
                TextColumn("{task.percentage:>3.0f} %  {task.fields[rest]}"),
                console=self.console,
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(escape(self.label), total=self.total, rest="")
        assert self._task is not None
        self._bar.update(self._task, completed=self.done, rest=escape(self._rest(now)))

    def _rate(self, now: float) -> float:
        return (self.done - self._first) / max(now - self._start, 1e-9)

    def _rest(self, now: float) -> str:
        rate = self._rate(now)
        left = (self.total - self.done) / rate if rate > 0 else float("inf")
        parts = [f"{self.done}/{self.total}", _rate_text(rate, self.unit), f"{duration(left)} left"]
        return "  ".join([*parts, self._note]).rstrip()

    def _line(self, now: float) -> str:
        percent = 100 * self.done // max(self.total, 1)
        return f"{self.label}: {percent} %  {self._rest(now)}"

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
        now = self._clock()
        taken = now - self._start
        if kind is None and taken >= QUIET_SECONDS:
            count, rate = self.done - self._first, _rate_text(self._rate(now), self.unit)
            text = f"{self.label}: {count} {self.unit}s in {duration(taken)}, {rate}"
            self.console.print(Text(f"{text}  {self._note}".rstrip()))


def _rate_text(rate: float, unit: str) -> str:
    if 0 < rate < 1:
        return f"{duration(1 / rate)}/{unit}"
    return f"{rate:.0f} {unit}s/s" if rate >= 10 else f"{rate:.1f} {unit}s/s"


def track(console: Console, items: Sequence[T], label: str, *, unit: str = "step") -> Iterator[T]:
    """Iterate over `items` with a `ProgressBar`."""
    with ProgressBar(console, len(items), label, unit=unit) as bar:
        for item in items:
            yield item
            bar.advance()


def results(
    console: Console,
    counts: Mapping[str, Mapping[str, Mapping[str, int]]],
    *,
    title: str = "Success in percent, 95 % interval",
    several_tasks: bool = False,
) -> None:
    """The final table: per domain ours beside the paper's, per method.

    Args:
      counts: method -> domain -> {"successes", "episodes", "nan"} (the content of eval.json).
      title: above the table.
      several_tasks: the counts are pooled over tasks, as the paper's numbers are.
    """
    methods = paper.ordered_methods(list(counts))
    domains = paper.ordered_domains(list(dict.fromkeys(d for m in methods for d in counts[m])))
    if not domains:
        return
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    (_by_domain if len(methods) <= 3 else _by_method)(table, counts, methods, domains)
    console.print(table)
    bad = sum(entry.get("nan", 0) for by_domain in counts.values() for entry in by_domain.values())
    notes = ["loss = 1 - OOD / ID success, lower is better"]
    if not several_tasks:
        notes.append("the paper's numbers are means of its four tasks")
    if bad:
        notes.append(f"{bad} episodes went non-finite and count as failures")
    console.print(Text("; ".join(notes) + ".", style="dim"))


def _by_domain(
    table: Table,
    counts: Mapping[str, Mapping[str, Mapping[str, int]]],
    methods: Sequence[str],
    domains: Sequence[str],
) -> None:
    """A row per domain; per method our success, our loss, and the paper's loss."""
    table.add_column("domain")
    for method in methods:
        table.add_column(escape(paper.method_label(method)), justify="right")
        table.add_column("loss", justify="right")
        table.add_column("paper", justify="right", style="dim")
    for domain in domains:
        cells = [cell for method in methods for cell in _cells(counts[method], method, domain)]
        table.add_row(paper.domain_label(domain), *cells)
    table.add_section()
    row = ["OOD mean"]
    for method in methods:
        reference = paper.average_degradation(method, counts[method])
        row += ["", _mean_loss(counts[method]), _number(reference)]
    table.add_row(*row)


def _by_method(
    table: Table,
    counts: Mapping[str, Mapping[str, Mapping[str, int]]],
    methods: Sequence[str],
    domains: Sequence[str],
) -> None:
    """A row per method with the success in every domain: what fits when there are many."""
    table.add_column("method")
    for domain in domains:
        table.add_column(paper.domain_label(domain), justify="right")
    table.add_column("OOD loss", justify="right")
    table.add_column("paper", justify="right", style="dim")
    for method in methods:
        cells = [_cells(counts[method], method, d)[0].partition(" ")[0] for d in domains]
        table.add_row(
            escape(paper.method_label(method)),
            *cells,
            _mean_loss(counts[method]),
            _number(paper.average_degradation(method, counts[method])),
        )


def _mean_loss(by_domain: Mapping[str, Mapping[str, int]]) -> str:
    """Over the paper's seven domains, like the reference beside it."""
    known = [domain for domain in by_domain if paper.domain_key(domain) in paper.OOD_DOMAINS]
    losses = [loss for domain in known if (loss := _loss(by_domain, domain)) is not None]
    return _number(sum(losses) / len(losses)) if losses else ""


def _cells(by_domain: Mapping[str, Mapping[str, int]], method: str, domain: str) -> list[str]:
    theirs = paper.degradation(method, domain)
    base = paper.in_domain_success(method) if paper.domain_key(domain) == "ID" else None
    reference = f"{100 * base:.0f} %" if base is not None else _number(theirs)
    if domain not in by_domain:
        return ["", "", reference]
    good, total = by_domain[domain]["successes"], by_domain[domain]["episodes"]
    lower, upper = wilson_interval(good, total)
    rate = float(success_rate(good, total))
    loss = _loss(by_domain, domain)
    return [
        f"{100 * rate:.0f} ({100 * lower:.0f}-{100 * upper:.0f})" if total else "-",
        _number(loss),
        reference,
    ]


def _loss(by_domain: Mapping[str, Mapping[str, int]], domain: str) -> float | None:
    base = next((d for d in by_domain if paper.domain_key(d) == "ID"), None)
    if base is None or paper.domain_key(domain) == "ID" or domain not in by_domain:
        return None
    rates = [
        success_rate(by_domain[d]["successes"], by_domain[d]["episodes"]) for d in (domain, base)
    ]
    loss = float(degradation(*rates))
    return None if loss != loss else loss


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}".replace("-0.00", "0.00")


HELD_OUT = ("loss", "translation, median error", "rotation, median error", "gripper right")
"""Of what `held_out_cells` gives."""

HELD_OUT_NOTE = "In brackets: a policy that never moves and never changes the gripper."


def held_out_cells(found: Mapping[str, Any]) -> list[str]:
    """A row of figures on episodes held out, from `palm_jax.train.held_out.measure`."""
    move, turn, gripper = (found[name] for name in ("translation_mm", "rotation_deg", "gripper"))
    return [
        f"{found['loss']:.4f}",
        f"{move['median_error']:.1f} mm ({move['standing_still']:.1f})",
        f"{turn['median_error']:.1f}\N{DEGREE SIGN} ({turn['standing_still']:.1f})",
        f"{gripper['right']:.0%} ({gripper['constant']:.0%})",
    ]


def held_out(console: Console, found: Mapping[str, Mapping[str, Any]]) -> None:
    """The table of a training on recordings: method -> `palm_jax.train.held_out.measure`."""
    if not found:
        return
    table = Table(
        title="On the episodes held out",
        box=box.SIMPLE_HEAD,
        title_justify="left",
        title_style="bold",
    )
    table.add_column("method")
    for column in HELD_OUT:
        table.add_column(column, justify="right")
    for name in paper.ordered_methods(list(found)):
        table.add_row(escape(paper.method_label(name)), *held_out_cells(found[name]))
    console.print(table)
    console.print(Text(HELD_OUT_NOTE, style="dim"))


def interrupted(console: Console, command: Sequence[str], *, saved: str = "") -> None:
    """Say, after Ctrl-C, that nothing is lost and how to go on.

    Args:
      console: where to print.
      command: the words that continue the run, e.g. ["python", "-m", "palm_jax.train", ...].
      saved: what is safe, e.g. "step 1200 of 2000".
    """
    console.print()
    console.print(Text(f"Stopped. Saved: {saved}." if saved else "Stopped.", style="bold"))
    console.print(Text("To go on from there:"))
    # No wrapping: the line is meant to be copied.
    console.print(Text("  " + shlex.join(command)), soft_wrap=True)


def resumed(console: Console, where: str) -> None:
    """Say that an earlier run goes on, e.g. `resumed(console, "step 1200 of 2000")`."""
    console.print(Text(f"Resuming at {where}."))
