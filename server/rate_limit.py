"""A bucket of tokens for each caller's address: so many requests a second on the whole, with short bursts."""

import time
from collections import OrderedDict
from collections.abc import Callable

from starlette.types import ASGIApp, Receive, Scope, Send

from server.problems import problem_response

BURST_SECONDS = 10.0
"""A caller that was quiet may send as many requests at once as it could in this time."""
MOST_ADDRESSES = 10_000


class RateLimit:
    """Final. Answers 429 with Retry-After to HTTP requests beyond the rate."""

    def __init__(self, app: ASGIApp, requests_a_second: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._rate = requests_a_second
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """Address -> tokens left, and when."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"].startswith("/api") and not self._take((scope.get("client") or ("?", 0))[0]):
            sentence = f"More than {self._rate:g} requests a second on the whole; wait a moment and send fewer."
            await problem_response(429, sentence, {"retry-after": "1"})(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _take(self, address: str) -> bool:
        now, most = self._clock(), self._rate * BURST_SECONDS
        tokens, at = self._buckets.pop(address, (most, now))
        tokens = min(most, tokens + (now - at) * self._rate)
        self._buckets[address] = (tokens - (tokens >= 1), now)
        if len(self._buckets) > MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return tokens >= 1
