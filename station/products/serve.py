"""Web server of the pages of stations, and of what only a server can answer: read-only, over loopback.

What it computes runs in a worker process with limited memory and time, one at a time; few may wait.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from station.errors import ConfigError, InconclusiveError, NotReadyError, StationError
from station.products.web import answers
from station.products.web.stations_page import StationRow, render_stations

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute
    from starlette.staticfiles import StaticFiles
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
MISSING_LIBRARIES = "serving needs two libraries: pip install 'tls-station[serve]'"
NOTEBOOKS = "http://localhost:* http://127.0.0.1:*"  # pages that may show the page in a frame, if any
HEADERS = {
    "content-security-policy": "default-src 'none'; img-src 'self'; script-src 'self'; style-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors {frames}",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",  # revalidate: the page changes with each scan
}
MAX_WAITING = 8  # requests that compute or wait for it
MAX_CONNECTIONS = 64
MAX_QUERY = 30_000  # characters
RETRY_S = "10"
FILES = {
    "export.nc": (answers.netcdf_part, "application/x-netcdf"),
    "export.tif": (answers.geotiff_part, "image/tiff"),
}
TABLES = {"epochs": answers.epoch_list, "change": answers.polygon_change}
Run = Callable[..., Any]  # run(task, *args) in a worker process; raises the StationError of the task


@dataclass(frozen=True)
class Served:
    """A station to serve: its data folder and the names on the page of all stations."""

    id: str
    name: str
    data: Path

    @property
    def page(self) -> Path:
        """Folder of the page."""
        return self.data / "page"


class _SecurityHeaders:
    """Adds the security headers to every response."""

    def __init__(self, app: ASGIApp, frames: str) -> None:
        self._app = app
        self._headers = [
            (name.encode(), text.format(frames=frames).encode()) for name, text in HEADERS.items()
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += self._headers
            await send(message)

        await self._app(scope, receive, answer)


class _Queue:
    """Runs one task at a time; few may wait."""

    def __init__(self, run: Run) -> None:
        self._run, self._waiting, self._turn = run, 0, asyncio.Lock()

    async def answer(self, task: Callable[..., Any], *args: object) -> Any:  # noqa: ANN401 - what the task returns
        from starlette.concurrency import run_in_threadpool  # noqa: PLC0415
        from starlette.exceptions import HTTPException  # noqa: PLC0415

        if self._waiting >= MAX_WAITING:
            raise HTTPException(503, "too many requests at once: try again later", {"retry-after": RETRY_S})
        self._waiting += 1
        try:
            async with self._turn:
                return await run_in_threadpool(self._run, task, *args)
        except (InconclusiveError, NotReadyError) as error:
            message = f"this takes too much time or memory: choose a smaller area or fewer epochs ({error})"
            raise HTTPException(503, message) from error
        except StationError as error:
            raise HTTPException(400, str(error)) from error
        finally:
            self._waiting -= 1


def app_for(stations: list[Served], run: Run, *, frames: str = "'none'", language: str = "en") -> Starlette:
    """Return a web application for this machine: the page of a station, or of several below an overview.

    It serves the files of the page folders, except hidden ones, and below `api/` what `run` computes.
    `frames` are the sites that may frame the pages. Raises StationError if starlette is not installed,
    ConfigError if two stations have the same id.
    """
    try:
        from starlette.applications import Starlette  # noqa: PLC0415 - an extra
        from starlette.exceptions import HTTPException  # noqa: PLC0415
        from starlette.middleware import Middleware  # noqa: PLC0415
        from starlette.middleware.gzip import GZipMiddleware  # noqa: PLC0415
        from starlette.middleware.trustedhost import TrustedHostMiddleware  # noqa: PLC0415
        from starlette.responses import HTMLResponse, JSONResponse, Response  # noqa: PLC0415
        from starlette.routing import Mount, Route  # noqa: PLC0415
    except ImportError as error:
        raise StationError(MISSING_LIBRARIES) from error
    if len({station.id for station in stations}) < len(stations):
        raise ConfigError("two of these site files have the same station.id: serve them separately")
    queue = _Queue(run)

    async def refuse(_: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)  # noqa: S101 - registered for it
        return JSONResponse({"error": error.detail}, error.status_code, error.headers)

    if len(stations) == 1:
        routes = _routes(stations[0], queue)
    else:
        entries = [StationRow(station.id, station.name, f"{station.id}/") for station in stations]
        html, script, style = render_stations(entries, language)

        def reply(content: str, kind: str) -> Callable[[Request], Response]:
            return lambda _: Response(content, media_type=kind)

        routes = [
            Route("/", lambda _: HTMLResponse(html), methods=["GET"]),
            Route("/stations.js", reply(script, "text/javascript"), methods=["GET"]),
            Route("/page.css", reply(style, "text/css"), methods=["GET"]),
            *(Mount(f"/{station.id}", routes=_routes(station, queue)) for station in stations),
        ]
    # A foreign host name that resolves to this machine (DNS rebinding) is rejected.
    return Starlette(
        routes=routes,
        exception_handlers={HTTPException: refuse},
        middleware=[
            Middleware(_SecurityHeaders, frames=frames),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
            Middleware(GZipMiddleware),
        ],
    )


def _routes(station: Served, queue: _Queue) -> list[BaseRoute]:
    """Return the routes of a station: its answers, then its files."""
    from starlette.background import BackgroundTask  # noqa: PLC0415
    from starlette.responses import FileResponse, JSONResponse  # noqa: PLC0415
    from starlette.routing import Mount, Route  # noqa: PLC0415

    def table(task: Callable[..., Any]) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            return JSONResponse(await queue.answer(task, station.data, _parameters(request)))

        return answer

    def file(name: str, task: Callable[..., Any], kind: str) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            asked, folder = _parameters(request), tempfile.TemporaryDirectory(prefix="station-")
            path, shown_name = Path(folder.name) / name, f"{station.id}_{name}"
            try:
                await queue.answer(task, station.data, path, asked)
            except BaseException:
                folder.cleanup()
                raise
            done = BackgroundTask(folder.cleanup)
            return FileResponse(path, media_type=kind, filename=shown_name, background=done)

        return answer

    return [
        *(Route(f"/api/{name}", table(task), methods=["GET"]) for name, task in TABLES.items()),
        *(Route(f"/api/{name}", file(name, *how), methods=["GET"]) for name, how in FILES.items()),
        Mount("/", _page_files(station.page)),
    ]


def _parameters(request: Request) -> Mapping[str, str]:
    """Return the parameters of a request for an answer, which only the page itself or a program may ask."""
    from starlette.exceptions import HTTPException  # noqa: PLC0415

    if request.headers.get("sec-fetch-site") == "cross-site":  # another site makes the browser ask
        raise HTTPException(403, "ask from the page of the station, not from another site")
    if len(request.url.query) > MAX_QUERY:
        raise HTTPException(414, f"the query is longer than {MAX_QUERY} characters")
    return dict(request.query_params)


def _page_files(folder: Path) -> StaticFiles:
    """Return the files of a folder whose names do not begin with a dot; links that leave it do not count."""
    from starlette.exceptions import HTTPException  # noqa: PLC0415
    from starlette.staticfiles import StaticFiles  # noqa: PLC0415

    class Shown(StaticFiles):
        def lookup_path(self, path: str) -> tuple[str, object]:  # type: ignore[override]
            if any(part.startswith(".") for part in Path(path).parts):
                raise HTTPException(404)
            return super().lookup_path(path)

    return Shown(directory=folder, html=True, check_dir=False)


def server_for(stations: list[Served], port: int, run: Run, language: str = "en") -> Callable[[], None]:
    """Return a function that serves until interrupted.

    Raises StationError if there is no page yet, or a library is missing.
    """
    without = [station for station in stations if not (station.page / "index.html").is_file()]
    if len(without) == len(stations):
        raise StationError(
            f"{without[0].page}: no page yet; it is written with the first scan (products.page = true)"
        )
    app = app_for(stations, run, language=language)
    try:
        import uvicorn  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError(MISSING_LIBRARIES) from error
    return partial(
        uvicorn.run,
        app,
        host=LOOPBACK,
        port=port,
        log_level="warning",
        server_header=False,
        limit_concurrency=MAX_CONNECTIONS,
    )
