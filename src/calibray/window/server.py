"""The server of the window: on this machine only, behind the guard."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from fastapi.responses import FileResponse, JSONResponse, Response
from nicegui import run, ui

from calibray.errors import InputError
from calibray.window.desk import Desk
from calibray.window.folder import StudyFolder
from calibray.window.guard import Guard
from calibray.window.page import build
from calibray.window.plan import findings, plan

ASSETS = Path(__file__).parent / "assets"
SHOWN = ("report.html", "map.png")
"""Files of a result that the page shows."""


def serve(folder: Path, port: int, opened: Callable[[str], None]) -> None:
    """Show a study's folder until Ctrl-C.

    Args:
        folder: The folder.
        port: The port; 0 for a free one.
        opened: Is called with the address when the port is open.

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
    """The page with its data and assets, without a guard."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/data/plan.json")
    async def data(scene: str | None = None) -> Response:
        try:
            return JSONResponse(await run.io_bound(plan, desk.folder, scene or desk.scene))
        except InputError as error:
            return JSONResponse({"links": [], "transmitters": [], "error": str(error)})

    # Apart from the map, which need not wait for it.
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
        # A result's page may come from elsewhere: its scripts get an origin of their own and can ask for nothing.
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
        # Connections wait from here on, so that the address can be opened before the server runs.
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(
            f"--port {port}: cannot be opened ({error}); give another, or 0 for a free one"
        ) from None
    return listening
