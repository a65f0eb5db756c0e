"""Who may speak to the console: pages of its own, in a browser that reached it by its own address or with its token."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

WELCOME = '<!doctype html><meta http-equiv="refresh" content="0; url=/"><title>Paceline</title>'
# The framework compiles its pages in the browser, hence the two exceptions for scripts; all of them are the console's.
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)


class Guard:
    """Wraps the whole application, its web sockets too.

    Without a ``token`` the console listens on this machine only, and a request must name one of its ``hosts`` — so no
    other site's name can be pointed at it. With one, the token comes once in the address and is kept as a cookie.
    Requests that another site's page makes are refused either way.
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str], token: str | None) -> None:
        self.app, self.hosts, self.token = app, set(hosts), token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if refusal is not None:
            if scope["type"] == "websocket":
                return await send({"type": "websocket.close", "code": 1008})
            return await refusal(scope, receive, send)

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                answer.setdefault("Content-Security-Policy", POLICY)
                answer["X-Content-Type-Options"] = "nosniff"
                answer["Referrer-Policy"] = "same-origin"
                answer["Cross-Origin-Resource-Policy"] = "same-origin"
            await send(message)

        gone = False

        async def receive_noting() -> Message:
            nonlocal gone
            message = await receive()
            gone = gone or message["type"] == "http.disconnect"
            return message

        try:
            await self.app(scope, receive_noting, send_guarded)
        except (RuntimeError, ClientDisconnect):  # a browser that leaves half way needs no answer, and gets none
            if not gone:
                raise

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if self.token is None and host not in self.hosts:
            return PlainTextResponse("This console answers only under the address that it printed.", 403)
        if self._is_foreign(scope, headers, host):
            return PlainTextResponse("Requests from other sites are refused.", 403)
        cookie = f"paceline-token-{scope['server'][1]}"  # cookies do not know ports; a machine may have two consoles
        if self.token is not None and not self._has(_value(headers, cookie)):
            given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not self._has(given):
                return PlainTextResponse("Open the address that the console printed, with its token.", 403)
            welcome = HTMLResponse(WELCOME)  # a page that goes on by itself: a redirection would not send the cookie
            welcome.set_cookie(cookie, self.token, httponly=True, samesite="strict")
            return welcome
        return None

    def _is_foreign(self, scope: Scope, headers: Headers, host: str) -> bool:
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return True
        if scope["type"] == "websocket" and origin is None:
            return True  # browsers always say where a socket comes from
        site = headers.get("sec-fetch-site", "none")
        followed = scope.get("method") == "GET" and headers.get("sec-fetch-dest") == "document"
        return site not in ("same-origin", "none") and not followed

    def _has(self, given: str) -> bool:
        return self.token is not None and secrets.compare_digest(given.encode(), self.token.encode())


def _value(headers: Headers, cookie: str) -> str:
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(cookie)
    except CookieError:
        return ""
    return "" if morsel is None else morsel.value
