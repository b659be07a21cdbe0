"""Narrates a benchmark in memory with a server. Arguments: a folder, the number of items, a URL."""

import sys
from pathlib import Path

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.narrate import narrate_store
from tests.teacher.memory_store import make_store

if __name__ == "__main__":
    folder, count, url = sys.argv[1:]
    # All responses of a random model are rejected; with one attempt, each item gets one response.
    cfg = TeacherConfig(
        name="tiny", url=url, model="tiny", attempts=1, max_tokens=16, concurrency=32
    )
    narrate_store(make_store(Path(folder), int(count)), cfg)
