"""The conventions of ROS map_server, on files written here byte by byte."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from map_files import pgm_bytes
from PIL import Image

from sqn_jax.maps import OccupancyMap, load_map, points_to_cells, save_map

Room = Callable[..., Path]


def blocks(*greys: int, dtype: type = np.uint8) -> np.ndarray:
    """An image of 20 rows with one band of 30 columns for each grey, left to right."""
    return np.repeat(np.array([greys], dtype=dtype), 30, axis=1).repeat(20, axis=0)


def free_bands(path: Path, count: int) -> list[bool]:
    """Whether each band of `blocks` is free, read in the middle of the band."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_map(path)
    middles = loaded.to_grid_frame([(3.0 * band + 1.55, 1.05) for band in range(count)])
    return [bool(~loaded.occupied[tuple(cell)]) for cell in points_to_cells(middles, 0.1)]


def png_bytes(pixels: np.ndarray, mode: str | None = None) -> bytes:
    buffer = io.BytesIO()
    image = Image.fromarray(pixels)
    (image if mode is None else image.convert(mode)).save(buffer, format="PNG")
    return buffer.getvalue()


def test_the_top_row_of_the_image_is_the_north_edge(room: Room) -> None:
    grey = np.full((20, 50), 254, dtype=np.uint8)
    grey[3, 40] = 0
    loaded = load_map(room(grey=grey))
    assert np.argwhere(loaded.occupied[1:-1, 1:-1]).tolist() == [[16, 40]]


@pytest.mark.parametrize("yaw", ["0.0", "0.7"])
def test_an_open_border_gets_a_wall_outside_and_coordinates_stay(room: Room, yaw: str) -> None:
    loaded = load_map(room(origin=f"[3.0, -2.0, {yaw}]", spawn_points="[[4, 2], [4, 3]]"))
    occupied = loaded.occupied
    assert occupied.shape == (92, 122)
    assert occupied[[0, -1]].all()
    assert occupied[:, [0, -1]].all()
    assert not occupied[1:-1, 1:-1].any()
    # The lower left corner of the image, one cell inside the wall.
    np.testing.assert_allclose(loaded.to_grid_frame([3.0, -2.0]), [0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(loaded.to_map_frame(loaded.spawn_points), [[4, 2], [4, 3]])


@pytest.mark.parametrize("side", ["top", "bottom", "left", "right", "none"])
def test_a_wall_is_added_only_where_a_free_cell_lies_on_the_border(room: Room, side: str) -> None:
    grey = np.full((40, 60), 254, dtype=np.uint8)
    grey[[0, -1]] = grey[:, [0, -1]] = 0
    door = {"top": (0, 9), "bottom": (-1, 9), "left": (9, 0), "right": (9, -1)}
    if side in door:
        grey[door[side]] = 254
    loaded = load_map(room(grey=grey))
    assert (~loaded.occupied).sum() == (grey == 254).sum()
    assert loaded.occupied.shape == ((42, 62) if side in door else (40, 60))


def test_points_are_given_in_the_map_frame(room: Room) -> None:
    # Turned by 90 degrees about the lower-left corner at (10, 20): grid (x, y) -> (10 - y, 20 + x).
    path = room(
        origin=f"[10.0, 20, {math.pi / 2!r}]",
        spawn_points="[[9.0, 22.0], [5.0, 30.0]]",
        evaluation_points="[[9.0, 22.0], [9, 22.5], [7.0, 21.0]]",
    )
    loaded = load_map(path)
    # And a cell of 0.1 m for the wall around it.
    np.testing.assert_allclose(loaded.spawn_points, [[2.1, 1.1], [10.1, 5.1]])
    np.testing.assert_allclose(loaded.evaluation_points, [[2.1, 1.1], [2.6, 1.1], [1.1, 3.1]])
    np.testing.assert_allclose(loaded.origin, [10.1, 19.9, math.pi / 2])


def test_the_own_keys_have_defaults_and_are_read(room: Room) -> None:
    plain = load_map(room())
    assert (plain.max_steps, plain.spawn_radius) == (400, 0.5)
    assert len(plain.spawn_points) == 16
    assert len(plain.evaluation_points) == 4
    changed = load_map(room(max_steps="1200", spawn_radius="0.25"))
    assert (changed.max_steps, changed.spawn_radius) == (1200, 0.25)
    assert plain.name == "room"
    assert plain.resolution == 0.1


def test_numbers_may_be_written_in_any_usual_way(room: Room) -> None:
    assert load_map(room(resolution="1e-1")).resolution == 0.1
    assert load_map(room(resolution='"+.1"', max_steps="4e2")).max_steps == 400


# (255 - 205) / 255 = 0.19608 and (255 - 206) / 255 = 0.19216, either side of 0.196.
@pytest.mark.parametrize(
    ("negate", "greys", "free"),
    [
        ("0", (254, 206, 205, 100, 0), [True, True, False, False, False]),
        ("1", (254, 206, 49, 50, 0), [False, False, True, False, True]),
        ("false", (254, 0), [True, False]),
        ("true", (254, 0), [False, True]),
    ],
)
def test_free_is_occupancy_below_the_threshold(
    room: Room, negate: str, greys: tuple[int, ...], free: list[bool]
) -> None:
    assert free_bands(room(grey=blocks(*greys), negate=negate), len(greys)) == free


def test_an_occupancy_equal_to_the_threshold_is_not_free(room: Room) -> None:
    # (255 - 204) / 255 is 0.2 exactly.
    assert free_bands(room(grey=blocks(255, 204, 205), free_thresh="0.2"), 3) == [True, False, True]


def test_raw_images_hold_percentages_and_ignore_negate(room: Room) -> None:
    for negate in "01":
        path = room(grey=blocks(0, 19, 20, 100, 101, 255), mode="raw", negate=negate)
        assert free_bands(path, 6) == [True, True, False, False, False, False]


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("kind", ["LA", "RGBA"])
def test_what_is_not_wholly_opaque_is_unknown_but_in_raw_mode(
    room: Room, mode: str, kind: str
) -> None:
    grey = 9 if mode == "raw" else 254
    pixels = np.stack([blocks(grey, grey, grey, 105), blocks(255, 254, 0, 255)], axis=-1)
    if kind == "RGBA":
        pixels = pixels[..., [0, 0, 0, 1]]
    path = room(image=png_bytes(pixels), mode=mode)
    assert free_bands(path, 4) == [True, mode == "raw", mode == "raw", False]


@pytest.mark.parametrize("kind", ["LA", "RGBA", "PA"])
@pytest.mark.parametrize("negate", ["0", "1"])
def test_an_opaque_alpha_channel_changes_nothing(room: Room, kind: str, negate: str) -> None:
    # With alpha averaged in, 205 would be (3 * 205 + 255) / 4 = 217.5 and free.
    grey = blocks(254, 205, 100, 50, 0)
    if kind == "PA":  # A palette whose every entry is marked as opaque.
        image = Image.fromarray(grey)
        image.putpalette([level for level in range(256) for _ in "rgb"])
        buffer = io.BytesIO()
        image.save(buffer, format="PNG", transparency=b"\xff" * 256)
        data = buffer.getvalue()
    else:
        data = png_bytes(grey, kind)
    free = free_bands(room(image=data, negate=negate), 5)
    assert free == free_bands(room(grey=grey, negate=negate), 5)
    assert free == ([True, False, False, False, False] if negate == "0" else [False] * 4 + [True])


def test_colour_is_averaged(room: Room) -> None:
    # Means 254, 206, 205 and 85: the limit lies between 206 and 205, as it does for grey.
    channels = [(254, 255, 255, 255), (254, 160, 159, 0), (254, 203, 201, 0)]
    pixels = np.stack([blocks(*channel) for channel in channels], axis=-1)
    assert free_bands(room(image=png_bytes(pixels)), 4) == [True, True, False, False]


@pytest.mark.parametrize("mode", ["P", "1"])
def test_palette_and_black_and_white_images_are_read(room: Room, mode: str) -> None:
    assert free_bands(room(image=png_bytes(blocks(255, 0, 255), mode)), 3) == [True, False, True]


def test_an_image_without_alpha_reads_the_same_in_scale_mode(room: Room) -> None:
    grey = blocks(254, 206, 205, 0)
    assert free_bands(room(grey=grey, mode="scale"), 4) == [True, True, False, False]


@pytest.mark.parametrize("kind", ["grey", "16 bit", "colour", "palette"])
def test_a_shade_that_is_marked_as_clear_is_unknown(room: Room, kind: str) -> None:
    clear: object = 255
    image = Image.fromarray(blocks(255, 254, 0))
    if kind == "16 bit":
        image, clear = Image.fromarray(blocks(65535, 65534, 0, dtype=np.uint16)), 65535
    elif kind == "colour":
        image, clear = image.convert("RGB"), (255, 255, 255)
    elif kind == "palette":
        image, clear = Image.fromarray(blocks(2, 1, 0)), 2
        image.putpalette([0, 0, 0, 254, 254, 254, 255, 255, 255])
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", transparency=clear)
    for mode in ("scale", "trinary"):
        assert free_bands(room(image=buffer.getvalue(), mode=mode), 3) == [False, True, False]


@pytest.mark.parametrize("kind", ["P1", "P3", "P4", "P6"])
def test_the_other_kinds_of_pnm_are_read(room: Room, kind: str) -> None:
    light = blocks(1, 0, 1)
    if kind == "P1":  # Bits, 1 is black.
        image = b"P1\n90 20\n" + b" ".join(b"%d" % (1 - bit) for bit in light.ravel())
    elif kind == "P4":
        image = b"P4\n90 20\n" + np.packbits(1 - light, axis=1).tobytes()
    elif kind == "P3":
        image = b"P3\n90 20\n255\n" + b" ".join(b"%d 255 255" % (255 * v) for v in light.ravel())
        # Cyan, (0, 255, 255), is occupancy 1/3.
    else:
        image = b"P6\n90 20\n255\n" + np.repeat(light * np.uint8(255), 3).tobytes()
    assert free_bands(room(image=image), 3) == [True, False, True]


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_a_grey_png_of_few_bits_is_read(room: Room, bits: int) -> None:
    top = 2**bits - 1
    shifts = np.arange(bits)[::-1]
    packed = np.packbits((blocks(top, 0, top)[..., None] >> shifts & 1).reshape(20, -1), axis=1)
    rows = b"".join(b"\0" + row.tobytes() for row in packed)
    chunks = {b"IHDR": struct.pack(">IIBBBBB", 90, 20, bits, 0, 0, 0, 0)}
    chunks |= {b"IDAT": zlib.compress(rows), b"IEND": b""}
    image = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )
    assert free_bands(room(image=image), 3) == [True, False, True]


@pytest.mark.parametrize("kind", ["pgm", "png"])
def test_sixteen_bits_are_not_clipped(room: Room, kind: str) -> None:
    # 0.196 of 65535 is 12845: 52691 is occupancy 0.19599. Clipped at 255 all but 0 would be white.
    grey = blocks(65535, 52691, 52690, 300, 0, dtype=np.uint16)
    image = pgm_bytes(grey, 65535) if kind == "pgm" else png_bytes(grey)
    assert free_bands(room(image=image), 5) == [True, True, False, False, False]


@pytest.mark.parametrize("maxval", [1, 15, 100, 255, 1000, 65535])
def test_grey_is_relative_to_the_largest_value(room: Room, maxval: int) -> None:
    grey = blocks(maxval, 0, round(0.7 * maxval), dtype=np.uint16)
    middle = round(0.7 * maxval) == maxval
    assert free_bands(room(image=pgm_bytes(grey, maxval)), 3) == [True, False, middle]


@pytest.mark.parametrize("maxval", [255, 65535])
def test_a_text_pgm_with_comments_is_read(room: Room, maxval: int) -> None:
    rows = "\n".join(" ".join(str(v * maxval) for v in row) for row in blocks(1, 0).tolist())
    text = f"P2 # kind\n# resolution: 0.05 m\n60 20\n# another\n{maxval}\n{rows}\n"
    assert free_bands(room(image=text.encode()), 2) == [True, False]


def test_a_comment_in_a_binary_pgm_is_skipped(room: Room) -> None:
    data = b"P5\n# CREATOR: map_generator 0.050 m/pix\n60 20\n255\n" + blocks(254, 0).tobytes()
    assert free_bands(room(image=data), 2) == [True, False]


def test_unknown_ground_that_reads_as_free_is_warned_about(room: Room) -> None:
    path = room(grey=blocks(254, 254, 205), free_thresh="0.25")
    with pytest.warns(UserWarning, match=r"room\.yaml: gray 205 of 255 .* fills 33% ") as caught:
        loaded = load_map(path)
    assert [str(warning.message) for warning in caught] == list(loaded.warnings)
    # A third of the ground in a shade that no program writes for unknown is as suspicious ...
    with pytest.warns(UserWarning, match="gray 200 of 255"):
        load_map(room(grey=blocks(254, 254, 200), free_thresh="0.25"))


@pytest.mark.parametrize(
    ("greys", "free_thresh"),
    [
        ((254, 254, 205), "0.196"),  # unknown is not free: the usual file
        ((205, 205, 0), "0.25"),  # the lightest there is
        ((254, 240, 230), "0.25"),  # far from the threshold
        ((254,) * 8 + (200,), "0.25"),  # a small area
    ],
)
def test_ordinary_maps_are_not_warned_about(
    room: Room, greys: tuple[int, ...], free_thresh: str
) -> None:
    # Warnings are errors here.
    assert load_map(room(grey=blocks(*greys), free_thresh=free_thresh)).warnings == ()


@pytest.mark.parametrize(
    ("greys", "free_thresh"),
    [
        ((254,) * 9 + (255,), "0.1"),  # a shade of white beside a purer one
        ((254, 254, 240), "0.25"),  # far lighter than any gray for unknown
        ((205, 205, 205, 205, 254), "0.25"),  # what is left would be a nook
    ],
)
def test_no_warning_gives_advice_that_makes_a_map_worse(
    room: Room, greys: tuple[int, ...], free_thresh: str
) -> None:
    pixels = blocks(*greys)
    if greys[-1] == 254:
        pixels[:, -27:] = 205
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*cells cut to")
        assert "gray" not in str(load_map(room(grey=pixels, free_thresh=free_thresh)).warnings)


def test_the_advice_about_unknown_ground_leaves_the_rest_free(room: Room) -> None:
    grey = blocks(254, 254, 205, 254)
    with pytest.warns(UserWarning, match=r"lower free_thresh from 0\.25 to 0\.196"):
        load_map(room(grey=grey, free_thresh="0.25"))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*of the free ground lies outside")
        assert free_bands(room(grey=grey, free_thresh="0.196"), 4) == [True, True, False, True]


@pytest.mark.parametrize("kind", ["1", "L", "P", "RGB"])
def test_a_bmp_image_is_read(room: Room, kind: str) -> None:
    buffer = io.BytesIO()
    Image.fromarray(blocks(255, 0, 255)).convert(kind).save(buffer, format="BMP")
    assert free_bands(room(image=buffer.getvalue()), 3) == [True, False, True]


@pytest.mark.parametrize("kind", ["1", "L", "P", "I;16"])
@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_cells_are_those_of_the_gray_that_the_image_library_reads(
    room: Room, kind: str, mode: str
) -> None:
    rng = np.random.default_rng(1)
    grey = rng.choice(np.array([0, 100, 205, 206, 254, 255], dtype=np.uint8), (20, 60))
    grey[5:15, 5:55] = 255
    if kind == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
        expected = grey
    else:
        image = Image.fromarray(grey).convert(kind)
        expected = np.asarray(image.convert("L"))
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = load_map(room(image=buffer.getvalue(), mode=mode))
    free = (255 - expected[::-1].astype(float)) / 255 < 0.196
    np.testing.assert_array_equal(~loaded.occupied[1:-1, 1:-1], free)


@pytest.mark.parametrize(
    ("field", "value"),
    [("mode", "TRINARY"), ("mode", "Scale"), ("negate", "no"), ("negate", "FALSE")],
)
def test_values_are_read_in_every_case_as_map_server_does(
    room: Room, field: str, value: str
) -> None:
    assert free_bands(room(grey=blocks(254, 205, 0), **{field: value}), 3) == [True, False, False]


def test_tabs_are_blanks_between_a_key_and_its_value(room: Room) -> None:
    path = room(origin="[1.0,\t2.0 ,0.0\t]\t# where", resolution='"0.1"\t', free_thresh="0.2\t")
    path.write_text(path.read_text().replace(": ", ":\t"))
    plain = load_map(room(origin="[1.0, 2.0, 0.0]", free_thresh="0.2"))
    path.write_text(path.read_text().replace(": ", ":\t \t"))
    np.testing.assert_array_equal(load_map(path).occupied, plain.occupied)
    path.write_text("image:\n\troom.pgm\n")
    with pytest.raises(ValueError, match="not readable as YAML"):
        load_map(path)


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("spawn_pionts", "unknown key 'spawn_pionts' (is spawn_points meant?): no effect"),
        ("Max_Steps", "unknown key 'Max_Steps' (is max_steps meant?): no effect"),
        ("author", "unknown key 'author': no effect"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest_known_one(
    room: Room, key: str, line: str
) -> None:
    with pytest.warns(UserWarning, match="unknown key") as caught:
        load_map(room(**{key: "[[1, 1], [2, 2]]"}))
    assert [str(warning.message).partition(": ")[2] for warning in caught] == [line]


def test_a_required_key_that_is_misspelt_is_found(room: Room) -> None:
    with pytest.raises(ValueError, match=r"free_thresh: missing \(is 'free_tresh' meant\?\)"):
        load_map(room(drop="free_thresh", free_tresh="0.2"))


@pytest.mark.parametrize("clear", [False, True])
def test_where_nothing_is_free_the_line_says_why(room: Room, clear: bool) -> None:
    # Black lines on white, or black ink on clear ground.
    ink = np.zeros((20, 60), dtype=bool)
    ink[::4] = True
    if clear:
        image = png_bytes(np.stack([np.zeros_like(ink), 255 * ink], axis=-1).astype(np.uint8))
        words = ["0.0% of the pixels are free", "75.0% are transparent, which means unknown"]
        words.append("negate: 1 would make 25.0% free")
        path = room(image=image)
    else:
        path = room(grey=np.where(ink, 0, 254), negate="1")
        words = ["25.0% of the pixels are free (negate: 1", "negate: 0 would make 75.0% free"]
    with pytest.raises(ValueError, match=r"no cell is free for a robot of radius 0\.1 m") as caught:
        load_map(path)
    for word in words:
        assert word in str(caught.value)


def test_an_image_in_a_folder_below_is_found(room: Room, tmp_path: Path) -> None:
    path = room()
    (tmp_path / "images").mkdir()
    (tmp_path / "room.pgm").rename(tmp_path / "images" / "grid.pgm")
    path.write_text(path.read_text().replace("room.pgm", "images/grid.pgm"))
    assert load_map(path).shape == (92, 122)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_saved_map_comes_back(tmp_path: Path, yaw: float) -> None:
    rng = np.random.default_rng(0)
    occupied = rng.random((37, 61)) < 0.1
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[1:8, 1:-1] = False
    points = np.array([[0.1, 0.1], [1 / 3, 0.2], [2.7, 0.35]])
    original = OccupancyMap(
        name="saved: twice #1",
        occupied=occupied,
        resolution=0.1 / 2.1,
        spawn_points=points,
        evaluation_points=points[:2],
        origin=(0.0 if yaw == 0 else 1 / 7, 0.0 if yaw == 0 else -3.0, yaw),
        spawn_radius=1 / 7,
        max_steps=123,
    )
    save_map(original, tmp_path / "saved: twice #1.yaml")
    loaded = load_map(tmp_path / "saved: twice #1.yaml", robot_radius=0.0)
    for field in ("name", "resolution", "origin", "spawn_radius", "max_steps"):
        assert getattr(loaded, field) == getattr(original, field)
    np.testing.assert_array_equal(loaded.occupied, occupied)
    atol = 0.0 if yaw == 0 else 1e-12
    np.testing.assert_allclose(loaded.spawn_points, points, rtol=0, atol=atol)
    np.testing.assert_allclose(loaded.evaluation_points, points[:2], rtol=0, atol=atol)


def test_saving_where_one_cannot_write_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"absent.*m\.yaml: cannot be written"):
        save_map(load_map("maze"), tmp_path / "absent" / "m.yaml")
    with pytest.raises(ValueError, match=r"expected a path ending in \.yaml"):
        save_map(load_map("maze"), tmp_path / "m.png")


def test_unknown_ground_is_told_from_obstacles(room: Callable[..., Path]) -> None:
    grey = np.full((90, 120), 254, dtype=np.uint8)
    assert load_map(room(grey=grey)).unknown is None
    grey[:5, :10], grey[10, 20:40] = 205, 0
    unknown = load_map(room(grey=grey)).unknown
    assert unknown is not None
    np.testing.assert_array_equal(unknown, np.pad(grey[::-1] == 205, 1))
