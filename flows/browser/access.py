"""Who may look: whoever knows the token, from a page of this server, under headers that let nothing else in or out."""

from __future__ import annotations

import hmac
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from starlette.datastructures import Headers, MutableHeaders, QueryParams
from starlette.responses import PlainTextResponse, RedirectResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: Nothing from elsewhere, no script but the one of the report, and no page around ours.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    # The token is in the first address that a browser opens.
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
_REFUSED = (
    "This page is for whoever started it: open the address that 'coslidar browse' printed, with its token, "
    "or send the header 'Authorization: Bearer TOKEN'.\n"
)


class Guard:
    """ASGI middleware that asks for the token and sets the headers.

    The token comes in the query once (``?token=…``), and is answered with a cookie and an address without it; programs
    send it as ``Authorization: Bearer``.

    Parameters
    ----------
    app : ASGIApp
        What is behind the door.
    token : str
        The secret.
    hosts : frozenset of str
        Names under which the server may be addressed. Others are refused: a page from elsewhere could point its own
        name at this machine.
    cookie : str
        Name of the cookie; one per port, because cookies are not kept apart by port.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str], cookie: str) -> None:
        self.app = app
        self.token = token
        self.hosts = hosts
        self.cookie = cookie

    def _right(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def _knows(self, headers: Headers) -> bool:
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._right(given.strip()):
            return True
        try:
            jar = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        return self.cookie in jar and self._right(jar[self.cookie].value)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
            await send(message)

        headers, query = Headers(scope=scope), QueryParams(scope["query_string"])
        host = headers.get("host", "")
        name = host.rpartition("]")[0] + "]" if host.startswith("[") else host.partition(":")[0]
        if name.lower() not in self.hosts:
            await PlainTextResponse("This is no name of this server.\n", 400)(scope, receive, guarded)
        elif (given := query.get("token")) is not None and self._right(given) and scope["method"] in ("GET", "HEAD"):
            rest = urlencode([(key, value) for key, value in query.multi_items() if key != "token"])
            # One leading slash: two would name another host.
            path = "/" + scope["path"].lstrip("/")
            answer = RedirectResponse(f"{path}?{rest}" if rest else path, 303)
            answer.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            await answer(scope, receive, guarded)
        elif self._knows(headers):
            await self.app(scope, receive, guarded)
        else:
            await PlainTextResponse(_REFUSED, 403)(scope, receive, guarded)
