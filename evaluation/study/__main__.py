"""Run a human study: annotators open personal links and answer selection items in a browser.

The run's study.sqlite has all data. After a stop or a kill, the same command resumes the study.
`python -m evaluation.study.export run=NAME` exports the votes with their accuracy and agreement.
"""

from __future__ import annotations

import logging

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.schema import StudyCommand

log = logging.getLogger(__name__)


@command("evaluation.study", StudyCommand)
def main(cfg: StudyCommand, run: Run) -> None:
    try:
        from dynapix.evaluation.study import routes, storage
    except ImportError as error:
        raise UserError(
            f"the study's pages need {error.name}: pip install -e '.[study]'",
            code="missing-package",
        ) from error
    from dynapix.evaluation.study import setup

    path, links = run.folder / storage.DATABASE, run.folder / storage.LINKS_FILE
    with routes.listen(cfg.host, cfg.port) as listener:
        if not path.exists():
            setup.create_study(cfg, path)
        db = storage.open_study(path)
        # Links are secrets: they go to the screen and to their file, not into the run's log.
        for name, link in storage.write_links(db, links, cfg.address).items():
            print(f"{name}  {link}")
        log.info("the links of the annotators are in %s", links)
        log.info("the study is running; stop it with Ctrl-C, resume it with the same command")
        routes.serve(routes.build_app(db, cfg), listener)


if __name__ == "__main__":
    main()
