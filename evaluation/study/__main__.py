"""Ask people: serve selection items in a browser to annotators who sign in by links of their own.

Everything is kept in the run's study.sqlite; stopped or killed, the same command goes on with it.
`python -m evaluation.study.export run=NAME` writes the votes and says how right they are.
"""

from __future__ import annotations

import logging

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import StudyCommand

log = logging.getLogger(__name__)


@command("evaluation.study", StudyCommand)
def main(cfg: StudyCommand, run: Run) -> None:
    try:
        from evaluation.study import auth, routes, serving, storage
    except ImportError as error:
        raise UserError(
            f"the study's pages need {error.name}: pip install -e '.[study]'"
        ) from error
    from evaluation.study import setup

    path = run.folder / storage.DATABASE
    with serving.listener(cfg.host, cfg.port) as at:
        if storage.begun(path):
            db = storage.open_study(path)
            setup.check_names(cfg, db)
        else:
            db = setup.begin(cfg, path)
        setup.add_media(cfg, db, path)

        links = run.folder / auth.LINKS

        def renew_links() -> dict[str, str]:
            return auth.write_links(db, links, cfg.address)

        # The links are secrets: they go to the screen and to their file, not into the run's log.
        for name, link in renew_links().items():
            print(f"{name}  {link}")
        log.info("a link signs in once; unspent ones are always in %s", links)
        log.info("the study is up; stop it with Ctrl-C, the same command goes on with it")
        serving.serve(routes.make_app(db, cfg.rest_every, cfg.public, renew_links), at)


if __name__ == "__main__":
    main()
