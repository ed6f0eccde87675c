"""Maps in the form of ROS map_server: a YAML file beside an image, with five keys of our own.

The keys `spawn_points`, `evaluation_points` (lists of [x, y] in the map frame, m), `region` (one
such point), `spawn_radius` (m) and `max_steps` are optional; map_server ignores them.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
import reprlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from sqn_jax.config.map_names import MAX_RESOLUTION, MIN_RESOLUTION
from sqn_jax.maps.fields import fail, read_fields
from sqn_jax.maps.image import (
    FORMATS,
    MODES,
    GrayImage,
    Suspicion,
    Thresholds,
    occupied_cells,
    read_pixels,
    suspicious_level,
    unknown_cells,
    why_nothing_is_free,
)
from sqn_jax.maps.movingai import load_movingai
from sqn_jax.maps.occupancy import OccupancyMap, no_room, reachable_cells, validate
from sqn_jax.maps.regions import SMALLEST_REGION, Points, complete
from sqn_jax.outside.messages import named
from sqn_jax.outside.reading import no_file

DEFAULT_ROBOT_RADIUS = 0.1
MAX_POINTS = 10_000
MAX_PLACE = 1e9
"""m or rad; up to here float64 knows a point to about a tenth of a micrometer."""
_INSIDE = (
    "a file in the YAML file's folder: copy the image beside the YAML file and write just its name "
    "here, or allow images outside where that is offered (sqn map check --allow-outside, "
    "load_map(..., allow_outside=True))"
)
_REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_OPTIONAL = ("mode", "spawn_points", "evaluation_points", "region", "spawn_radius", "max_steps")
# As yaml-cpp, the parser of map_server, reads a truth value.
_TRUE, _FALSE = (
    {form for value in values for form in (value, value.capitalize(), value.upper())}
    for values in (("1", "y", "yes", "true", "on"), ("0", "n", "no", "false", "off"))
)
_ANOTHER_REGION = "; region: {point} in the YAML file takes the next"
_POINT, _ORIGIN = "[x m, y m]", "[x m, y m, yaw rad]"
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
    resolution: float | None = None,
) -> OccupancyMap:
    """Load and check one map, by the name of one of the project's own or by the path of a file.

    Unknown cells count as occupied. A map with free cells at its border gets a wall around it. One
    without spawn points gets sixteen spread over a free region (`regions.complete` says which), and
    the first four of these, which lie farthest apart, as evaluation points.

    Args:
        name_or_path: "maze", or a path ending in .yaml, .yml or (MovingAI) .map.
        robot_radius: m, >= 0; free space and reachability are judged for a robot of this size.
        allow_outside: let a YAML file name an image outside its own folder, by a path that leads
            out of it or by a link. It must still be an image of the usual size.
        resolution: m per cell of a .map file, which names none; 1 by default.

    Returns:
        The map, points in the grid frame.

    Raises:
        ValueError: one line naming the file, the field, the offending value and what was expected.

    Warns:
        UserWarning: a large area whose gray looks like unknown reads as free, an unknown key, much
            ground that cannot be reached from the points, or cells that were cut off.
    """
    if not (math.isfinite(robot_radius) and robot_radius >= 0):
        raise ValueError(f"robot_radius: {robot_radius!r}, expected a length >= 0 in m")
    known = known_maps()
    if isinstance(name_or_path, str) and name_or_path in known:
        path = known[name_or_path]
    else:
        path = Path(name_or_path)
    if path.suffix.lower() == ".map":
        loaded = load_movingai(
            path, robot_radius=robot_radius, resolution=1.0 if resolution is None else resolution
        )
        for line in loaded.warnings:
            warnings.warn(line, UserWarning, stacklevel=3)
        validate(loaded, robot_radius, source=named(path))
        return loaded
    if path.suffix.lower() not in (".yaml", ".yml"):
        if os.path.isdir(path):  # False for what is no possible name.
            raise ValueError(
                f"{named(path)}: a folder, expected a .yaml or .map file{_inside(path)}"
            )
        raise ValueError(
            f"unknown map {str(name_or_path)!r}, expected one of: {', '.join(known)}, a procedural "
            "one such as maze:7, or the path of a .yaml or .map file"
        )
    return _load_yaml(path, robot_radius, allow_outside)


def _inside(folder: Path) -> str:
    """What maps a folder holds, for an error; nothing if there are none, or many."""
    names = sorted(path.name for path in folder.glob("*") if path.suffix in (".yaml", ".map"))
    return f", such as {', '.join(map(repr, names))} in it" if 1 <= len(names) <= 5 else ""


def _load_yaml(path: Path, robot_radius: float, allow_outside: bool) -> OccupancyMap:
    """Load one map_server YAML file with its image."""
    fields, unknown = read_fields(path, _REQUIRED, _OPTIONAL)
    thresholds = _thresholds(path, fields)
    resolution = _number(path, "resolution", fields["resolution"])
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        form = f"m per cell, from {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g}"
        fail(path, "resolution", fields["resolution"], form)
    x, y, yaw = _numbers(path, "origin", fields["origin"], 3, _ORIGIN)
    points = Points(
        spawn=_points(path, "spawn_points", fields),
        evaluation=_points(path, "evaluation_points", fields),
        region=_region(path, fields),
    )
    empty = np.empty((0, 2))
    frame = OccupancyMap(
        name=path.stem,
        occupied=np.ones((1, 1), dtype=bool),
        resolution=resolution,
        spawn_points=empty,
        evaluation_points=empty,
        origin=(x, y, yaw),
        spawn_radius=_spawn_radius(path, fields),
        max_steps=_max_steps(path, fields),
    )
    image = _read_image(path, fields["image"], allow_outside)
    loaded = _drawn(path, frame, image, thresholds, points, robot_radius)
    # A wall or a cut moves the corner; what is written must be readable again.
    if max(map(abs, loaded.origin)) > MAX_PLACE:
        fail(path, "origin", fields["origin"], _place_form(3, _ORIGIN))
    lines = [f"{named(path)}: {line}" for line in loaded.warnings]
    if unknown is not None:
        lines.append(unknown)
    suspicion = suspicious_level(image, thresholds)
    if suspicion is not None and _helps(path, frame, image, suspicion, points, robot_radius):
        lines.append(f"{named(path)}: {suspicion.text}")
    for line in lines:
        warnings.warn(line, UserWarning, stacklevel=4)
    return dataclasses.replace(loaded, warnings=tuple(lines))


def _drawn(
    path: Path,
    frame: OccupancyMap,
    image: GrayImage,
    thresholds: Thresholds,
    points: Points,
    robot_radius: float,
) -> OccupancyMap:
    """The map that an image draws under some thresholds, checked."""
    drawn = dataclasses.replace(
        frame,
        occupied=occupied_cells(image, thresholds),
        unknown=unknown_cells(image, thresholds),
    )
    try:
        loaded = complete(drawn, points, robot_radius, _ANOTHER_REGION)
    except ValueError as error:
        if str(error) == no_room(robot_radius):
            reason = f"image: {error}: {why_nothing_is_free(image, thresholds)}"
        elif str(error).startswith("region"):
            reason = str(error)
        else:
            reason = f"image: {error}"
        raise ValueError(f"{named(path)}: {reason}") from error
    validate(loaded, robot_radius, source=named(path))
    return loaded


def _helps(
    path: Path,
    frame: OccupancyMap,
    image: GrayImage,
    suspicion: Suspicion,
    points: Points,
    robot_radius: float,
) -> bool:
    """Whether the map is still one, with room in it, if one does what a warning advises."""
    try:
        changed = _drawn(path, frame, image, suspicion.thresholds, points, robot_radius)
    except ValueError:
        return False
    room = np.count_nonzero(reachable_cells(changed, robot_radius)) * frame.resolution**2
    return bool(room >= SMALLEST_REGION)


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
    fail(path, field, value, "a finite number")


def _numbers(path: Path, field: str, value: object, count: int, form: str) -> list[float]:
    """A list of `count` numbers that is a place: none larger than `MAX_PLACE`."""
    if not isinstance(value, list) or len(value) != count:
        fail(path, field, value, f"{count} numbers {form}")
    numbers = [_number(path, f"{field}[{i}]", item) for i, item in enumerate(value)]
    if max(map(abs, numbers)) > MAX_PLACE:
        fail(path, field, value, _place_form(count, form))
    return numbers


def _place_form(count: int, form: str) -> str:
    return f"{count} numbers {form} from {-MAX_PLACE:g} to {MAX_PLACE:g}"


def _thresholds(path: Path, fields: Mapping[str, Any]) -> Thresholds:
    """The keys that say how gray becomes occupancy."""
    mode = fields.get("mode", "trinary")
    if not isinstance(mode, str) or mode.lower() not in MODES:
        fail(path, "mode", mode, f"one of {', '.join(MODES)}")
    negate = fields["negate"]
    if not isinstance(negate, str) or negate not in _TRUE | _FALSE:
        fail(path, "negate", negate, "0 or 1")
    limits = {}
    for field in ("occupied_thresh", "free_thresh"):
        limits[field] = _number(path, field, fields[field])
        if not 0 <= limits[field] <= 1:
            fail(path, field, fields[field], "a number from 0 to 1")
    if limits["free_thresh"] >= limits["occupied_thresh"]:
        fail(path, "free_thresh", fields["free_thresh"], "a number below occupied_thresh")
    return Thresholds(mode=mode.lower(), negate=negate in _TRUE, **limits)


def _image_path(path: Path, name: object, allow_outside: bool) -> Path:
    """The image a YAML file names: in the same folder or below, unless it may lie outside."""
    form = f"the name of a {FORMATS} file"
    if not allow_outside:
        form += " in the YAML file's folder"
    if not isinstance(name, str) or not name or "\0" in name:
        fail(path, "image", name, form)
    try:
        folder = path.parent.resolve()
        image_path = (folder / name).resolve()
        is_file = image_path.is_file()
    # Too long, a circle of links, or a character that no name of a file can hold.
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no file can have this name"
        fail(path, "image", name, f"{form} ({reason})")
    if not (allow_outside or image_path.is_relative_to(folder)):
        fail(path, "image", name, _INSIDE)
    if not is_file:
        fail(path, "image", name, f"{form} ({no_file(image_path)})")
    return image_path


def _read_image(path: Path, name: object, allow_outside: bool) -> GrayImage:
    """The pixels of the image a YAML file names."""
    image_path = _image_path(path, name, allow_outside)
    try:
        return read_pixels(image_path)
    except OSError as error:
        fail(path, "image", name, f"a {FORMATS} file that can be read ({error.strerror})")
    except ValueError as error:
        raise ValueError(f"{named(path)}: image: {reprlib.repr(name)}: {error}") from error


def _points(path: Path, field: str, fields: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """A list of points in the map frame, m; None if the key is absent."""
    if field not in fields:
        return None
    value = fields[field]
    if not isinstance(value, list) or not 2 <= len(value) <= MAX_POINTS:
        fail(path, field, value, f"a list of 2 to {MAX_POINTS} points [x m, y m]")
    return np.array([_numbers(path, f"{field}[{i}]", p, 2, _POINT) for i, p in enumerate(value)])


def _region(path: Path, fields: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """The key `region`, a point in the map frame, m."""
    if "region" not in fields:
        return None
    return np.array(_numbers(path, "region", fields["region"], 2, _POINT))


def _spawn_radius(path: Path, fields: Mapping[str, Any]) -> float:
    """The key `spawn_radius`, m."""
    if "spawn_radius" not in fields:
        return OccupancyMap.spawn_radius
    radius = _number(path, "spawn_radius", fields["spawn_radius"])
    if not 0 <= radius <= MAX_PLACE:
        form = f"a length >= 0 in m, at most {MAX_PLACE:g}"
        fail(path, "spawn_radius", fields["spawn_radius"], form)
    return radius


def _max_steps(path: Path, fields: Mapping[str, Any]) -> int:
    """The key `max_steps`."""
    if "max_steps" not in fields:
        return OccupancyMap.max_steps
    steps = _number(path, "max_steps", fields["max_steps"])
    if steps != int(steps) or not 1 <= steps <= 1_000_000:
        fail(path, "max_steps", fields["max_steps"], "a whole number from 1 to 1000000")
    return int(steps)
