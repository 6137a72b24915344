"""Pieces of the HTML report: styles, tables, tiles, pictures. Strings in, strings out.

Every text passes through `esc`; nothing refers to anything outside of the page.
"""

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax.train.reporting import console, figures, paper
from palm_jax.train.reporting.runs import Counts
from palm_jax.train.reporting.stats import (
    degradation,
    degradation_interval,
    mean_interval,
    success_rate,
    wilson_interval,
)

CSS = """
:root{color-scheme:light dark;--bg:#fff;--fg:#1b1b1f;--muted:#5f6368;--line:#dfe2e7;--card:#f6f7f9;
--warn:#fff4e5;--warnline:#e8a33d}
@media(prefers-color-scheme:dark){:root{--bg:#15171a;--fg:#e8eaed;--muted:#a2a8b0;--line:#353a41;
--card:#1e2125;--warn:#33270f;--warnline:#b57a1c}}
*{box-sizing:border-box}
body{margin:0 auto;max-width:1120px;padding:2rem 1.2rem 4rem;background:var(--bg);color:var(--fg);
font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .2rem}
h2{font-size:1.25rem;margin:2.6rem 0 .8rem;padding-bottom:.3rem;border-bottom:1px solid var(--line)}
h3{font-size:1rem;margin:0 0 .5rem}
.lead{color:var(--muted);margin:.2rem 0 1.4rem}
.facts{display:grid;grid-template-columns:max-content 1fr;gap:.25rem 1.2rem;margin:0;
padding:1rem 1.2rem;background:var(--card);border-radius:10px;font-size:.9rem}
@media(min-width:900px){.facts{grid-template-columns:max-content 1fr max-content 1fr}}
.facts dt{color:var(--muted)}.facts dd{margin:0;overflow-wrap:anywhere}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(230px,1fr));gap:.8rem;
margin:1rem 0}
.tile{background:var(--card);border-radius:10px;border-left:5px solid var(--c);padding:.8rem 1rem}
.tile dl{display:flex;gap:1.6rem;margin:0}.tile dt{color:var(--muted);font-size:.8rem}
.tile dd{margin:0;font-size:1.5rem;font-weight:650;line-height:1.2;
font-variant-numeric:tabular-nums}
.tile small{font-weight:400;font-size:.8rem}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9rem;width:100%}
th,td{padding:.4rem .7rem;text-align:right;border-bottom:1px solid var(--line);vertical-align:top;
white-space:nowrap}
th{font-weight:600}thead th{border-bottom-color:var(--muted)}
thead tr:nth-child(2) th{font-weight:400;color:var(--muted);font-size:.8rem}
th[scope=row],thead tr:first-child th:first-child{text-align:left;position:sticky;left:0;
background:var(--bg)}
th[scope=colgroup]{text-align:center}
th i{display:inline-block;width:.7em;height:.7em;border-radius:2px;margin-right:.45em}
td small,th small,dd small{display:block;color:var(--muted);font-weight:400;font-size:.78rem}
small.paper{font-style:italic}
td.rate{background:linear-gradient(90deg,color-mix(in srgb,var(--c) 24%,transparent) var(--p),
transparent var(--p))}
tr.mean th,tr.mean td{border-top:2px solid var(--muted)}
figure{margin:1.2rem 0;background:#fff;border:1px solid var(--line);border-radius:10px;
padding:.8rem;color:#1b1b1f}
figure img,figure video{display:block;max-width:100%;height:auto;margin:0 auto}
figcaption{margin-top:.6rem;font-size:.88rem;color:#5f6368;text-align:center}
.videos{display:grid;grid-template-columns:repeat(auto-fit,minmax(320px,1fr));gap:.8rem}
.videos figure{margin:0;padding:.5rem}.videos video{width:100%}
pre{background:var(--card);border-radius:10px;padding:.8rem 1rem;overflow-x:auto;font-size:.85rem}
.note,.notes{font-size:.88rem;color:var(--muted)}.notes li{margin:.3rem 0}
.warn{background:var(--warn);border:1px solid var(--warnline);border-radius:10px;padding:.6rem 1rem;
font-size:.9rem;margin:1rem 0}
details{margin:.6rem 0;font-size:.9rem}summary{cursor:pointer}
footer{margin-top:3rem;color:var(--muted);font-size:.85rem}
@media print{figure,.tile{break-inside:avoid}}
"""


def esc(value: object) -> str:
    """Text for HTML, also inside attributes."""
    return html.escape(str(value), quote=True)


def _percent(value: float) -> str:
    return "–" if math.isnan(value) else f"{100 * value:.0f} %"


def _loss(value: float | None) -> str:
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.2f}".replace("-0.00", "0.00").replace("-", "−")


def _range(lower: float, upper: float, *, percent: bool) -> str:
    if math.isnan(lower) or math.isnan(upper):
        return ""
    if percent:
        return f"{100 * lower:.0f}–{100 * upper:.0f}"
    low = "−∞" if math.isinf(lower) else _loss(lower)
    return f"{low} to {_loss(upper)}"


def _small(text: str, kind: str = "") -> str:
    return f'<small class="{kind}">{esc(text)}</small>' if text else ""


def result_table(counts: Mapping[str, Counts]) -> str:
    """Rows: domains. Per method: success with interval, and degradation; the paper's below each."""
    domains = paper.ordered_domains(list(dict.fromkeys(d for c in counts.values() for d in c)))
    head = "".join(
        f'<th colspan="2" scope="colgroup"><i style="background:{figures.look(name).colour}"></i>'
        f"{esc(paper.method_label(name))}</th>"
        for name in counts
    )
    sub = '<th scope="col">success</th><th scope="col">degradation</th>' * len(counts)
    rows = []
    for domain in domains:
        cells = "".join(_domain_cells(name, counts[name], domain) for name in counts)
        rows.append(
            f'<tr><th scope="row" title="{esc(paper.domain_title(domain))}">'
            f"{esc(paper.domain_label(domain))}{_small(_full_name(domain), 'name')}</th>"
            f"{cells}</tr>"
        )
    cells = ""
    for name in counts:
        ours, theirs = ood_mean(counts[name]), paper.average_degradation(name, counts[name])
        reference = f"paper {_loss(theirs)}" if theirs is not None else ""
        cells += f"<td></td><td><b>{_loss(ours)}</b>{_small(reference, 'paper')}</td>"
    rows.append(f'<tr class="mean"><th scope="row">OOD mean</th>{cells}</tr>')
    return (
        '<div class="scroll"><table class="results"><thead>'
        f'<tr><th rowspan="2" scope="col">domain</th>{head}</tr><tr>{sub}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _full_name(domain: str) -> str:
    """What a short label stands for; empty where the label is the name."""
    return paper.domain_title(domain) if domain in paper.DOMAINS else ""


def _domain_cells(method: str, counts: Counts, domain: str) -> str:
    if domain not in counts:
        return "<td>–</td><td>–</td>"
    good, total = counts[domain]["successes"], counts[domain]["episodes"]
    rate = float(success_rate(good, total))
    lower, upper = wilson_interval(good, total)
    theirs = paper.implied_success(method, domain)
    mark = "" if domain == "ID" else "≈ "
    reference = f"paper {mark}{100 * theirs:.0f}" if theirs is not None else ""
    width = 0.0 if math.isnan(rate) else 100 * rate
    success = (
        f'<td class="rate" style="--p:{width:.1f}%;--c:{figures.look(method).colour}" '
        f'title="{good} of {total} scenes"><b>{_percent(rate)}</b>'
        f"{_small(_range(float(lower), float(upper), percent=True))}"
        f"{_small(reference, 'paper')}</td>"
    )
    if domain == "ID" or "ID" not in counts:
        return success + "<td></td>"
    base = counts["ID"]
    loss = float(degradation(rate, success_rate(base["successes"], base["episodes"])))
    ends = degradation_interval(good, total, base["successes"], base["episodes"])
    interval = _range(float(ends[0]), float(ends[1]), percent=False)
    printed = paper.degradation(method, domain)
    reference = f"paper {_loss(printed)}" if printed is not None else ""
    return success + f"<td>{_loss(loss)}{_small(interval)}{_small(reference, 'paper')}</td>"


def ood_mean(counts: Counts) -> float:
    """Plain mean of the degradations of the paper's seven domains, as in the paper; NaN without
    any. A domain of another kind of shift has a row of its own only."""
    base = counts.get("ID")
    if base is None:
        return math.nan
    rate = success_rate(base["successes"], base["episodes"])
    losses = [
        float(degradation(success_rate(entry["successes"], entry["episodes"]), rate))
        for domain, entry in counts.items()
        if domain in paper.OOD_DOMAINS
    ]
    return float(np.mean(losses)) if losses else math.nan


def mean_table(tasks: Mapping[str, Mapping[str, Counts]]) -> str:
    """The paper's Table I: methods over the mean of the tasks, from those tasks that have them."""
    methods = paper.ordered_methods(list(dict.fromkeys(m for t in tasks.values() for m in t)))
    head = "".join(f'<th scope="col">{esc(paper.domain_label(d))}</th>' for d in paper.DOMAINS)
    rows = []
    for method in methods:
        have = [counts[method] for counts in tasks.values() if method in counts]
        cells = ""
        for domain in paper.DOMAINS:
            cells += f"<td>{_mean_cell(method, have, domain)}</td>"
        ours = [value for counts in have if not math.isnan(value := ood_mean(counts))]
        theirs = paper.average_degradation(method, {d for counts in have for d in counts})
        reference = f"paper {_loss(theirs)}" if theirs is not None else ""
        average = _loss(float(np.mean(ours))) if ours else "–"
        rows.append(
            f'<tr><th scope="row"><i style="background:{figures.look(method).colour}"></i>'
            f"{esc(paper.method_label(method))}{_small(f'{len(have)} tasks', 'name')}</th>{cells}"
            f"<td><b>{average}</b>{_small(reference, 'paper')}</td></tr>"
        )
    return (
        '<div class="scroll"><table class="results"><thead><tr><th scope="col">method</th>'
        f'{head}<th scope="col">OOD mean</th></tr></thead><tbody>{"".join(rows)}</tbody></table>'
        "</div><p class=note>ID: success with its 95 % interval. Other columns: normalised "
        "degradation 1 − OOD / ID, averaged over tasks as in the paper; lower is better.</p>"
    )


def _mean_cell(method: str, have: Sequence[Counts], domain: str) -> str:
    with_domain = [counts for counts in have if domain in counts and "ID" in counts]
    if not with_domain:
        return "–"
    good = [counts[domain]["successes"] for counts in with_domain]
    total = [counts[domain]["episodes"] for counts in with_domain]
    if domain == "ID":
        mean, lower, upper = mean_interval(good, total)
        theirs = paper.in_domain_success(method)
        reference = f"paper {100 * theirs:.0f}" if theirs is not None else ""
        return (
            f"<b>{_percent(mean)}</b>{_small(_range(lower, upper, percent=True))}"
            f"{_small(reference, 'paper')}"
        )
    base = success_rate(
        [counts["ID"]["successes"] for counts in with_domain],
        [counts["ID"]["episodes"] for counts in with_domain],
    )
    losses = degradation(success_rate(good, total), base)
    losses = losses[~np.isnan(losses)]
    printed = paper.degradation(method, domain)
    reference = f"paper {_loss(printed)}" if printed is not None else ""
    mean = float(losses.mean()) if losses.size else math.nan
    return f"{_loss(mean)}{_small(reference, 'paper')}"


def held_out_table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Rows: methods that were trained on recordings; `palm_jax.train.held_out.measure` of each."""
    head = "".join(f'<th scope="col">{esc(text)}</th>' for text in ("method", *console.HELD_OUT))
    rows = []
    for name, entry in found.items():
        cells = "".join(f"<td>{esc(text)}</td>" for text in console.held_out_cells(entry))
        rows.append(
            f'<tr><th scope="row"><i style="background:{figures.look(name).colour}"></i>'
            f"{esc(paper.method_label(name))}</th>{cells}</tr>"
        )
    return (
        f'<div class="scroll"><table class="results"><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div><p class=note>{esc(console.HELD_OUT_NOTE)}"
        f"</p>{_determination(found)}"
    )


def _determination(found: Mapping[str, Mapping[str, Any]]) -> str:
    """R² of each of the action's numbers, per method."""
    names = list(dict.fromkeys(name for entry in found.values() for name in entry["r2"]))
    head = "".join(f'<th scope="col">{esc(name)}</th>' for name in names)
    rows = []
    for method, entry in found.items():
        values = (entry["r2"].get(name) for name in names)
        cells = "".join(f"<td>{'–' if v is None else f'{v:.2f}'}</td>" for v in values)
        rows.append(f'<tr><th scope="row">{esc(paper.method_label(method))}</th>{cells}</tr>')
    return (
        '<div class="scroll"><table class="results"><thead><tr><th scope="col">R² of</th>'
        f"{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def tiles(counts: Mapping[str, Counts]) -> str:
    """The two numbers that matter most, per method, beside the paper's."""
    cards: list[str] = []
    if len(counts) > 4:
        return ""  # with many methods the table says it better
    for method, by_domain in counts.items():
        if "ID" not in by_domain:
            continue
        base = by_domain["ID"]
        rate = float(success_rate(base["successes"], base["episodes"]))
        theirs = (paper.in_domain_success(method), paper.average_degradation(method, by_domain))
        notes = [f"paper {_percent(theirs[0])}" if theirs[0] is not None else ""]
        notes.append(f"paper {_percent(theirs[1])}" if theirs[1] is not None else "")
        loss = ood_mean(by_domain)
        cards.append(
            f'<div class="tile" style="--c:{figures.look(method).colour}">'
            f"<h3>{esc(paper.method_label(method))}</h3><dl>"
            f"<div><dt>in-domain success</dt><dd>{_percent(rate)}{_small(notes[0], 'paper')}</dd>"
            f"</div><div><dt>lost out of domain</dt><dd>{_percent(loss).replace('-', '−')}"
            f"{_small(notes[1], 'paper')}</dd></div></dl></div>"
        )
    return f'<div class="tiles">{"".join(cards)}</div>' if cards else ""


def _data_uri(path: Path) -> str:
    kinds = {".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"data:{kinds[path.suffix.lower()]};base64,{content}"


_MAGIC = {".png": (0, b"\x89PNG\r\n\x1a\n"), ".gif": (0, b"GIF8"), ".mp4": (4, b"ftyp")}


def damaged_media(path: Path) -> str:
    """Why a picture or video cannot be shown; empty if it looks whole."""
    try:
        head = path.read_bytes()[:16]
    except OSError as error:
        return f"{path}: not readable ({error})"
    offset, magic = _MAGIC[path.suffix.lower()]
    if head[offset : offset + len(magic)] != magic:
        return f"{path}: not a {path.suffix[1:].upper()} file (empty or damaged)"
    return ""


def _png_width(path: Path) -> int:
    with path.open("rb") as file:
        return int.from_bytes(file.read(24)[16:20], "big")


def picture(path: Path, caption: str) -> str:
    """A picture with its caption, smaller than its pixels so that it stays sharp."""
    size = f' width="{round(0.75 * _png_width(path))}"' if path.suffix.lower() == ".png" else ""
    return (
        f'<figure><img alt="{esc(caption)}"{size} src="{_data_uri(path)}">'
        f"<figcaption>{esc(caption)}</figcaption></figure>"
    )


def video(path: Path, caption: str) -> str:
    """A video (or an animated GIF) with its caption."""
    if path.suffix.lower() == ".gif":
        return picture(path, caption)
    return (
        f'<figure class="video"><video controls loop muted playsinline preload="metadata" '
        f'src="{_data_uri(path)}"></video><figcaption>{esc(caption)}</figcaption></figure>'
    )


def section(title: str, body: str) -> str:
    return f"<section><h2>{esc(title)}</h2>{body}</section>" if body else ""


def listing(lines: Iterable[str]) -> str:
    return f'<ul class="notes">{"".join(f"<li>{esc(line)}</li>" for line in lines)}</ul>'
