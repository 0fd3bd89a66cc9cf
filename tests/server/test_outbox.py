"""What waits for a client that reads slowly, or not at all: little, and in order."""

import asyncio

from drgs_server.live.outbox import MOST_MESSAGES, Outbox


def taken(outbox: Outbox, count: int) -> list[tuple[str, str | bytes]]:
    async def take() -> list[tuple[str, str | bytes]]:
        return [await outbox.take() for _ in range(count)]

    return asyncio.run(take())


def test_messages_leave_in_the_order_in_which_they_came() -> None:
    outbox = Outbox(100)
    outbox.put("answer")
    outbox.put(b"picture")
    outbox.put_change("change")
    assert taken(outbox, 3) == [("text", "answer"), ("picture", b"picture"), ("change", "change")] and outbox.waiting_bytes == 0


def test_changes_beyond_half_of_the_room_give_way_to_one_whole_log() -> None:
    outbox = Outbox(100)
    outbox.put("first")
    for k in range(1000):
        outbox.put_change(f"change {k:03}")
        assert outbox.waiting_bytes <= 50
    outbox.put("last")
    assert [message for _, message in taken(outbox, 3)] == ["first", "", "last"]
    assert not outbox.overrun.is_set()


def test_a_whole_log_waits_once_and_holds_no_bytes() -> None:
    outbox = Outbox(100)
    for _ in range(1000):
        outbox.put_log()
    outbox.put_change("is in the log that waits")
    outbox.put("answer")
    assert taken(outbox, 2) == [("log", ""), ("text", "answer")]


def test_pictures_are_not_counted_since_acknowledgements_bound_them() -> None:
    outbox = Outbox(100)
    outbox.put(b"x" * 1000)
    assert outbox.waiting_bytes == 0 and not outbox.overrun.is_set()


def test_too_many_bytes_or_messages_end_it_and_nothing_is_kept() -> None:
    by_bytes, by_number = Outbox(100), Outbox(1 << 20)
    by_bytes.put("x" * 101)
    for _ in range(MOST_MESSAGES + 1):
        by_number.put("")
    for outbox in (by_bytes, by_number):
        assert outbox.overrun.is_set() and outbox.waiting_bytes == 0
        outbox.put("more")
        assert outbox.waiting_bytes == 0
