"""Maps in the form of ROS map_server: a YAML file beside an image, with four keys of our own.

The keys `spawn_points`, `evaluation_points` (lists of [x, y] in the map frame, m), `spawn_radius`
(m) and `max_steps` are optional; map_server ignores them.
"""

from __future__ import annotations

import io
import math
import re
import reprlib
import warnings
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from sqn_jax.maps.image import (
    MODES,
    GrayImage,
    Thresholds,
    occupied_cells,
    read_pixels,
    suspicious_level,
)
from sqn_jax.maps.movingai import load_movingai
from sqn_jax.maps.occupancy import (
    EVALUATION_COUNT,
    OccupancyMap,
    close_border,
    sample_spawn_points,
    validate,
)
from sqn_jax.outside.messages import named, one_line
from sqn_jax.outside.reading import read_at_most

DEFAULT_ROBOT_RADIUS = 0.1
MAX_YAML_BYTES = 2**20
MAX_POINTS = 10_000
MIN_RESOLUTION, MAX_RESOLUTION = 1e-6, 1000.0  # m per cell
MAX_PLACE = 1e9
"""m or rad; up to here float64 knows a point to about a tenth of a micrometer."""
_INSIDE = (
    "a file in the YAML file's folder: copy the image beside the YAML file and write just its name "
    "here, or allow images outside where that is offered (sqn map check --allow-outside, "
    "load_map(..., allow_outside=True))"
)
_REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_FREE_GRAY, _OCCUPIED_GRAY = 254, 0


def known_maps() -> dict[str, Path]:
    """The project's own maps, name -> YAML file: in the wheel, or in a checkout's maps folder."""
    here = Path(__file__).resolve()
    for folder in (here.parent / "data", here.parents[2] / "maps"):
        yaml_files = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        if yaml_files:
            return yaml_files
    return {}


def load_map_file(
    name_or_path: str | Path,
    *,
    robot_radius: float = DEFAULT_ROBOT_RADIUS,
    allow_outside: bool = False,
) -> OccupancyMap:
    """Load and check one map, by the name of one of the project's own or by the path of a file.

    Unknown cells count as occupied and the border is closed. A map without spawn points gets
    sixteen spread over its largest free region, and the first four of these, which lie farthest
    apart, as evaluation points.

    Args:
        name_or_path: "maze", or a path ending in .yaml, .yml or (MovingAI, 1 m a cell) .map.
        robot_radius: m, >= 0; free space and reachability are judged for a robot of this size.
        allow_outside: let a YAML file name an image outside its own folder, by a path that leads
            out of it or by a link. It must still be a PNG or PNM file of the usual size.

    Returns:
        The map, points in the grid frame.

    Raises:
        ValueError: one line naming the file, the field, the offending value and what was expected.

    Warns:
        UserWarning: a large area whose gray looks like unknown reads as free.
    """
    if not (math.isfinite(robot_radius) and robot_radius >= 0):
        raise ValueError(f"robot_radius: {robot_radius!r}, expected a length >= 0 in m")
    known = known_maps()
    if isinstance(name_or_path, str) and name_or_path in known:
        path = known[name_or_path]
    else:
        path = Path(name_or_path)
    if path.suffix.lower() == ".map":
        loaded = load_movingai(path, robot_radius=robot_radius)
        validate(loaded, robot_radius, source=named(path))
        return loaded
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(
            f"unknown map {str(name_or_path)!r}, expected one of: {', '.join(known)}, a procedural "
            "one such as maze:7, or the path of a .yaml or .map file"
        )
    return _load_yaml(path, robot_radius, allow_outside)


def _load_yaml(path: Path, robot_radius: float, allow_outside: bool) -> OccupancyMap:
    """Load one map_server YAML file with its image."""
    fields = _read_fields(path)
    thresholds = _thresholds(path, fields)
    resolution = _number(path, "resolution", fields["resolution"])
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        form = f"m per cell, from {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g}"
        _fail(path, "resolution", fields["resolution"], form)
    x, y, yaw = _numbers(path, "origin", fields["origin"], 3, "[x m, y m, yaw rad]")
    origin = (x, y, yaw)
    image = _read_image(path, fields["image"], thresholds.mode, allow_outside)
    notes = []
    if (note := suspicious_level(image, thresholds)) is not None:
        notes.append(f"{named(path)}: {note}")
        warnings.warn(notes[0], UserWarning, stacklevel=4)
    occupied = close_border(occupied_cells(image, thresholds))
    empty = np.empty((0, 2))
    frame = OccupancyMap(path.stem, occupied, resolution, empty, empty, origin)
    spawn = _points(path, "spawn_points", fields, frame)
    evaluation = _points(path, "evaluation_points", fields, frame)
    if spawn is None or evaluation is None:
        try:
            sampled = sample_spawn_points(occupied, resolution, robot_radius)
        except ValueError as error:
            raise ValueError(f"{named(path)}: image: {error}") from error
        spawn = sampled if spawn is None else spawn
        evaluation = sampled[:EVALUATION_COUNT] if evaluation is None else evaluation
    loaded = OccupancyMap(
        name=path.stem,
        occupied=occupied,
        resolution=resolution,
        spawn_points=spawn,
        evaluation_points=evaluation,
        origin=origin,
        spawn_radius=_spawn_radius(path, fields),
        max_steps=_max_steps(path, fields),
        warnings=tuple(notes),
    )
    validate(loaded, robot_radius, source=named(path))
    return loaded


def save_map(occupancy_map: OccupancyMap, yaml_path: str | Path) -> None:
    """Write a map as YAML and a PNG of the same name beside it; `load_map` reads it back.

    Cells, resolution, origin, radius and steps come back bit for bit; points too if the yaw is 0,
    else to rounding (they are stored in the map frame).

    Raises:
        ValueError: the files cannot be written, or the path does not end in .yaml.
    """
    path = Path(yaml_path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"{named(path)}: expected a path ending in .yaml")
    gray = np.where(occupancy_map.occupied[::-1], _OCCUPIED_GRAY, _FREE_GRAY).astype(np.uint8)
    png = io.BytesIO()
    Image.fromarray(gray).save(png, format="PNG", optimize=True)
    text = _yaml_text(occupancy_map, path.with_suffix(".png").name)
    try:
        path.with_suffix(".png").write_bytes(png.getvalue())
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{named(path)}: cannot be written ({error.strerror})") from error


def _yaml_text(occupancy_map: OccupancyMap, image_name: str) -> str:
    """The YAML file of a map, points one a line in the map frame."""
    lines = [
        f"image: {yaml.safe_dump(image_name, allow_unicode=True, width=10**6).splitlines()[0]}",
        "mode: trinary",
        f"resolution: {float(occupancy_map.resolution)!r}",
        f"origin: [{', '.join(repr(float(value)) for value in occupancy_map.origin)}]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
        f"max_steps: {occupancy_map.max_steps}",
        f"spawn_radius: {float(occupancy_map.spawn_radius)!r}",
    ]
    for field in ("evaluation_points", "spawn_points"):
        lines.append(f"{field}:")
        points = occupancy_map.to_map_frame(getattr(occupancy_map, field))
        lines += [f"  - [{float(x)!r}, {float(y)!r}]" for x, y in points]
    return "\n".join(lines) + "\n"


def _fail(path: Path, field: str, value: object, expected: str) -> NoReturn:
    """Raise the one line every unusable file ends in; long and deep values are shortened."""
    shown = reprlib.repr(value)[:100]
    raise ValueError(f"{named(path)}: {field}: {shown}, expected {expected}")


class _TextLoader(yaml.BaseLoader):
    """The safest of YAML's loaders, and no key may stand twice.

    It builds nothing but text, lists and mappings, so that what counts as a number is decided
    below, the same for 0.05, 5e-2 and "0.05".
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping; readers differ on which of two equal keys counts, so there is to be one."""
        mapping: dict[Any, Any] = super().construct_mapping(node, deep=deep)
        if len(mapping) < len(node.value):
            counts = Counter(key.value for key, _ in node.value)
            twice = max(counts, key=counts.__getitem__)
            raise ValueError(f"{reprlib.repr(twice)} stands twice, expected every key once")
        return mapping


def _read_fields(path: Path) -> Mapping[str, Any]:
    """The YAML file as a mapping of its keys to text (or nested lists of text)."""
    data = read_at_most(path, MAX_YAML_BYTES, "a map's YAML file")
    try:
        fields = yaml.load(data, Loader=_TextLoader)
    # The parser raises a dozen kinds of error on damaged files: each means unusable.
    except Exception as error:
        reason = one_line(error)[:200]
        raise ValueError(f"{named(path)}: not readable as YAML ({reason})") from error
    if not isinstance(fields, dict):
        _fail(path, "file", fields, "a mapping with the keys of a map_server YAML file")
    for key in _REQUIRED:
        if key not in fields:
            keys = ", ".join(_REQUIRED)
            raise ValueError(f"{named(path)}: {key}: missing, expected the keys {keys}")
    return fields


def _number(path: Path, field: str, value: object) -> float:
    """A finite number from a YAML scalar."""
    # float() alone would also take "1_000", "infinity" and digits of other alphabets.
    if isinstance(value, str) and re.fullmatch(r"[-+]?[0-9.]+([eE][-+]?[0-9]+)?", value):
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if math.isfinite(number):
            return number
    _fail(path, field, value, "a finite number")


def _numbers(path: Path, field: str, value: object, count: int, form: str) -> list[float]:
    """A list of `count` numbers that is a place: none larger than `MAX_PLACE`."""
    if not isinstance(value, list) or len(value) != count:
        _fail(path, field, value, f"{count} numbers {form}")
    numbers = [_number(path, f"{field}[{i}]", item) for i, item in enumerate(value)]
    if max(map(abs, numbers)) > MAX_PLACE:
        _fail(path, field, value, f"{count} numbers {form} from {-MAX_PLACE:g} to {MAX_PLACE:g}")
    return numbers


def _thresholds(path: Path, fields: Mapping[str, Any]) -> Thresholds:
    """The keys that say how gray becomes occupancy."""
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        _fail(path, "mode", mode, f"one of {', '.join(MODES)}")
    negate = fields["negate"]
    if negate not in ("0", "1", "true", "false", "True", "False"):
        _fail(path, "negate", negate, "0 or 1")
    limits = {}
    for field in ("occupied_thresh", "free_thresh"):
        limits[field] = _number(path, field, fields[field])
        if not 0 <= limits[field] <= 1:
            _fail(path, field, fields[field], "a number from 0 to 1")
    if limits["free_thresh"] >= limits["occupied_thresh"]:
        _fail(path, "free_thresh", fields["free_thresh"], "a number below occupied_thresh")
    return Thresholds(mode=mode, negate=negate in ("1", "true", "True"), **limits)


def _image_path(path: Path, name: object, allow_outside: bool) -> Path:
    """The image a YAML file names: in the same folder or below, unless it may lie outside."""
    form = "the name of a PNG or PGM file"
    if not allow_outside:
        form += " in the YAML file's folder"
    if not isinstance(name, str) or not name or "\0" in name:
        _fail(path, "image", name, form)
    try:
        folder = path.parent.resolve()
        image_path = (folder / name).resolve()
        is_file = image_path.is_file()
    # Too long, a circle of links, or a character that no name of a file can hold.
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no file can have this name"
        _fail(path, "image", name, f"{form} ({reason})")
    if not (allow_outside or image_path.is_relative_to(folder)):
        _fail(path, "image", name, _INSIDE)
    if not is_file:
        _fail(path, "image", name, f"{form} (no such file)")
    return image_path


def _read_image(path: Path, name: object, mode: str, allow_outside: bool) -> GrayImage:
    """The pixels of the image a YAML file names."""
    image_path = _image_path(path, name, allow_outside)
    try:
        return read_pixels(image_path, mode)
    except OSError as error:
        _fail(path, "image", name, f"a PNG or PGM file that can be read ({error.strerror})")
    except ValueError as error:
        raise ValueError(f"{named(path)}: image: {reprlib.repr(name)}: {error}") from error


def _points(
    path: Path, field: str, fields: Mapping[str, Any], frame: OccupancyMap
) -> NDArray[np.float64] | None:
    """A list of points, from the file's map frame to the grid frame; None if the key is absent."""
    if field not in fields:
        return None
    value = fields[field]
    if not isinstance(value, list) or not 2 <= len(value) <= MAX_POINTS:
        _fail(path, field, value, f"a list of 2 to {MAX_POINTS} points [x m, y m]")
    points = [_numbers(path, f"{field}[{i}]", p, 2, "[x m, y m]") for i, p in enumerate(value)]
    return frame.to_grid_frame(np.array(points))


def _spawn_radius(path: Path, fields: Mapping[str, Any]) -> float:
    """The key `spawn_radius`, m."""
    if "spawn_radius" not in fields:
        return OccupancyMap.spawn_radius
    radius = _number(path, "spawn_radius", fields["spawn_radius"])
    if not 0 <= radius <= MAX_PLACE:
        form = f"a length >= 0 in m, at most {MAX_PLACE:g}"
        _fail(path, "spawn_radius", fields["spawn_radius"], form)
    return radius


def _max_steps(path: Path, fields: Mapping[str, Any]) -> int:
    """The key `max_steps`."""
    if "max_steps" not in fields:
        return OccupancyMap.max_steps
    steps = _number(path, "max_steps", fields["max_steps"])
    if steps != int(steps) or not 1 <= steps <= 1_000_000:
        _fail(path, "max_steps", fields["max_steps"], "a whole number from 1 to 1000000")
    return int(steps)
