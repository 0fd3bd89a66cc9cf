"""The first start of an installation: the renderer's kernels are compiled in a process of their own, while the server already answers.

In: the device. Out: two lines on the console, and compiled kernels. Without this the first picture would wait for them, ten seconds, and nothing would
say why.
"""

import subprocess
import sys
import threading
import time

from drgs.compiled_kernels import are_compiled


class KernelCompiler:
    """Final. Compiles once, on a thread that waits for its process; nothing is done where the kernels are there."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopping = False

    def start(self) -> None:
        if not are_compiled():
            threading.Thread(target=self._compile, name="kernel-compiler", daemon=True).start()

    def stop(self) -> None:
        """End what is under way; what was compiled stays."""
        with self._lock:
            self._stopping = True
            process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            process.wait(10)

    def _compile(self) -> None:
        started = time.monotonic()
        with self._lock:
            if self._stopping:
                return
            # -P: what lies in the present folder is nothing to import.
            command = [sys.executable, "-P", "-m", "drgs.render.compile_kernels", self._device]
            self._process = subprocess.Popen(command, start_new_session=True)
        print(
            "The renderer is being compiled for this machine, once: about ten seconds, and pictures wait for it",
            file=sys.stderr,
            flush=True,
        )
        code = self._process.wait()
        if code == 0:
            print(f"The renderer is compiled ({time.monotonic() - started:.0f} s)", file=sys.stderr, flush=True)
        elif not self._stopping:
            print(
                f"The renderer could not be compiled beforehand (exit code {code}); it is when pictures need it",
                file=sys.stderr,
                flush=True,
            )
