"""Counters of this process in Prometheus' text format (version 0.0.4), and the ASGI layer that counts requests.

Counted on the event loop and the render thread; one lock guards all, since increments are rare beside what they count.
"""

import threading
import time
from collections import defaultdict
from collections.abc import Mapping

from starlette.types import ASGIApp, Message, Receive, Scope, Send

BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
"""Upper bounds [s]."""
HELP = {
    "drgs_requests_total": ("counter", "HTTP requests by route, method and status."),
    "drgs_request_seconds": ("histogram", "Time to answer an HTTP request, by kind: picture (frame, thumbnail, download) or call."),
    "drgs_frames_total": ("counter", "Pictures sent to viewers."),
    "drgs_frame_bytes_total": ("counter", "Bytes of them."),
    "drgs_render_seconds_total": ("counter", "Time the render thread worked on them."),
    "drgs_edits_total": ("counter", "Changes of edit logs, by kind."),
    "drgs_viewers": ("gauge", "Open streams."),
    "drgs_sessions_live": ("gauge", "Sessions in this process."),
    "drgs_assets_loaded": ("gauge", "Assets in memory."),
    "drgs_jobs": ("gauge", "Jobs that wait or run."),
    "drgs_workers_alive": ("gauge", "Workers with a heartbeat."),
    "drgs_resident_bytes": ("gauge", "Memory of the server process."),
}
_PICTURES = ("frame.", "thumb.jpg", "preview.jpg", "mesh.glb", "/files/", "export", "environment.exr")


class Metrics:
    """Final. One an app."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: dict[tuple[str, tuple[tuple[str, str], ...]], float] = defaultdict(float)

    def add(self, name: str, amount: float = 1.0, **labels: str) -> None:
        """Raise a counter of HELP."""
        with self._lock:
            self._values[name, tuple(sorted(labels.items()))] += amount

    def observe(self, name: str, seconds: float, **labels: str) -> None:
        """One more value of a histogram of HELP."""
        for bound in BUCKETS:
            if seconds <= bound:
                self.add(f"{name}_bucket", 1, le=f"{bound:g}", **labels)
        self.add(f"{name}_bucket", 1, le="+Inf", **labels)
        self.add(f"{name}_sum", seconds, **labels)
        self.add(f"{name}_count", 1, **labels)

    def text(self, gauges: Mapping[str, float]) -> str:
        """Everything, with the present values of gauges."""
        with self._lock:
            values = dict(self._values)
        values |= {(name, ()): value for name, value in gauges.items()}
        lines = []
        for name, (kind, sentence) in HELP.items():
            found = sorted(key for key in values if key[0] == name or (kind == "histogram" and key[0].rsplit("_", 1)[0] == name))
            if found:
                lines += [f"# HELP {name} {sentence}", f"# TYPE {name} {kind}"]
                lines += [f"{key[0]}{_labels(key[1])} {values[key]:g}" for key in found]
        return "\n".join(lines) + "\n"


def _labels(labels: tuple[tuple[str, str], ...]) -> str:
    if not labels:
        return ""
    escaped = (f'{key}="{value}"' for key, value in ((k, v.replace("\\", r"\\").replace('"', r"\"")) for k, v in labels))
    return "{" + ",".join(escaped) + "}"


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
            self._metrics.add("drgs_requests_total", route=route, method=method, status=str(status))
            self._metrics.observe("drgs_request_seconds", time.perf_counter() - started, kind=kind)
