"""Draw contact sheets of a benchmark's items and queries, and a page that contains all of them."""

from __future__ import annotations

import logging
from pathlib import Path

from tqdm import tqdm

from dynapix.conf.entry import Run, command
from dynapix.conf.files import write_bytes, write_text
from dynapix.conf.schema import GalleryCommand

log = logging.getLogger(__name__)


@command("data.gallery", GalleryCommand)
def main(cfg: GalleryCommand, run: Run) -> dict[str, float]:
    from dynapix.data.build import ensure_benchmark
    from dynapix.data.publish.gallery import draw_sheets, render_page

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    sheets = []
    for sheet in tqdm(draw_sheets(store, cfg.examples, cfg.seed), desc="drawing", unit="sheet"):
        write_bytes(run.folder / sheet.file, sheet.png)
        sheets.append(sheet)
    page = run.folder / "index.html"
    write_text(page, render_page(store, sheets))
    log.info("%d sheets: open %s", len(sheets), page)
    return {"sheets": float(len(sheets))}


if __name__ == "__main__":
    main()
