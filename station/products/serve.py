"""Web server of the station's page: read-only, over loopback."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from station.errors import StationError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
MISSING_LIBRARIES = "serving needs two libraries: pip install 'tls-station[serve]'"
HEADERS = {
    "content-security-policy": "default-src 'none'; img-src 'self'; script-src 'self'; style-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",  # revalidate: the page changes with each scan
}


class _SecurityHeaders:
    """Adds the security headers to every response."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(name.encode(), value.encode()) for name, value in HEADERS.items()]
            await send(message)

        await self._app(scope, receive, answer)


def app_for(folder: Path) -> Starlette:
    """Return a web application that serves the files of a folder, except hidden ones, to this machine.

    Raises StationError if starlette is not installed.
    """
    try:
        from starlette.applications import Starlette  # noqa: PLC0415 - an extra
        from starlette.exceptions import HTTPException  # noqa: PLC0415
        from starlette.middleware import Middleware  # noqa: PLC0415
        from starlette.middleware.gzip import GZipMiddleware  # noqa: PLC0415
        from starlette.middleware.trustedhost import TrustedHostMiddleware  # noqa: PLC0415
        from starlette.routing import Mount  # noqa: PLC0415
        from starlette.staticfiles import StaticFiles  # noqa: PLC0415
    except ImportError as error:
        raise StationError(MISSING_LIBRARIES) from error

    class Shown(StaticFiles):
        """Files whose names do not begin with a dot; links that leave the folder are not followed."""

        def lookup_path(self, path: str) -> tuple[str, object]:  # type: ignore[override]
            if any(part.startswith(".") for part in Path(path).parts):
                raise HTTPException(404)
            return super().lookup_path(path)

    # A foreign host name that resolves to this machine (DNS rebinding) is rejected.
    return Starlette(
        routes=[Mount("/", Shown(directory=folder, html=True, check_dir=False))],
        middleware=[
            Middleware(_SecurityHeaders),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
            Middleware(GZipMiddleware),
        ],
    )


def server_for(folder: Path, port: int) -> Callable[[], None]:
    """Return a function that serves until interrupted.

    Raises StationError if there is no page yet, or a library is missing.
    """
    if not (folder / "index.html").is_file():
        raise StationError(f"{folder}: no page yet; it is written with the first scan (products.page = true)")
    app = app_for(folder)
    try:
        import uvicorn  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError(MISSING_LIBRARIES) from error
    return partial(uvicorn.run, app, host=LOOPBACK, port=port, log_level="warning", server_header=False)
