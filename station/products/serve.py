"""The station's page on this machine: read-only, over loopback."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from station.errors import StationError

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = "127.0.0.1"
HEADERS = {
    "content-security-policy": "default-src 'none'; img-src 'self'; script-src 'self'; style-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",  # ask whether it has changed: the page is a new one after each scan
}


class _Headed:
    """Adds the headers to every answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] += [(name.encode(), value.encode()) for name, value in HEADERS.items()]
            await send(message)

        await self._app(scope, receive, answer)


def app_for(folder: Path) -> Starlette:
    """Return a web application of the files in a folder: for readers on this machine, and nothing hidden.

    Raises StationError where starlette is not installed.
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
        raise StationError("serving needs two libraries: pip install 'tls-station[serve]'") from error

    class Shown(StaticFiles):
        """Files whose names do not begin with a dot; links are not followed out of the folder."""

        def lookup_path(self, path: str) -> tuple[str, object]:  # type: ignore[override]
            if any(part.startswith(".") for part in Path(path).parts):
                raise HTTPException(404)
            return super().lookup_path(path)

    # Another site's name that leads here (DNS rebinding) is refused.
    return Starlette(
        routes=[Mount("/", Shown(directory=folder, html=True, check_dir=False))],
        middleware=[
            Middleware(_Headed),
            Middleware(TrustedHostMiddleware, allowed_hosts=[LOOPBACK, "localhost"]),
            Middleware(GZipMiddleware),
        ],
    )


def serve(folder: Path, port: int) -> None:
    """Serve until interrupted. Raises StationError where there is no page yet."""
    if not (folder / "index.html").is_file():
        raise StationError(f"{folder}: no page yet; it is made with the first scan (products.page = true)")
    app = app_for(folder)
    import uvicorn  # noqa: PLC0415 - an extra

    uvicorn.run(app, host=LOOPBACK, port=port, log_level="warning", server_header=False)
