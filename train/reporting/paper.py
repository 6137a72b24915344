"""The numbers printed in the paper, in one place, and names for domains and methods.

Source: Wang, Zhuang, Kragic, Pokorny, "PALM: Enhanced Generalizability for Local
Visuomotor Policies via Perception Alignment", RA-L 2026, arXiv 2601.19514. Table numbers are the
paper's. All are fractions. Table I and II are means over the paper's four simulated tasks.
"""

import re
from collections.abc import Iterable

# The eight domains in the paper's order: in-domain, then every non-empty set of
# W (workspace), V (viewpoint) and E (embodiment). The keys are those of eval.json.
DOMAINS: dict[str, str] = {
    "ID": "in-domain",
    "W": "workspace",
    "V": "viewpoint",
    "E": "embodiment",
    "WV": "workspace + viewpoint",
    "WE": "workspace + embodiment",
    "VE": "viewpoint + embodiment",
    "WVE": "all three",
}
OOD_DOMAINS = tuple(name for name in DOMAINS if name != "ID")

# Display names. "w/o" rows are PALM without one of its parts; PALM in the paper's narrow frame
# and RoVi-Aug's widest views are this package's own comparisons.
METHODS: dict[str, str] = {
    "bc": "BC",
    "palm": "PALM",
    "palm-paper-frame": "PALM (512 frame)",
    "palm-crop": "PALM w/o crop",
    "palm-overlay": "PALM w/o overlay",
    "palm-aug": "PALM w/o augmentation",
    "palm-prop": "PALM w/o aligned proprio",
    "mirrorduo": "MirrorDuo",
    "roviaug": "RoVi-Aug",
    "roviaug-ultra": "RoVi-Aug (widest views)",
    "arro": "ARRO",
}

TASKS: dict[str, str] = {
    "lift_lid": "Lift Lid",
    "lift_spam": "Lift Spam",
    "lift_spam_invisible": "Lift Spam Invisible",
    "insert_peg": "Insert Peg",
    "rearrange_veggies": "Rearrange Veggies",
    "drawer": "Drawer",
    "stack": "Stack",
}

TABLE_TASKS = ("lift_lid", "lift_spam", "insert_peg", "rearrange_veggies")
"""The rows of Table I, whose means it prints."""

# Table I: in-domain success, then normalised degradation per domain in the order of OOD_DOMAINS.
_TABLE_I: dict[str, tuple[float, ...]] = {
    "mirrorduo": (0.47, 0.33, 0.52, 0.60, 0.61, 0.67, 0.70, 0.65),
    "roviaug": (0.26, 0.17, 0.36, 0.41, 0.45, 0.55, 0.72, 0.49),
    "arro": (0.41, 0.25, 0.55, 0.32, 0.81, 0.48, 0.60, 0.79),
    "bc": (0.52, 0.40, 0.61, 0.79, 0.65, 0.78, 0.89, 0.83),
    "palm-crop": (0.35, 0.23, 0.30, 0.65, 0.35, 0.74, 0.73, 0.66),
    "palm-overlay": (0.73, 0.08, 0.11, 0.47, 0.04, 0.45, 0.44, 0.44),
    "palm-aug": (0.73, 0.08, 0.05, 0.23, 0.06, 0.21, 0.34, 0.21),
    "palm-prop": (0.70, 0.35, 0.32, 0.15, 0.55, 0.53, 0.38, 0.57),
    "palm": (0.72, -0.02, 0.06, 0.10, 0.00, 0.05, 0.21, 0.18),
}
# The table's own last row, printed with two digits.
_TABLE_I_AVERAGE = {
    "mirrorduo": 0.58,
    "roviaug": 0.45,
    "arro": 0.54,
    "bc": 0.71,
    "palm-crop": 0.52,
    "palm-overlay": 0.29,
    "palm-aug": 0.17,
    "palm-prop": 0.41,
    "palm": 0.08,
}

# Table II: third-person and eye-in-hand camera together, laid out like Table I.
TABLE_II: dict[str, tuple[float, ...]] = {
    "bc": (0.89, 0.03, 0.09, 0.26, 0.09, 0.09, 0.26, 0.26),
    "palm": (0.88, -0.06, -0.01, 0.11, -0.02, 0.08, 0.12, 0.06),
}
# Table IV: real robot, success in 20 trials: domain -> (drawer BC, PALM, stack BC, PALM).
TABLE_IV: dict[str, tuple[float, float, float, float]] = {
    "ID": (0.65, 0.85, 0.65, 1.00),
    "W": (0.20, 0.60, 0.00, 0.60),
    "V": (0.20, 0.65, 0.00, 0.50),
    "E": (0.50, 0.85, 0.00, 1.00),
}

_LETTERS = {
    "workspace": "W",
    "w": "W",
    "viewpoint": "V",
    "view": "V",
    "v": "V",
    "embodiment": "E",
    "e": "E",
}
_WHOLE = {"id": "ID", "in": "ID", "indomain": "ID", "all": "WVE", "ood": "WVE"}


def domain_key(name: str) -> str:
    """The key in `DOMAINS` for any usual spelling: "in_domain", "w+v", "viewpoint_workspace", ...

    Names that are none of the eight come back unchanged: a sweep may have domains of its own.
    """
    if not re.fullmatch(r"[A-Za-z +&,_-]+", name):
        return name
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word]
    joined = "".join(words)
    if joined in _WHOLE:
        return _WHOLE[joined]
    if len(words) == 1 and words[0] not in _LETTERS and set(words[0]) <= set("wve"):
        words = list(words[0])
    letters = {_LETTERS.get(word, "?") for word in words}
    if not letters or "?" in letters:
        return name
    return "".join(letter for letter in "WVE" if letter in letters)


def domain_label(name: str) -> str:
    """Short label as in the paper's tables: ID, W, V, E, W+V, W+E, V+E, All; others in words."""
    key = domain_key(name)
    if key not in DOMAINS:
        return domain_title(name)
    if key == "ID":
        return key
    return "All" if key == "WVE" else "+".join(key)


def domain_title(name: str) -> str:
    """The domain in words: "object color + workspace"."""
    return DOMAINS.get(domain_key(name)) or name.replace("_", " ").replace("+", " + ")


def ordered_domains(names: list[str]) -> list[str]:
    """Known domains in the paper's order, then the others in the order given."""
    order = list(DOMAINS)
    known = [name for name in names if domain_key(name) in DOMAINS]
    rest = [name for name in names if domain_key(name) not in DOMAINS]
    return sorted(known, key=lambda name: order.index(domain_key(name))) + rest


def method_label(method: str) -> str:
    """Display name of a method; an unknown one as it is."""
    return METHODS.get(method, method)


def task_label(task: str) -> str:
    """Display name of a task; an unknown one with spaces for underscores."""
    return TASKS.get(task, task.replace("_", " "))


def ordered_methods(names: list[str]) -> list[str]:
    """PALM and BC first, then ablations and other baselines; unknown ones last."""
    first = ["palm", "bc"]
    order = first + [name for name in METHODS if name not in first]
    return sorted(names, key=lambda name: order.index(name) if name in order else len(order))


def in_domain_success(method: str) -> float | None:
    """Table I, first row; None for a method that is not in the paper."""
    return _TABLE_I[method][0] if method in _TABLE_I else None


def degradation(method: str, domain: str) -> float | None:
    """Table I, normalised degradation in one out-of-distribution domain; None where not given."""
    key = domain_key(domain)
    if method not in _TABLE_I or key not in OOD_DOMAINS:
        return None
    return _TABLE_I[method][1 + OOD_DOMAINS.index(key)]


def average_degradation(method: str, domains: Iterable[str] = OOD_DOMAINS) -> float | None:
    """Mean of Table I over some out-of-distribution domains; over all seven, its last row.

    Compare means over the same domains only: those with embodiment are the hard ones. In-domain and
    unknown domains are ignored; None if nothing is left, or for a method that is not in the paper.
    """
    keys = {domain_key(name) for name in domains} & set(OOD_DOMAINS)
    if method not in _TABLE_I or not keys:
        return None
    if len(keys) == len(OOD_DOMAINS):
        return _TABLE_I_AVERAGE[method]
    values = [value for name in keys if (value := degradation(method, name)) is not None]
    return sum(values) / len(values)


def implied_success(method: str, domain: str) -> float | None:
    """Success that Table I implies: ID * (1 - degradation).

    Approximate outside of the in-domain row: the paper averages ratios over tasks, not successes.
    """
    base, key = in_domain_success(method), domain_key(domain)
    if base is None or key == "ID":
        return base if key == "ID" else None
    loss = degradation(method, key)
    return None if loss is None else base * (1.0 - loss)
