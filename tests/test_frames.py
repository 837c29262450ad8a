"""Folders of real frames as people bring them: other pictures, other spreadsheets, and two thousand mutations."""

import os
import shutil
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from test_hardware import write_folder

from lt_lib.hardware import real_frames
from lt_lib.hardware.real_frames import _read_picture, read_rows, read_sessions
from lt_lib.settings.base import UserError

MUTATIONS = 2_000


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("brought") / "frames")


@pytest.fixture
def folder(good, tmp_path):
    return Path(shutil.copytree(good, tmp_path / "frames"))


@pytest.fixture(scope="module")
def scene():
    """A colourful picture, smooth enough for JPEG, that looks different from every side."""
    y, x = np.mgrid[0:80, 0:120]
    return np.stack([2 * x, 3 * y, 255 - x - y], axis=-1).clip(0, 255).astype(np.uint8)


# --- pictures
TURNED = {
    3: lambda a: a[::-1, ::-1],
    6: lambda a: np.rot90(a, 1),
    8: lambda a: np.rot90(a, -1),
    2: lambda a: a[:, ::-1],
}


@pytest.mark.parametrize("orientation", TURNED)
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_picture_is_turned_upright_as_its_exif_says(scene, tmp_path, orientation, kind):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"a.{kind}"
    Image.fromarray(np.ascontiguousarray(TURNED[orientation](scene))).save(path, exif=exif, quality=95)
    read = _read_picture(path, "row 2")
    assert read.shape == scene.shape
    assert np.abs(read.astype(int) - scene).mean() < 3


def test_sixteen_bits_are_scaled_and_grey_palette_and_opaque_alpha_are_read_as_they_look(scene, tmp_path):
    grey = scene[..., 0]
    pictures = {
        "sixteen.png": (Image.fromarray(grey.astype(np.uint16) * 257), grey[..., None].repeat(3, 2)),
        "grey.png": (Image.fromarray(grey), grey[..., None].repeat(3, 2)),
        "palette.png": (Image.fromarray(scene).quantize(256), None),
        "alpha.png": (Image.fromarray(np.dstack([scene, np.full_like(grey, 255)])), scene),
        "bits.png": (Image.fromarray(grey > 100), (255 * (grey > 100))[..., None].repeat(3, 2)),
    }
    for name, (picture, expected) in pictures.items():
        picture.save(tmp_path / name)
        expected = np.asarray(picture.convert("RGB")) if expected is None else expected
        np.testing.assert_array_equal(_read_picture(tmp_path / name, name), expected, err_msg=name)


def test_a_colour_profile_other_than_srgb_is_converted(scene, tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(scene).save(tmp_path / "srgb.png", icc_profile=srgb)
    assert np.abs(_read_picture(tmp_path / "srgb.png", "").astype(int) - scene).max() <= 1
    Image.fromarray(scene).save(tmp_path / "odd.png", icc_profile=b"no profile at all")
    with pytest.raises(UserError, match="^row 2 has an unusable colour profile"):
        _read_picture(tmp_path / "odd.png", "row 2")
    swapped = bytearray(srgb)  # red and green primaries exchanged: a gamut of its own
    red, green = (srgb.index(tag) for tag in (b"rXYZ", b"gXYZ"))
    swapped[red : red + 4], swapped[green : green + 4] = b"gXYZ", b"rXYZ"
    Image.fromarray(scene).save(tmp_path / "swapped.png", icc_profile=bytes(swapped))
    assert np.abs(_read_picture(tmp_path / "swapped.png", "").astype(int) - scene).mean() > 10


@pytest.mark.parametrize(
    "save, complaint",
    [
        (lambda p, a: Image.fromarray(np.dstack([a, a[..., 0]])).save(p), "has transparent pixels; save it without"),
        (lambda p, a: Image.fromarray(a).convert("CMYK").save(p, "JPEG"), "is in CMYK; save it as RGB"),
        (
            lambda p, a: Image.fromarray(a[..., 0].astype(np.float32)).save(p, "TIFF"),
            "is no image in PNG or JPEG format",
        ),
        (lambda p, a: Image.fromarray(a).save(p, "GIF"), "is no image in PNG or JPEG format"),
        (lambda p, a: p.write_bytes(b""), "is no image in PNG or JPEG format"),
    ],
)
def test_a_picture_that_would_have_to_be_guessed_is_refused_by_name(scene, tmp_path, save, complaint):
    path = tmp_path / "a.png"
    save(path, scene)
    with pytest.raises(UserError, match=f"^row 2: a.png {complaint}"):
        _read_picture(path, "row 2: a.png")


def test_a_picture_over_the_limit_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    Image.new("L", (300, 300)).save(tmp_path / "a.png")
    monkeypatch.setattr(real_frames, "MOST_PIXELS", 300 * 300 - 1)
    with pytest.raises(UserError, match=r"row 2 has more than 89,999 pixels; scale it down"):
        _read_picture(tmp_path / "a.png", "row 2")
    monkeypatch.setattr(real_frames, "MOST_PIXELS", 50_000_000)
    for limit in (300 * 300 - 1, 100 * 100):  # Pillow's own warning, and its own error
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", limit)
        with pytest.raises(UserError, match="row 2 has more than 50,000,000 pixels"):
            _read_picture(tmp_path / "a.png", "row 2")


# --- labels
def labels(folder: Path) -> str:
    return (folder / "labels.csv").read_text()


SPREADSHEETS = {
    "utf-16": (lambda t: t.encode("utf-16"), "labels.csv is UTF-16; save it as 'CSV UTF-8'"),
    "latin-1": (
        lambda t: t.replace("refit_1.png", "réfit_1.png").encode("latin-1"),
        "row 3 is not UTF-8; save the file",
    ),
    "semicolons": (
        lambda t: t.replace(",", ";").encode(),
        "row 1: expected the columns .* with commas between the values",
    ),
    "spaces in the header": (
        lambda t: t.replace(",", ", ", 5).encode(),
        "row 1: .*; remove the spaces beside the commas",
    ),
    "spaces in a row": (
        lambda t: t.replace("png,refit", "png, refit", 1).encode(),
        "row 3: session ' refit' has a space",
    ),
    "decimal comma": (
        lambda t: t.replace(",bright", ",5,bright", 1).encode(),
        "row 2: expected 6 values, got 7; a decimal",
    ),
    "null byte": (lambda t: t.replace("refit_1.png", "refit\0.png").encode(), "row 3: "),
    "outside": (
        lambda t: t.replace("refit_1.png", "../out.png").encode(),
        r"row 3: '../out.png' lies outside the folder",
    ),
    "absolute": (
        lambda t: t.replace("refit_1.png", "/etc/x.png").encode(),
        r"row 3: '/etc/x.png' lies outside the folder",
    ),
    "other digits": (lambda t: t.replace("refit,1,", "refit,١,").encode(), "row 3: placement must be a whole number"),
    "distance 0": (lambda t: set_value(t, 3, 3, "0").encode(), "row 3: distance_cm must be .* above 0, got '0'"),
}


def set_value(text: str, row: int, column: int, value: str) -> str:
    lines = text.splitlines()
    values = lines[row - 1].split(",")
    values[column] = value
    lines[row - 1] = ",".join(values)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("case", SPREADSHEETS)
def test_a_spreadsheet_s_own_ways_get_one_line_that_says_what_to_do(case, folder):
    change, complaint = SPREADSHEETS[case]
    (folder.parent / "out.png").write_bytes((folder / "refit_1.png").read_bytes())
    (folder / "labels.csv").write_bytes(change(labels(folder)))
    with pytest.raises(UserError, match=complaint) as caught:
        read_rows(folder)
    assert "\n" not in str(caught.value)


def test_a_link_that_leaves_the_folder_is_not_followed(folder):
    outside = folder.parent / "secret.png"
    (folder / "refit_1.png").rename(outside)
    (folder / "refit_1.png").symlink_to(outside)
    with pytest.raises(UserError, match="row 3: 'refit_1.png' lies outside the folder"):
        read_rows(folder)


@pytest.mark.parametrize("column, value", [(3, "99"), (4, None), (5, None)])
def test_one_placement_has_one_answer_distance_and_light(folder, column, value):
    text = set_value(labels(folder), 3, 2, labels(folder).splitlines()[1].split(",")[2])  # as in row 2
    for same in (3, 4, 5):
        text = set_value(text, 3, same, text.splitlines()[1].split(",")[same])
    (folder / "labels.csv").write_text(text)
    read_rows(folder)
    was = text.splitlines()[1].split(",")[column]
    other = value or {"bright": "dim", "dim": "bright", "0": "1", "1": "0"}[was]
    (folder / "labels.csv").write_text(set_value(text, 3, column, other))
    with pytest.raises(UserError, match=rf"row 3: placement \d+ has .* {other}, but {was} in row 2; number every"):
        read_rows(folder)


def test_the_row_that_is_named_is_the_spreadsheet_s_even_behind_a_blank_line_and_a_byte_order_mark(folder):
    lines = labels(folder).splitlines()
    lines.insert(2, "")
    text = set_value("\n".join(lines), 6, 4, "sunny")
    (folder / "labels.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    with pytest.raises(UserError, match="row 6: unknown lighting 'sunny'"):
        read_rows(folder)


# --- mutations
def mutate(folder: Path, rng: np.random.Generator) -> None:
    """Changes one thing of a folder: bytes of a file, a file's name, or a link in its place."""
    files = sorted(p for p in folder.iterdir())
    path = files[rng.integers(len(files))]
    if rng.random() < 0.5:  # tables are small beside pictures, and more can go wrong in them
        path = folder / ("labels.csv" if rng.random() < 0.8 else "optics.yaml")
    how, data = rng.integers(6), bytearray(path.read_bytes())
    where = int(rng.integers(len(data)))
    match how:
        case 0:
            data[where] = int(rng.integers(256))
        case 1:
            data[where:where] = bytes(rng.integers(0, 256, rng.integers(1, 9), dtype=np.uint8))
        case 2:
            del data[where : where + int(rng.integers(1, 200))]
        case 3:
            other = int(rng.integers(len(data)))
            data[where], data[other] = data[other], data[where]
        case 4:
            path.rename(path.with_name(path.name + "x"))
            return
        case 5:
            target = ("../outside.png", "/dev/null", "labels.csv", path.name)[rng.integers(4)]
            path.unlink()
            path.symlink_to(target)
            return
    path.write_bytes(bytes(data))


@pytest.mark.slow
def test_every_mutation_of_a_folder_is_read_or_refused_in_one_line_and_opens_nothing_outside(
    good, tmp_path, monkeypatch
):
    shutil.copy(good / "refit_1.png", tmp_path / "outside.png")
    opened = []
    sys.addaudithook(
        lambda event, args: opened.append(os.path.realpath(str(args[0]))) if event == "open" and watching else None
    )
    watching = []
    rng, outcomes = np.random.default_rng(0), {"read": 0, "refused": 0}
    kept = {path.name: path.read_bytes() for path in good.iterdir()}
    folder = tmp_path / "frames"
    folder.mkdir()
    for _ in range(MUTATIONS):
        for path in folder.iterdir():
            if path.is_symlink() or path.name not in kept or path.read_bytes() != kept[path.name]:
                path.unlink()
        for name in kept.keys() - {path.name for path in folder.iterdir()}:
            (folder / name).write_bytes(kept[name])
        mutate(folder, rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of odd EXIF
            watching.append(True)
            try:
                read_sessions(folder)
                outcomes["read"] += 1
            except UserError as error:
                assert len(str(error).splitlines()) == 1
                outcomes["refused"] += 1
            finally:
                watching.clear()
    assert min(outcomes.values()) > MUTATIONS / 10
    inside = f"{folder.resolve()}{os.sep}"
    assert any(path.startswith(inside) for path in opened)
    assert not [path for path in opened if path.startswith((str(tmp_path), os.devnull)) and not path.startswith(inside)]
