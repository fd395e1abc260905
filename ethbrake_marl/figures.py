"""Every figure of a result in one style: its colours, its caption, its file, and its SVG for a page. Loads matplotlib.

A figure is a function of a result: of an evaluation, an episode, a curve, a measurement of the shield, a study.
"""

from __future__ import annotations

import hashlib
import io
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Self
from xml.etree import ElementTree

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure as Figure  # the type that every figure has, for other modules
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from matplotlib.ticker import (
    EngFormatter,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
    PercentFormatter,
    StrMethodFormatter,
)

from ethbrake_marl.envs import (
    BODY_M,
    COLOURS as COLOURS,  # one palette for figures and frames
    vehicle_colour,
)
from ethbrake_marl.errors import InvalidInput, count_of, plain_text
from ethbrake_marl.evaluation import (
    Conditions,
    DecelerationCurve,
    EpisodeRecord,
    Evaluation,
    SummaryRow,
    drawn_alike,
    mean,
)
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.files.store import write_output
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits import Unproven
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.scenario import QUANTITY, Sample, Scenario

# Markers and dashes repeat the distinction of the colours.
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1)), "-", "--")
GREY = "#555555"
ALARM = "#b00020"
DPI = 150

_CAPTION = "caption"  # the name of a caption's group in an SVG
_CAPTION_PT = 7.5
_CHARACTERS_PER_INCH = 17.0  # of a caption
_NO_DATES: dict[str, dict[str, None]] = {  # what would differ from one writing to the next, and from one version too
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


class ShownFigure(Figure):
    """A figure that a notebook shows, whether or not pyplot is loaded there."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw it; the first of the two times that a writing draws it, where nothing is kept, it is only laid out."""
        engine = self.get_layout_engine()
        if self.axes and isinstance(engine, ConstrainedLayoutEngine) and self.canvas.is_saving():
            engine.execute(self)
        else:
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        return picture_bytes(self, "shown.png")


def series_style(number: int) -> dict[str, Any]:
    """Colour, marker and dashes of the series with this number (from 0); they repeat after seven."""
    k = number % len(COLOURS)
    return {"color": COLOURS[k], "marker": MARKERS[k], "linestyle": DASHES[k], "linewidth": 1.6, "markersize": 4.5}


def label_text(text: str, most: int = 40) -> str:
    """Text as a figure may have it, whoever wrote it: no formula, no sign that the font lacks, not too long."""
    signs = font_signs()
    told = "".join(c if ord(c) in signs else c.encode("unicode_escape").decode() for c in plain_text(text))
    return (told if len(told) <= most else f"{told[: most - 16]}…{told[-15:]}").replace("$", r"\$")


@cache
def font_signs() -> frozenset[int]:
    """Code points that the font of figures has."""
    return frozenset(get_font(findfont("DejaVu Sans")).get_charmap())


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure that lays itself out; it belongs to no window."""
    return ShownFigure(figsize=(width_in, height_in), layout="constrained")


def style_axes(axes: Axes, labelsize: float = 9) -> None:
    """Thin grid behind the data, no frame where nothing is read off."""
    axes.grid(visible=True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=labelsize, color=GREY)


def new_panels(size_in: tuple[float, float], rows: int = 1, columns: int = 1, **how: Any) -> tuple[Figure, list[Axes]]:
    """A figure and its axes, row by row, in the style of all; ``how`` as matplotlib's ``subplots``."""
    figure = new_figure(*size_in)
    panels = list(figure.subplots(rows, columns, squeeze=False, **how).ravel())
    for axes in panels:
        style_axes(axes)
    return figure, panels


def name_axes(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """What a panel shows, above it, and what its axes mean."""
    in_style = ((title, partial(axes.set_title, loc="left"), 10), (x, axes.set_xlabel, 9), (y, axes.set_ylabel, 9))
    for text, write, size in in_style:
        if text:
            write(text, fontsize=size)


def finish(
    figure: Figure,
    caption: str,
    legend: Axes | None = None,
    *,
    columns: int = 6,
    fontsize: float = 9,
    loc: Literal["outside upper left", "outside upper right"] = "outside upper left",
) -> Figure:
    """The figure with its caption, and one legend for all panels above them: that of the axes given."""
    if legend is not None:
        named = legend.get_legend_handles_labels()
        figure.legend(*named, loc=loc, ncols=columns, frameon=False, fontsize=fontsize)
    add_caption(figure, caption)
    return figure


def _band(axes: Axes, x: Sequence[float] | Floats, low: Any, high: Any, style: Mapping[str, Any]) -> None:
    """What a line's intervals reach, in the line's colour."""
    axes.fill_between(x, low, high, color=str(style["color"]), alpha=0.18, linewidth=0.0)


def add_caption(figure: Figure, text: str) -> None:
    """The conditions of a figure, small, below it."""
    width = int(figure.get_figwidth() * _CHARACTERS_PER_INCH)
    label = figure.supxlabel(textwrap.fill(text, width), x=0.01, ha="left", fontsize=_CAPTION_PT, color=GREY)
    label.set_gid(_CAPTION)


def picture_ending(path: str | Path) -> str:
    """The ending that says how a picture is written; raises ``InvalidInput`` for any but .png, .svg and .pdf."""
    ending = Path(path).suffix.lower()
    if ending not in _NO_DATES:
        raise InvalidInput(f"{path}: pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf")
    return ending


def picture_bytes(figure: Figure, path: str | Path) -> bytes:
    """The figure as the ending of ``path`` says: ``.png``, ``.svg`` or ``.pdf``; the same figure gives the same bytes.

    Raises ``InvalidInput`` for another ending.
    """
    ending = picture_ending(path)
    buffer = io.BytesIO()
    # Fonts travel with the file: as outlines in SVG, as TrueType in PDF.
    with matplotlib.rc_context(
        {"savefig.facecolor": "white", "svg.hashsalt": "ethbrake", "svg.fonttype": "path", "pdf.fonttype": 42}
    ):
        figure.savefig(buffer, format=ending[1:], dpi=DPI, metadata=_NO_DATES[ending])
    return buffer.getvalue()


def write_picture(path: str | Path, figure: Figure, *, force: bool = False) -> None:
    """Write a figure as the ending of ``path`` says, whole or not at all.

    Raises ``InvalidInput`` for an ending other than ``.png``, ``.svg`` and ``.pdf`` or a file that cannot be written,
    ``AlreadyExists`` unless ``force``.
    """
    write_output(path, picture_bytes(figure, path), force=force)


# A figure inside a page.

_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_DROPPED = {f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"}
_PALETTE = {  # colours of figures by what a page calls them: it has others for the dark
    "#000000": "var(--series-0)",
    "#d55e00": "var(--series-1)",
    "#0072b2": "var(--series-2)",
    "#009e73": "var(--series-3)",
    "#cc79a7": "var(--series-4)",
    "#e69f00": "var(--series-5)",
    "#56b4e9": "var(--series-6)",
    "#ffffff": "var(--paper)",
    "#555555": "var(--quiet)",
    "#262626": "var(--ink)",
    "#b00020": "var(--alarm)",
    "#dddddd": "var(--grid)",
    "black": "var(--ink)",
    "white": "var(--paper)",
}
_ID = re.compile(r"#([A-Za-z][\w.:-]*)")
_CLIP = re.compile(r"url\(#[A-Za-z][\w.:-]*\)")
_HREF = f"{{{_LINK}}}href"
_TAGS = {f"{{{_SVG}}}{name}" for name in ("svg", "g", "defs", "path", "use", "clipPath", "rect")}  # of a figure of ours
_ATTRIBUTES = {
    "id", "d", "x", "y", "width", "height", "viewBox", "transform", "clip-path", "fill", "fill-opacity", "opacity",
    "stroke", "stroke-width", "stroke-opacity", "stroke-linecap", "stroke-linejoin", "stroke-dasharray",
    "stroke-dashoffset", "stroke-miterlimit", "version",
}  # fmt: skip
_MOST_DEEP = 50
_LINE_PT = 1.2 * _CAPTION_PT  # of a caption, from one line to the next
_NARROW_PT = 540.0  # figures up to this width have one panel
SLIM_IN = 3.8  # a figure of this width can be read on a phone without scrolling


def inline_svg(figure: Figure | bytes, label: str, *, recolour: bool = True) -> tuple[str, str]:
    """A figure as an SVG element of a page, whose policy allows no ``style``, and its caption, which is taken out.

    No two names in a page may be alike. Raises ``InvalidInput`` for the bytes of an SVG with what no figure of ours
    holds: somebody else may have changed the file.
    """
    svg = figure if isinstance(figure, bytes) else picture_bytes(figure, "figure.svg")
    if svg is figure and not _is_ours(svg):
        raise InvalidInput("is not a figure as it was drawn; make it again (--force)")
    root = ElementTree.fromstring(svg, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    group, caption = root.find(f".//{{{_SVG}}}g[@id='{_CAPTION}']"), ""
    if group is not None:  # its text stands in comments; outlines of its letters stay: texts drawn after it use them
        lines = [(each.text or "").strip() for each in group.iter(ElementTree.Comment)]  # type: ignore[arg-type]
        outlines = list(group.iter(f"{{{_SVG}}}defs"))
        for child in list(group):
            group.remove(child)
        group.extend(outlines)
        width, height = _size_pt(root)
        if height > len(lines) * _LINE_PT:
            root.attrib["viewBox"] = f"0 0 {width:g} {height - len(lines) * _LINE_PT:g}"
        caption = "".join(line if re.search(r"\w-$", line) else f"{line} " for line in lines).strip()
    prefix = f"f{hashlib.sha256(svg + label.encode()).hexdigest()[:8]}-"
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _DROPPED or not isinstance(child.tag, str):  # the latter are comments
                parent.remove(child)
    for element in root.iter():
        _restyle(element, recolour)
        if "id" in element.attrib:
            element.attrib["id"] = prefix + element.attrib["id"]
        for name, value in element.attrib.items():  # every name that it points to
            if name == _HREF or (name in ("clip-path", "fill", "mask") and value.startswith("url(")):
                element.attrib[name] = value if value.startswith("data:") else _ID.sub(rf"#{prefix}\1", value)
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    if _size_pt(root)[0] > _NARROW_PT:
        root.attrib["class"] = "broad"
    elif _size_pt(root)[0] <= 72.0 * SLIM_IN + 0.1:
        root.attrib["class"] = "slim"
    root.attrib |= {"role": "img", "aria-label": plain_text(label, keep="\u00a0")}
    root.attrib |= {
        "stroke-linejoin": "round",
        "stroke-linecap": "butt",
        "fill": "var(--ink)" if recolour else "#000000",
    }
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    return ElementTree.tostring(root, encoding="unicode"), caption


def _size_pt(root: ElementTree.Element) -> tuple[float, float]:
    """Width and height of a figure; 0 where it does not say them as ours do."""
    found = re.fullmatch(r"0 0 (\d+(?:\.\d+)?) (\d+(?:\.\d+)?)", root.attrib.get("viewBox", ""))
    return (float(found[1]), float(found[2])) if found else (0.0, 0.0)


def _is_ours(svg: bytes) -> bool:
    """Whether all that a page would take from an SVG is what our figures are made of."""
    try:
        level = [ElementTree.fromstring(svg)]
    except (ElementTree.ParseError, LookupError, ValueError):  # no XML, or in a coding that nobody knows
        return False
    for _ in range(_MOST_DEEP):
        level = [element for element in level if element.tag not in _DROPPED]
        for element in level:
            _restyle(element, recolour=False)
            if element.tag not in _TAGS:
                return False
            for name, value in element.attrib.items():  # each only draws, and points to nothing outside its figure
                inside = name == "transform" or "(" not in value or _CLIP.fullmatch(value) is not None
                if not (_ID.fullmatch(value) if name == _HREF else name in _ATTRIBUTES and inside):
                    return False
        level = [child for element in level for child in element]
    return not level


def _restyle(element: ElementTree.Element, recolour: bool) -> None:
    """Write each declaration of ``style`` as the attribute of that name."""
    for declaration in element.attrib.pop("style", "").split(";"):
        name, colon, value = declaration.partition(":")
        if colon:
            element.attrib[name.strip()] = value.strip()
    if recolour:
        for name in ("fill", "stroke"):
            if (colour := element.attrib.get(name, "").lower()) in _PALETTE:
                element.attrib[name] = _PALETTE[colour]


_TITLES = {"first": "First-impact harm (m²/s²)", "total": "Total harm (m²/s²)"}
_POINTS = 250  # of a curve; more cannot be told apart
_PARTS = (
    ("best known of these worlds", "#bbbbbb", ""),
    ("above it, contact unavoidable", COLOURS[2], "//"),
    ("above it, contact avoidable", COLOURS[1], ".."),
)


def harm_by_agent(
    rows: Sequence[SummaryRow],
    harm_count: HarmCount = "first",
    elsewhere: Mapping[str, Sequence[SummaryRow]] | None = None,
) -> Figure:
    """Mean harm of each agent with its 95 % interval; a line: the best known; marks: the same agent elsewhere.

    As narrow as a phone. ``elsewhere``: rows of other tests, by title. Raises ``InvalidInput`` without rows.
    """
    if not rows:
        raise InvalidInput("harm_by_agent: no rows; evaluate at least one agent")
    figure, (axes,) = new_panels((SLIM_IN, 0.9 + 0.24 * len(rows)))
    name = {"first": "first_impact_harm", "total": "total_harm"}[harm_count]
    for k, row in enumerate(rows):
        axes.barh(k, getattr(row, name).value, height=0.62, color=COLOURS[2])
        axes.hlines(k, *getattr(row, name).ends, color=COLOURS[0], linewidth=1.6)
    if (best := rows[0][f"best_known_{name}"]) is not None:
        axes.axvline(best.value, color=COLOURS[3], linewidth=1.6, linestyle="--", label="best known")
    for number, (title, others) in enumerate((elsewhere or {}).items()):
        harms = {row.agent: getattr(row, name).value for row in others}
        places = [k for k, row in enumerate(rows) if row.agent in harms]
        style = series_style(number + 4) | {"linestyle": "none", "markersize": 6.0}
        axes.plot([harms[rows[k].agent] for k in places], places, label=label_text(title.lower(), 22), **style)
    name_axes(axes, x=_TITLES[harm_count])
    axes.set_xlim(left=0.0)
    _name_rows(axes, [row.agent for row in rows], most=22)
    axes.tick_params(labelsize=8)
    named = axes.get_legend_handles_labels()
    figure.legend(
        *named, loc="outside upper right", ncols=3, frameon=False, fontsize=8, handletextpad=0.4, columnspacing=1
    )
    return figure


def _name_rows(axes: Axes, agents: Sequence[str], most: int = 40) -> None:
    """One row per agent, the first on top; no name longer than ``most`` signs."""
    axes.set_yticks(range(len(agents)), [label_text(agent, most) for agent in agents])
    axes.invert_yaxis()


def regret_distribution(evaluation: Evaluation) -> Figure:
    """Share of the worlds in which an agent's harm is above the best known by more than x, under both counts.

    Where nothing is known to be the best, the same of the harm itself.
    """
    regrets = evaluation.regrets
    figure, panels = new_panels((10.0, 3.8), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for number, (agent, outcome) in enumerate(evaluation.outcomes.items()):
            values = outcome.ledger.world_harm(count) if regrets is None else regrets.regret(outcome, count)
            ordered = np.sort(values)  # thresholds: the values themselves, or so many of them
            chosen = np.unique(np.linspace(0, len(ordered) - 1, min(_POINTS, len(ordered))).astype(np.int64))
            thresholds = np.concatenate([[0.0], ordered[chosen]])
            share = [float((ordered > threshold).mean()) for threshold in thresholds]
            style = {**series_style(number), "markevery": 40}
            axes.plot(thresholds, share, label=label_text(agent), **style)
        axes.set_xscale("symlog", linthresh=1.0, linscale=0.4)
        axes.xaxis.set_major_formatter(FuncFormatter(_plain))
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 1.0)
        what = "Harm" if regrets is None else "Regret"
        name_axes(axes, x=f"{what}, {_TITLES[count][0].lower()}{_TITLES[count][1:]}")
    name_axes(panels[0], y="Worlds with more than that")
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    caption = f"Linear up to 1 m²/s², logarithmic beyond. {evaluation.conditions.line}."
    return finish(figure, caption, panels[0], columns=5)


def harm_in_parts(evaluation: Evaluation) -> Figure:
    """Mean harm of each agent as what nobody is known to avoid, and what it did beyond that, under both counts.

    Raises ``InvalidInput`` where nothing is proven of the worlds.
    """
    regrets = evaluation.regrets
    if regrets is None:
        raise InvalidInput("harm_in_parts: nothing is proven of these worlds, so no part can be told from another")
    avoidable = regrets.limits.proof.avoidable
    if avoidable is None:
        raise InvalidInput("harm_in_parts: where contact can be avoided is not decided for these vehicles")
    figure, panels = new_panels((10.0, 1.4 + 0.36 * len(evaluation.outcomes)), columns=2, sharey=True)
    for axes, count in zip(panels, HARM_COUNTS, strict=True):
        for k, outcome in enumerate(evaluation.outcomes.values()):
            regret, left = regrets.regret(outcome, count), 0.0
            parts = (regrets.best(count).mean(), (regret * ~avoidable).mean(), (regret * avoidable).mean())
            for part, (label, colour, hatch) in zip(map(float, parts), _PARTS, strict=True):
                axes.barh(
                    k, part, left=left, height=0.62, color=colour, hatch=hatch, edgecolor="#ffffff", linewidth=0.5,
                    label=label if k == 0 else None,
                )  # fmt: skip
                left += part
        name_axes(axes, x=_TITLES[count])
    _name_rows(panels[0], list(evaluation.outcomes))
    return finish(figure, f"Mean per world. {evaluation.conditions.line}.", panels[0], columns=5)


# The figure of one episode: where the vehicles are, where they hit each other, and what the driven one asked for.


def trajectories(records: Mapping[str, EpisodeRecord], *, caption: str = "") -> Figure:
    """Positions with impacts marked, gaps, and the command of the driven vehicle, over time.

    One column per record (by its title), on common scales: agents in the same world compare at a glance. Without a
    ``caption`` the conditions of the first record stand there. Raises ``InvalidInput`` without records.
    """
    if not records:
        raise InvalidInput("trajectories: no records given")
    first = next(iter(records.values()))
    columns = len(records)
    figure, panels = new_panels(
        (max(3.4 * columns, 6.4), 7.4), 3, columns, sharex=True, sharey="row", height_ratios=(2.2, 1.0, 1.0)
    )
    for k, (title, record) in enumerate(records.items()):
        for axes, draw in zip(panels[k::columns], (_positions, _gaps, _command), strict=True):
            draw(axes, record)
        harms = (float(record.ledger.world_harm(count)[0]) for count in HARM_COUNTS)
        told = "{}\nharm {:.2f} first-impact, {:.2f} total".format(label_text(title), *harms)
        panels[k].set_title(told, loc="left", fontsize=9.5)
        name_axes(axes, x="Time since Vehicle 1 began to brake (s)")
    positions, gaps, commands = panels[::columns]
    moving = [np.flatnonzero((each.speeds_mps != 0.0).any(axis=1)) for each in records.values()]
    # to the first sampled time from which no vehicle moves any more, or the end
    ends = [
        float(each.time_s[min(rows[-1] + 1 if len(rows) else 0, len(each.time_s) - 1)])
        for each, rows in zip(records.values(), moving, strict=True)
    ]
    positions.set_xlim(0.0, 1.1 * max(ends))
    gaps.set_ylim(bottom=0.0)
    commands.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    capacity = max(float(each.initial.vehicles.braking_capacity_mps2[0, each.vehicle]) for each in records.values())
    largest = max(float(each.command_mps2[:, each.vehicle].max()) for each in records.values())
    commands.set_ylim(-1.1 * capacity, max(largest, 0.0) + 0.4 * capacity)  # with room for a line of text
    name_axes(positions, y="Position from Vehicle 1's\nat the alert (m)")
    name_axes(gaps, y="Gap ahead (m)")
    name_axes(commands, y=f"Command of\nVehicle {first.vehicle + 1} (m/s²)")
    return finish(
        figure, caption or f"{first.scenario.name}: {Conditions.of(first.initial).quantities}. {_NOTE}", positions
    )


_NOTE = "Figures at impacts: closing speed in m/s. Vehicles are drawn without length. Harm in m²/s²."


def _positions(axes: Axes, record: EpisodeRecord) -> None:
    for i in range(record.positions_m.shape[1]):
        axes.plot(record.time_s, record.positions_m[:, i], label=f"Vehicle {i + 1}", **_vehicle_style(i))
    if np.isfinite(record.initial.obstacle_gap_m[0]):
        axes.axhline(float(record.initial.obstacle_gap_m[0]), color="black", linewidth=2.5, label="obstacle")
    rows = record.impacts
    front = np.maximum(rows.pair, 0)  # of each impact's pair; at the obstacle, Vehicle 1
    at = np.array([
        np.interp(t, record.time_s, record.positions_m[:, i]) for t, i in zip(rows.time_s, front, strict=True)
    ])  # fmt: skip
    for first, fill, size, label in ((True, "black", 60.0, "first impact"), (False, "white", 26.0, "later impact")):
        chosen = rows.first == first
        axes.scatter(
            rows.time_s[chosen], at[chosen], marker="X", s=size, facecolor=fill, edgecolor="black", linewidth=0.8,
            zorder=5 if first else 4, label=label,
        )  # fmt: skip
    for k in np.flatnonzero(rows.first):
        speed_mps = rows.closing_speed_mps[k]
        words = f"{speed_mps:.1f}" if speed_mps >= 0.05 else "< 0.1"  # an impact never reads 0.0
        axes.annotate(
            words, (rows.time_s[k], at[k]), xytext=(7, -7), textcoords="offset points",
            fontsize=8.5, va="top", zorder=6,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip


def _gaps(axes: Axes, record: EpisodeRecord) -> None:
    for p in range(record.gaps_m.shape[1]):
        axes.plot(record.time_s, record.gaps_m[:, p], **_vehicle_style(p + 1))
    times = record.impacts.time_s[record.impacts.first]
    axes.scatter(
        times, np.zeros(len(times)), marker="X", s=60.0, facecolor="black", edgecolor="black", linewidth=0.8, zorder=5,
        clip_on=False,
    )  # fmt: skip


def _command(axes: Axes, record: EpisodeRecord) -> None:
    i = record.vehicle
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(record.time_s, record.command_mps2[:, i], drawstyle="steps-post", color=vehicle_colour(i), linewidth=1.4)
    latency = float(record.initial.vehicles.latency_s[0, i])
    axes.axvline(latency, color=GREY, linewidth=0.8, linestyle=":")
    axes.annotate(
        f"acts from {latency:g} s", (latency, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -1),
        textcoords="offset points", fontsize=8, color=GREY, va="top",
    )  # fmt: skip


def _vehicle_style(i: int) -> dict[str, Any]:
    """Colour and dashes of Vehicle ``i + 1``, and of the gap ahead of it."""
    return {"color": vehicle_colour(i), "linestyle": DASHES[i % len(DASHES)], "linewidth": 1.6}


# The figures of a run.

_PANELS = (
    ("first_impact_harm", "First-impact harm (m²/s²)"),
    ("total_harm", "Total harm (m²/s²)"),
    ("collision_rate", "Worlds with a collision"),
)
_POLICY_NUMBER = 3  # the series whose colour is the learning policy's
_POLICY = COLOURS[_POLICY_NUMBER]


def learning_curve(
    points: Sequence[Mapping[str, float]], *, references: Sequence[SummaryRow] = (), caption: str = ""
) -> Figure:
    """Both harms and the collision rate of the policy on its fixed list, while it learns.

    Each point has ``steps``, ``first_impact_harm``, ``total_harm`` and ``collision_rate``; ``references`` are drawn as
    level lines. Raises ``InvalidInput`` without points.
    """
    if not points:
        raise InvalidInput("learning_curve: no points; evaluate the policy at least once during training")
    figure, panels = new_panels((10.0, 3.9), columns=3)
    steps = [point["steps"] for point in points]
    for axes, (name, label) in zip(panels, _PANELS, strict=True):
        axes.plot(steps, [point[name] for point in points], color=_POLICY, marker="o", markersize=3.5, label="policy")
        for number, row in enumerate(references):
            style = series_style(number if number < _POLICY_NUMBER else number + 1)
            axes.axhline(
                getattr(row, name).value, color=style["color"], linestyle=style["linestyle"], linewidth=1.2,
                label=label_text(row.agent),
            )  # fmt: skip
        name_axes(axes, label, "Training steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_ylim(bottom=0.0)
    panels[2].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return finish(figure, caption, panels[0])


def harm_against_total_gap(evaluation: Evaluation, *, agents: Sequence[str] | None = None, bins: int = 12) -> Figure:
    """Mean of both harms against the sum of the gaps at the alert, one line per agent, bands: 95 % intervals.

    Worlds are grouped into ``bins`` equal parts of the range. Raises ``InvalidInput`` for an unknown agent or
    ``bins < 1``.
    """
    if not bins >= 1:
        raise InvalidInput(f"harm_against_total_gap: bins = {bins}; at least 1 is needed")
    gap, gaps = evaluation.worlds.gaps_m.sum(axis=1), [f"d{p}" for p in range(1, evaluation.worlds.N)]
    part = np.minimum(((gap - gap.min()) / (np.ptp(gap) or 1.0) * bins).astype(np.int64), bins - 1)
    groups = [part == k for k in np.unique(part)]
    sum_of_gaps = " + ".join(gaps) if len(gaps) <= 3 else f"d1 + … + {gaps[-1]}"
    figure, panels = new_panels((10.0, 4.6), columns=2, sharey=True)
    for axes, (name, label) in zip(panels, _PANELS[:2], strict=True):
        for number, agent in enumerate(evaluation.outcomes if agents is None else agents):
            harm, style = getattr(evaluation.outcome(agent), name), series_style(number)
            estimates = [mean(harm[group]) for group in groups]
            at = [float(gap[group].mean()) for group in groups]
            axes.plot(at, [each.value for each in estimates], label=label_text(agent), **style)
            ends = np.array([each.ends for each in estimates])
            if len(groups) > 1:
                _band(axes, at, ends[:, 0], ends[:, 1], style)
            else:
                axes.vlines(at, ends[:, 0], ends[:, 1], color=str(style["color"]), linewidth=1.2)
        name_axes(axes, label, f"Total gap at the alert, {sum_of_gaps} (m)")
        axes.set_ylim(bottom=0.0)
    caption = f"Mean per group of worlds; bands: 95 % intervals. {evaluation.conditions.line}."
    return finish(figure, caption, panels[0])


# Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known.

_PREDICTED = COLOURS[2]
_COUNTS: tuple[tuple[HarmCount, str, str, str], ...] = (
    ("first", "first-impact harm", COLOURS[1], "-"),
    ("total", "total harm", COLOURS[0], "--"),
)
_REGIMES = {  # name of how a pair first meets: its colour and meaning
    "early": ("#d7c2e8", "before the front vehicle brakes"),
    "A": ("#8f8f8f", "A: rear vehicle still coasts"),
    "A'": ("#5f5f5f", "A': rear vehicle coasts, front one stands"),
    "B": ("#9fd3ee", "B: both brake"),
    "C": ("#f3c98b", "C: front vehicle stands"),
}


def deceleration_figure(curve: DecelerationCurve, *, title: str = "") -> Figure:
    """Predicted and realised harm of one world over the constant deceleration of one vehicle.

    Above: the three curves, the decelerations that E-V2X-BM takes (closed form and coupled, both counts), and as level
    lines the best known harm of any profile, where it is known. Below: how each pair alone first meets.
    """
    scenario, vehicle = curve.task.scenario, curve.task.vehicle
    figure = new_figure(8.0, 5.4)
    axes, strips = figure.subplots(2, 1, sharex=True, height_ratios=(5.0, 0.45 * len(curve.regimes)))
    style_axes(axes)
    at, changes = curve.deceleration_mps2, {pair: names[1:] != names[:-1] for pair, names in curve.regimes.items()}
    axes.plot(
        at, curve.predicted, color=_PREDICTED, linestyle="-.", linewidth=1.4, zorder=4, label="predicted (pairwise)"
    )
    for harm_count, name, colour, dashes in _COUNTS:
        axes.plot(at, curve.harm(harm_count), color=colour, linestyle=dashes, linewidth=1.5, label=f"realised {name}")
    for changed in changes.values():
        for k in np.flatnonzero(changed):
            axes.axvline(float(at[k + 1]), color=GREY, linewidth=0.6, linestyle=(0, (1, 3)))
    largest = max(float(harm.max()) for harm in (curve.predicted, curve.first_impact_harm, curve.total_harm))
    axes.set_ylim(-0.02 * largest, 1.05 * largest + 1e-3)
    chosen, predicted = curve.closed_form.deceleration_mps2, curve.closed_form.harm
    realised = float(curve.first_impact_harm[np.searchsorted(at, chosen)])
    axes.vlines(chosen, predicted, realised, color=_PREDICTED, linewidth=1.0, linestyle=":")
    axes.plot(
        [chosen], [predicted], color=_PREDICTED, marker="D", markersize=6, linestyle="none", clip_on=False, zorder=6,
        label=f"a* = {chosen:.3f} m/s², closed form: predicts {predicted:.2f}, realises {realised:.2f}",
    )  # fmt: skip
    for (harm_count, name, colour, _), marker, size in zip(_COUNTS, ("o", "s"), (6, 10), strict=True):
        best = curve.coupled[harm_count]
        axes.plot(
            [best.deceleration_mps2], [best.harm], color=colour, marker=marker, markersize=size, markerfacecolor="none",
            linestyle="none", markeredgewidth=1.4, clip_on=False, zorder=5,
            label=f"a* = {best.deceleration_mps2:.3f} m/s², coupled, least {name}: {best.harm:.2f}",
        )  # fmt: skip
    limits = curve.limits
    if not isinstance(limits, Unproven) and limits.known[0]:  # of any profile, over all time-varying commands
        first, total = float(limits.first_impact_harm[0]), float(limits.total_harm[0])
        for (_, _, colour, dashes), harm in zip(_COUNTS, (first, total), strict=True):
            axes.axhline(harm, color=colour, linewidth=0.9, linestyle=dashes, alpha=0.7)
        proof = limits.proof
        least = "" if proof.harm is None else f"; proven: no less than {proof.harm[0]:.2f}"
        told = " (avoidable)" if proof.avoidable is not None and proof.avoidable[0] else least
        axes.annotate(
            f"best known profile: {first:.2f} first-impact, {total:.2f} total{told}", (0.0, max(first, total)),
            xytext=(6, 3), textcoords="offset points", fontsize=8.5, color=GREY,
        )  # fmt: skip
    axes.set_xlim(0.0, float(at[-1]))
    name_axes(axes, title or f"{scenario.name}: one world", y="Harm (m²/s²)")
    present = []
    for row, (pair, names) in enumerate(curve.regimes.items()):
        for start, stop in pairwise([0, *(np.flatnonzero(changes[pair]) + 1), len(names)]):
            name, left, right = str(names[start]), at[start], at[min(stop, len(at) - 1)]
            if name in _REGIMES:
                colour = _REGIMES[name][0]
                strips.barh(-row, right - left, left=left, height=0.8, color=colour, edgecolor=GREY, linewidth=0.6)
                present.append(name)
    strips.set_yticks([-row for row in range(len(curve.regimes))], list(curve.regimes))
    strips.set_ylim(0.5 - len(curve.regimes), 0.5)
    strips.tick_params(labelsize=9, color=GREY)
    strips.spines[["top", "right"]].set_visible(False)
    handles = [Patch(facecolor=c, edgecolor=GREY, label=m) for r, (c, m) in _REGIMES.items() if r in present]
    handles.append(Patch(facecolor="white", edgecolor=GREY, label="no contact"))
    strips.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.75), ncols=4, frameon=False, fontsize=8)
    name_axes(strips, x=f"Constant deceleration of Vehicle {vehicle + 1} (m/s²)")
    others = {i: scenario.scripts.get(i, "full_brake") for i in range(scenario.vehicles) if i != vehicle}
    scripts = ", ".join(dict.fromkeys(others.values()))
    if len(set(others.values())) != 1:
        scripts = ", ".join(f"Vehicle {i + 1} {script}" for i, script in others.items())
    conditions = (
        f"{Conditions.of(curve.world).quantities}. Harm until {scenario.horizon_s:g} s."
        " Predicted: each pair alone, all others braking fully."
        " Realised: in the simulation, with velocity exchange and every later impact;"
        f" other vehicles: {scripts}. Dotted: where the way changes in which a pair first meets."
    )
    return finish(figure, conditions, axes, columns=2, fontsize=8.5)


# The worlds of a scenario: how each quantity is distributed, which go together, and three worlds to scale.

_ABREAST = 4  # distributions in a row
_MOST_APART = 4  # outlines in one of them that are named
_MOST_PAIRED = 5  # quantities that are drawn in pairs
_LABEL_CHARACTERS = 18  # of a line beside such a pair
_MOST_NAMED = 8  # vehicles of a line whose gaps and speeds are written
_SHOWN = {0.0: "shortest line", 0.5: "median line", 1.0: "longest line"}  # by the rank of the sum of gaps


def worlds_figure(scenario: Scenario, sample: Sample, *, seed: int) -> Figure:
    """How each quantity that varies is distributed, the most important ones in pairs, and three worlds to scale.

    In pairs are quantities of the first learner, and of the pair ahead of it, before those of others. Colours tell
    the scenarios of a mixture apart, or the types of that vehicle.
    """
    worlds, panels = sample.worlds, drawn_alike(sample.worlds, scenario)
    focus = scenario.learners[0] if scenario.learners else 0
    kinds = sample.kinds.get("scenario", sample.kinds.get(f"vehicle_{focus + 1}_type", np.full(worlds.n, "")))
    paired, ranked = _paired(worlds, focus), np.argsort(worlds.gaps_m.sum(axis=1), kind="stable")
    shown = {int(ranked[round(rank * (worlds.n - 1))]): name for rank, name in _SHOWN.items()}
    drawings = [
        (1.6 * -(-len(panels) // _ABREAST), partial(_distributions, panels)),
        (1.35 * len(paired) - 0.95 if len(paired) > 1 else 0.0, partial(_pairs, paired, kinds)),
        (0.4 + 0.95 * len(shown), partial(_lines, sample, shown)),
    ]
    drawings = [(height_in, draw) for height_in, draw in drawings if height_in]
    heights_in = [height_in for height_in, _ in drawings]
    figure = new_figure(8.0, sum(heights_in) + 0.4)
    parts = figure.subfigures(len(drawings), 1, squeeze=False, height_ratios=heights_in).ravel()
    for part, (_, draw) in zip(parts, drawings, strict=True):
        draw(part)
    return finish(
        figure,
        f"{label_text(scenario.name, 80)}, {count_of(worlds.n, 'world')} of the list of seed {seed}. Lines to scale,"
        f" vehicles {BODY_M:g} m long; above: gaps (m), below: speeds (m/s).",
    )


def _paired(worlds: Worlds, focus: int) -> dict[str, Floats]:
    """Label -> values [n] of what is drawn in pairs: one entry of each quantity that varies, then further ones."""
    found: list[tuple[int, str, Floats]] = []
    for rule in QUANTITY.of(worlds).values():
        values, own = rule.of(worlds), {"vehicle": focus, "pair": max(focus - 1, 0), "world": 0}[rule.per]
        varying = np.flatnonzero(np.ptp(values, axis=0) > 0.0)  # not where only some have an obstacle
        nearest = varying[np.argsort(np.abs(varying - own), kind="stable")].tolist()
        for i in sorted(nearest):
            owner = "" if rule.per == "world" else f"{rule.per.capitalize()} {i + 1}, "
            found.append((nearest.index(i), textwrap.fill(owner + rule.label, _LABEL_CHARACTERS), values[:, i]))
    chosen = np.argsort([place for place, *_ in found], kind="stable")[:_MOST_PAIRED]
    return {found[k][1]: found[k][2] for k in sorted(chosen)}


def _distributions(panels: Mapping[str, Mapping[str, Floats]], part: Any) -> None:
    """Shares of each quantity's values: an outline for all who draw alike."""
    columns = min(len(panels), _ABREAST)
    every = part.subplots(-(-len(panels) // columns), columns, squeeze=False).ravel()
    for axes in every[len(panels) :]:
        axes.set_axis_off()
    for axes, (key, drawn) in zip(every, panels.items(), strict=False):
        style_axes(axes, 7)
        every_value = np.concatenate([values.ravel() for values in drawn.values()])
        for number, (owners, values) in enumerate(drawn.items()):
            style, shares = series_style(number + 2), np.full(values.size, 1.0 / values.size)
            axes.hist(
                values.ravel(), np.linspace(every_value.min(), every_value.max(), 25), weights=shares,
                histtype="step" if number else "stepfilled", color=style["color"], linestyle=style["linestyle"],
                linewidth=1.4, label=owners.replace("vehicle_", "Vehicle "),
            )  # fmt: skip
        if "" not in drawn and len(drawn) <= _MOST_APART:
            axes.legend(fontsize=6.5, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 0.98), borderpad=0.0)
        axes.locator_params(nbins=3)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        name_axes(axes, x=QUANTITY.declared[key].label)
    name_axes(every[0], y="Share of worlds")


def _pairs(paired: Mapping[str, Floats], kinds: Any, part: Any) -> None:
    """Each pair of quantities as points, below the diagonal; a colour for each kind of world."""
    labels, values, names = list(paired), list(paired.values()), np.unique(kinds)
    grid = part.subplots(len(paired) - 1, len(paired) - 1, squeeze=False, sharex="col", sharey="row")
    for axes in grid[np.triu_indices(len(grid), 1)]:
        axes.set_axis_off()
    for row, column in zip(*np.tril_indices(len(grid)), strict=True):
        axes = grid[row, column]
        style_axes(axes, 7)
        for number, name in enumerate(names):
            chosen, style = kinds == name, series_style(number + 2)
            axes.scatter(
                values[column][chosen], values[row + 1][chosen], s=5.0, alpha=0.5, linewidths=0.0, rasterized=True,
                marker=style["marker"], color=style["color"], label=label_text(str(name)),
            )  # fmt: skip
        axes.locator_params(nbins=3)
        name_axes(axes, x=labels[column], y=labels[row + 1])
        axes.label_outer()
    if len(names) > 1:
        part.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, frameon=False, markerscale=2.5)


def _lines(sample: Sample, shown: Mapping[int, str], part: Any) -> None:
    """Some of the worlds at the alert, to scale."""
    worlds, every = sample.worlds, part.subplots(len(shown), 1, squeeze=False, sharex=True).ravel()
    for axes, (row, name) in zip(every, shown.items(), strict=True):
        style_axes(axes, 7)
        axes.set(yticks=[], ylim=(-1.5, 1.0))
        axes.use_sticky_edges = False  # some road ahead and behind
        axes.axhline(-0.4, color=GREY, linewidth=0.8)
        name_axes(axes, f"World {sample.index[row]}, {name}")
        gaps, ahead = worlds.gaps_m[row], worlds.obstacle_gap_m[row]
        fronts = -np.concatenate([[0.0], np.cumsum(gaps + BODY_M)])
        bodies = {"left": fronts - BODY_M, "color": [vehicle_colour(i) for i in range(worlds.N)]}
        axes.barh(np.zeros(worlds.N), BODY_M, 0.8, **bodies)
        told = [(front + 0.5 * gap, 0.65, f"{gap:.1f}") for front, gap in zip(fronts[1:], gaps, strict=True)]
        for i, front in enumerate(fronts - 0.5 * BODY_M):
            kind = "" if sample.types is None else f"\n{label_text(str(sample.types[row, i]), 20)}"
            told += [(front, 0.0, f"{i + 1}"), (front, -0.95, f"{worlds.speeds_mps[row, i]:.1f}{kind}")]
        if worlds.obstacle_ahead[row]:
            axes.axvline(ahead, 0.2, 1.0, color="black", linewidth=4.0)
            told.append((0.5 * ahead, 0.65, f"{ahead:.1f} to the obstacle"))
        for x, y, text in told if worlds.N <= _MOST_NAMED else ():
            axes.text(x, y, text, ha="center", va="center", fontsize=7, color="black" if y else "white")
    name_axes(every[-1], x="Position from the front of Vehicle 1, at the alert (m)")


LINEAR = 0.1  # m2/s2; axes are linear up to there and logarithmic beyond: harm falls to a hundredth

_LEAST_IN = 2.6  # height of a figure with few rows: titles and caption need it
_LEAST_TICKS = 4
_BESIDE = 0.42  # of a worse channel, right of its clear one

Json = dict[str, Any]


def ablation_figures(found: Json, caption: str) -> list[Figure]:
    """What an ablation found: harm level by level, what each step changes, and who pays.

    Above each, in red: which levels are not trained enough.
    """
    figures = [_harm_curve(found, caption), _change_figure(found, caption), _who_pays(found, caption)]
    for figure in figures if found["undertrained"] else ():
        text = "\n".join(textwrap.fill(line, int(figure.get_figwidth() * 13.0)) for line in found["undertrained"])
        for legend in figure.legends:  # a title of the figure would stand on it
            legend.set_title(text, prop=FontProperties(size=9))
            legend.set_alignment("left")
            legend.get_title().set_color(ALARM)
        if not figure.legends:
            figure.suptitle(text, x=0.01, ha="left", fontsize=9, color=ALARM)
    return figures


def _harm_curve(found: Json, caption: str) -> Figure:
    """Harm level by level under both counts, with full braking above and the joint optimum, its limit, below.

    All of it in the worlds in which the joint optimum was searched.
    """
    figure, panels = new_panels((10.5, 4.8), columns=2)
    ladder = list(dict.fromkeys(level["level"] for level in found["levels"] if level["clear"] is None))
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        for key, label, colour in (
            ("full_brake", "all brake fully", GREY),
            ("best_known", "joint optimum", COLOURS[3]),
        ):
            shown = [level for level in found["levels"] if level[harm_count]["searched"][key] is not None]
            for number, level in enumerate(shown):  # short lines; shorter ones beside for worse channels
                x, half = _place(level, ladder), 0.3 if level["clear"] is None else 0.07
                value, name = level[harm_count]["searched"][key]["value"], "" if number else label
                axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=name)
        for number, algorithm in enumerate(_algorithms(found)):
            _reached(axes, found["levels"], ladder, harm_count, algorithm, number)
        axes.set_xticks(range(len(ladder)), [_short(name) for name in ladder], fontsize=8)
        axes.set_yscale("symlog", linthresh=LINEAR)
        axes.yaxis.set_major_formatter(FuncFormatter(_plain))
        axes.set_ylim(0.0, 1.5 * axes.get_ylim()[1])
        name_axes(axes, _TITLES[harm_count])
    worlds = found["levels"][0]["first"]["searched"]["worlds"]
    told = f"{caption} All of this figure: the first {count_of(worlds, 'world')}."
    return finish(figure, told, panels[0], columns=4, fontsize=8.5)


def _change_figure(found: Json, caption: str) -> Figure:
    """What each step and each worse channel changes, with its interval: left of the line is less harm."""
    changes = found["steps"] + found["channels"]
    figure, panels = new_panels((10.5, max(_LEAST_IN, 1.6 + 0.6 * len(changes))), columns=2, sharey=True)
    for axes, harm_count in zip(panels, HARM_COUNTS, strict=True):
        axes.axvline(0.0, color=GREY, linewidth=0.9)
        for row, change in enumerate(changes):
            estimate = Estimate(**change[harm_count]["difference"])
            low, high = estimate.ends
            colour = COLOURS[3] if high < 0.0 else COLOURS[1] if low > 0.0 else GREY
            _with_intervals(axes, [row], [estimate], upright=False, fmt="o", color=colour, capsize=3, markersize=5)
            share = 100.0 * change[harm_count]["worse_off"]["value"]
            text = f"{estimate.value:+.2f} [{low:+.2f}, {high:+.2f}]\nsomebody worse off in {share:.0f} %"
            axes.text(
                0.99, row - 0.12, text, transform=axes.get_yaxis_transform(), ha="right", va="bottom", fontsize=7,
                color=GREY, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip
        axes.set_title(f"Change of {_TITLES[harm_count][0].lower()}{_TITLES[harm_count][1:]}", loc="left", fontsize=10)
        axes.set_xscale("symlog", linthresh=LINEAR)
        axes.margins(x=0.1)
        axes.set_xticks(signed_ticks(*axes.get_xlim()))
        axes.xaxis.set_major_formatter(FuncFormatter(_plain))
        axes.xaxis.set_minor_locator(NullLocator())
    panels[0].set_yticks(range(len(changes)), _of_changes(found), fontsize=8)
    panels[0].set_ylim(len(changes) - 0.5, -0.8)  # from top to bottom
    return finish(figure, caption)


def _who_pays(found: Json, caption: str) -> Figure:
    """How harm moved between the vehicles from level to level: a matrix of changes, blue is less."""
    changes = found["steps"] + found["channels"]
    figure = new_figure(10.5, max(_LEAST_IN, 1.8 + 0.42 * len(changes)))
    grids = {
        count: np.array([[estimate["value"] for estimate in change[count]["vehicles"]] for change in changes])
        for count in HARM_COUNTS
    }
    largest = max(float(np.abs(grid).max()) for grid in grids.values()) or 1.0
    every = figure.subplots(1, 2, sharey=True)
    for axes, (harm_count, grid) in zip(every, grids.items(), strict=True):
        norm = SymLogNorm(LINEAR, vmin=-largest, vmax=largest)
        image = axes.imshow(grid, cmap="RdBu_r", norm=norm, aspect="auto")
        for row, values in enumerate(grid):
            for column, value in enumerate(values):
                colour = "white" if abs(float(norm(value)) - 0.5) > 0.28 else "black"
                axes.text(column, row, f"{value:+.2f}", ha="center", va="center", fontsize=8, color=colour)
        axes.set_xticks(range(grid.shape[1]), [f"Vehicle {i + 1}" for i in range(grid.shape[1])], fontsize=9)
        axes.set_title(f"Change of {_TITLES[harm_count][0].lower()}{_TITLES[harm_count][1:]}", loc="left", fontsize=10)
    every[0].set_yticks(range(len(changes)), _of_changes(found), fontsize=8)
    bar = figure.colorbar(image, ax=list(every), label="m²/s²", format=FuncFormatter(_plain))
    bar.set_ticks(signed_ticks(-largest, largest))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    return finish(figure, caption)


def signed_ticks(low: float, high: float) -> list[float]:
    """Round numbers from ``low`` to ``high``, 0 among them, for an axis that is linear up to ``LINEAR``: a few."""
    first = -1 if max(-low, high) > LINEAR else -3
    found: list[float] = []
    for steps in ((1,), (1, 3), (1, 2, 5)):
        sizes = [float(f"{step}e{power}") for power in range(first, 6) for step in steps]
        found = [tick for tick in sorted({0.0, *sizes, *(-size for size in sizes)}) if low <= tick <= high]
        if len(found) >= _LEAST_TICKS:
            break
    return found


def _plain(value: float, _: int) -> str:
    """A tick without powers."""
    return f"{value:g}"


def _place(level: Json, ladder: Sequence[str]) -> float:
    """Where a level stands: its number in the ladder, a worse channel to the right of its clear one."""
    return ladder.index(level["clear"] or level["level"]) + (0.0 if level["clear"] is None else _BESIDE)


def _reached(
    axes: Axes, levels: Sequence[Json], ladder: Sequence[str], harm_count: HarmCount, algorithm: str, number: int
) -> None:
    """One algorithm: its ladder, and its worse channels beside their clear ones, each seed a dot."""
    own = [level for level in levels if level["algorithm"] in (None, algorithm)]
    style = series_style(number + 1 if number == 0 else number + 3)
    hollow = {**style, "linestyle": "none", "markerfacecolor": "white"}
    steps, worse = ([level for level in own if (level["clear"] is None) == clear] for clear in (True, False))
    shielded = [level for level in own if level["first"].get("shielded") is not None]
    for some, told, beside, look in (
        (steps, steps, 0.0, {**style, "label": algorithm}),
        # what the same teams do behind the step shield, as crosses to the left
        (
            shielded, [{harm_count: level[harm_count]["shielded"]} for level in shielded], -0.12,
            {"fmt": "x", "color": COLOURS[2], "label": f"{algorithm}, shielded"},
        ),
        (worse, worse, 0.0, {**hollow, "label": f"{algorithm}, worse channel"}),
    ):  # fmt: skip
        x = [_place(level, ladder) + 0.06 * number + beside for level in some]
        if some:
            harms = [Estimate(**each[harm_count]["searched"]["harm"]) for each in told]
            _with_intervals(axes, x, harms, capsize=3, **look)
    for level in [*steps, *worse]:
        place, found = _place(level, ladder) + 0.06 * number, level[harm_count]["searched"]
        if level["clear"] is not None:
            channel, spot = level["level"].rpartition("-")[2], (place, found["full_brake"]["value"])
            axes.annotate(channel, spot, xytext=(0, 4), textcoords="offset points", ha="center", fontsize=8)
        dots = found["each_seed"]
        if len(dots) > 1:
            axes.scatter([place + 0.05] * len(dots), dots, s=6, color=str(style["color"]), alpha=0.5, linewidths=0)


def _with_intervals(
    axes: Axes, at: Sequence[float], estimates: Sequence[Estimate], *, upright: bool = True, **style: Any
) -> None:
    """Marks with whiskers: ``at`` is where they stand, along the other axis."""
    values = np.array([each.value for each in estimates])
    errors = np.abs(np.array([each.ends for each in estimates]).T - values)
    if upright:
        axes.errorbar(at, values, yerr=errors, **style)
    else:
        axes.errorbar(values, at, xerr=errors, **style)


def _algorithms(found: Json) -> list[str]:
    return list(dict.fromkeys(level["algorithm"] for level in found["levels"] if level["algorithm"] is not None))


def _short(name: str) -> str:
    """``cooperation-2-paper`` as two lines, ``2`` and ``paper``."""
    return name.removeprefix("cooperation-").replace("-", "\n", 1)


def _of_changes(found: Json) -> list[str]:
    """What each step and each worse channel is called."""
    changes, several = found["steps"] + found["channels"], len(_algorithms(found)) > 1
    words = [f"{_short(change['from'])} → {_short(change['to'])}".replace("\n", " ") for change in changes]
    return [f"{each} ({c['algorithm']})" if several else each for each, c in zip(words, changes, strict=True)]


# Curves of several trainings: harm over training steps, with the spread over seeds.


@dataclass(frozen=True, slots=True)
class SeedCurve:
    """One figure of several trainings of one recipe, at the same steps."""

    steps: Floats  # [k]
    values: Floats  # [seeds, k]

    @classmethod
    def of(cls, trainings: Sequence[Mapping[int, float]]) -> Self:
        """Of several trainings, by step, at the steps that all of them have. Raises ``InvalidInput`` for none."""
        common = sorted(set.intersection(*(set(training) for training in trainings))) if trainings else []
        if not common:
            raise InvalidInput("curves of several seeds: the trainings were never evaluated at the same step")
        values = [[training[step] for step in common] for training in trainings]
        return cls(np.array(common, np.float64), np.array(values, np.float64))


def seed_curves(
    panels: Mapping[str, Mapping[str, SeedCurve]],
    *,
    logarithmic: Collection[str] = (),
    caption: str = "",
    x_label: str = "Training steps",
    known: Mapping[str, float] | None = None,
) -> Figure:
    """One panel per label, one line per recipe: the mean over seeds, bands one standard deviation to either side.

    Panels in ``logarithmic`` have a logarithmic axis if their means allow it: harm falls to a tenth, and the last
    tenth is what matters. A dashed line is the best that is ``known``. Raises ``InvalidInput`` without panels or lines.
    """
    if not panels or not all(panels.values()):
        raise InvalidInput("seed_curves: nothing to draw; at least one training with one evaluation is needed")
    figure, every = new_panels((5.0 * len(panels), 4.2), columns=len(panels))
    for axes, (label, curves) in zip(every, panels.items(), strict=True):
        for number, (recipe, curve) in enumerate(curves.items()):
            style = series_style(number + 1)
            mean, seeds = curve.values.mean(axis=0), len(curve.values)
            spread = curve.values.std(axis=0, ddof=1) if seeds > 1 else mean * 0.0  # of one seed nothing is known
            axes.plot(curve.steps, mean, label=f"{recipe}, {seeds} seed{'s' * (seeds != 1)}", **style)
            _band(axes, curve.steps, mean - spread, mean + spread, style)
        if label in logarithmic and all((curve.values > 0.0).all() for curve in curves.values()):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        if known is not None:
            axes.axhline(known[label], label="best known", color=GREY, linestyle="--", linewidth=1.0)
        name_axes(axes, label, x_label)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    return finish(figure, caption, every[0])


# The figures of ``ethbrake reproduce``: harm over a number, bars, vehicles along the road, commands, changes.

_ARROW_STEPS = 10  # the paper draws every tenth time step
_ROW_CHARACTERS = 52  # of a line beside the axis


def estimates_figure(
    panels: Mapping[str, Mapping[str, Mapping[Any, Estimate]]], *, y_label: str, caption: str, x_label: str = ""
) -> Figure:
    """One panel per title, and in it one series of estimates per label.

    Over numbers, which ``x_label`` names: lines, bands: 95 % intervals. Over texts: for each a bar for each label.
    """
    figure, every = new_panels((4.6 * len(panels), 4.2), columns=len(panels), sharey=True)
    for axes, (title, lines) in zip(every, panels.items(), strict=True):
        width, groups = 0.8 / len(lines), list(next(iter(lines.values())))
        for number, (label, line) in enumerate(lines.items()):
            style, y = series_style(number), [each.value for each in line.values()]
            low, high = zip(*(each.ends for each in line.values()), strict=True)
            if x_label:
                axes.plot(list(line), y, label=label, **style)
                _band(axes, list(line), low, high, style)
                continue
            x = [k + (number - 0.5 * (len(lines) - 1)) * width for k in range(len(line))]
            axes.bar(x, y, 0.9 * width, color=str(style["color"]), label=label)
            axes.vlines(x, low, high, color="black", linewidth=1.0)
        if not x_label:
            axes.set_xticks(range(len(groups)), groups)
        name_axes(axes, title, x_label)
    if x_label:
        every[0].set_ylim(bottom=0.0)
    name_axes(every[0], y=y_label)
    return finish(figure, caption, every[0], columns=3)


def road_figure(records: Mapping[str, EpisodeRecord], *, caption: str) -> Figure:
    """As the paper draws it: position along the road against the vehicle, an arrow at every tenth time step.

    Dashed lines join the vehicles at the same time. One panel per record, two in a row.
    """
    figure, panels = _in_pairs(len(records), 1.9, "Position along the road (m)", "Vehicle")
    for axes, (title, record) in zip(panels, records.items(), strict=False):
        vehicles = np.arange(1, record.positions_m.shape[1] + 1)
        times = np.arange(0.0, record.time_s[-1] + 1e-9, _ARROW_STEPS * record.scenario.time_step_s)
        at = np.array([np.interp(times, record.time_s, column) for column in record.positions_m.T])
        axes.plot(at, vehicles, color=GREY, linewidth=0.7, linestyle="--")
        for i, number in enumerate(vehicles):
            colour = vehicle_colour(i)
            axes.plot([at[i].min(), at[i].max()], [number, number], color=colour, linewidth=1.4)
            axes.plot(at[i], np.full(len(times), number), linestyle="none", marker=">", markersize=6, color=colour)
        axes.set_yticks(vehicles)
        axes.set_ylim(0.5, len(vehicles) + 0.5)
        name_axes(axes, title)
    return finish(figure, caption)


def _in_pairs(panels: int, height_in: float, x: str, y: str) -> tuple[Figure, list[Axes]]:
    """Panels on common scales, two in a row, named at the left and below."""
    rows = (panels + 1) // 2
    figure, every = new_panels((10.0, height_in * rows + 1.0), rows, 2, sharex=True, sharey=True)
    for axes in every[::2]:
        name_axes(axes, y=y)
    for axes in every[-2:]:
        name_axes(axes, x=x)
    return figure, every


def profiles_figure(panels: Mapping[str, Mapping[str, EpisodeRecord]], *, caption: str) -> Figure:
    """The command of the driven vehicle over time: one panel per title, one line per label."""
    figure, every = _in_pairs(len(panels), 2.3, "Time since Vehicle 1 began to brake (s)", "Command (m/s²)")
    for axes, (title, records) in zip(every, panels.items(), strict=False):
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        for number, (label, record) in enumerate(records.items()):
            style = {**series_style(number), "marker": ""}
            command = record.command_mps2[:, record.vehicle]
            axes.plot(record.time_s, command, drawstyle="steps-post", label=label, **style)
        name_axes(axes, title)
    return finish(figure, caption, every[0], columns=4)


def changes_figure(changes: Mapping[str, Mapping[str, Estimate]], *, x_label: str, caption: str) -> Figure:
    """By how much each change moves a number: one row per change, one mark per label, with its interval."""
    rows = list(changes)
    labels = list(dict.fromkeys(label for each in changes.values() for label in each))
    figure, (axes,) = new_panels((9.4, 0.3 * len(rows) + 1.6))
    axes.axvline(0.0, color=GREY, linewidth=0.9)
    for number, label in enumerate(labels):
        at = [(len(rows) - 1 - k + 0.16 * (0.5 * (len(labels) - 1) - number), changes[row].get(label))
              for k, row in enumerate(rows)]  # fmt: skip
        known = [(y, each.value, *each.ends) for y, each in at if each is not None]
        y, value, low, high = zip(*known, strict=True)
        style = series_style(number)
        axes.hlines(y, low, high, color=str(style["color"]), linewidth=1.4)
        axes.plot(value, y, linestyle="none", marker=style["marker"], markersize=4.5, color=style["color"],
                  label=label)  # fmt: skip
    axes.set_yticks(range(len(rows)), [textwrap.fill(row, _ROW_CHARACTERS) for row in rows[::-1]], fontsize=8)
    name_axes(axes, x=x_label)
    return finish(figure, caption, axes, columns=3)
