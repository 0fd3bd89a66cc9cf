"""What this process counts, in Prometheus' text format, and the ASGI layer that counts requests.

Counted on the event loop and the render thread: prometheus-client's counters may be raised from any thread.
"""

import time
from collections.abc import Mapping

from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    generate_latest,
)
from starlette.types import ASGIApp, Message, Receive, Scope, Send

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
"""Upper bounds [s]."""
GAUGES = {
    "drgs_viewers": "Open streams.",
    "drgs_sessions_live": "Sessions in this process.",
    "drgs_assets_loaded": "Assets in memory.",
    "drgs_jobs": "Jobs that wait or run.",
    "drgs_workers_alive": "Workers with a heartbeat.",
    "drgs_heavy_waiting": "Requests for pictures, poses and files that wait for their turn.",
    "drgs_resident_bytes": "Memory of the server process.",
}
_PICTURES = ("frame.", "thumb.jpg", "preview.jpg", "mesh.glb", "/files/", "export", "environment.exr")

disable_created_metrics()  # else each series would have a second one, with the time when it began


class Metrics:
    """Final. One an app, with a registry of its own."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()

        def counter(name: str, sentence: str, *labels: str) -> Counter:
            return Counter(name, sentence, labels, registry=self._registry)

        self.requests = counter("drgs_requests_total", "HTTP requests by method, route and status.", "method", "route", "status")
        self.request_seconds = Histogram(
            "drgs_request_seconds",
            "Time to answer an HTTP request, by kind: picture (frame, thumbnail, download) or call.",
            ["kind"],
            registry=self._registry,
            buckets=BUCKETS,
        )
        self.frames = counter("drgs_frames_total", "Pictures sent to viewers.")
        self.frame_bytes = counter("drgs_frame_bytes_total", "Bytes of them.")
        self.render_seconds = counter("drgs_render_seconds_total", "Time the render thread worked on them.")
        self.edits = counter("drgs_edits_total", "Changes of edit logs, by kind.", "kind")
        self._gauges = {name: Gauge(name, sentence, registry=self._registry) for name, sentence in GAUGES.items()}

    def text(self, gauges: Mapping[str, float]) -> bytes:
        """Everything as CONTENT_TYPE, with the present values of GAUGES."""
        for name, value in gauges.items():
            self._gauges[name].set(value)
        return generate_latest(self._registry)


class MetricsMiddleware:
    """Counts what is answered. The route is the pattern, never the address, so that ids make no new series."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started, status = time.perf_counter(), 500

        async def send_and_see(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, send_and_see)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            kind = "picture" if any(part in route for part in _PICTURES) else "call"
            method = scope["method"] if scope["method"] in ("GET", "HEAD", "POST", "PUT", "DELETE") else "other"
            self._metrics.requests.labels(method=method, route=route, status=str(status)).inc()
            self._metrics.request_seconds.labels(kind=kind).observe(time.perf_counter() - started)
