"""What comes with a request: bytes and JSON up to a size, refused in one line otherwise."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import Request

from paceline.errors import UnusableInput

LARGEST_BODY = 4 << 20  # bytes of JSON


async def received_json(request: Request) -> dict[str, Any]:
    """The JSON object that a request sends. Raises UnusableInput."""
    body = await received(request.stream(), LARGEST_BODY)
    try:
        found = json.loads(body, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise UnusableInput("the request is no JSON") from error
    if not isinstance(found, dict):
        raise UnusableInput("the request is no JSON object")
    return found


async def received(stream: AsyncIterator[bytes], most: int) -> bytes:
    """All bytes of a ``stream``, at most so many. Raises UnusableInput."""
    content = bytearray()
    async for chunk in stream:
        content += chunk
        if len(content) > most:
            raise UnusableInput(f"the request is larger than {most >> 20} MiB")
    return bytes(content)


def _no_constant(name: str) -> float:
    raise ValueError(name)
