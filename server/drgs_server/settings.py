"""What a server was started with (worker/drgs_worker/store/settings.py, where workers read the same)."""

from drgs_worker.store.settings import Limits, ServiceSettings

ServerSettings = ServiceSettings

__all__ = ["Limits", "ServerSettings"]
