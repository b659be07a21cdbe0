"""Export a study's votes, its server running or not, and say how right and how agreed they are."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import resolve_run_name, write_text
from conf.schema import ExportStudyCommand

log = logging.getLogger(__name__)

VOTES = "votes.jsonl"


@command("evaluation.study.export", ExportStudyCommand)
def main(cfg: ExportStudyCommand, run: Run) -> dict[str, float]:
    from evaluation.reporting.tables import human_table
    from evaluation.study import storage
    from evaluation.study.agreement import summary
    from evaluation.study.votes import votes_of

    runs = Path(cfg.checkpoints) / "study"
    path = runs / resolve_run_name(cfg.run, str(runs)) / storage.DATABASE
    if not storage.begun(path):
        raise UserError(f"{path} is not there: begin a study with python -m evaluation.study")
    db = storage.open_study(path)
    with storage.transaction(db, reads=True):
        votes = list(votes_of(db))
        about, items = storage.about(db), len(storage.item_ids(db, practice=False))
        annotators = storage.annotators(db)
    if not votes:
        raise UserError(f"{path} holds no votes yet")
    of = {"benchmark": about["benchmark"], "build": about["identity"]}
    found = of | summary(votes, items, annotators)
    write_text(run.folder / VOTES, "".join(json.dumps(v.to_row()) + "\n" for v in votes))
    write_text(run.folder / "report.json", json.dumps(found, indent=1))
    table = human_table(found)
    write_text(run.folder / "report.txt", f"{table}\n")
    log.info("%s\n\nvotes: %s", table, run.folder / VOTES)
    families = {f"majority_{f}": i["value"] for f, i in found["majority"]["families"].items()}
    return {**families, "majority_macro": found["majority"]["macro"]}


if __name__ == "__main__":
    main()
