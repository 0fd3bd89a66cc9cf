"""How often a caller may ask, and how often it may be wrong: buckets of tokens, so many a second on the whole, with short bursts.

Calls that are let in count for the caller's address, as trusted proxies say it. Those without the token, or with a wrong one, count for the
peer that opened the connection, whatever it says of itself, and in a bucket of its own: guessing takes nothing from those who know the token.
"""

import time
from collections import OrderedDict
from collections.abc import Callable
from ipaddress import IPv6Address, ip_address

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drgs_server.api.problems import problem_response

BURST_SECONDS = 10.0
"""A caller that was quiet may send as many requests at once as it could in this time."""
MOST_ADDRESSES = 10_000
PEER = "drgs.peer"
"""Key of a scope: the address that opened the connection, before any proxy's word for another."""
OPEN_API_PATHS = ("/api/login",)
"""Below /api, yet without the token: whether such a call is let in is known by its answer."""
_NETWORK_BITS = 64
"""Of an IPv6 address: whoever has one has all that share them."""


class CallBuckets:
    """Final. A bucket for each address."""

    def __init__(self, calls_a_second: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate = calls_a_second
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """Address -> tokens left, and when."""

    def take(self, address: str) -> bool:
        """Whether a token was left."""
        key, now, most = _network(address), self._clock(), self.rate * BURST_SECONDS
        tokens, at = self._buckets.pop(key, (most, now))
        tokens = min(most, tokens + (now - at) * self.rate)
        self._buckets[key] = (tokens - (tokens >= 1), now)
        if len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return tokens >= 1


def _network(address: str) -> str:
    try:
        found = ip_address(address)
    except ValueError:  # a proxy may say anything
        return address[:64]
    if not isinstance(found, IPv6Address):
        return str(found)
    return str(found.ipv4_mapped or IPv6Address(int(found) >> (128 - _NETWORK_BITS) << (128 - _NETWORK_BITS)))


def caller_of(scope: Scope) -> str:
    """The address that a request comes from, as trusted proxies say it."""
    return str((scope.get("client") or ("?", 0))[0])


def peer_of(scope: Scope) -> str:
    """The address at the other end of the connection."""
    return str((scope.get(PEER) or scope.get("client") or ("?", 0))[0])


class KeepPeer:
    """Writes down who opened the connection, outside of what believes proxies."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope[PEER] = scope.get("client")
        await self._app(scope, receive, send)


class RateLimit:
    """Final. Answers 429 with Retry-After to HTTP requests beyond the rate. Those that reach it were let in, or ask to be."""

    def __init__(
        self, app: ASGIApp, requests_a_second: float, clock: Callable[[], float] = time.monotonic, failures: CallBuckets | None = None
    ) -> None:
        """
        Args:
            failures: of calls that ask to be let in and were refused; where None they are not counted.
        """
        self._app = app
        self._calls = CallBuckets(requests_a_second, clock)
        self._failures = failures

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not scope["path"].startswith("/api"):
            await self._app(scope, receive, send)
        elif scope["path"] in OPEN_API_PATHS:
            await self._ask_to_be_let_in(scope, receive, send)
        elif self._calls.take(caller_of(scope)):
            await self._app(scope, receive, send)
        else:
            await too_many_calls(self._calls)(scope, receive, send)

    async def _ask_to_be_let_in(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Counted by its answer: the right token where calls are, anything else where failures are."""
        instead: ASGIApp | None = None

        async def count_and_send(message: Message) -> None:
            nonlocal instead
            if message["type"] == "http.response.start":
                if message["status"] < 400:
                    instead = None if self._calls.take(caller_of(scope)) else too_many_calls(self._calls)
                elif self._failures is not None and not self._failures.take(peer_of(scope)):
                    instead = too_many_failures(self._failures)
                if instead is not None:
                    await instead(scope, receive, send)
            if instead is None:
                await send(message)

        await self._app(scope, receive, count_and_send)


def too_many_calls(buckets: CallBuckets) -> ASGIApp:
    return problem_response(
        429, f"More than {buckets.rate:g} requests a second on the whole; wait a moment and send fewer.", {"retry-after": "1"}
    )


def too_many_failures(buckets: CallBuckets) -> ASGIApp:
    sentence = f"More than {buckets.rate:g} refused requests a second on the whole; wait a moment. The address that `drgs serve` printed holds the token."
    return problem_response(429, sentence, {"retry-after": "1"})
