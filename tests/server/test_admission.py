"""The queue before everything heavy: how much at once, whose turn, and who is told to come back."""

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor

import pytest
from conftest import Service
from painter import Painter
from test_rest import is_problem
from test_stream import material, talk

from drgs_server.api.problems import ProblemError
from drgs_server.live.admission import Admission, Caller, Kind
from drgs_server.settings import Limits
from tests.patience import PATIENCE_SECONDS

MIB = 1 << 20


class Work:
    """Requests that hold their places until they are let go; `begun` lists them in the order of their turns."""

    def __init__(self, **limits: int) -> None:
        self.admission = Admission(Limits(**limits))  # type: ignore[arg-type]
        self.begun: list[str] = []
        self._ends: dict[str, asyncio.Event] = {}
        self._tasks: dict[str, asyncio.Task] = {}

    async def ask(self, name: str, kind: Kind, caller: Caller, bytes: int = 0) -> None:
        self._ends[name] = asyncio.Event()
        self._tasks[name] = asyncio.create_task(self._hold(name, kind, caller, bytes))
        await settle()

    async def _hold(self, name: str, kind: Kind, caller: Caller, bytes: int) -> None:
        async with self.admission.place(kind, caller, bytes):
            self.begun.append(name)
            await self._ends[name].wait()

    async def end(self, name: str) -> None:
        self._ends[name].set()
        await settle()

    async def leave(self, name: str) -> None:
        self._tasks[name].cancel()
        await settle()

    async def result(self, name: str) -> None:
        await self._tasks[name]


async def settle() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


def run(test: Coroutine) -> None:
    asyncio.run(test)


def test_no_more_run_at_once_than_the_number_of_their_kind() -> None:
    async def test() -> None:
        work = Work(pictures_at_once=2)
        for name in "abc":
            await work.ask(name, "picture", ("here",))
        await work.ask("tool", "file", ("here",))
        assert work.begun == ["a", "b", "tool"], "another kind has places of its own"
        await work.end("a")
        assert work.begun[-1] == "c" and work.admission.running("picture") == 2 and work.admission.waiting() == 0

    run(test())


def test_memory_is_shared_by_all_kinds_and_large_things_are_not_passed_by_small_ones() -> None:
    async def test() -> None:
        work = Work(heavy_bytes=100 * MIB, pictures_at_once=4, file_tools_at_once=4)
        await work.ask("a", "picture", ("one",), 60 * MIB)
        await work.ask("large", "file", ("two",), 90 * MIB)
        await work.ask("small", "picture", ("three",), 10 * MIB)
        await work.ask("pose", "pose", ("three",))
        assert work.begun == ["a", "pose"], "small would fit, but large came first; what needs no memory passes"
        await work.end("a")
        assert work.begun == ["a", "pose", "large", "small"]

    run(test())


def test_what_needs_more_than_there_is_runs_alone() -> None:
    async def test() -> None:
        work = Work(heavy_bytes=10 * MIB, pictures_at_once=4)
        await work.ask("giant", "picture", ("one",), 1000 * MIB)
        await work.ask("b", "picture", ("one",), MIB)
        assert work.begun == ["giant"]
        await work.end("giant")
        assert work.begun == ["giant", "b"]

    run(test())


def test_turns_are_fair_between_addresses_and_then_between_sessions() -> None:
    async def test() -> None:
        work = Work(pictures_at_once=1)
        await work.ask("first", "picture", ("greedy", "s1"))
        for k in range(3):
            await work.ask(f"greedy{k}", "picture", ("greedy", "s1"))
        await work.ask("greedy-other", "picture", ("greedy", "s2"))
        for k in range(2):
            await work.ask(f"modest{k}", "picture", ("modest", "s3"))
        for name in ("first", "modest0", "greedy-other", "modest1", "greedy0", "greedy1"):
            await work.end(name)
        assert work.begun == ["first", "modest0", "greedy-other", "modest1", "greedy0", "greedy1", "greedy2"]

    run(test())


def test_who_leaves_while_waiting_gives_up_the_turn_and_holds_nothing() -> None:
    async def test() -> None:
        work = Work(pictures_at_once=1)
        for name in "abc":
            await work.ask(name, "picture", ("here",))
        await work.leave("b")
        await work.end("a")
        assert work.begun == ["a", "c"]
        await work.leave("c")
        assert work.admission.running("picture") == 0 and work.admission.waiting() == 0

    run(test())


def test_who_leaves_in_the_very_moment_of_its_turn_holds_nothing() -> None:
    async def test() -> None:
        work = Work(pictures_at_once=1)
        await work.ask("a", "picture", ("here",))
        await work.ask("b", "picture", ("here",))
        work._ends["a"].set()
        work._tasks["a"].add_done_callback(lambda _: work._tasks["b"].cancel())
        await settle()
        await work.ask("c", "picture", ("here",))
        assert work.begun[-1] == "c"

    run(test())


def test_too_many_are_told_when_to_come_back_and_one_address_cannot_fill_the_queue() -> None:
    async def test() -> None:
        work = Work(pictures_at_once=1, waiting=3, waiting_of_one=2)
        for k in range(3):
            await work.ask(f"g{k}", "picture", ("greedy",))
        await work.ask("g3", "picture", ("greedy",))
        with pytest.raises(ProblemError) as refused:
            await work.result("g3")
        assert refused.value.status == 429 and refused.value.retry_after is not None and refused.value.retry_after >= 1
        await work.ask("m0", "picture", ("modest",))
        await work.ask("m1", "picture", ("modest",))
        with pytest.raises(ProblemError):
            await work.result("m1")
        for name in ("g0", "m0"):
            await work.end(name)
        assert work.begun == ["g0", "m0", "g1"]

    run(test())


def test_a_place_becomes_one_of_another_kind_and_frees_the_first_while_it_waits() -> None:
    async def test() -> None:
        admission = Admission(Limits(poses_at_once=1, simulations_at_once=1))
        async with admission.place("simulation", ("one",)), admission.place("pose", ("two",)) as place:
            becoming = asyncio.create_task(place.become("simulation"))
            await settle()
            assert admission.running("pose") == 0 and admission.waiting() == 1
            becoming.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await becoming
        assert admission.running("simulation") == 0 and admission.waiting() == 0

    run(test())


# ---- over HTTP -----------------------------------------------------------------------------------------------------------


async def ask(service: Service, path: str, leave_when: Callable[[], bool] | None = None) -> tuple[int, dict[str, str]]:
    """Status and headers of a GET whose caller may leave; 0 where nothing was answered."""
    started: list[dict] = []
    left = asyncio.Event()

    async def receive() -> dict:
        await left.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict) -> None:
        if message["type"] == "http.response.start":
            started.append(message)

    path, _, query = path.partition("?")
    headers = [(b"host", b"127.0.0.1:8000"), (b"authorization", f"Bearer {service.token}".encode())]
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query.encode(), "headers": headers, "client": ("127.0.0.1", 5)}
    call = asyncio.create_task(service.app({**scope, "http_version": "1.1", "scheme": "http", "root_path": ""}, receive, send))
    if leave_when is not None:
        while not leave_when():
            await asyncio.sleep(0.01)
        left.set()
    await asyncio.wait_for(call, PATIENCE_SECONDS)
    found = started[0] if started else {"status": 0, "headers": []}
    return found["status"], {name.decode(): value.decode() for name, value in found["headers"]}


@pytest.mark.slow
def test_a_picture_is_given_up_when_its_caller_has_left(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/frame.png?width=16&height=16&spp=65535"
    service.painter.pass_seconds = 0.01
    status, _ = asyncio.run(ask(service, url, leave_when=lambda: service.painter.slices > 2))
    assert status == 499
    slices = service.painter.slices
    assert slices < 1000
    assert service.client.get("/api/assets").status_code == 200
    assert service.painter.slices <= slices + 1 and service.context.admission.running("picture") == 0


def test_pictures_beyond_the_queue_are_told_to_come_back(tmp_path) -> None:
    service = Service(tmp_path, Painter(pass_seconds=0.02), limits={"pictures_at_once": 1, "waiting": 2, "waiting_of_one": 2})
    with service.client:
        url = f"/api/sessions/{service.open_session()}/frame.png?width=16&height=16&spp=16"

        async def all_at_once() -> list[tuple[int, dict[str, str]]]:
            return await asyncio.gather(*(ask(service, url) for _ in range(5)))

        answers = asyncio.run(all_at_once())
    assert sorted(status for status, _ in answers) == [200, 200, 200, 429, 429]
    assert all(int(headers["retry-after"]) >= 1 for status, headers in answers if status == 429)


SIMULATE = {"op": "simulate", "scene": {"matter": {"preset": "jelly"}}, "time": 1.0}


def test_simulations_make_room_for_other_sessions_edits_and_can_be_given_up(service: Service) -> None:
    service.painter.simulation_seconds = PATIENCE_SECONDS
    urls = [f"/api/sessions/{service.open_session()}"]
    urls += [f"/api/sessions/{service.client.post('/api/sessions', json={'asset': 'a' * 32}).json()['id']}" for _ in range(5)]
    admission = service.context.admission
    with ThreadPoolExecutor(4) as pool:
        simulating = [pool.submit(service.client.post, f"{url}/edits", json={"edit": SIMULATE}) for url in urls[:4]]
        start = time.monotonic()
        while admission.running("simulation") + admission.waiting() < 4:
            assert time.monotonic() - start < PATIENCE_SECONDS
            time.sleep(0.02)
        assert admission.running("simulation") == 2 and admission.running("pose") == 0
        for url in urls[4:]:
            assert service.client.post(f"{url}/edits", json={"edit": material(0.5)}).json()["revision"] == 1
        for url in urls:
            assert service.client.post(f"{url}/cancel").status_code == 204
        for answer in simulating:
            assert "was cancelled" in is_problem(answer.result(PATIENCE_SECONDS), 409)
    assert admission.running("simulation") == admission.waiting() == 0
    assert [service.client.get(url).json()["revision"] for url in urls] == [0, 0, 0, 0, 1, 1]


def test_a_stream_gives_up_the_change_that_is_computed(service: Service) -> None:
    service.painter.simulation_seconds = PATIENCE_SECONDS
    with talk(service, service.open_session()) as client:
        client.send(type="edit", id=1, edit=SIMULATE)
        client.send(type="edit", id=2, edit=material(0.5))
        time.sleep(0.05)
        client.send(type="cancel")
        assert client.text("rejected")["id"] == 1
        assert client.text("accepted") == {"type": "accepted", "id": 2, "revision": 1}
