"""Requests that the window refuses: without its token, from elsewhere, out of its folders."""

from __future__ import annotations

import asyncio

import httpx
import pytest

from calibray.window.server import POLICY, Guard

TOKEN, PORT = "a" * 43, 4711
HOST = f"127.0.0.1:{PORT}"
COOKIE = f"calibray_{PORT}={TOKEN}"


async def behind(scope, receive, send):
    """An application that answers everything."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def ask(path="/", **headers) -> httpx.Response:
    async def send() -> httpx.Response:
        transport = httpx.ASGITransport(Guard(behind, TOKEN, PORT))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client:
            return await client.get(
                path, headers={name.replace("_", "-"): value for name, value in headers.items()}
            )

    return asyncio.run(send())


def test_the_token_becomes_a_strict_cookie_and_leaves_the_address():
    entered = ask(f"/?token={TOKEN}")
    assert entered.status_code == 303
    assert entered.headers["location"] == "/"
    assert entered.headers["set-cookie"] == f"{COOKIE}; HttpOnly; SameSite=Strict; Path=/"


def test_with_the_cookie_a_request_passes_and_gets_the_policy():
    passed = ask("/data/plan.json", cookie=COOKIE)
    assert (passed.status_code, passed.text) == (200, "inside")
    assert passed.headers["content-security-policy"] == POLICY


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/", {}, 403),
        ("/?token=", {}, 403),
        ("/?token=" + "b" * 43, {}, 403),
        ("/?token=%C3%A4", {}, 403),
        (f"/data/plan.json?token={TOKEN}", {}, 403),
        ("/", {"cookie": f"calibray_{PORT}={'b' * 43}"}, 403),
        ("/", {"cookie": f"calibray_{PORT + 1}={TOKEN}"}, 403),
        ("/", {"cookie": COOKIE, "host": "evil.example"}, 400),
        ("/", {"cookie": COOKIE, "host": f"127.0.0.1:{PORT + 1}"}, 400),
        ("/", {"cookie": COOKIE, "origin": "https://evil.example"}, 400),
        ("/", {"cookie": COOKIE, "origin": f"http://127.0.0.1:{PORT + 1}"}, 400),
        ("/", {"cookie": COOKIE, "origin": "null"}, 400),
        ("/", {"cookie": COOKIE, "sec_fetch_site": "cross-site"}, 400),
        ("/", {"cookie": COOKIE, "sec_fetch_site": "same-site"}, 400),
        ("/result/%2e%2e/report.html", {"cookie": COOKIE}, 400),
        ("/window/..%2f..%2fserver.py", {"cookie": COOKIE}, 400),
        ("/window/..%5cserver.py", {"cookie": COOKIE}, 400),
        ("/window/a%00b", {"cookie": COOKIE}, 400),
    ],
)
def test_refused(path, headers, status):
    refused = ask(path, **headers)
    assert refused.status_code == status
    assert "inside" not in refused.text


@pytest.mark.parametrize(
    ("origin", "sent"), [(HOST, "websocket.accept"), ("evil.example", "websocket.close")]
)
def test_a_websocket_from_another_origin_is_closed(origin, sent):
    messages = []
    scope = {
        "type": "websocket", "path": "/socket", "query_string": b"",
        "headers": [(b"host", HOST.encode()), (b"origin", f"http://{origin}".encode()), (b"cookie", COOKIE.encode())],
    }  # fmt: skip

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        messages.append(message["type"])

    asyncio.run(Guard(behind, TOKEN, PORT)(scope, receive, send))
    assert messages == [sent]
