"""How the snakemake command answers TERM and INT."""

import queue
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any


def answer_term_aside(scheduler: Any) -> None:
    """Have a thread of its own run what Snakemake (9.27) does on TERM: it submits nothing more.

    Its handler waits for a lock of the scheduler and for one of a semaphore, in the main thread, which
    holds them itself while it deals with jobs that have ended, and would then wait for ever. Nothing is
    changed where another handler is installed, as where the scheduler is not run by the main thread.

    Parameters
    ----------
    scheduler : Snakemake's, before it starts jobs.
    """
    submit_no_more = getattr(scheduler, "exit_gracefully", None)
    if submit_no_more is None or signal.getsignal(signal.SIGTERM) != submit_no_more:
        return
    # unlike other queues, one that a signal handler may put to while the same thread does
    asked: queue.SimpleQueue[int] = queue.SimpleQueue()

    def answer() -> None:
        asked.get()
        submit_no_more()

    threading.Thread(target=answer, name="answer TERM", daemon=True).start()
    signal.signal(signal.SIGTERM, lambda number, _: asked.put(number))


def answer_interrupt(note: Callable[[], None]) -> None:
    """Have the user's interrupt, as by Ctrl-C, noted before it ends this process's work.

    Nothing is changed where another handler is installed, or interrupts are ignored, as in the background.

    Parameters
    ----------
    note : called in the signal handler, so it takes no lock.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        note()
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
