"""The console answers nobody but its own pages."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from console_client import HOST, SAME
from fastapi import FastAPI, WebSocket
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from paceline.console.access_control import AccessControl
from paceline.console.server import _host_names, _public_address

FOREIGN = [
    {"host": "evil.example"},  # another name pointed at this machine
    {"host": "127.0.0.1:9999"},
    {"host": HOST, "origin": "http://evil.example"},
    {"host": HOST, "origin": "null"},
    {"host": HOST, "origin": "http://127.0.0.1:3000"},
    {"host": HOST, "origin": f"https://{HOST}"},  # another program, though on the same port
    {"host": HOST, "origin": "http://127.0.0.1"},
    {"host": HOST, "origin": "http://["},
    {"host": HOST, "origin": "http://127.0.0.1:x"},
    {"host": HOST, "sec-fetch-site": "cross-site"},
    {"host": HOST, "sec-fetch-site": "same-site", "sec-fetch-dest": "image"},
    {"host": HOST, "sec-fetch-site": "cross-site", "sec-fetch-dest": "iframe"},
]


OTHER_SITES = [("http", "evil.example"), ("https", HOST), ("ws", HOST)]


@pytest.mark.parametrize("headers", FOREIGN)
def test_requests_of_other_sites_are_refused(client: TestClient, headers: dict[str, str]) -> None:
    for method, address in (("GET", "/api/setup?clip=road"), ("POST", "/api/run?clip=road"), ("PUT", "/api/setup")):
        assert client.request(method, address, headers=headers).status_code == 403


@pytest.mark.parametrize("headers", [SAME, {"host": HOST}, {"host": HOST, "sec-fetch-site": "cross-site",
                                                            "sec-fetch-dest": "document"}])  # fmt: skip
def test_its_own_pages_and_links_to_it_are_answered(client: TestClient, headers: dict[str, str]) -> None:
    answer = client.get("/api/setup?clip=road", headers=headers)
    assert answer.status_code == 200
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_followed_link_changes_nothing(client: TestClient) -> None:
    headers = {"host": HOST, "sec-fetch-site": "cross-site", "sec-fetch-dest": "document"}
    assert client.post("/api/run?clip=road", headers=headers, json={"kind": "speed"}).status_code == 403


def test_an_address_that_others_reach_requires_its_token() -> None:
    app = FastAPI()

    @app.get("/")
    def page() -> str:
        return "the console"

    guarded: Any = AccessControl(app, set(), "s3cret")
    with TestClient(guarded, base_url="http://road.example:8640") as client:
        for given in ("/", "/?token=", "/?token=wrong", "/?token=s3cre"):
            assert client.get(given).status_code == 403
        assert client.get("/", headers={"cookie": "paceline-token-8640=wrong"}).status_code == 403
        assert "the console" not in client.get("/?token=s3cret").text
        assert client.cookies["paceline-token-8640"] == "s3cret"
        assert "the console" in client.get("/").text
        assert client.get("/", headers={"origin": "http://evil.example"}).status_code == 403


@pytest.mark.parametrize("host", ["road.example", "road.example:443"])
def test_pages_behind_a_proxy_that_encrypts_are_its_own(host: str) -> None:
    """As uvicorn serves it: a proxy on this machine says by which scheme it was asked."""
    app = FastAPI()

    @app.get("/")
    def page() -> str:
        return "the console"

    proxied: Any = ProxyHeadersMiddleware(AccessControl(app, set(), "s3cret"), "testclient")
    with TestClient(proxied, base_url="http://road.example") as client:
        client.cookies["paceline-token-80"] = "s3cret"
        own = {"host": host, "origin": "https://road.example"}
        assert client.get("/", headers=own).status_code == 403
        assert client.get("/", headers={**own, "x-forwarded-proto": "https"}).status_code == 200
        plain = {"host": host, "origin": "http://road.example", "x-forwarded-proto": "https"}
        assert client.get("/", headers=plain).status_code == 403


def test_sockets_of_other_sites_are_refused() -> None:
    app = FastAPI()

    @app.websocket("/ws")
    async def speak(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_text("the console")

    guarded: Any = AccessControl(app, {HOST}, None)
    with TestClient(guarded, base_url=f"http://{HOST}") as client:
        foreign = [{"host": HOST, "origin": f"{scheme}://{host}"} for scheme, host in OTHER_SITES]
        for headers in (*foreign, {"host": HOST}, {"host": "evil.example"}):
            with pytest.raises(WebSocketDisconnect), client.websocket_connect("/ws", headers=headers):
                pass
        with client.websocket_connect("/ws", headers=SAME) as socket:
            assert socket.receive_text() == "the console"


@pytest.mark.parametrize(
    ("host", "port", "shown", "names"),
    [
        ("127.0.0.1", 8640, "http://127.0.0.1:8640/", {"127.0.0.1:8640", "localhost:8640"}),
        ("localhost", 80, "http://localhost:80/", {"localhost", "127.0.0.1"}),
        ("::1", 9000, "http://[::1]:9000/", {"[::1]:9000"}),
    ],
)
def test_only_names_of_this_machine_are_accepted(host: str, port: int, shown: str, names: set[str]) -> None:
    assert _public_address(host, port) == (shown, None) and _host_names(shown) == names


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "road.example"])
def test_every_other_address_has_a_token_of_its_own(host: str) -> None:
    (address, token), (_, another) = _public_address(host, 8640), _public_address(host, 8640)
    assert token and another and token != another and address.endswith(f":8640/?token={token}")


def test_a_disconnected_client_gets_no_answer() -> None:
    """The framework raises an error for it; any other error is passed on."""

    def answered(message: dict[str, Any]) -> None:
        async def app(scope: Any, receive: Any, send: Any) -> None:
            await receive()
            raise RuntimeError("No response returned.")

        async def receive() -> dict[str, Any]:
            return message

        scope = {"type": "http", "server": ("127.0.0.1", 8640), "headers": [(b"host", HOST.encode())], "method": "GET"}
        anyio.run(AccessControl(app, {HOST}, None), scope, receive, None)

    answered({"type": "http.disconnect"})
    with pytest.raises(RuntimeError, match="No response"):
        answered({"type": "http.request"})
