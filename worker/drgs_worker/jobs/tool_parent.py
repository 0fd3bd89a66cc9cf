"""`python -m drgs_worker.jobs.tool_parent SOCKET`: the process whose children the file tools are.

It loads what they need, which takes about three seconds of a core, and forks for each, which takes a hundredth of one. It decodes nothing itself
and runs no threads: what a hostile file does to a child leaves the next child as this process was. begin_tool.py starts it and talks to it.

Through SOCKET, the number of an inherited socket, come the channels of tools, a socket each with a byte to carry it. In a channel lies a line of
JSON, {"arguments" (of file_tool.main), "file_limits" (RLIMIT_FSIZE of who asks), "threads" (to compute with)}. Back come what the tool writes to stderr, a zero and its exit
code, then the end. Whoever ends his side of a channel ends its tool; who ends SOCKET's other side, by dying too, ends all tools and this process.
"""

import contextlib
import gc
import json
import os
import resource
import select
import signal
import socket
import sys
import traceback

from drgs_worker.jobs import file_tool

IDLE_SECONDS = 300.0
"""Without a tool, after which this process makes room for others: it holds 240 MB that are its own."""
FORKS = sys.platform == "linux"
"""Elsewhere what libraries of the system have begun does not outlive a fork, and each tool loads what it needs."""


def main(arguments: list[str]) -> int:
    given = int(arguments[0])
    asking = socket.socket(fileno=os.dup(given))  # the lowest number that is free: of a busy server it was one too large for select
    os.close(given)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; who asks decides
    woken, wake = socket.socketpair()
    woken.setblocking(False)
    wake.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake.fileno(), warn_on_full_buffer=False)
    forks = FORKS
    if FORKS:
        _load_what_tools_need()
        gc.collect()
        gc.freeze()  # children would copy each page that their garbage collector counts on
        forks = len(os.listdir("/proc/self/task")) == 1  # locks of other threads would stay locked in children
    tools: dict[int, socket.socket] = {}
    is_open = True
    while is_open or tools:
        watched = [woken, *tools.values(), *([asking] if is_open else [])]
        ready, _, _ = select.select(watched, [], [], None if tools else IDLE_SECONDS)
        if not ready:
            asking.shutdown(socket.SHUT_RD)  # what is sent from now on fails there; what was sent before is read
        if asking in ready or not ready:
            _, channels, _, _ = socket.recv_fds(asking, 1, 1)
            is_open = bool(channels)
            for channel in (socket.socket(fileno=descriptor) for descriptor in channels):
                asked = json.loads(channel.makefile("rb").readline())
                process = _fork_tool(asked, channel, [asking, woken, wake, *tools.values()]) if forks else _start_tool(asked, channel)
                tools[process] = channel
        if woken in ready:
            woken.recv(1 << 12)
        for process, channel in list(tools.items()):
            if _has_ended(process, channel):
                del tools[process]
            elif channel in ready:
                os.kill(process, signal.SIGKILL)  # nothing is sent behind the line, so this is the end of the other side
    return 0


def _load_what_tools_need() -> None:
    import simplejpeg  # noqa: F401
    import trimesh  # noqa: F401

    import drgs.convert.bake_edits
    import drgs.convert.export_asset
    import drgs.convert.import_mesh
    import drgs.convert.material_variants
    import drgs.evaluate.look_at_capture
    import drgs.render.render_frame  # noqa: F401


def _start_tool(asked: dict, channel: socket.socket) -> int:
    command = [sys.executable, "-P", "-m", "drgs_worker.jobs.file_tool", *asked["arguments"]]
    said = (os.POSIX_SPAWN_DUP2, channel.fileno(), sys.stderr.fileno())
    threads = {"OMP_NUM_THREADS": str(asked["threads"])}
    return os.posix_spawn(command[0], command, {**os.environ, **threads}, file_actions=[said])


def _fork_tool(asked: dict, channel: socket.socket, others: list[socket.socket]) -> int:
    """The tool's process."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for other in others:
            other.close()
        os.dup2(channel.fileno(), sys.stderr.fileno())
        channel.close()
        resource.setrlimit(resource.RLIMIT_FSIZE, tuple(asked["file_limits"]))
        import torch  # loaded already

        torch.set_num_threads(asked["threads"])
        code = file_tool.main(asked["arguments"])
    except BaseException:  # a fault of the tool's: told, and no reason for a child to go on as a parent
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _has_ended(process: int, channel: socket.socket) -> bool:
    """Whether the tool is over; then the channel has been told so."""
    found, status = os.waitpid(process, os.WNOHANG)
    if not found:
        return False
    with contextlib.suppress(OSError):  # nobody waits for it any more
        channel.sendall(b"\0%d" % os.waitstatus_to_exitcode(status))
    channel.close()
    return True


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
