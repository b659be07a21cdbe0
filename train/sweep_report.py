"""Draw a sweep's table and plot again, from the folder that the sweep left."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from conf.errors import UserError
from conf.multirun.summary import write_sweep_table


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m train.sweep_report", description=__doc__)
    parser.add_argument(
        "folder",
        metavar="DIR",
        type=Path,
        help="a sweep of any command, such as checkpoints/sft/sweep-lr_rank; its sweep.txt, "
        "sweep.csv and sweep.png are written anew",
    )
    try:
        print(write_sweep_table(parser.parse_args().folder))
    except UserError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: {error.filename}: {error.strerror}")


if __name__ == "__main__":
    main()
