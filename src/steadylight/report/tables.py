"""Human-readable tables from `run.json` and `stats.json`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_TITLES = {
    "first_pass": "First pass",
    "merge": "Merge",
    "coverage": "Coverage audit",
    "second_pass": "Second pass",
    "tasks": "Tasks",
}
_WORDS = {
    "fps": "frames per second",
    "spp": "samples per pixel",
    "seconds": "time",
    "seconds_cpu": "CPU time, all workers",
    "isa": "instruction sets",
    "cpu": "processor",
    "frame_seconds": "time per frame",
    "makespan_s": "makespan",
}
_MOST_ITEMS = 8


@dataclass(frozen=True)
class Table:
    """A titled list of names and values, all text.

    Attributes:
        title: heading of the table.
        rows: pairs of name and value.
    """

    title: str
    rows: tuple[tuple[str, str], ...]


def settings_tables(record: Mapping[str, Any]) -> list[Table]:
    """`run.json` as tables: one for each group, and one for single values; keyframes and parts are only counted."""
    record = {name: value for name, value in record.items() if name != "format"}
    if isinstance(camera := record.get("camera"), dict):
        keyframes = camera.get("keyframes")
        record["camera"] = {**camera, "keyframes": len(keyframes)} if isinstance(keyframes, list) else camera
    if isinstance(survey := record.get("survey"), dict) and "windows" in survey:
        seen = [len(window) for window in survey["windows"]]
        record["survey"] = {
            "parts": len(survey["neighbours"]),
            "parts_read_by_a_window": sum(seen) / max(len(seen), 1),
        }
    order = ("scene", "settings", "constants", "camera")
    groups = [name for name in order if name in record] + [name for name in record if name not in order]
    single = {name: record[name] for name in groups if not isinstance(record[name], dict)}
    tables = [
        _table(_words(name).capitalize(), record[name]) for name in groups if isinstance(record[name], dict)
    ]
    return [*tables, *([_table("Backend", single)] if single else [])]


def statistics_tables(statistics: Mapping[str, Any]) -> list[Table]:
    """The groups of `stats.json` as tables, in the order of the work."""
    names = [name for name in _TITLES if name in statistics] + [n for n in statistics if n not in _TITLES]
    return [
        _table(_TITLES.get(name, _words(name).capitalize()), _with_rates(statistics[name]))
        for name in names
        if isinstance(statistics[name], dict)
    ]


def key_figures(statistics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The key figures at the top of the page: value and label."""
    second = _group(statistics, "second_pass")
    times = second.get("frame_seconds") or []
    found: list[tuple[str, Any]] = [
        ("makespan", statistics.get("makespan_s")),
        ("mean time per frame", sum(times) / len(times) if times else None),
    ]
    figures = [(duration(value), words) for words, value in found if value is not None]
    counts = [
        ("frames", statistics.get("frames")),
        ("frames in the first pass", len(statistics.get("selected_frames") or []) or None),
        ("records in the merged cache", _records(statistics)),
        ("misses in the second pass", second.get("missed")),
        ("repeated tasks", _repeated(_group(statistics, "tasks"))),
    ]
    return figures + [(_value("", value), words) for words, value in counts if value is not None]


def duration(seconds: float) -> str:
    """Human-readable duration: `0.26 s`, `3 min 20 s`, `2 h 05 min`."""
    if seconds < 60:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:,} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _group(statistics: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    group = statistics.get(name)
    return group if isinstance(group, dict) else {}


def _records(statistics: Mapping[str, Any]) -> int | None:
    """Number of records read by the second pass: merged, plus those added by the audit."""
    merged = _group(statistics, "merge").get("records_out")
    return None if merged is None else int(merged) + int(_group(statistics, "coverage").get("records") or 0)


def _repeated(tasks: Mapping[str, Any]) -> int | None:
    return int(tasks.get("failed", 0)) + int(tasks.get("lost", 0)) if tasks else None


def _with_rates(group: Mapping[str, Any]) -> dict[str, Any]:
    """The group with its hit rate, if it counts hits and misses."""
    rates = dict(group)
    looked_up = rates.get("hits", 0) + rates.get("misses", 0)
    if "hits" in rates and "misses" in rates and looked_up:
        rates["hit_rate"] = f"{rates['hits'] / looked_up:.2%}"
    return rates


def _table(title: str, group: Mapping[str, Any]) -> Table:
    return Table(title, tuple((_words(name), _value(name, value)) for name, value in group.items()))


def _words(name: str) -> str:
    return _WORDS.get(name, name.replace("_", " "))


def _value(name: str, value: object) -> str:
    """A value as text: durations with units, thousands separated, long lists shortened."""
    if value is None or isinstance(value, bool):
        return {None: "–", True: "yes", False: "no"}[value]
    if isinstance(value, int | float):
        if "seconds" in name or name.endswith("_s"):
            return duration(value)
        return (
            f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
            if isinstance(value, int)
            else f"{value:.4g}"
        )
    if isinstance(value, dict):
        return (
            ", ".join(f"{_words(str(key))} {_value(str(key), item)}" for key, item in value.items()) or "none"
        )
    if isinstance(value, list | tuple):
        return _list(name, value)
    return str(value)


def _list(name: str, values: Sequence[object]) -> str:
    numbers = [value for value in values if isinstance(value, int | float)]
    if "seconds" in name and numbers:
        low, middle, high = min(numbers), sorted(numbers)[len(numbers) // 2], max(numbers)
        return f"{duration(low)} to {duration(high)}, median {duration(middle)}"
    if len(values) > _MOST_ITEMS:
        return f"{_value('', values[0])}, {_value('', values[1])} … {_value('', values[-1])} ({len(values)})"
    return ", ".join(_value("", value) for value in values) or "none"
