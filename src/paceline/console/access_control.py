"""Access control: the console answers only requests from its own pages at its own address, or with its token."""

from __future__ import annotations

import secrets
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_SCHEMES = {"ws": "http", "wss": "https"}  # of the pages that open a socket
DEFAULT_PORTS = {"http": 80, "https": 443}
REDIRECT_PAGE = '<!doctype html><meta http-equiv="refresh" content="0; url=/"><title>Paceline</title>'
# NiceGUI compiles its pages in the browser, hence the two exceptions for scripts; all scripts are the console's own.
CONTENT_SECURITY_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)


class AccessControl:
    """ASGI middleware around the whole application, its web sockets included.

    Without a ``token`` the console listens on this machine only, and the Host header must be one of its ``hosts``
    (against DNS rebinding). With one, the token is given once in the address and then kept as a cookie. Cross-site
    requests are refused either way.
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

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(scope=message)
                answer.setdefault("Content-Security-Policy", CONTENT_SECURITY_POLICY)
                answer["X-Content-Type-Options"] = "nosniff"
                answer["Referrer-Policy"] = "same-origin"
                answer["Cross-Origin-Resource-Policy"] = "same-origin"
            await send(message)

        disconnected = False

        async def receive_until_gone() -> Message:
            nonlocal disconnected
            message = await receive()
            disconnected = disconnected or message["type"] == "http.disconnect"
            return message

        try:
            await self.app(scope, receive_until_gone, send_with_headers)
        except (RuntimeError, ClientDisconnect):  # a browser that disconnects half way needs no answer
            if not disconnected:
                raise

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if self.token is None and host not in self.hosts:
            return PlainTextResponse("This console answers only under the address that it printed.", 403)
        if self._is_cross_site(scope, headers, host):
            return PlainTextResponse("Requests from other sites are refused.", 403)
        cookie = f"paceline-token-{scope['server'][1]}"  # cookies ignore ports; a machine may run two consoles
        if self.token is not None and not self._token_matches(_cookie_value(headers, cookie)):
            token = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
            if not self._token_matches(token):
                return PlainTextResponse("Open the address that the console printed, with its token.", 403)
            # a page that redirects: the browser would not send a strict cookie after a 302
            redirect = HTMLResponse(REDIRECT_PAGE)
            redirect.set_cookie(cookie, self.token, httponly=True, samesite="strict")
            return redirect
        return None

    def _is_cross_site(self, scope: Scope, headers: Headers, host: str) -> bool:
        origin = headers.get("origin")
        if origin is not None and not _is_own_origin(origin, scope["scheme"], host):
            return True
        if scope["type"] == "websocket" and origin is None:
            return True  # browsers always send the origin of a socket
        site = headers.get("sec-fetch-site", "none")
        followed = scope.get("method") == "GET" and headers.get("sec-fetch-dest") == "document"
        return site not in ("same-origin", "none") and not followed

    def _token_matches(self, token: str) -> bool:
        return self.token is not None and secrets.compare_digest(token.encode(), self.token.encode())


def _is_own_origin(origin: str, scheme: str, host: str) -> bool:
    """Whether ``origin`` is that of the pages under the ``host`` that is asked by ``scheme``.

    Behind a reverse proxy on this machine the scheme is what the proxy states in X-Forwarded-Proto.
    """
    own = _origin(f"{PAGE_SCHEMES.get(scheme, scheme)}://{host}")
    return own is not None and own == _origin(origin)


def _origin(address: str) -> tuple[str, str, int] | None:
    """The scheme, the host and the port of an ``address``, by which browsers tell sites apart; None without these."""
    try:
        parts = urlsplit(address)
        port = DEFAULT_PORTS.get(parts.scheme) if parts.port is None else parts.port
    except ValueError:
        return None
    return None if parts.hostname is None or port is None else (parts.scheme, parts.hostname, port)


def _cookie_value(headers: Headers, cookie: str) -> str:
    try:
        morsel = SimpleCookie(headers.get("cookie", "")).get(cookie)
    except CookieError:
        return ""
    return "" if morsel is None else morsel.value
