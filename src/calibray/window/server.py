"""The server of the window, which only this machine can reach; a guard refuses unauthorized requests."""

from __future__ import annotations

import hmac
import secrets
import socket
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any, Final, final
from urllib.parse import parse_qs

import uvicorn
from fastapi import FastAPI
from fastapi.responses import FileResponse, JSONResponse, Response
from nicegui import run, ui

from calibray.errors import InputError
from calibray.window.desk import Desk, StudyFolder, findings, plan
from calibray.window.page import build

ASSETS = Path(__file__).parent / "assets"
SHOWN = ("report.html", "map.png")
"""Files in a result's folder that the page shows."""


def serve(folder: Path, port: int, opened: Callable[[str], None]) -> None:
    """Serve the page for a study's folder until Ctrl-C; port 0 selects a free port. `opened` receives the address.

    Raises:
        InputError: The port is in use.
    """
    listening = _listen(port)
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(32)
    guarded = Guard(application(Desk(StudyFolder(folder))), token, port)
    opened(f"http://127.0.0.1:{port}/?token={token}")
    config = uvicorn.Config(
        guarded, log_level="warning", access_log=False, server_header=False, lifespan="on"
    )
    uvicorn.Server(config).run(sockets=[listening])


def application(desk: Desk) -> FastAPI:
    """Make the application that serves the page with its data and assets, without a guard."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/data/plan.json")
    async def data(scene: str | None = None) -> Response:
        try:
            return JSONResponse(await run.io_bound(plan, desk.folder, scene or desk.scene))
        except InputError as error:
            return JSONResponse({"links": [], "transmitters": [], "sites": [], "error": str(error)})

    # The findings are served separately, so that the map does not have to wait for them.
    @app.get("/data/findings.json")
    async def suspicions() -> Response:
        try:
            return JSONResponse(await run.io_bound(findings, desk.folder))
        except InputError as error:
            return JSONResponse([str(error)])

    @app.get("/data/solid/{number}.stl")
    async def mesh(number: int) -> Response:
        shown = desk.solid
        if shown is None or not 0 <= number < len(shown.meshes):
            return Response("no such mesh", 404)
        return Response(shown.stl(list(shown.meshes)[number]), media_type="model/stl")

    @app.get("/result/{name}/{file}")
    async def result_file(name: str, file: str) -> Response:
        if name not in desk.folder.results() or file not in SHOWN:
            return Response("no such file", 404)
        path = desk.folder.path / name / file
        if not path.is_file():
            return Response("not written yet", 404)
        # A report may come from another machine, so its scripts run in a separate origin and cannot send requests.
        policy = "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        return FileResponse(
            path, headers={"Content-Security-Policy": policy + "img-src data:; font-src data:"}
        )

    @app.get("/window/{name}")
    async def asset(name: str) -> Response:
        known = {file.name for file in ASSETS.iterdir()}
        return FileResponse(ASSETS / name) if name in known else Response("no such file", 404)

    ui.run_with(
        app, root=lambda: build(desk), title=f"{desk.folder.path.name} · Calibray", dark=None, language="en-US",
        show_welcome_message=False, tailwind=False,
    )  # fmt: skip
    return app


def _listen(port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
        # From here on, connections are queued, so a browser can open the address before the server is running.
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(
            f"--port {port}: cannot be opened ({error}); give another port, or 0 for a free port"
        ) from None
    return listening


POLICY: Final = (
    # NiceGUI compiles its templates in the browser, which requires eval; nothing is loaded from other hosts.
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; frame-src 'self'; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)
HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"SAMEORIGIN"),
)


@final
class Guard:
    """An ASGI application that refuses unauthorized requests before they reach the application that it wraps."""

    def __init__(self, app: Any, token: str, port: int) -> None:
        self._app, self._token, self._port = app, token.encode(), port
        self._hosts = {f"{name}:{port}".encode() for name in ("127.0.0.1", "localhost")}
        # All ports of a host share their cookies, so the name of the cookie contains the port.
        self._cookie = f"calibray_{port}"

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Answer a request, or pass it to the wrapped application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        fault = self._fault(scope, headers)
        entering = scope["type"] == "http" and scope["path"] == "/" and self._given(scope)
        if fault is None and entering:
            # The token disappears from the address bar and the history; the cookie replaces the token.
            cookie = f"{self._cookie}={self._token.decode()}; HttpOnly; SameSite=Strict; Path=/".encode()
            await _answer(send, 303, b"", ((b"location", b"/"), (b"set-cookie", cookie)))
        elif fault is not None or not self._known(headers):
            text = fault or "this address has no valid token; open the address that `calibray open` printed"
            await _refuse(scope, receive, send, 400 if fault else 403, text)
        else:
            await self._app(scope, receive, _with_headers(send))

    def _fault(self, scope: Any, headers: dict[bytes, bytes]) -> str | None:
        """The reason to refuse a request regardless of its token; None if the request is acceptable."""
        path = scope["path"]
        if ".." in path.split("/") or "\\" in path or not path.isprintable():
            return "the path is outside the window's pages"
        if headers.get(b"host") not in self._hosts:
            return "the request is for another host"
        origins = {b"http://" + host for host in self._hosts}
        if b"origin" in headers and headers[b"origin"] not in origins:
            return "the request comes from another origin"
        # A page served from another port of this machine is same-site, so SameSite=Strict alone would not stop its
        # requests.
        if headers.get(b"sec-fetch-site", b"none") not in {b"none", b"same-origin"}:
            return "the request comes from another site"
        return None

    def _given(self, scope: Any) -> bool:
        """Whether the address contains the token."""
        query = parse_qs(scope["query_string"].decode("latin-1"))
        return self._same(query.get("token", [""])[0])

    def _known(self, headers: dict[bytes, bytes]) -> bool:
        """Whether the cookie contains the token."""
        try:
            cookies = SimpleCookie(headers.get(b"cookie", b"").decode("latin-1"))
        except CookieError:
            return False
        return self._cookie in cookies and self._same(cookies[self._cookie].value)

    def _same(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("utf-8", "replace"), self._token)


async def _refuse(scope: Any, receive: Any, send: Any, status: int, text: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
    else:
        await _answer(send, status, f"Refused: {text}\n".encode(), ())


async def _answer(send: Any, status: int, body: bytes, headers: tuple[tuple[bytes, bytes], ...]) -> None:
    kind = (b"content-type", b"text/plain; charset=utf-8")
    length = (b"content-length", str(len(body)).encode())
    fields = [kind, length, *HEADERS, *headers]
    await send({"type": "http.response.start", "status": status, "headers": fields})
    await send({"type": "http.response.body", "body": body})


def _with_headers(send: Any) -> Any:
    """Add the window's headers to all responses, and its content security policy to responses that have none."""

    async def sending(message: Any) -> None:
        if message["type"] == "http.response.start":
            names = {name.lower() for name, _ in message["headers"]}
            policy = (
                ()
                if b"content-security-policy" in names
                else ((b"content-security-policy", POLICY.encode()),)
            )
            message = {**message, "headers": [*message["headers"], *HEADERS, *policy]}
        await send(message)

    return sending
