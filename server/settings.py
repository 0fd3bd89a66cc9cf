"""What a server was started with (worker/settings.py, where workers read the same)."""

from worker.settings import Limits, ServiceSettings

ServerSettings = ServiceSettings

__all__ = ["Limits", "ServerSettings"]
