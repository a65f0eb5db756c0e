"""Renders self-contained HTML pages from templates; all text is escaped."""

from __future__ import annotations

import base64
import json

from jinja2 import Environment, PackageLoader, StrictUndefined

from paceline.reports.common.tables import to_json_value


def render(template: str, **values: object) -> str:
    """Renders ``template`` with ``values``; the filters jpeg and svg embed images, all other values are escaped."""
    templates = Environment(
        loader=PackageLoader("paceline.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["jpeg"] = lambda data: _data_uri("image/jpeg", data)
    templates.filters["svg"] = lambda text: _data_uri("image/svg+xml", text.encode())
    return templates.get_template(template).render(**values)


def flatten_settings(settings: dict[str, object], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    pairs = []
    for key, value in settings.items():
        if isinstance(value, dict):
            pairs += flatten_settings(value, f"{prefix}{key}.")
        else:
            text = value if isinstance(value, str) else json.dumps(to_json_value(value), ensure_ascii=False)
            pairs.append((f"{prefix}{key}", text))
    return pairs


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
