"""How maps are named: text is parsed once into small values that the whole program shares.

maze                  a map of the project
folder/my_map.yaml    a file
room.map@0.5          a MovingAI file, which names no scale, at 0.5 m a cell
maze:7                the procedural maze that belongs to seed 7
maze,maze:0-14        sixteen maps side by side, to train on all of them
maze*8,maze:0-14      the same, with eight times as many tasks on the first as on each other
"a,b.yaml"*8,maze     a file whose name would read otherwise, quoted as in JSON
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

KINDS = (
    *("maze", "column", "forest", "cave"),
    *("rooms", "corridors", "track", "clutter", "courtyard"),
)
"""Kinds of procedural maps; what is drawn from a seed may count on their order."""

MAX_SEED = 999_999_999

MAX_MAPS = 256
"""How many can be laid side by side."""

MAX_WEIGHT = 100
"""How many times as many tasks as on another a map can have."""

FILE_SUFFIXES = (".yaml", ".yml", ".map")

MIN_RESOLUTION, MAX_RESOLUTION = 1e-6, 1000.0
"""m per cell."""

_MAX_DIGITS = len(str(MAX_SEED))

_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"', re.DOTALL)
# Up to the next comma, but for those within quotes that a part begins with.
_PARTS = re.compile(rf"(?:^|,)\s*((?:{_QUOTED.pattern}(?=[\s,*@]|$))?[^,]*)", re.DOTALL)
_SCALED = re.compile(r"(.+)@([0-9.]+(?:[eE][-+]?[0-9]+)?)", re.DOTALL)
_WEIGHTED = re.compile(r"(.+)\*([0-9]+)", re.DOTALL)
_SEEDS = re.compile(rf"({'|'.join(KINDS)}):([0-9]+)(?:-([0-9]+))?")
_PROJECT_NAME = re.compile(r'[^\s,*:"/](?:[^,*:"/]*[^\s,*:"/])?')


@dataclass(frozen=True)
class ProjectMap:
    """One of the maps that come with the project; whether there is such a one shows on loading."""

    name: str

    def __post_init__(self) -> None:
        if _looks_like_file(self.name) or not _PROJECT_NAME.fullmatch(self.name):
            raise _unknown(self.name)

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class MapFile:
    """A map in a file."""

    path: str
    resolution: float | None = None
    """m per cell, `MIN_RESOLUTION` to `MAX_RESOLUTION`; only for files that name none: .map."""

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("map '': a name is missing, expected the path of a file")
        if self.resolution is None:
            return
        if not self.path.lower().endswith(".map"):
            raise ValueError(
                f"map {_shortened(self.path)}: expected @ and m per cell behind a .map file "
                "alone; a YAML file has its key resolution"
            )
        if not MIN_RESOLUTION <= self.resolution <= MAX_RESOLUTION:
            raise ValueError(
                f"map {_shortened(self.path)}: {self.resolution:g} behind @, expected m per cell "
                f"from {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g}"
            )

    def __str__(self) -> str:
        """The path, in quotes where `parse` would take it for something else, and the scale."""
        return self._quoted_path() + ("" if self.resolution is None else f"@{self.resolution!r}")

    def _quoted_path(self) -> str:
        reads_as_it_is = (
            _looks_like_file(self.path)
            and self.path.isprintable()
            and "," not in self.path
            and not self.path.startswith('"')
            and self.path == self.path.strip()
            and not _WEIGHTED.fullmatch(self.path)
            and not _SCALED.fullmatch(self.path)
        )
        if reads_as_it_is:
            return self.path
        return json.dumps(self.path, ensure_ascii=not self.path.isprintable())


@dataclass(frozen=True)
class ProceduralMap:
    """The map of a kind that belongs to a seed."""

    kind: str
    """One of `KINDS`."""
    seed: int
    """0 to `MAX_SEED`."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS or not 0 <= self.seed <= MAX_SEED:
            raise _unknown(f"{self.kind}:{self.seed}")

    def __str__(self) -> str:
        return f"{self.kind}:{self.seed}"


MapName = ProjectMap | MapFile | ProceduralMap


@dataclass(frozen=True)
class MapSet:
    """One map or several side by side; `parse(str(maps)) == maps`.

    Raises:
        ValueError: no map, more than `MAX_MAPS`, one of them twice, or a weight out of range.
    """

    names: tuple[MapName, ...]
    weights: tuple[int, ...]
    """How many times as many tasks each has in training, 1 to `MAX_WEIGHT`."""

    def __post_init__(self) -> None:
        if len(self.names) != len(self.weights) or not self.names:
            raise ValueError(
                f"map: {len(self.names)} names and {len(self.weights)} weights, expected at least "
                "one name and a weight for each"
            )
        if len(self.names) > MAX_MAPS:
            raise ValueError(f"map: {len(self.names)} maps, expected at most {MAX_MAPS}")
        seen: set[MapName] = set()
        for name, weight in zip(self.names, self.weights, strict=True):
            if name in seen:
                raise ValueError(f"map: {name} comes twice, expected each once")
            seen.add(name)
            if not 1 <= weight <= MAX_WEIGHT:
                raise ValueError(_wrong_weight(f"{name}*{weight}"))

    def __str__(self) -> str:
        """The canonical text: maps in their order, runs of seeds of one weight as ranges."""
        return ",".join(self._parts())

    @property
    def stem(self) -> str:
        """A short name for titles and folders: `str`, with files without folder and suffix."""
        if len(self.names) == 1 and isinstance(self.names[0], MapFile):
            return Path(self.names[0].path).stem
        return ",".join(self._parts(stems=True))

    def resolved(self) -> MapSet:
        """The same with absolute paths for all files that exist."""
        names = tuple(
            MapFile(str(Path(name.path).resolve()), name.resolution)
            if isinstance(name, MapFile) and Path(name.path).exists()
            else name
            for name in self.names
        )
        return MapSet(names, self.weights)

    def without_folders(self) -> MapSet:
        """The same with the names alone for files; as it is where two of them would be the same."""
        names = tuple(
            MapFile(Path(name.path).name, name.resolution) if isinstance(name, MapFile) else name
            for name in self.names
        )
        return MapSet(names, self.weights) if len(set(names)) == len(names) else self

    def _parts(self, *, stems: bool = False) -> Iterator[str]:
        runs: list[tuple[MapName, MapName, int]] = []  # First, last, weight.
        for name, weight in zip(self.names, self.weights, strict=True):
            if runs and runs[-1][2] == weight and _follows(name, runs[-1][1]):
                runs[-1] = (runs[-1][0], name, weight)
            else:
                runs.append((name, name, weight))
        for first, last, weight in runs:
            text = Path(first.path).stem if stems and isinstance(first, MapFile) else str(first)
            if isinstance(last, ProceduralMap) and last != first:
                text += f"-{last.seed}"
            yield text + (f"*{weight}" if weight > 1 else "")


def parse(text: str | Path) -> MapSet:
    """The maps that a text stands for.

    Args:
        text: see the module; a `Path`, or a text with a comma, an asterisk, a quote or outer spaces
            that is an existing file as a whole, is that file.

    Raises:
        ValueError: one line that names the part and what was expected: a name is missing, or is of
            no known form; a range of seeds runs backwards; a weight is out of range; a map comes
            twice; or there are more than `MAX_MAPS`.

    Example:
        >>> parse("maze*8,maze:0-1").weights
        (8, 1, 1)
        >>> str(parse("maze*8, maze:0, maze:1"))
        'maze*8,maze:0-1'
    """
    if isinstance(text, Path) or (_could_be_split(text) and _is_file(text)):
        return MapSet((MapFile(str(text)),), (1,))
    names: list[MapName] = []
    weights: list[int] = []
    for part in (part.strip() for part in _PARTS.findall(text)):
        if not part:
            raise ValueError(f"map {_shortened(text)}: a name is missing, expected {_FORMS}")
        matched = _WEIGHTED.fullmatch(part)
        name, digits = (matched[1], matched[2]) if matched else (part, "1")
        weight = int(digits) if len(digits) <= _MAX_DIGITS else 0
        if not 1 <= weight <= MAX_WEIGHT:
            raise ValueError(_wrong_weight(part))
        of_part = _parse_name(name, part)
        names += of_part
        weights += [weight] * len(of_part)
    return MapSet(tuple(names), tuple(weights))


_FORMS = (
    "the name of a map of the project, KIND:SEED or KIND:FIRST-LAST for procedural ones (KIND one "
    f"of {', '.join(KINDS)}), or the path of a .yaml or .map file (room.map@0.5: "
    "at 0.5 m a cell)"
)


def _parse_name(name: str, part: str) -> list[MapName]:
    """One map, or one for each seed of a range."""
    scaled = _SCALED.fullmatch(name)
    if scaled and (_QUOTED.fullmatch(scaled[1]) or _looks_like_file(scaled[1])):
        return [MapFile(_path(scaled[1]), _meters(scaled[2], part))]
    if _QUOTED.fullmatch(name) or _looks_like_file(name):
        return [MapFile(_path(name))]
    seeds = _SEEDS.fullmatch(name)
    if seeds is None:
        return [ProjectMap(name)]
    digits = (seeds[2], seeds[3] or seeds[2])
    if max(map(len, digits)) > _MAX_DIGITS:
        raise ValueError(f"map {_shortened(part)}: expected seeds from 0 to {MAX_SEED}")
    first, last = map(int, digits)
    if last < first:
        raise ValueError(
            f"map {part!r}: runs backwards, expected FIRST-LAST, such as {last}-{first}"
        )
    if last >= first + MAX_MAPS:
        raise ValueError(
            f"map {part!r}: {last - first + 1} maps, expected FIRST-LAST with at most {MAX_MAPS}"
        )
    return [ProceduralMap(seeds[1], seed) for seed in range(first, last + 1)]


def _path(text: str) -> str:
    """The path of a file, which may stand in quotes."""
    if not _QUOTED.fullmatch(text):
        return text
    try:
        path: str = json.loads(text)
    except json.JSONDecodeError:
        raise _unknown(text) from None
    return path


def _meters(text: str, part: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"map {_shortened(part)}: {_shortened(text)}, expected a number of m per cell behind @"
        ) from None


def _looks_like_file(name: str) -> bool:
    return "/" in name or name.lower().endswith(FILE_SUFFIXES)


def _could_be_split(text: str) -> bool:
    return bool(set(',*"@') & set(text)) or text != text.strip()


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # Too long for a name, say.
        return False


def _follows(name: MapName, before: MapName) -> bool:
    return (
        isinstance(name, ProceduralMap)
        and isinstance(before, ProceduralMap)
        and (name.kind, name.seed) == (before.kind, before.seed + 1)
    )


def _shortened(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")


def _wrong_weight(part: str) -> str:
    return f"map {_shortened(part)}: expected a weight from 1 to {MAX_WEIGHT}"


def _unknown(name: str) -> ValueError:
    return ValueError(f"unknown map {_shortened(name)}, expected {_FORMS}")
