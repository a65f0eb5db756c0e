"""Reads request bodies, bytes or JSON, up to a size limit."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import Request

from paceline.errors import UnusableInput

MAX_JSON_BYTES = 4 << 20


async def read_json(request: Request) -> dict[str, Any]:
    """The JSON object in the body of a request. Raises UnusableInput."""
    body = await read_body(request.stream(), MAX_JSON_BYTES)
    try:
        content = json.loads(body, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise UnusableInput("the request is not JSON") from error
    if not isinstance(content, dict):
        raise UnusableInput("the request is not a JSON object")
    return content


async def read_body(stream: AsyncIterator[bytes], max_bytes: int) -> bytes:
    """The bytes of a ``stream``. Raises UnusableInput where there are more than ``max_bytes``."""
    content = bytearray()
    async for chunk in stream:
        content += chunk
        if len(content) > max_bytes:
            raise UnusableInput(f"the request is larger than {max_bytes >> 20} MiB")
    return bytes(content)


def _refuse_constant(name: str) -> float:
    raise ValueError(name)
