"""Export the votes of a study with their accuracy and agreement. The study may be running."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.conf.runs import resolve_run_name
from dynapix.conf.schema import ExportStudyCommand

log = logging.getLogger(__name__)

VOTES_FILE = "votes.jsonl"


@command("evaluation.study.export", ExportStudyCommand)
def main(cfg: ExportStudyCommand, run: Run) -> dict[str, float]:
    from dynapix.evaluation.reporting.tables import human_table
    from dynapix.evaluation.study import storage
    from dynapix.evaluation.study.agreement import summarize_votes

    studies = Path(cfg.checkpoints) / "study"
    path = studies / resolve_run_name(cfg.run, str(studies)) / storage.DATABASE
    db = storage.open_study(path)
    with storage.transaction(db, read_only=True):
        votes = storage.read_votes(db)
        about = dict(tuple(row) for row in db.execute("SELECT key, value FROM about"))
        [(items,)] = db.execute("SELECT count(*) FROM item")
        annotators = [name for (name,) in db.execute("SELECT name FROM annotator ORDER BY rowid")]
    if votes.empty:
        raise UserError(f"{path} has no votes yet", code="no-votes")
    benchmark = about["benchmark"], about["identity"]
    report = summarize_votes(votes, items, annotators, *benchmark, cfg.seed)
    rows = votes.to_json(orient="records", lines=True, double_precision=15)
    write_text(run.folder / VOTES_FILE, rows)
    write_text(run.folder / "report.json", json.dumps(asdict(report), indent=1))
    table = human_table(report)
    write_text(run.folder / "report.txt", f"{table}\n")
    log.info("%s\n\nvotes: %s", table, run.folder / VOTES_FILE)
    majority = report.majority
    families = {f"majority_{f}": share.value for f, share in majority.families.items()}
    return {**families, "majority_macro": majority.macro.value}


if __name__ == "__main__":
    main()
