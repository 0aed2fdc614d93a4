"""Sensor files: a `Sensor`, with its optics, as TOML, every quantity with its unit; the presets that come as files.

A file holds `name`, `description`, the tables `histogram`, `pulse`, `jitter`, `detector`, `tdc`, `optics` and
`zones`, of which `histogram` (bins, bin_width) and `pulse` must be there, and `sources`: where each number comes from.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple

from scenes.errors import InputError, did_you_mean, listed, require, require_kind
from scenes.files import whole_file
from scenes.io.inputs import file_sha256
from scenes.json_types import JsonObject
from spad.sensor.budget import Optics
from spad.sensor.model import HOT_RATE_HZ, PRESETS, Sensor
from spad.sensor.pulse import FWHM_PER_SIGMA, AnyPulse, Pulse, SampledPulse
from spad.sensor.quantities import format_quantity, parse_quantity
from spad.sensor.tdc import Tdc
from spad.sensor.toml import format_toml, read_toml
from spad.sensor.zone_array import ZoneArray, check_times

SCHEMA = "1.0"
KINDS_OF_PULSE = "sigma, fwhm, or samples with step"


class Key(NamedTuple):
    """One key of a table: the field that it sets, its dimension ("" a number, "count" a whole one, "word" a text),
    whether it must be there, may be negative, is a list (or may be one), and may be infinite."""

    field: str
    dimension: str = ""
    required: bool = False
    signed: bool = False
    many: Literal["no", "may", "must"] = "no"
    infinite: bool = False


HISTOGRAM = {
    "bins": Key("bins", "count", required=True),
    "bin_width": Key("bin_width_s", "time", required=True),
    "period": Key("period_s", "time"),
    "exposure": Key("exposure_s", "time"),
}
DETECTOR = {
    "pde": Key("pde"),
    "dark_count_rate": Key("dark_count_rate_hz", "rate", many="may"),
    "hot_fraction": Key("hot_share"),
    "hot_rate": Key("hot_rate_hz", "rate"),
    "dead_fraction": Key("dead_share"),
    "reset": Key("reset", "word"),
    "dead_time": Key("dead_time_s", "time"),
    "crosstalk": Key("crosstalk"),
}
OPTICS = {
    "pulse_energy": Key("pulse_energy_j", "energy", required=True),
    "focal_length": Key("focal_length_m", "length", required=True),
    "f_number": Key("f_number", required=True),
    "pixel_pitch": Key("pixel_pitch_m", "length", required=True),
    "transmission": Key("transmission"),
    "filter_width": Key("filter_nm", "bandwidth"),
    "wavelength": Key("wavelength_m", "length"),
}
PULSE = {
    "sigma": Key("sigma_s", "time"),
    "fwhm": Key("fwhm_s", "time"),
    "tail": Key("tail_s", "time"),
    "samples": Key("samples", many="must"),
    "step": Key("sample_s", "time"),
}
TDC = {
    "clock_period": Key("clock_period_s", "time", required=True),
    "table": Key("table", "word"),
    "codes": Key("codes", "count"),
    "dnl": Key("dnl"),
    "missing": Key("missing"),
    "jitter": Key("jitter_s", "time"),
    "correction": Key("correction", "word"),
    "correction_bits": Key("correction_bits", "count"),
}
ZONES = {
    "centre_x": Key("centre_x", required=True, signed=True, many="must"),
    "centre_y": Key("centre_y", required=True, signed=True, many="must"),
    "width": Key("width", required=True, many="must"),
    "height": Key("height", required=True, many="must"),
    "gain": Key("gain", many="must"),
    "delay": Key("delay_s", "time", signed=True, many="must"),
    "skew": Key("skew_s", "time", many="must"),
    "clock": Key("clock", many="must"),
    "chirp": Key("chirp_hz", "rate", signed=True),
    "background": Key("background", many="must"),
    "leak": Key("leak", many="must"),
    "echo": Key("echo_m2", "area", many="must"),
    "crosstalk": Key("crosstalk"),
    "trials": Key("trials", many="must", infinite=True),
    "recovery": Key("recovery", many="may"),
    "compression": Key("compression", many="may"),
    "illumination_x": Key("illumination_x", signed=True),
    "illumination_y": Key("illumination_y", signed=True),
    "curvature_x": Key("curvature_x"),
    "curvature_y": Key("curvature_y"),
    "baseline": Key("baseline_m", "length", signed=True, many="must"),
    "aperture": Key("aperture_m", "length"),
}
TABLES = {
    "histogram": HISTOGRAM,
    "pulse": PULSE,
    "jitter": PULSE,
    "detector": DETECTOR,
    "tdc": TDC,
    "optics": OPTICS,
    "zones": ZONES,
}
TOP = ("schema", "name", "description")


@dataclass(frozen=True)
class SensorFile:
    """Contents of a sensor file.

    sensor       the detector and its histogram
    optics       lens, filter and laser of a radiometric budget; None where the file has none, and beside zones
    zones        zones of a multi-zone sensor; None for one that has pixels
    description  one line for people
    sources      where the numbers come from, by "table.key"; what is not public says "assumed"
    """

    sensor: Sensor
    optics: Optics | None = None
    zones: ZoneArray | None = None
    description: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.zones is not None:
            check_times(self.sensor, self.zones)
            self._check_no_pixels()
            require(self.optics is None, "zones and optics do not go together: a radiometric budget is of pixels")

    def _check_no_pixels(self) -> None:
        """Raise InputError for what only pixels have, and zones would leave without a meaning.

        Efficiency and dark counts are of a chip's data sheet, whose zones have gains and backgrounds for them.
        """
        require(self.sensor.tdc is None, "zones and tdc do not go together: converters are of pixels")
        ideal = Sensor()
        for name in ("hot_fraction", "hot_rate", "dead_fraction", "reset", "dead_time", "crosstalk"):
            same = getattr(self.sensor, DETECTOR[name].field) == getattr(ideal, DETECTOR[name].field)
            require(same, f"zones and detector.{name} do not go together: it is of pixels")


def preset_files() -> dict[str, Path]:
    """Return the sensor files that come with the package, by name."""
    folder = Path(str(files("spad") / "sensors"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def sensor_names() -> list[str]:
    """Return the names that `load_sensor` knows."""
    return [*PRESETS, *preset_files()]


def load_sensor(name: str) -> SensorFile:
    """Return a preset by its name, or what the sensor file (.toml) of that path says.

    Raises InputError in one line for an unknown name, which lists those there are, and as `read_sensor` does.
    """
    if name in PRESETS:
        return SensorFile(PRESETS[name])
    if name in (shipped := preset_files()):
        return read_sensor(shipped[name])
    if name.endswith(".toml") or "/" in name:
        return read_sensor(Path(name))
    names = sensor_names()
    meant = did_you_mean(name, names)
    raise InputError(f"sensor {name!r} is unknown{meant}, expected a file (.toml) or one of {', '.join(names)}")


def pixel_sensor(given: Sensor | str | Path) -> Sensor:
    """Return the sensor that is given, or that of a preset or file (.toml) as `load_sensor`; InputError for one of
    zones, whose pixels nobody has, and anything else."""
    if isinstance(given, str | Path):
        found = load_sensor(str(given))
        require(found.zones is None, f"sensor {given} has zones, expected one of pixels; `scene2spad sense` takes it")
        return found.sensor
    require_kind(given, Sensor, "sensor", " or its name")
    return given


def read_sensor(path: Path) -> SensorFile:
    """Read a sensor file.

    Raises InputError in one line that names the file and the key: a file that is missing or no TOML, of a newer schema,
    an unknown key, a missing one, a unit that is missing or of another dimension, a value out of its range.
    """
    contents = read_toml(Path(path))
    try:
        return sensor_from_tables(contents, Path(path).parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def sensor_from_tables(contents: Mapping[str, object], folder: Path = Path()) -> SensorFile:
    """Return what the tables of a sensor file in `folder` say; see `read_sensor`."""
    _check_schema(contents)
    _check_keys(contents, (*TOP, *TABLES, "sources"), "")
    name = contents.get("name")
    require(isinstance(name, str) and bool(name), "name is missing, expected a text")
    description = contents.get("description", "")
    if not isinstance(description, str):
        raise InputError(f"description: {description!r} is no text")
    for table in ("histogram", "pulse"):
        require(table in contents, f"table [{table}] is missing")
    # checked by `_field`, and by the classes that take them
    tables: dict[str, dict[str, Any]] = {table: _table(contents, table) for table in TABLES if table in contents}
    values: dict[str, Any] = {"name": name}
    for table in ("histogram", "detector"):
        values.update(tables.get(table, {}))
    if values.get("hot_share"):
        values.setdefault("hot_rate_hz", HOT_RATE_HZ)
    for table in ("pulse", "jitter"):
        if table in tables:
            values[table] = _pulse(tables[table], table)
    if "tdc" in tables:
        values["tdc"] = _converters(Tdc(**tables["tdc"]), folder)
    optics = Optics(**tables["optics"]) if "optics" in tables else None
    zones = ZoneArray(**tables["zones"]) if "zones" in tables else None
    try:
        sensor = Sensor(**values)
    except InputError as error:
        raise InputError(_by_keys(str(error))) from None
    return SensorFile(sensor, optics, zones, description, _sources(contents))


def _by_keys(message: str) -> str:
    """Return a message of `Sensor` with the keys of a sensor file in place of its fields."""
    for key, spec in (HISTOGRAM | DETECTOR).items():
        message = re.sub(rf"\b{spec.field}\b", key, message)
    return message


def _converters(tdc: Tdc, folder: Path) -> Tdc:
    """Return converters whose table of codes, if they have one of their own, lies where the sensor file's folder says
    and is known by its hash."""
    if tdc.has_own_table:
        path = folder / tdc.table
        tdc = replace(tdc, table=str(path), table_sha256=file_sha256(path))
    tdc.ends()
    return tdc


def _check_schema(contents: Mapping[str, object]) -> None:
    schema = contents.get("schema", SCHEMA)
    major = str(schema).partition(".")[0]
    good = isinstance(schema, str) and major.isdigit()
    require(good, f"schema {schema!r} is none, expected a text such as {SCHEMA!r}")
    ours = SCHEMA.partition(".")[0]
    require(major == ours, f"sensor file of schema {schema}, this program reads {ours}; use another scene2spad")


def _check_keys(found: Mapping[str, object], known: tuple[str, ...], where: str) -> None:
    for key in found:
        meant = did_you_mean(key, known) or f", expected one of {', '.join(known)}"
        require(key in known, f"unknown key {where}{key}{meant}")


def _table(contents: Mapping[str, object], name: str) -> dict[str, object]:
    """Return the fields that a table sets, in SI units."""
    table, keys = contents[name], TABLES[name]
    if not isinstance(table, dict):
        raise InputError(f"{name}: expected a table [{name}]")
    _check_keys(table, tuple(keys), f"{name}.")
    missing = [key for key, key_spec in keys.items() if key_spec.required and key not in table]
    require(not missing, f"{name}.{listed(missing)} is missing")
    return {keys[key].field: _field(value, keys[key], f"{name}.{key}") for key, value in table.items()}


def _field(value: object, key: Key, where: str) -> object:
    if key.dimension == "word":
        require(isinstance(value, str), f"{where}: {value!r} is no text")
        return value
    if key.dimension == "count":
        whole = isinstance(value, int) and not isinstance(value, bool)
        require(whole, f"{where}: {value!r} is no whole number")
        return value
    require(isinstance(value, list) or key.many != "must", f"{where}: expected a list of numbers")
    read = partial(parse_quantity, signed=key.signed, infinite=key.infinite)
    if isinstance(value, list) and key.many != "no":
        return tuple(read(item, key.dimension, f"{where}[{at}]") for at, item in enumerate(value))
    return read(value, key.dimension, where)


def _pulse(values: JsonObject, where: str) -> AnyPulse:
    ways = [way for way in ("sigma_s", "fwhm_s", "samples") if way in values]
    require(len(ways) == 1, f"{where}: expected one of {KINDS_OF_PULSE}, there are {len(ways)}")
    if ways == ["samples"]:
        require("sample_s" in values, f"{where}.step is missing: the time step of {where}.samples")
        require("tail_s" not in values, f"{where}.tail does not go with samples")
        return _named(where, SampledPulse, values["samples"], values["sample_s"])
    require("sample_s" not in values, f"{where}.step goes with samples alone")
    sigma = values["sigma_s"] if "sigma_s" in values else values["fwhm_s"] / FWHM_PER_SIGMA
    return _named(where, Pulse, sigma, values.get("tail_s", 0.0))


def _named(where: str, kind: Callable[..., AnyPulse], *values: Any) -> AnyPulse:
    """Make a pulse; what is wrong with it is told of its table, as jitter is a pulse too."""
    try:
        return kind(*values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _sources(contents: Mapping[str, object]) -> dict[str, str]:
    sources = contents.get("sources", {})
    if not isinstance(sources, dict):
        raise InputError("sources: expected a table [sources]")
    known = tuple(f"{table}.{key}" for table, keys in TABLES.items() for key in keys)
    for key, source in sources.items():
        require(isinstance(source, str), f"sources.{key}: {source!r} is no text")
        _check_keys({key: source}, known, "sources.")
    return dict(sources)


def write_sensor(contents: SensorFile, path: Path) -> Path:
    """Write a sensor file, whole or not at all. Returns the path.

    `read_sensor` returns the same, but for the path of a converter's own table, which is written as an absolute one, so
    that the sensor file can be anywhere: the two differ in `tdc.table` where that was relative.
    """
    path = Path(path)
    require(path.suffix == ".toml", f"{path}: the output must end in .toml")
    with whole_file(path) as beside:
        beside.write_text(format_toml(sensor_tables(contents)), encoding="utf-8")
    return path


def sensor_tables(contents: SensorFile) -> dict[str, object]:
    """Return the tables of a sensor file, as `format_toml` takes them: what is as in a perfect sensor is left out."""
    sensor, optics = contents.sensor, contents.optics
    ideal = Sensor(bins=sensor.bins, bin_width_s=sensor.bin_width_s, exposure_s=max(1 / 30, sensor.period_s))
    tables: dict[str, object] = {"schema": SCHEMA, "name": sensor.name}
    if contents.description:
        tables["description"] = contents.description
    tables["histogram"] = dict(_written(sensor, HISTOGRAM))
    tables["pulse"] = _pulse_table(sensor.pulse)
    if sensor.jitter is not None:
        tables["jitter"] = _pulse_table(sensor.jitter)
    differing = {name: key for name, key in DETECTOR.items() if getattr(sensor, key.field) != getattr(ideal, key.field)}
    detector = dict(_written(sensor, differing))
    if detector:
        tables["detector"] = detector
    if (tdc := sensor.tdc) is not None:
        defaults = {one.name: one.default for one in fields(Tdc)}
        used = {name: key for name, key in TDC.items() if getattr(tdc, key.field) != defaults[key.field]}
        place = {"table": str(Path(tdc.table).resolve())} if tdc.has_own_table else {}  # wherever the sensor file goes
        tables["tdc"] = dict(_written(tdc, used)) | place
    if optics is not None:
        tables["optics"] = dict(_written(optics, OPTICS))
    if (zones := contents.zones) is not None:
        views = ("centre_x", "centre_y", "width", "height")
        plain = ZoneArray(*(getattr(zones, name) for name in views))
        used = {name: key for name, key in ZONES.items() if name in views} | _differing(ZONES, zones, plain)
        tables["zones"] = dict(_written(zones, used))
    if contents.sources:
        tables["sources"] = dict(contents.sources)
    return tables


def _differing(keys: Mapping[str, Key], holder: object, ideal: object) -> dict[str, Key]:
    """Return the keys whose fields are not as in an ideal sensor."""
    return {name: key for name, key in keys.items() if getattr(holder, key.field) != getattr(ideal, key.field)}


def _written(holder: object, keys: Mapping[str, Key]) -> Iterator[tuple[str, object]]:
    for name, key in keys.items():
        value = getattr(holder, key.field)
        if key.dimension in ("", "word", "count"):
            yield name, list(value) if isinstance(value, tuple) else value
        elif isinstance(value, tuple):
            yield name, [format_quantity(item, key.dimension) for item in value]
        else:
            yield name, format_quantity(value, key.dimension)


def _pulse_table(pulse: AnyPulse) -> Mapping[str, object]:
    if isinstance(pulse, SampledPulse):
        return {"step": format_quantity(pulse.sample_s, "time"), "samples": list(pulse.samples)}
    table = {"sigma": format_quantity(pulse.sigma_s, "time")}
    return {**table, "tail": format_quantity(pulse.tail_s, "time")} if pulse.tail_s else table
