"""Access control of the server: secret in the address, host name, origin, sizes and paths.

The server listens on the loopback interface only, but any page in a browser can send requests there. Requests without
the token get no information; host names other than loopback ones are rejected (DNS rebinding), and so are requests of
other origins.
"""

import secrets
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from avmsf._utils.text import parse_json
from avmsf.export.web import directives_of, policy_text
from avmsf.studio.responses import RequestError, bad_request, response_to

_FRAMES = {"frame-ancestors": "'none'"}
"""Directive that is valid only in a header."""
NOTHING_HERE = "there is nothing at this address; a restarted studio prints a new address: open it"
MAX_UPLOAD_BYTES = 64 << 20
"""Bytes of one request: a minute of stereo sound at 96 kHz, 32 bits."""
MAX_JSON_BYTES = 1 << 20
"""Maximum size of a JSON request, bytes."""
LOOPBACK = ("127.0.0.1", "localhost")
"""Names under which a browser may know this machine."""
_HEADERS = {
    "cache-control": "no-store",
    # For all that is not the page: it may run nothing if opened as a page.
    "content-security-policy": policy_text({"default-src": "'none'", **_FRAMES}),
    "cross-origin-resource-policy": "same-origin",
    # The token is in the address, and other sites that the page loads its libraries from must not learn it.
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


def policy_of(page: str) -> str:
    """Return the Content-Security-Policy of the page's HTML."""
    return policy_text({**directives_of(page), **_FRAMES})


def new_token() -> str:
    """Return a random token of characters that need no escaping in addresses."""
    return secrets.token_urlsafe(24)


class Guard:
    """ASGI middleware that passes allowed requests on, without the token in their paths."""

    def __init__(self, app: ASGIApp, *, token: str, port: int, largest: int = MAX_UPLOAD_BYTES) -> None:
        self.app, self.token, self.largest = app, token, largest
        self.hosts = frozenset(f"{name}:{port}" for name in LOOPBACK)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer as ASGI applications do; what is neither HTTP nor the server's own beginning and end is closed."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        hardened = _hardened(send)
        try:
            rest = self._admit(scope)
        except RequestError as refusal:
            await response_to(refusal)(scope, receive, hardened)
            return
        if not rest:
            # Without the last slash the page's relative addresses would lose the token.
            await RedirectResponse(f"/{self.token}/", 308)(scope, receive, hardened)
            return
        inner = {**scope, "path": rest, "raw_path": quote(rest).encode(), "root_path": ""}
        await self.app(inner, self._bounded(receive), hardened)

    def _admit(self, scope: Scope) -> str:
        """Return the path after the token. Raises RequestError for requests that are not the page's own."""
        headers = Headers(scope=scope)
        hosts = headers.getlist("host")
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            wanted, advice = " or ".join(LOOPBACK), "open the address as printed"
            raise bad_request("host", wanted, hosts, got="another", advice=advice, status=403)
        origins = headers.getlist("origin")
        if any(each.lower() != f"http://{hosts[0].lower()}" for each in origins):
            raise bad_request("origin", "the studio's own page", origins, got="another", status=403)
        first, slash, rest = scope["path"].removeprefix("/").partition("/")
        if not secrets.compare_digest(first.encode(), self.token.encode()):
            # By `moved` a page knows that its studio has ended, and keeps what it was to send.
            raise RequestError(404, NOTHING_HERE, more={"moved": True})
        # Decoded already, so that %2e%2e is two dots here.
        if ".." in rest.split("/") or "\\" in rest or "\0" in rest:
            raise nothing_here()
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self.largest:
            raise too_large(self.largest)
        return f"{slash}{rest}"

    def _bounded(self, receive: Receive) -> Receive:
        """Return a `receive` that raises RequestError as soon as a request exceeds its maximum size."""
        taken = 0

        async def receive_bounded() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > self.largest:
                raise too_large(self.largest)
            return message

        return receive_bounded


def _hardened(send: Send) -> Send:
    async def send_hardened(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return send_hardened


def too_large(largest: int) -> RequestError:
    """Return what to raise for a request of more than `largest` bytes."""
    wanted, advice = f"at most {largest >> 10} KiB", "send a shorter recording"
    return bad_request("request", wanted, got="more", advice=advice, status=413)


async def read_json_object(request: Request) -> dict[str, object]:
    """Return a request's JSON object. Raises RequestError for other content, and above `MAX_JSON_BYTES`."""
    body = await request.body()
    if len(body) > MAX_JSON_BYTES:
        raise too_large(MAX_JSON_BYTES)
    try:
        values = parse_json(body.decode())
    except ValueError as error:
        got = f"other data ({str(error)[:100]})"
        raise bad_request("request", "a JSON object", got=got, advice="reload the page") from error
    if not isinstance(values, dict):
        raise bad_request("request", "a JSON object", type(values).__name__, advice="reload the page")
    return values


def nothing_here() -> RequestError:
    """Return the error for an address that does not exist, or that the request may not access."""
    return RequestError(404, NOTHING_HERE)
