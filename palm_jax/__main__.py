"""`python -m palm_jax VERB ...`, the same as the console script `palm-jax VERB ...`.

Every verb is a module with `main(argv) -> int | None`, imported only when it is asked for, so
`--help` is instant and a verb's dependencies load only with that verb.
"""

import difflib
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from palm_jax import __version__
from palm_jax._quiet import without_lines


class Verb(NamedTuple):
    """One command: the module that holds its `main`, a line for `--help`, the extra it needs."""

    module: str
    help: str
    extra: str = ""


VERBS: dict[str, Verb] = {
    "train": Verb("palm_jax.train.__main__", "collect demonstrations, train, evaluate, report"),
    "sweep": Verb("palm_jax.train.sweep", "success over a grid of shifts, for a finished run"),
    "table": Verb("palm_jax.train.table", "every cell of the paper's main table, resumable"),
    "report": Verb("palm_jax.train.report", "one self-contained HTML page from run folders"),
    "data": Verb("palm_jax.train.data.commands", "your own robot data: inspect, check, align"),
    "show": Verb("palm_jax.train.show", "pictures of every task, robot and shift, as PNG"),
    "serve": Verb("palm_jax.train.serve", "a policy behind a websocket, for a robot", "serve"),
    "export": Verb(
        "palm_jax.train.export", "a policy as StableHLO, for use without Python", "export"
    ),
    "debug": Verb("palm_jax.train.debug", "repeat and explain an update that failed"),
    "bench": Verb("benchmarks.__main__", "speed, side by side with peers (needs a checkout)"),
}

_BENCH_HINT = """\
palm-jax: the benchmarks are not part of the installed package. Run them from a checkout:

    git clone <this repository> && cd <its folder>
    make bench                                  # or, in an environment with the bench extra:
    python -m palm_jax bench [render|physics|train|align|worlds]
"""


def usage() -> str:
    """The text of `--help`."""
    width = max(map(len, VERBS))
    lines = [f"  {name:<{width}}  {verb.help}" for name, verb in VERBS.items()]
    return (
        f"palm_jax {__version__}: perception alignment for visuomotor policies\n\n"
        "usage: python -m palm_jax VERB [options]      (or: palm-jax VERB [options])\n\n"
        + "\n".join(lines)
        + "\n\n`python -m palm_jax VERB --help` lists the options of a verb.\n"
    )


def unknown_verb(name: str) -> str:
    """The message for a verb that does not exist, with the nearest one that does."""
    near = difflib.get_close_matches(name, VERBS, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"palm-jax: unknown verb {name!r}.{hint} Known verbs: {', '.join(VERBS)}.\n"


def _checkout_root() -> Path | None:
    """The folder that holds `benchmarks/`, or None in an installation without it."""
    root = Path(__file__).resolve().parents[1]
    return root if (root / "benchmarks" / "__main__.py").is_file() else None


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit status.

    Args:
      argv: the words after the program name; None takes them from `sys.argv`.

    Returns:
      0 on success, 2 for a wrong command line, else what the verb returned.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(usage())
        return 0
    if words[0] in ("-V", "--version"):
        sys.stdout.write(f"palm_jax {__version__}\n")
        return 0
    name, rest = words[0], words[1:]
    if name not in VERBS:
        sys.stderr.write(unknown_verb(name))
        return 2
    if name == "bench":
        root = _checkout_root()
        if root is None:
            sys.stderr.write(_BENCH_HINT)
            return 2
        sys.path.insert(0, str(root))  # the console script does not look into the checkout
    # Before the slow imports, and on stderr: verbs such as bench print JSON on stdout.
    print(f"palm_jax {__version__}: {name}", file=sys.stderr, flush=True)
    try:
        with without_lines():
            module = importlib.import_module(VERBS[name].module)
    except ModuleNotFoundError as error:
        if not VERBS[name].extra:
            raise
        hint = f"pip install 'palm-jax[{VERBS[name].extra}]'"
        sys.stderr.write(f"palm-jax: {name} needs {error.name}: {hint}\n")
        return 2
    return int(module.main(rest) or 0)


if __name__ == "__main__":
    sys.exit(main())
