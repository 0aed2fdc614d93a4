"""Read material libraries (.mtl): what of each material becomes an albedo."""

from __future__ import annotations

import codecs
import math
from dataclasses import dataclass, replace
from pathlib import Path

from scenes.arrays import finite_number
from scenes.errors import InputError, listed, require
from scenes.io.inputs import file_inside, read_bytes
from scenes.io.textures import WHITE, Colour

# Options of a map, and what they are where they change nothing: up to three numbers, of which those left out are as
# stated here, or as many words; None is one word that matters to a cache or to other maps alone. -s and -o are read.
POINT_OPTIONS = {"-s": (1.0, 1.0, 1.0), "-o": (0.0, 0.0, 0.0), "-t": (0.0, 0.0, 0.0)}
WORD_OPTIONS = {
    "-blendu": ("on",),
    "-blendv": ("on",),
    "-cc": ("off",),
    "-clamp": ("off",),
    "-mm": ("0", "1"),
    "-texres": None,
    "-imfchan": None,
    "-boost": None,
}

_LOOKS = {
    "ke": "its surfaces give no light",
    "map_ke": "its surfaces give no light",
    "pm": "its surfaces are diffuse",
    "map_pm": "its surfaces are diffuse",
    **dict.fromkeys(("bump", "map_bump", "norm", "disp"), "its surfaces keep their own shape"),
}


@dataclass(frozen=True)
class MaterialEntry:
    """Entry of an .mtl file for one material: linear RGB of Kd, file of map_Kd with the scale (-s) and the shift (-o)
    of its texture coordinates (2,), whether it names a map_d, d."""

    colour: Colour | None = None
    image: Path | None = None
    uv_scale: tuple[float, float] = (1.0, 1.0)
    uv_shift: tuple[float, float] = (0.0, 0.0)
    cut_out: bool = False
    opacity: float = 1.0

    @property
    def tint(self) -> Colour:
        """Return the linear RGB that the image is multiplied by: Kd, as the format says, or 1 where there is none.

        A black one would leave nothing of the image. Programs write it that let the image replace the colour.
        """
        return self.colour if self.colour is not None and any(self.colour) else WHITE

    @property
    def tint_note(self) -> str:
        """Say what becomes of a Kd beside the image, where it is neither missing nor white."""
        if self.colour is None or self.colour == WHITE:
            return ""
        if self.tint == WHITE:
            return "map_Kd is taken alone, not multiplied by its black Kd"
        return f"map_Kd is multiplied by its Kd, {' '.join(f'{value:g}' for value in self.colour)}"


def without_mark(content: bytes) -> bytes:
    """Return text without the byte order mark that editors put before it, which would be part of its first word."""
    return content.removeprefix(codecs.BOM_UTF8)


def lenient_text(path: Path) -> str:
    """Read a text file: names and comments in any encoding, numbers never."""
    return without_mark(read_bytes(path)).decode("utf-8", errors="replace")


def read_library(library: Path, notes: list[str]) -> dict[str, MaterialEntry]:
    """Read a material library: its materials by name, with notes on options of images that are left out.

    Raises InputError for an image that is not there, and for one that is distorted at random (-t).
    """
    entries: dict[str, MaterialEntry] = {}
    changed: dict[str, list[str]] = {}  # materials by what is changed
    stated: set[str] = set()  # by d
    name = ""
    for line in lenient_text(library).splitlines():
        key, rest = (*line.split(maxsplit=1), "", "")[:2]
        if key.lower() == "newmtl":
            name = " ".join(rest.split())
            entries[name] = MaterialEntry()
        elif key.lower() == "kd" and name:
            given, colour = _kd(library, rest)
            entries[name] = replace(entries[name], colour=colour)
            if given != colour:
                changed.setdefault("Kd outside 0 to 1 is clipped", []).append(name)
        elif key.lower() in _LOOKS and name and _is_some(rest):
            changed.setdefault(f"{key} is left out, {_LOOKS[key.lower()]}", []).append(name)
        elif key.lower() == "map_kd" and name:
            entries[name] = _with_map(entries[name], library, name, rest, notes)
        elif key.lower() == "map_d" and name:
            entries[name] = replace(entries[name], cut_out=True)
        elif key.lower() in ("d", "tr") and name and not (key.lower() == "tr" and name in stated):
            # where both are given, programs disagree on what Tr is
            stated |= {name} if key.lower() == "d" else set()
            entries[name] = replace(entries[name], opacity=_opacity(library, key.lower(), rest))
    notes += [f"{words}: {listed(list(dict.fromkeys(names)))}" for words, names in changed.items()]
    return entries


def _is_some(text: str) -> bool:
    """Return whether numbers, or a map's name, say that there is any of it."""
    try:
        return any(float(word) > 0 for word in text.split())
    except ValueError:
        return bool(text.strip())


def _opacity(library: Path, key: str, text: str) -> float:
    """Return what d says, or 1 less what Tr says."""
    try:
        value = float(text.removeprefix("-halo").split()[0])
    except (ValueError, IndexError):
        raise InputError(f"{library}: {key} {text.strip()!r}, expected a number") from None
    return value if key == "d" else 1 - value


def _kd(library: Path, text: str) -> tuple[Colour, Colour]:
    """Return Kd as given and 0 to 1 each: a reflectance by the format's text, and in Blender's files: linear."""
    try:
        words = text.split()[:3]
        given = [finite_number(float(word), "Kd") for word in (words * 3 if len(words) == 1 else words)]
        red, green, blue = given
    except ValueError:  # of which InputError is one
        raise InputError(f"{library}: Kd {text.strip()!r}, expected three numbers") from None
    clipped = [min(max(value, 0.0), 1.0) for value in given]
    return (red, green, blue), (clipped[0], clipped[1], clipped[2])


def _with_map(entry: MaterialEntry, library: Path, name: str, text: str, notes: list[str]) -> MaterialEntry:
    """Return the entry with what a map_Kd line says: its file, -s and -o. Other options are noted, -t is refused."""
    where = f"{library}: map_Kd of material {name}"
    points: dict[str, tuple[float, ...]] = dict(POINT_OPTIONS)
    rest = text.strip()
    while rest.startswith("-") and len(rest.split(maxsplit=1)) == 2:
        option, rest = rest.split(maxsplit=1)
        option = option.lower()
        if option in POINT_OPTIONS:
            identity = POINT_OPTIONS[option]
            values, rest = _leading_numbers(rest)
            points[option] = (*values, *identity[len(values) :])
            same = option != "-t" or points[option] == identity
            shown = " ".join(f"{value:g}" for value in values)
            require(same, f"{where}: option {option} {shown} is not read; bake it into the image")
            require(all(map(math.isfinite, values)), f"{where}: option {option} {shown}, expected finite numbers")
        elif option in WORD_OPTIONS:
            usual = WORD_OPTIONS[option]
            words = rest.split(maxsplit=1 if usual is None else len(usual))
            given, rest = words[:-1], words[-1]
            if usual is not None and not _equal(given, usual):
                notes.append(f"material {name}: option {option} {' '.join(given)} of map_Kd is left out")
        else:
            notes.append(f"material {name}: option {option} of map_Kd is left out")
            rest = _named_file(library.parent, rest)
    try:
        image = file_inside(library.parent, rest, f"texture of material {name}")
    except InputError as error:
        raise InputError(f"{library}: {error}") from None
    (*scale, _), (*shift, _) = points["-s"], points["-o"]
    return replace(entry, image=image, uv_scale=(scale[0], scale[1]), uv_shift=(shift[0], shift[1]))


def _named_file(folder: Path, text: str) -> str:
    """Return the name of a file behind an option of unknown length: the longest one that is there, or the last word."""
    words = text.split(" ")
    names = [" ".join(words[start:]) for start in range(1, len(words))]
    return next((name for name in names if name.strip() and (folder / name).is_file()), text.split()[-1])


def _leading_numbers(text: str) -> tuple[list[float], str]:
    """Return up to three numbers that text begins with, and the text behind them, which is a file's name."""
    values: list[float] = []
    while len(values) < 3 and len(text.split(maxsplit=1)) == 2:
        word, behind = text.split(maxsplit=1)
        try:
            values.append(float(word))
        except ValueError:
            break
        text = behind
    return values, text


def _equal(given: list[str], usual: tuple[str, ...]) -> bool:
    """Compare words of an option; numbers count by their value."""
    try:
        return [float(word) for word in given] == [float(word) for word in usual]
    except ValueError:
        return [word.lower() for word in given] == list(usual)
