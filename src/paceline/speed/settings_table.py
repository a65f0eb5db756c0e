"""Writes docs/configuration.md, every setting with range and effect: ``python -m paceline.speed.settings_table``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from paceline.speed.choices import resampling_schemes
from paceline.speed.configuration import ASCENDING, PAIR_WORDS, REGISTERED_SCHEME, Section, SpeedSettings
from paceline.units import SpeedUnit

PAGE_INTRODUCTION = """# Settings of `paceline speed`

```
paceline speed CLIP -o OUT --config settings.yaml
```

reads settings from a YAML file; every key may be left out. Options of the command line override the file. An unknown
key, a key given twice or a value out of range ends the command with status 2 and one line. The settings that were
used are in `summary.json` under `configuration`; as a file, they reproduce the result.

```yaml
particles: 1000
motion: line
limits:
  max_half_width: 0.03
```

From Python: `paceline.load_settings("settings.yaml").configuration`, or `paceline.SpeedConfiguration(particles=1000)`.
Noises "per frame" are those of [Zhu] at its 5 frames/s; for another time step they grow with its square root. Numbers
in brackets are equations of the paper ([method.md](method.md)).

This page is made from [configuration.py](../src/paceline/speed/configuration.py).
"""
TABLE_HEADER = "| key | default | range | effect |\n| --- | --- | --- | --- |"


def settings_page() -> str:
    """The text of docs/configuration.md."""
    fields = {name: field for name, field in SpeedSettings.model_fields.items() if section_of(field) is None}
    parts = [PAGE_INTRODUCTION, "\n".join([TABLE_HEADER, *map(row, fields, fields.values())])]
    for name, field in SpeedSettings.model_fields.items():
        if (section := section_of(field)) is not None:
            docstring = (section.__doc__ or "").strip()
            rows = "\n".join([TABLE_HEADER, *(row(f"{name}.{key}", f) for key, f in section.model_fields.items())])
            parts.append(f"\n## {name}\n\n{docstring}\n\n{rows}")
    return "\n".join(parts) + "\n"


def section_of(field: FieldInfo) -> type[Section] | None:
    """The section that a field is; None for a plain one."""
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Section) else None


def row(name: str, field: FieldInfo) -> str:
    return f"| `{name}` | {shown(field.default)} | {range_of(field)} | {field.description} |"


def shown(value: Any) -> str:
    """A value as text of a YAML file."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(shown, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def range_of(field: FieldInfo) -> str:
    """The allowed values of a field as text."""
    if get_origin(field.annotation) is Literal:
        return ", ".join(map(str, get_args(field.annotation)))
    if REGISTERED_SCHEME in field.metadata:
        return ", ".join(resampling_schemes())
    if get_origin(field.annotation) is tuple:
        return PAIR_WORDS + ", the smaller one first" * (ASCENDING in field.metadata)
    if field.annotation is SpeedUnit:
        return ", ".join(SpeedUnit)
    if field.annotation is bool:
        return "true, false"
    return ", ".join(bounds(field)) or "text"


def bounds(field: FieldInfo) -> Iterator[str]:
    for limit in field.metadata:
        for name, relation in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most")):
            if (value := getattr(limit, name, None)) is not None:
                yield f"{relation} {value:,}".replace(",", " ")


if __name__ == "__main__":
    from pathlib import Path

    page = Path(__file__).parents[3] / "docs" / "configuration.md"
    page.write_text(settings_page(), encoding="utf-8")
