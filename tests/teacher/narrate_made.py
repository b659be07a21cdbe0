"""Narrates a benchmark in memory: `python narrate_made.py FOLDER COUNT URL`, to be killed."""

import sys
from pathlib import Path

from conf.schema import TeacherConfig
from teacher.narrate import narrate_store
from tests.teacher.made import made_store

if __name__ == "__main__":
    folder, count, url = sys.argv[1:]
    # A random model's answers are all rejected, so that one attempt is an item's whole story.
    cfg = TeacherConfig(
        name="tiny", url=url, model="tiny", attempts=1, max_tokens=16, concurrency=32
    )
    narrate_store(made_store(Path(folder), int(count)), cfg)
