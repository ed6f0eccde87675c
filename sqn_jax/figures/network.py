"""The architecture of a network, drawn from its parameter tree."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch

from sqn_jax.figures.ground import skill_color
from sqn_jax.figures.style import DPI, INK, WIDTH_IN, plain

Tree = Mapping[str, Any]

_BOX_WIDTH, _LINE, _MARGIN = 1.5, 0.21, 0.09
# Left edges of the columns and middles of the symbols, in.
_INPUTS, _FEATURES, _PERCEPTION, _ADD, _MODULES, _WEIGHTS = 0.08, 0.95, 2.75, 4.93, 5.55, 7.35
_GRAY, _INK_LIGHT = "#8a9299", "#5c646b"


@dataclass(frozen=True)
class _Box:
    """A module on the page, in inches from the lower left corner."""

    left: float
    middle: float
    height: float
    width: float = _BOX_WIDTH

    @property
    def right(self) -> float:
        return self.left + self.width

    @property
    def top(self) -> float:
        return self.middle + self.height / 2


def network_architecture(params: Tree, *, title: str) -> Figure:
    """Draw the modules of a network with their layers and sizes (paper, network architecture).

    From left to right: observations, an MLP for each, perception, and either the skill decision
    and the skills, each with its embedding, or a single head. A module lists the layers that the
    tree has, `inputs → outputs`, and its number of parameters.

    Args:
        params: the parameters of one network or their shapes, `{"params": {module: ...}}`.
        title: above the drawing, followed by the number of all parameters.

    Raises:
        ValueError: the tree has a module that is none of these.
    """
    modules = _known_modules(params["params"])
    names = [*(["decision"] if "decision" in modules else []), *_skills(modules)]
    heights = [_height(modules[name]) for name in names]
    feature_height = max(_height(module) for module in modules["features"].values())
    height = max(sum(heights) + 0.3 * len(names), 2 * feature_height + 0.6) + 0.75
    figure = Figure(figsize=(WIDTH_IN, height), dpi=DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, WIDTH_IN), ylim=(0, height))
    axes.axis("off")
    center = (height - 0.5) / 2
    perception = _draw_perception(axes, modules, center)
    boxes = {}
    top = center + (sum(heights) + 0.3 * (len(names) - 1)) / 2
    for name, box_height in zip(names, heights, strict=True):
        box = _Box(_MODULES, top - box_height / 2, box_height)
        label = (
            "skill decision" if name == "decision" else _skill_label(name, len(_skills(modules)))
        )
        color = _GRAY if name == "decision" else skill_color(int(name.removeprefix("skill_")))
        _draw_module(axes, box, label, modules[name], color)
        _draw_input(axes, perception, box, modules.get(f"{name}_embedding"))
        boxes[name] = box
        top -= box_height + 0.3
    _draw_output(axes, modules, boxes)
    total = f"{_count(params):,} parameters"
    figure.suptitle(plain(f"{title}: {total}"), y=1 - 0.12 / height, va="top", fontsize=12)
    return figure


def _known_modules(modules: Tree) -> Tree:
    """The modules of a network; the layer norm that DQN has after its perception is part of it.

    Raises:
        ValueError: there is one that the drawing has no place for.
    """
    places = {"features", "perception", "norm"}
    places |= {"decision", "decision_embedding", "decision_balance"}
    skills = set(_skills(modules))
    places |= skills | {f"{name}_embedding" for name in skills}
    unknown = sorted(set(modules) - places)
    if unknown:
        raise ValueError(f"the network has {', '.join(unknown)}, expected {', '.join(places)}")
    modules = dict(modules)
    if "norm" in modules:
        modules["perception"] = {**modules["perception"], "norm": modules["norm"]}
    if "decision_balance" in modules:
        modules["decision"] = {**modules["decision"], "balance_bias": modules["decision_balance"]}
    return modules


def _skills(modules: Tree) -> list[str]:
    """The names of the skills, or of a single head, by number."""
    names = [n for n in modules if n.startswith("skill_") and n[len("skill_") :].isdecimal()]
    return sorted(names, key=lambda name: int(name.removeprefix("skill_")))


def _skill_label(name: str, count: int) -> str:
    return f"skill {int(name.removeprefix('skill_')) + 1}" if count > 1 else "Q-head"


def _leaves(tree: Any) -> Iterator[Any]:
    if isinstance(tree, Mapping):
        for child in tree.values():
            yield from _leaves(child)
    else:
        yield tree


def _count(tree: Any) -> int:
    """Number of parameters of a module."""
    return sum(math.prod(leaf.shape) for leaf in _leaves(tree))


def _layers(module: Tree) -> dict[str, tuple[int, ...]]:
    """The shape of each layer by its name: that of its kernel or, without one, of its vector.

    A layer is a subtree, or arrays with a common prefix: `input_kernel` and `input_bias`.
    """
    layers: dict[str, tuple[int, ...]] = {}
    for name, child in module.items():
        if isinstance(child, Mapping):
            layers |= {f"{name} {n}".strip(): shape for n, shape in _layers(child).items()}
        else:
            layer = name.rpartition("_")[0]
            layers[layer] = max(layers.get(layer, ()), tuple(child.shape), key=len)
    return layers


def _rows(module: Tree) -> list[str]:
    """What stands in a module's box: its layers and its number of parameters."""
    layers = _layers(module)
    rows = [f"{name} {' → '.join(map(str, shape))}".strip() for name, shape in layers.items()]
    return [*rows, f"{_count(module):,} parameters"]


def _height(module: Tree) -> float:
    return (1 + len(_rows(module))) * _LINE + 2 * _MARGIN


def _draw_module(axes: Axes, box: _Box, label: str, module: Tree, color: str) -> None:
    """Draw a box with the name of a module, its layers and its number of parameters."""
    _draw_frame(axes, box, color)
    middle = box.left + box.width / 2
    y = box.top - _MARGIN - _LINE / 2
    options: dict[str, Any] = {"ha": "center", "va": "center"}
    axes.text(middle, y, label, fontsize=10, fontweight="bold", color=INK, **options)
    rows = _rows(module)
    for number, row in enumerate(rows, start=1):
        color = _INK_LIGHT if number == len(rows) else INK
        axes.text(middle, y - number * _LINE, row, fontsize=9, color=color, **options)


def _draw_frame(axes: Axes, box: _Box, color: str) -> None:
    corner = (box.left, box.middle - box.height / 2)
    style = "round,pad=0,rounding_size=0.06"
    frame = FancyBboxPatch(corner, box.width, box.height, boxstyle=style, fc="white", ec=color)
    frame.set(lw=1.8, zorder=2)
    axes.add_patch(frame)


def _draw_arrow(axes: Axes, *points: tuple[float, float]) -> None:
    """Draw an arrow along a line of points (x, y) in."""
    axes.plot(*zip(*points[:-1], strict=True), color=_GRAY, lw=1.3, zorder=1)
    options: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 9, "color": _GRAY}
    arrow = FancyArrowPatch(points[-2], points[-1], shrinkA=0, shrinkB=0, lw=1.3, **options)
    axes.add_patch(arrow)


def _draw_note(axes: Axes, x: float, y: float, note: str, **options: Any) -> None:
    style: dict[str, Any] = {"fontsize": 9, "color": INK, "ha": "center", "va": "center"}
    axes.text(x, y, note, **style | options)


def _draw_perception(axes: Axes, modules: Tree, middle: float) -> _Box:
    """Draw the observations, their MLPs and the perception; return the box of the last."""
    features: Tree = modules["features"]
    is_recurrent = "hidden_kernel" in modules["perception"]
    label = "perception (GRU)" if is_recurrent else "perception"
    perception = _Box(_PERCEPTION, middle, _height(modules["perception"]))
    _draw_module(axes, perception, label, modules["perception"], _GRAY)
    tallest = max(_height(module) for module in features.values())
    for number, name in enumerate(sorted(features, reverse=True)):
        offset = (tallest + 0.3) * ((len(features) - 1) / 2 - number)
        box = _Box(_FEATURES, middle + offset, _height(features[name]))
        _draw_module(axes, box, f"{name} (MLP)", features[name], _GRAY)
        size = next(iter(_layers(features[name]).values()))[0]
        _draw_note(axes, _INPUTS + 0.27, box.middle, f"{name}\n{size}")
        _draw_arrow(axes, (_INPUTS + 0.58, box.middle), (box.left, box.middle))
        between = (box.right + perception.left) / 2
        _draw_arrow(
            axes, (box.right, box.middle), (between, box.middle), (between, middle),
            (perception.left, middle),
        )  # fmt: skip
    kernel = modules["perception"]["input_kernel" if is_recurrent else "kernel"]
    motion = kernel.shape[0] - sum([*_layers(x).values()][-1][-1] for x in features.values())
    if motion:
        right = _FEATURES + _BOX_WIDTH
        _draw_note(axes, (_FEATURES + right) / 2, middle, f"last motion {motion}")
        _draw_arrow(axes, (right, middle), (perception.left, middle))
    if is_recurrent:
        left, right, above = perception.left + 0.3, perception.right - 0.3, perception.top + 0.22
        _draw_arrow(
            axes, (right, perception.top), (right, above), (left, above), (left, perception.top)
        )
        size = modules["perception"]["hidden_kernel"].shape[0]
        _draw_note(axes, (left + right) / 2, above + 0.12, f"carry {size}")
    return perception


def _draw_input(axes: Axes, perception: _Box, box: _Box, embedding: Any) -> None:
    """Draw the way from the perception to a module, past the embedding that is added to it."""
    between = perception.right + 0.16
    start = (perception.right, perception.middle)
    corner = (between, perception.middle)
    if embedding is None:
        _draw_arrow(axes, start, corner, (between, box.middle), (box.left, box.middle))
        return
    radius, y = 0.1, box.middle - 0.12
    _draw_arrow(axes, start, corner, (between, y), (_ADD - radius, y))
    axes.add_patch(Circle((_ADD, y), radius, fc="white", ec=_GRAY, lw=1.3, zorder=2))
    _draw_note(axes, _ADD, y, "+", fontsize=11)
    _draw_arrow(axes, (_ADD + radius, y), (box.left, y))
    _draw_note(axes, _ADD - 0.03, y + 0.45, f"embedding\n{embedding.shape[0]}")
    _draw_arrow(axes, (_ADD, y + 0.27), (_ADD, y + radius))


def _draw_output(axes: Axes, modules: Tree, boxes: Mapping[str, _Box]) -> None:
    """Draw the way from the modules to the Q-values, with skills by their weighted sum."""
    skills = [box for name, box in boxes.items() if name != "decision"]
    middle = (skills[0].middle + skills[-1].middle) / 2
    actions = modules[_skills(modules)[0]]["output"]["kernel"].shape[1]
    start = skills[0].right
    if "decision" in boxes or len(skills) > 1:
        lowest = skills[-1]
        height = skills[0].top - lowest.top + lowest.height
        total = _draw_operation(axes, middle, height, "weighted\nsum")
        _draw_skill_arrows(axes, skills, total)
        start = total.right
    if "decision" in boxes:
        decision = boxes["decision"]
        softmax = _draw_operation(axes, decision.middle, 0.4, "softmax")
        _draw_arrow(axes, (decision.right, softmax.middle), (softmax.left, softmax.middle))
        x = total.left + total.width / 2
        _draw_arrow(axes, (x, softmax.middle - softmax.height / 2), (x, total.top))
        count = modules["decision"]["output"]["kernel"].shape[1]
        _draw_note(axes, x + 0.07, softmax.middle - 0.42, f"{count} skill\nweights", ha="left")
    _draw_arrow(axes, (start, middle), (start + 0.25, middle))
    _draw_note(axes, start + 0.29, middle, f"Q\n{actions}", ha="left")


def _draw_operation(axes: Axes, middle: float, height: float, text: str) -> _Box:
    """Draw what has no parameters, in the column after the modules; return its box."""
    box = _Box(_WEIGHTS, middle, height, 0.85)
    _draw_frame(axes, box, _GRAY)
    _draw_note(axes, box.left + box.width / 2, box.middle, text, fontweight="bold")
    return box


def _draw_skill_arrows(axes: Axes, skills: Sequence[_Box], total: _Box) -> None:
    for box in skills:
        _draw_arrow(axes, (box.right, box.middle), (total.left, box.middle))
