"""Renders self-contained HTML pages from templates; all text is escaped."""

from __future__ import annotations

import base64
import json

from jinja2 import Environment, PackageLoader, StrictUndefined

from paceline.reports.common.tables import to_json_value


def render(template: str, **values: object) -> str:
    """Renders ``template`` with ``values``.

    The filters ``jpeg`` (of bytes) and ``svg`` (of text) return an image as a data URI; all other values are escaped.
    """
    environment = Environment(
        loader=PackageLoader("paceline.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["jpeg"] = _jpeg_data_uri
    environment.filters["svg"] = _svg_data_uri
    return environment.get_template(template).render(**values)


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


def _jpeg_data_uri(data: bytes) -> str:
    return _data_uri("image/jpeg", data)


def _svg_data_uri(text: str) -> str:
    return _data_uri("image/svg+xml", text.encode())


def _data_uri(mime_type: str, data: bytes) -> str:
    return f"data:{mime_type};base64,{base64.b64encode(data).decode()}"
